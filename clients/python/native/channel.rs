//! Calls as bytes over one connection: Python has the messages, this has the wire.

use crate::{
    driver::{Driver, Keeper, Local},
    errors::Failure,
};
use bytes::Bytes;
use mazeway_client::{ClientCertificate, ConnectOptions, Connection, Token, Wire};
use mazeway_proto::raw::Raw;
use pyo3::{exceptions::PyValueError, prelude::*, types::PyBytes};
use std::{
    mem,
    sync::{Arc, Mutex as Lock, PoisonError},
    time::Duration,
};
use tokio::{
    sync::{
        Mutex, OnceCell,
        mpsc::{self, error::TrySendError},
    },
    task::JoinHandle,
};
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Request, Status, Streaming, client::Grpc, codegen::http::uri::PathAndQuery};

/// Largest message either way.
const MAX_MESSAGE_BYTES: usize = 256 << 20;
/// Requests of a stream that may wait to be sent. Python's own bounds are far below, so that this is a defect's end.
const MAX_WAITING: usize = 4096;

/// A connection and who drives it.
#[derive(Debug)]
pub struct Link {
    pub driver: Arc<Driver>,
    pub dial: Arc<Dial>,
}

/// A connection alone: what a task of the driver may hold without keeping the driver.
#[derive(Debug)]
pub struct Dial {
    address: String,
    options: ConnectOptions,
    wire: OnceCell<Wire>,
}

impl Dial {
    /// The connection, opened with its first use.
    async fn wire(&self) -> Result<Wire, Failure> {
        Ok(self.wire.get_or_try_init(|| Wire::open(&self.address, &self.options)).await?.clone())
    }

    /// The same for the typed client.
    pub async fn connection(&self) -> Result<Connection, Failure> {
        Ok(Connection::from_channel(self.wire().await?))
    }

    async fn grpc(&self) -> Result<Grpc<Wire>, Failure> {
        let mut grpc = Grpc::new(self.wire().await?)
            .max_decoding_message_size(MAX_MESSAGE_BYTES)
            .max_encoding_message_size(MAX_MESSAGE_BYTES);
        grpc.ready().await.map_err(|error| Failure::from(Status::from_error(error.into())))?;
        Ok(grpc)
    }
}

/// A call's path, such as `/mazeway.env.v1.EnvironmentService/Render`.
fn path(text: &str) -> PyResult<PathAndQuery> {
    text.parse().map_err(|error| PyValueError::new_err(format!("{text}: {error}")))
}

/// Seconds as Python counts them.
pub fn seconds(secs: f64) -> Duration {
    // Negative and no number: none. Beyond all bounds: the driver has its own.
    Duration::try_from_secs_f64(secs).unwrap_or(if secs > 0.0 { Duration::MAX } else { Duration::ZERO })
}

/// One connection to a server; connects with the first call.
#[pyclass(frozen, module = "mazeway._native")]
#[derive(Debug)]
pub struct Channel(Local<Arc<Link>>);

impl Channel {
    pub fn link(&self) -> PyResult<&Arc<Link>> {
        self.0.get()
    }
}

#[pymethods]
impl Channel {
    /// Takes the token, and the contents of files in PEM: authorities, and a certificate with its key. Whether they go with
    /// the address Python has seen to, which also waits no longer than its timeouts.
    #[new]
    #[pyo3(signature = (address, keeper, token=None, ca=None, cert=None, key=None))]
    fn new(
        address: String,
        keeper: &Keeper,
        token: Option<&str>,
        ca: Option<Vec<u8>>,
        cert: Option<Vec<u8>>,
        key: Option<Vec<u8>>,
    ) -> PyResult<Self> {
        let options = ConnectOptions {
            token: token.map(Token::new).transpose().map_err(Failure::from)?,
            ca,
            certificate: cert.zip(key).map(|(chain, key)| ClientCertificate { chain, key }),
            insecure: true,
            deadline: Duration::MAX,
            work_deadline: Duration::MAX,
            ..ConnectOptions::default()
        };
        let driver = Arc::new(Driver::new()?);
        keeper.watch(&driver)?;
        let dial = Arc::new(Dial { address, options, wire: OnceCell::new() });
        Ok(Self(Local::new(Arc::new(Link { driver, dial }))))
    }

    /// One request, one answer.
    fn unary<'py>(&self, py: Python<'py>, path: &str, request: &[u8], timeout: f64) -> PyResult<Bound<'py, PyBytes>> {
        let (link, path, request) = (self.link()?, self::path(path)?, Bytes::copy_from_slice(request));
        let call = async {
            let answer = link.dial.grpc().await?.unary(Request::new(request), path, Raw).await;
            Ok::<_, Failure>(answer?.into_inner())
        };
        Ok(PyBytes::new(py, &link.driver.wait(py, seconds(timeout), call)??))
    }

    /// Many requests, one answer.
    fn requests<'py>(
        &self,
        py: Python<'py>,
        path: &str,
        requests: Vec<Vec<u8>>,
        timeout: f64,
    ) -> PyResult<Bound<'py, PyBytes>> {
        let (link, path) = (self.link()?, self::path(path)?);
        let requests = tokio_stream::iter(requests.into_iter().map(Bytes::from));
        let call = async {
            let answer = link.dial.grpc().await?.client_streaming(Request::new(requests), path, Raw).await;
            Ok::<_, Failure>(answer?.into_inner())
        };
        Ok(PyBytes::new(py, &link.driver.wait(py, seconds(timeout), call)??))
    }

    /// One request, many answers.
    fn answers(&self, path: &str, request: &[u8]) -> PyResult<Answers> {
        let (link, path, request) = (self.link()?, self::path(path)?, Bytes::copy_from_slice(request));
        let dial = Arc::clone(&link.dial);
        let call = link.driver.runtime().spawn(async move {
            let answer = dial.grpc().await?.server_streaming(Request::new(request), path, Raw).await;
            Ok::<_, Failure>(answer?.into_inner())
        });
        Ok(Answers(Local::new(Incoming::new(link, call))))
    }

    /// A stream both ways.
    fn exchange(&self, path: &str) -> PyResult<Exchange> {
        let (link, path) = (self.link()?, self::path(path)?);
        let (requests, body) = mpsc::channel(MAX_WAITING);
        let dial = Arc::clone(&link.dial);
        let call = link.driver.runtime().spawn(async move {
            let body = ReceiverStream::new(body);
            let answer = dial.grpc().await?.streaming(Request::new(body), path, Raw).await;
            Ok::<_, Failure>(answer?.into_inner())
        });
        Ok(Exchange(Local::new((Lock::new(Some(requests)), Incoming::new(link, call)))))
    }
}

