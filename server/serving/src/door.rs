//! The door: who calls is found out once a call, what the call needs is looked up, and its deadline is kept.
//!
//! Invariants: no part of a service sees a request before its caller is known and may make it; the secret goes no further
//! than this; an answer that a deadline cuts off gives back what it holds before the caller hears of it; a caller who goes
//! in the middle of its request has cancelled its call, whatever the service makes of what came.

use crate::{
    caller::Caller,
    config::{DoorConfig, DoorError},
    keyring::Keyring,
    rules::{Need, Rule, Rules, common},
    telemetry::{
        Life, Telemetry,
        calls::{Calls, Observed},
    },
    watch::{Call, Fate, Standing, Visit, Watch},
};
use bytes::Bytes;
use http::{HeaderMap, Request, Response, header::AUTHORIZATION};
use http_body::{Body as _, Frame, SizeHint};
use hyper::body::Incoming;
use std::{
    convert::Infallible,
    pin::Pin,
    sync::Arc,
    task::{Context, Poll},
    time::{Duration, SystemTime},
};
use tokio::time::{Instant, Sleep, sleep_until, timeout_at};
use tokio_util::sync::WaitForCancellationFutureOwned;
use tonic::{Status, body::Body, service::Routes};
use tower::ServiceExt as _;
use tracing::Instrument as _;

/// Bytes of an answer that the transport is given at a time: it counts a stream that it was given everything of as done.
const SLICE_BYTES: usize = 64 << 10;
/// Longest deadline that `grpc-timeout` can ask for and a timer can count: far beyond any call.
const FAR: Duration = Duration::from_hours(24 * 365);

/// Lets callers in.
#[derive(Debug)]
pub struct Door {
    keyring: Option<Keyring>,
    /// Whether callers are known by their certificates where there are no tokens.
    mutual: bool,
    rules: Rules,
    open_reflection: bool,
    call_deadline: Duration,
    max_call_deadline: Duration,
    /// Who and what is inside.
    pub watch: Arc<Watch>,
    calls: Calls,
    life: Arc<Life>,
}

impl Drop for Door {
    fn drop(&mut self) {
        // Whoever is inside holds it.
        self.life.ended();
    }
}

impl Door {
    /// A door by its settings, for a service with these rules.
    ///
    /// # Errors
    /// The file of tokens does not serve.
    pub fn new(config: &DoorConfig, rules: Rules, telemetry: &Telemetry) -> Result<Self, DoorError> {
        let keyring = config.keyring()?;
        telemetry.calls.serve(rules);
        telemetry.life.asks(config);
        Ok(Self {
            keyring,
            mutual: config.tls_client_ca.is_some(),
            rules,
            open_reflection: config.open_reflection,
            call_deadline: config.call_deadline,
            max_call_deadline: config.max_call_deadline,
            watch: Watch::new(config),
            calls: telemetry.calls.clone(),
            life: Arc::clone(&telemetry.life),
        })
    }

    /// Looks after what is inside, and at the file of tokens, for as long as it is polled.
    pub async fn guard(&self) {
        loop {
            tokio::time::sleep(self.watch.pause()).await;
            if let Some(keyring) = &self.keyring {
                keyring.refresh();
            }
            self.watch.look();
        }
    }

    /// Who calls.
    fn caller(&self, headers: &HeaderMap, visit: &Visit) -> Result<Caller, Status> {
        let Some(keyring) = &self.keyring else {
            return match visit.certified() {
                Some(caller) => Ok(caller.clone()),
                // The handshake would not have come to its end.
                None if self.mutual => Err(Status::unauthenticated("expected a client certificate, got none")),
                None => Ok(Caller::anybody()),
            };
        };
        let mut shown = headers.get_all(AUTHORIZATION).iter();
        let (Some(shown), None) = (shown.next(), shown.next()) else {
            return Err(Status::unauthenticated("expected metadata 'authorization: Bearer TOKEN', once"));
        };
        let shown = shown.as_bytes();
        let secret = match shown.split_first_chunk::<7>() {
            Some((scheme, secret)) if scheme.eq_ignore_ascii_case(b"bearer ") => secret,
            _ => return Err(Status::unauthenticated("expected metadata 'authorization: Bearer TOKEN'")),
        };
        // An expired token is as unknown as any other: who does not hold it learns nothing.
        let grant = keyring.find(secret).filter(|grant| grant.holds(SystemTime::now()));
        grant.map(Caller::from).ok_or_else(|| Status::unauthenticated("the token is unknown, revoked or expired"))
    }

    fn admit(&self, rule: Rule, path: &str, headers: &HeaderMap, visit: &Visit) -> Result<Caller, Status> {
        if rule.need == Need::Nothing {
            return Ok(Caller::anybody());
        }
        let caller = self.caller(headers, visit)?;
        match rule.need {
            Need::Scope(scopes) if !scopes.iter().any(|scope| caller.may(*scope)) => {
                let names: Vec<_> = scopes.iter().map(|scope| scope.name()).collect();
                let (name, method) = (caller.name(), path.rsplit('/').next().unwrap_or_default());
                let method: String = method.chars().take(64).collect();
                let message = format!("{method} needs the scope {}, which token {name:?} has not", names.join(" or "));
                Err(Status::permission_denied(message))
            }
            _ => Ok(caller),
        }
    }

