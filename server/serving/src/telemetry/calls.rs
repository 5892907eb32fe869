//! Every call, seen from the edge of the service: counted by method and code, timed, named and traced.
//!
//! The name of a call, its request id, goes into its span, into the metadata of its answer and into the details of its error. A
//! call lasts until the last byte of its answer is handed on, or its caller has gone, which counts as CANCELLED.
//!
//! Invariants: a message that passes costs no more than a look at whether it is the last; labels and names of spans come
//! from the methods that are served, never from a client. What the transport's decoder blames on the service although the
//! request was none is blamed on the caller here.

use super::{
    Telemetry,
    methods::{Methods, OTHER},
    numbers::{Counter, Times},
    request_id,
};
use crate::{caller::Caller, rules::Rules};
use bytes::Bytes;
use http::{HeaderMap, HeaderValue, Request, Response};
use http_body::{Body as HttpBody, Frame, SizeHint};
use opentelemetry::propagation::{Extractor, TextMapPropagator as _};
use opentelemetry_sdk::propagation::TraceContextPropagator;
use prometheus_client::{
    encoding::{EncodeLabelSet, EncodeLabelValue},
    metrics::family::{Family, MetricConstructor},
};
use std::{
    pin::Pin,
    sync::{Arc, OnceLock},
    task::{Context, Poll},
    time::Instant,
};
use tonic::{Code, Status};
use tonic_types::{ErrorDetails, StatusExt as _};
use tracing::{Span, field};
use tracing_opentelemetry::OpenTelemetrySpanExt as _;

/// A method of a service.
#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct MethodLabel {
    method: Arc<str>,
}

/// How a call of a method ended.
#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct EndLabel {
    method: Arc<str>,
    code: CodeLabel,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
struct CodeLabel(Code);

impl EncodeLabelValue for CodeLabel {
    fn encode(&self, encoder: &mut prometheus_client::encoding::LabelValueEncoder<'_>) -> std::fmt::Result {
        EncodeLabelValue::encode(&name(self.0), encoder)
    }
}

/// The name of a code as gRPC writes it.
fn name(code: Code) -> &'static str {
    match code {
        Code::Ok => "OK",
        Code::Cancelled => "CANCELLED",
        Code::Unknown => "UNKNOWN",
        Code::InvalidArgument => "INVALID_ARGUMENT",
        Code::DeadlineExceeded => "DEADLINE_EXCEEDED",
        Code::NotFound => "NOT_FOUND",
        Code::AlreadyExists => "ALREADY_EXISTS",
        Code::PermissionDenied => "PERMISSION_DENIED",
        Code::ResourceExhausted => "RESOURCE_EXHAUSTED",
        Code::FailedPrecondition => "FAILED_PRECONDITION",
        Code::Aborted => "ABORTED",
        Code::OutOfRange => "OUT_OF_RANGE",
        Code::Unimplemented => "UNIMPLEMENTED",
        Code::Internal => "INTERNAL",
        Code::Unavailable => "UNAVAILABLE",
        Code::DataLoss => "DATA_LOSS",
        Code::Unauthenticated => "UNAUTHENTICATED",
    }
}

/// Codes that tell of a fault of the service: shown from the start, so that the first of them is seen to come.
const FAULTS: [Code; 3] = [Code::Internal, Code::DataLoss, Code::Unknown];
/// Longest part of a path that is no method's in a span, in bytes.
const MAX_PART_BYTES: usize = 64;
/// What the transport's decoder says, under INTERNAL, of requests that are none.
const UNDECODABLE: [&str; 5] = [
    "failed to decode Protobuf message",
    "protocol error: received message with ",
    "Error decompressing: ",
    "Unexpected EOF decoding stream",
    "Missing request message",
];

#[derive(Debug, Clone, Copy, Default)]
struct OfCalls;

impl MetricConstructor<Times> for OfCalls {
    fn new_metric(&self) -> Times {
        Times::of_calls()
    }
}