/// The answers of a stream.
#[derive(Debug)]
struct Incoming {
    link: Arc<Link>,
    state: Mutex<State>,
}

#[derive(Debug)]
#[expect(clippy::large_enum_variant, reason = "one a stream, and open for nearly all of its life")]
enum State {
    Opening(JoinHandle<Result<Streaming<Bytes>, Failure>>),
    Open(Streaming<Bytes>),
    Over,
}

impl Incoming {
    fn new(link: &Arc<Link>, call: JoinHandle<Result<Streaming<Bytes>, Failure>>) -> Self {
        Self { link: Arc::clone(link), state: Mutex::new(State::Opening(call)) }
    }

    /// The next answer; `None` where the stream is over.
    async fn next(&self) -> Result<Option<Bytes>, Failure> {
        let mut state = self.state.lock().await;
        loop {
            let ended = match &mut *state {
                State::Opening(call) => match call.await {
                    Ok(Ok(answers)) => {
                        *state = State::Open(answers);
                        continue;
                    }
                    Ok(Err(failure)) => Err(failure),
                    Err(error) => Err(Failure::protocol(error.to_string())),
                },
                State::Open(answers) => match answers.message().await {
                    Ok(Some(answer)) => return Ok(Some(answer)),
                    Ok(None) => Ok(None),
                    Err(status) => Err(status.into()),
                },
                State::Over => Ok(None),
            };
            *state = State::Over;
            return ended;
        }
    }

    fn receive<'py>(&self, py: Python<'py>, timeout: f64) -> PyResult<Option<Bound<'py, PyBytes>>> {
        let answer = self.link.driver.wait(py, seconds(timeout), self.next())??;
        Ok(answer.map(|answer| PyBytes::new(py, &answer)))
    }

    /// Ends the stream; one that another thread waits for ends there.
    fn cancel(&self, py: Python<'_>) {
        if let Ok(mut state) = self.state.try_lock()
            && let State::Opening(call) = mem::replace(&mut *state, State::Over)
        {
            call.abort();
        }
        self.link.driver.settle(py);
    }
}

/// The answers of a call, one after another.
#[pyclass(frozen, module = "mazeway._native")]
#[derive(Debug)]
pub struct Answers(Local<Incoming>);

#[pymethods]
impl Answers {
    /// Waits for the next answer; None where there are no more.
    fn receive<'py>(&self, py: Python<'py>, timeout: f64) -> PyResult<Option<Bound<'py, PyBytes>>> {
        self.0.get()?.receive(py, timeout)
    }

    /// Ends the call at once; may be called twice.
    fn cancel(&self, py: Python<'_>) -> PyResult<()> {
        self.0.get()?.cancel(py);
        Ok(())
    }
}

/// Requests that wait to be sent; none where the stream is over.
type Outgoing = Lock<Option<mpsc::Sender<Bytes>>>;

/// A stream both ways, whose n-th answer is to the n-th request.
#[pyclass(frozen, module = "mazeway._native")]
#[derive(Debug)]
pub struct Exchange(Local<(Outgoing, Incoming)>);

#[pymethods]
impl Exchange {
    /// Sends a request; never waits. Refused where too many wait to be sent.
    fn send(&self, py: Python<'_>, request: &[u8]) -> PyResult<()> {
        let (requests, incoming) = self.0.get()?;
        if let Some(requests) = &*requests.lock().unwrap_or_else(PoisonError::into_inner) {
            match requests.try_send(Bytes::copy_from_slice(request)) {
                // A stream that has ended says why with its next answer.
                Ok(()) | Err(TrySendError::Closed(_)) => {}
                Err(TrySendError::Full(_)) => return Err(Failure::full(MAX_WAITING).into()),
            }
        }
        incoming.link.driver.settle(py);
        Ok(())
    }

    /// Sends no more: the other side ends the stream when it has answered all.
    fn end(&self, py: Python<'_>) -> PyResult<()> {
        let (requests, incoming) = self.0.get()?;
        requests.lock().unwrap_or_else(PoisonError::into_inner).take();
        incoming.link.driver.settle(py);
        Ok(())
    }

    /// Waits for the next answer; None where there are no more.
    fn receive<'py>(&self, py: Python<'py>, timeout: f64) -> PyResult<Option<Bound<'py, PyBytes>>> {
        self.0.get()?.1.receive(py, timeout)
    }

    /// Ends the stream at once; may be called twice.
    fn cancel(&self, py: Python<'_>) -> PyResult<()> {
        let (requests, incoming) = self.0.get()?;
        requests.lock().unwrap_or_else(PoisonError::into_inner).take();
        incoming.cancel(py);
        Ok(())
    }
}