    fn rule(&self, path: &str) -> Rule {
        common(path, self.open_reflection).unwrap_or_else(|| (self.rules)(path))
    }
}

/// Passes the calls of one connection on to a service.
#[derive(Debug, Clone)]
pub struct Entrance {
    door: Arc<Door>,
    visit: Arc<Visit>,
    routes: Routes,
}

impl Entrance {
    /// For the calls of `visit`.
    pub fn new(door: Arc<Door>, visit: Arc<Visit>, routes: Routes) -> Self {
        Self { door, visit, routes }
    }

    fn enter(&self, request: &mut Request<Incoming>) -> Result<Entered, Status> {
        if self.visit.holds_too_much() {
            return Err(Status::resource_exhausted(
                "expected the answers of this connection to be read before further calls",
            ));
        }
        let rule = self.door.rule(request.uri().path());
        let open = rule.need == Need::Nothing;
        if open && self.visit.has_enough_open_calls() {
            return Err(Status::resource_exhausted(
                "expected calls that need no token to end before there are more on this connection",
            ));
        }
        let caller = self.door.admit(rule, request.uri().path(), request.headers(), &self.visit)?;
        request.headers_mut().remove(AUTHORIZATION);
        let asked = asked_time(request.headers())?;
        let allowed = match (rule.streams, asked) {
            (true, asked) => asked,
            (false, None) => Some(self.door.call_deadline.min(self.door.max_call_deadline)),
            (false, Some(asked)) => Some(asked.min(self.door.max_call_deadline)),
        };
        let deadline = allowed.map(|allowed| Instant::now() + allowed.min(FAR));
        Ok(Entered { caller, deadline, streams: rule.streams, open })
    }
}

/// How a call was let in.
struct Entered {
    caller: Caller,
    deadline: Option<Instant>,
    streams: bool,
    /// It needs nothing.
    open: bool,
}

impl hyper::service::Service<Request<Incoming>> for Entrance {
    type Response = Response<Observed<Answer>>;
    type Error = Infallible;
    type Future = Pin<Box<dyn Future<Output = Result<Response<Observed<Answer>>, Infallible>> + Send>>;

    fn call(&self, mut request: Request<Incoming>) -> Self::Future {
        let observed = self.door.calls.begin(&request);
        let entered = self.enter(&mut request);
        let (caller, standing) = match &entered {
            Ok(Entered { open: true, .. }) => (Caller::anybody(), Standing::Open),
            Ok(Entered { caller, .. }) => (caller.clone(), Standing::Admitted),
            Err(_) => (Caller::anybody(), Standing::Refused),
        };
        let call = self.visit.call(caller, standing, observed.span().clone());
        let Entered { caller, deadline, streams, open } = match entered {
            Ok(entered) => entered,
            Err(status) => {
                let response = status.into_http::<Body>().map(|body| Answer::new(body, call, None));
                return Box::pin(std::future::ready(Ok(observed.answer(response))));
            }
        };
        observed.by(&caller);
        request.extensions_mut().insert(caller);
        let request = request.map(|body| Body::new(Asked { body, fate: Arc::clone(call.fate()) }));
        let answering = self.routes.clone().oneshot(request).instrument(observed.span().clone());
        let leave = open.then(|| self.visit.leave().clone());
        Box::pin(async move {
            let in_time = async {
                match deadline {
                    None => answering.await,
                    Some(deadline) => match timeout_at(deadline, answering).await {
                        Ok(response) => response,
                        Err(_) => Ok(too_late().into_http()),
                    },
                }
            };
            let mut response = match &leave {
                None => in_time.await?,
                Some(leave) => tokio::select! {
                    biased;
                    response = in_time => response?,
                    () = leave.cancelled() => closing().into_http(),
                },
            };
            if call.fate().is_gone() && response.headers().contains_key("grpc-status") {
                response = gone().into_http();
            }
            Ok(observed.answer(response.map(|body| {
                let mut answer = Answer::new(body, call, deadline.filter(|_| streams));
                answer.leave = leave.map(|leave| Box::pin(leave.cancelled_owned()));
                answer
            })))
        })
    }
}

/// The body of a request; notes that its sender has gone before its end.
struct Asked {
    body: Incoming,
    fate: Arc<Fate>,
}

impl http_body::Body for Asked {
    type Data = Bytes;
    type Error = hyper::Error;