/// Calls, counted and timed. Cloning shares it.
#[derive(Debug, Clone)]
pub struct Calls {
    methods: Arc<OnceLock<Methods>>,
    other: Arc<str>,
    ended: Family<EndLabel, Counter>,
    took: Family<MethodLabel, Times, OfCalls>,
    begun: Counter,
    over: Counter,
}

impl Default for Calls {
    fn default() -> Self {
        Self {
            methods: Arc::default(),
            other: OTHER.into(),
            ended: Family::default(),
            took: Family::new_with_constructor(OfCalls),
            begun: Counter::default(),
            over: Counter::default(),
        }
    }
}

impl Calls {
    pub(super) fn register(&self, telemetry: &Telemetry) {
        telemetry.add("calls", "Calls that have ended, by method and code", self.ended.clone());
        telemetry.add("call_seconds", "Time from a call's begin to its end; streams last", self.took.clone());
        let (begun, over) = (self.begun.clone(), self.over.clone());
        telemetry
            .read("calls_open", "Calls and streams under way", move || begun.get().saturating_sub(over.get()) as i64);
    }

    /// Whatever has a rule among these is counted by its name; before this is told, nothing is.
    pub fn serve(&self, rules: Rules) {
        let methods = self.methods.get_or_init(|| Methods::served(rules));
        for method in methods.iter() {
            for code in FAULTS {
                drop(self.ended.get_or_create(&EndLabel { method: Arc::clone(method), code: CodeLabel(code) }));
            }
        }
    }

    /// Takes note of a call that begins.
    pub fn begin<T>(&self, request: &Request<T>) -> Call {
        let request_id = request_id::of(request.headers());
        let asked = request.uri().path();
        let known = self.methods.get().and_then(|methods| methods.of(asked));
        let name = Arc::clone(known.unwrap_or(&self.other));
        let (service, method) = match known.map(|name| name.rsplit_once('/')) {
            Some(parts) => parts.unwrap_or_default(),
            None => asked.rsplit_once('/').map_or(("", asked), |(service, method)| (clipped(service), method)),
        };
        // At the level of errors, so that whatever is logged of a call carries its name.
        let span = tracing::error_span!(
            "call",
            otel.name = &*name,
            otel.kind = "server",
            otel.status_code = field::Empty,
            rpc.system = "grpc",
            rpc.service = service,
            rpc.method = clipped(method),
            rpc.grpc.status_code = field::Empty,
            caller = field::Empty,
            request_id = request_id.to_str().unwrap_or_default(),
        );
        if request.headers().contains_key("traceparent") {
            let parent = TraceContextPropagator::new().extract(&Carrier(request.headers()));
            // Where spans are not exported there is nobody to tell.
            let _ = span.set_parent(parent);
        }
        self.begun.add(1);
        Call { calls: self.clone(), method: name, request_id, span, begun: Instant::now(), ended: false }
    }
}

/// What of a path of anybody's is written down.
fn clipped(part: &str) -> &str {
    &part[..part.floor_char_boundary(MAX_PART_BYTES)]
}

/// A status that blames whom it should: a request that cannot be decoded is the caller's fault.
fn fair(status: Status) -> Status {
    if status.code() == Code::Internal && UNDECODABLE.iter().any(|begin| status.message().starts_with(begin)) {
        return Status::with_metadata(Code::InvalidArgument, status.message(), status.metadata().clone());
    }
    status
}

/// W3C trace context among metadata.
struct Carrier<'a>(&'a HeaderMap);

impl Extractor for Carrier<'_> {
    fn get(&self, key: &str) -> Option<&str> {
        self.0.get(key).and_then(|value| value.to_str().ok())
    }

    fn keys(&self) -> Vec<&str> {
        self.0.keys().map(http::HeaderName::as_str).collect()
    }
}

/// A call under way. Dropped before its end, its caller has gone.
#[derive(Debug)]
pub struct Call {
    calls: Calls,
    method: Arc<str>,
    request_id: HeaderValue,
    span: Span,
    begun: Instant,
    ended: bool,
}

impl Call {
    /// The span that what happens for it belongs to.
    pub fn span(&self) -> &Span {
        &self.span
    }

    /// Who makes it, once that is known.
    pub fn by(&self, caller: &Caller) {
        if !caller.name().is_empty() {
            self.span.record("caller", caller.name());
        }
    }

    /// Names the answer, and follows it to its end.
    pub fn answer<B>(mut self, response: Response<B>) -> Response<Observed<B>> {
        let (mut parts, body) = response.into_parts();
        // An error that came at once has its status here.
        if parts.headers.contains_key("grpc-status") {
            self.end(&mut parts.headers);
        }
        parts.headers.insert(request_id::HEADER, self.request_id.clone());
        Response::from_parts(parts, Observed { body, call: self })
    }

    /// Takes note of the status among the trailers, and names the call there if it failed.
    fn end(&mut self, trailers: &mut HeaderMap) {
        let status = fair(Status::from_header_map(trailers).unwrap_or_else(|| Status::unknown("no status")));
        self.count(status.code());
        if status.code() == Code::Ok {
            return;
        }
        let _entered = self.span.enter();
        match status.code() {
            Code::Internal | Code::DataLoss | Code::Unknown => {
                tracing::error!(message = status.message(), code = name(status.code()), "a call failed");
            }
            code => tracing::debug!(message = status.message(), code = name(code), "a call was refused"),
        }
        let mut details = status.get_error_details();
        details.set_request_info(self.request_id.to_str().unwrap_or_default(), "");
        named(&status, details, trailers);
    }

    fn count(&mut self, code: Code) {
        if std::mem::replace(&mut self.ended, true) {
            return;
        }
        let calls = &self.calls;
        calls.over.add(1);
        let method = Arc::clone(&self.method);
        calls.took.get_or_create(&MethodLabel { method: Arc::clone(&method) }).observe(self.begun.elapsed());
        calls.ended.get_or_create(&EndLabel { method, code: CodeLabel(code) }).add(1);
        self.span.record("rpc.grpc.status_code", code as i32);
        // As OpenTelemetry asks of servers: what the caller did wrong is no error of the service.
        if matches!(
            code,
            Code::Unknown
                | Code::DeadlineExceeded
                | Code::Unimplemented
                | Code::Internal
                | Code::Unavailable
                | Code::DataLoss
        ) {
            self.span.record("otel.status_code", "ERROR");
        }
    }
}

impl Drop for Call {
    fn drop(&mut self) {
        self.count(Code::Cancelled);
    }
}

/// Writes a status with other details over the one that is there.
fn named(status: &Status, details: ErrorDetails, trailers: &mut HeaderMap) {
    let metadata = status.metadata().clone();
    let named = Status::with_error_details_and_metadata(status.code(), status.message(), details, metadata);
    // One that cannot be written leaves the one that is there.
    let mut written = HeaderMap::new();
    if named.add_header(&mut written).is_ok() {
        for (key, value) in written {
            if let Some(key) = key {
                trailers.insert(key, value);
            }
        }
    }
}

/// The body of an answer, followed to its end.
#[derive(Debug)]
pub struct Observed<B> {
    body: B,
    call: Call,
}

impl<B: HttpBody<Data = Bytes, Error = Status> + Unpin> HttpBody for Observed<B> {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        let this = &mut *self;
        let mut polled = Pin::new(&mut this.body).poll_frame(cx);
        if let Poll::Ready(Some(Ok(frame))) = &mut polled
            && let Some(trailers) = frame.trailers_mut()
        {
            this.call.end(trailers);
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        grant::Scope,
        rules::{Need, Rule},
    };
    use prost::Message as _;
    use tonic::body::Body;