    fn poll_frame(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, hyper::Error>>> {
        let polled = Pin::new(&mut self.body).poll_frame(cx);
        if let Poll::Ready(Some(Err(_))) = &polled {
            self.fate.goes();
        }
        polled
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

fn gone() -> Status {
    Status::cancelled("the caller has gone in the middle of its request")
}

fn closing() -> Status {
    Status::unavailable("this connection is closing; ask again on another")
}

fn too_late() -> Status {
    Status::deadline_exceeded("the deadline of the call has passed")
}

/// The time that a caller gives a call. gRPC: at most eight digits and a unit.
fn asked_time(headers: &HeaderMap) -> Result<Option<Duration>, Status> {
    let Some(value) = headers.get("grpc-timeout") else { return Ok(None) };
    let read = || {
        let (unit, digits) = value.as_bytes().split_last()?;
        if !(1..=8).contains(&digits.len()) || !digits.iter().all(u8::is_ascii_digit) {
            return None;
        }
        let number = std::str::from_utf8(digits).ok()?.parse::<u64>().ok()?;
        Some(match unit {
            b'H' => Duration::from_secs(number * 3600),
            b'M' => Duration::from_secs(number * 60),
            b'S' => Duration::from_secs(number),
            b'm' => Duration::from_millis(number),
            b'u' => Duration::from_micros(number),
            b'n' => Duration::from_nanos(number),
            _ => return None,
        })
    };
    read()
        .map(Some)
        .ok_or_else(|| Status::invalid_argument("grpc-timeout: expected 1 to 8 digits and one of H M S m u n"))
}

/// An answer on its way, watched over.
#[derive(Debug)]
pub struct Answer {
    body: Body,
    /// What is still to be given of a large frame.
    rest: Bytes,
    call: Arc<Call>,
    deadline: Option<Pin<Box<Sleep>>>,
    /// For a call that needs nothing: its connection is told to go, and it ends before.
    leave: Option<Pin<Box<WaitForCancellationFutureOwned>>>,
}

impl Answer {
    fn new(body: Body, call: Arc<Call>, deadline: Option<Instant>) -> Self {
        if body.is_end_stream() {
            call.completes();
        }
        let deadline = deadline.map(|deadline| Box::pin(sleep_until(deadline)));
        Self { body, rest: Bytes::new(), call, deadline, leave: None }
    }
}

impl http_body::Body for Answer {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        let this = self.get_mut();
        if let Some(deadline) = &mut this.deadline
            && deadline.as_mut().poll(cx).is_ready()
        {
            return Poll::Ready(Some(this.cut(&too_late())));
        }
        if !this.rest.is_empty() {
            let rest = std::mem::take(&mut this.rest);
            return Poll::Ready(Some(Ok(this.slice(rest))));
        }
        let polled = Pin::new(&mut this.body).poll_frame(cx);
        match polled {
            Poll::Pending => {
                // What it had to say comes first.
                if let Some(leave) = &mut this.leave
                    && leave.as_mut().poll(cx).is_ready()
                {
                    return Poll::Ready(Some(this.cut(&closing())));
                }
                this.call.waits();
            }
            Poll::Ready(Some(Ok(frame))) if frame.is_data() => {
                this.call.took();
                return Poll::Ready(Some(match frame.into_data() {
                    Ok(bytes) if bytes.len() > SLICE_BYTES => {
                        this.call.visit().holds(bytes.len());
                        Ok(this.slice(bytes))
                    }
                    Ok(bytes) => Ok(Frame::data(bytes)),
                    Err(frame) => Ok(frame),
                }));
            }
            Poll::Ready(Some(_)) if this.call.fate().is_gone() => return Poll::Ready(Some(this.cut(&gone()))),
            Poll::Ready(_) => this.call.completes(),
        }
        polled
    }

    fn is_end_stream(&self) -> bool {
        self.rest.is_empty() && self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        // Of the body alone: without the rest it would be wrong.
        if self.rest.is_empty() { self.body.size_hint() } else { SizeHint::default() }
    }
}

impl Answer {
    /// The beginning of what is left, which the connection holds until then.
    fn slice(&mut self, mut bytes: Bytes) -> Frame<Bytes> {
        self.call.took();
        let slice = bytes.split_to(bytes.len().min(SLICE_BYTES));
        self.call.visit().gives(slice.len());
        self.rest = bytes;
        Frame::data(slice)
    }

    /// Ends it with a status, whatever there still was.
    fn cut(&mut self, status: &Status) -> Result<Frame<Bytes>, Status> {
        self.body = Body::empty();
        self.forget();
        (self.deadline, self.leave) = (None, None);
        self.call.completes();
        let mut trailers = HeaderMap::with_capacity(2);
        status.add_header(&mut trailers).map(|()| Frame::trailers(trailers))
    }

    /// Forgets what is left.
    fn forget(&mut self) {
        self.call.visit().gives(std::mem::take(&mut self.rest).len());
    }
}

impl Drop for Answer {
    fn drop(&mut self) {
        self.forget();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_read_as_grpc_writes_them() {
        let read = |text: &str| {
            let mut headers = HeaderMap::new();
            headers.insert("grpc-timeout", text.parse().expect("a value"));
            asked_time(&headers)
        };
        assert_eq!(read("2H").expect("reads"), Some(Duration::from_hours(2)));
        assert_eq!(read("99999999n").expect("reads"), Some(Duration::from_nanos(99_999_999)));
        assert_eq!(asked_time(&HeaderMap::new()).expect("none"), None);
        for wrong in ["", "S", "5", "-1S", "1.5S", "999999999S", "5s"] {
            assert!(read(wrong).is_err(), "{wrong}");
        }
    }
}