    const METHOD: &str = "mazeway.env.v1.EnvironmentService/Step";

    fn request(headers: &[(&'static str, &'static str)]) -> Request<()> {
        let mut request = Request::builder().uri(format!("/{METHOD}"));
        for (key, value) in headers {
            request = request.header(*key, *value);
        }
        request.body(()).expect("a request")
    }

    #[test]
    fn a_failed_call_is_named_in_its_details_and_counted_once() {
        let telemetry = Telemetry::new("test");
        telemetry.calls.serve(|_| Rule::call(Need::Scope(&[Scope::Act])));
        let call = telemetry.calls.begin(&request(&[("x-request-id", "a-1")]));
        let status = Status::with_error_details(Code::NotFound, "nothing", {
            let mut details = ErrorDetails::new();
            details.add_bad_request_violation("id", "no such thing");
            details
        });
        let response = call.answer(status.into_http::<Body>());
        let status = Status::from_header_map(response.headers()).expect("a status");
        let details = status.get_error_details();
        assert_eq!(details.request_info().map(|info| info.request_id.as_str()), Some("a-1"));
        assert_eq!(details.bad_request().map(|bad| bad.field_violations.len()), Some(1), "what was there stays");
        assert_eq!(response.headers()["x-request-id"], "a-1");
        drop(response);
        drop(telemetry.calls.begin(&request(&[])));
        let text = telemetry.text().expect("numbers");
        for line in [
            format!("test_calls_total{{method=\"{METHOD}\",code=\"NOT_FOUND\"}} 1"),
            format!("test_calls_total{{method=\"{METHOD}\",code=\"CANCELLED\"}} 1"),
            format!("test_calls_total{{method=\"{METHOD}\",code=\"INTERNAL\"}} 0"),
            format!("test_call_seconds_count{{method=\"{METHOD}\"}} 2"),
            "test_calls_open 0".into(),
        ] {
            assert!(text.lines().any(|found| found == line), "{line} in\n{text}");
        }
    }

    #[test]
    fn a_path_that_is_no_methods_makes_no_number_however_its_call_ends() {
        let telemetry = Telemetry::new("test");
        telemetry.calls.serve(|_| Rule::call(Need::Scope(&[Scope::Act])));
        let call = |number: u32| {
            let path = format!("/some{number}.Service/Method");
            telemetry.calls.begin(&Request::builder().uri(path).body(()).expect("a request"))
        };
        let end = |number: u32| {
            drop(call(number));
            for code in [Code::Unauthenticated, Code::InvalidArgument, Code::Unimplemented] {
                drop(call(number).answer(Status::new(code, "no").into_http::<Body>()));
            }
        };
        end(0);
        let series = || telemetry.text().expect("numbers").lines().count();
        let before = series();
        (1..1001).for_each(end);
        assert_eq!(series(), before);
        let text = telemetry.text().expect("numbers");
        assert!(text.contains("test_calls_total{method=\"other\",code=\"CANCELLED\"} 1001\n"), "{text}");
        assert!(!text.contains("some"), "{text}");
    }

    #[test]
    fn a_request_that_is_none_is_its_callers_fault_and_a_fault_of_ours_stays_ours() {
        let telemetry = Telemetry::new("test");
        telemetry.calls.serve(|_| Rule::call(Need::Scope(&[Scope::Act])));
        let answered = |status: Status| {
            let response = telemetry.calls.begin(&request(&[])).answer(status.into_http::<Body>());
            Status::from_header_map(response.headers()).expect("a status")
        };
        let undecodable = prost_types::Timestamp::decode(&[0xff][..]).expect_err("none").to_string();
        let status = answered(Status::internal(undecodable.clone()));
        assert_eq!((status.code(), status.message()), (Code::InvalidArgument, undecodable.as_str()));
        assert_eq!(answered(Status::internal("internal error")).code(), Code::Internal);
    }
}
