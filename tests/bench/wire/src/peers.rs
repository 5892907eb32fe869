//! What Mazeway's wire is compared with: plain sockets, and bare gRPC that carries as many bytes.

use crate::process::Process;
use mazeway_proto::raw::Raw as Plain;
use std::{
    io::{Read, Write},
    net::{TcpListener, TcpStream},
    os::unix::net::{UnixListener, UnixStream},
    path::Path,
    process::Command,
    thread,
};
use tokio::sync::mpsc;
use tokio_stream::{StreamExt as _, wrappers::ReceiverStream};
use tonic::{
    Request, Response, Status, Streaming,
    body::Body,
    codegen::{BoxFuture, BoxStream, Bytes, Context, Poll, Service, http},
    server::{Grpc, NamedService, StreamingService, UnaryService},
    transport::{Channel, Endpoint, Server, server::TcpIncoming},
};

/// Bytes in flight: enough for the largest batch.
const WINDOW_BYTES: u32 = 64 << 20;
const MAX_MESSAGE_BYTES: usize = 64 << 20;
/// Streams of a connection at a time.
const MAX_STREAMS: u32 = 20_000;
/// Header with the size of the replies that a caller wants.
const REPLY_BYTES: &str = "reply-bytes";

/// Addresses of a process that serves every peer.
pub struct Peers {
    _process: Process,
    _directory: tempfile::TempDir,
    pub raw_tcp: String,
    pub raw_unix: String,
    pub tonic_tcp: String,
    pub tonic_unix: String,
    pub tonic_multi_thread: String,
}

impl Peers {
    /// Starts the process: this program again.
    pub fn start() -> Self {
        let directory = tempfile::tempdir().expect("a directory");
        let mut command = Command::new(std::env::current_exe().expect("a path of this program"));
        let process = Process::start(command.arg("--serve-peers").current_dir(&directory));
        let mut addresses = process.address().split(' ').map(str::to_owned);
        let mut next = || addresses.next().expect("an address");
        let (raw_tcp, tonic_tcp, tonic_multi_thread) = (next(), next(), next());
        let path = |name: &str| directory.path().join(name).to_str().expect("a path in UTF-8").to_owned();
        let (raw_unix, tonic_unix) = (path("raw.sock"), format!("unix:{}", path("tonic.sock")));
        Self { _process: process, _directory: directory, raw_tcp, raw_unix, tonic_tcp, tonic_unix, tonic_multi_thread }
    }
}

/// Serves until the process is killed. The first four bytes on a plain socket say how long a request is, the next four how
/// long a reply.
pub fn serve() {
    fn answer(mut stream: impl Read + Write) {
        let (mut ask, mut reply) = ([0; 4], [0; 4]);
        if stream.read_exact(&mut ask).and_then(|()| stream.read_exact(&mut reply)).is_err() {
            return;
        }
        let mut request = vec![0; u32::from_le_bytes(ask) as usize];
        let reply = vec![1; u32::from_le_bytes(reply) as usize];
        while stream.read_exact(&mut request).and_then(|()| stream.write_all(&reply)).is_ok() {}
    }
    let tcp = TcpListener::bind("127.0.0.1:0").expect("a port");
    let unix = UnixListener::bind("raw.sock").expect("a socket");
    let raw_tcp = tcp.local_addr().expect("an address");
    thread::spawn(move || {
        for stream in tcp.incoming().map_while(Result::ok) {
            let _ = stream.set_nodelay(true);
            thread::spawn(|| answer(stream));
        }
    });
    thread::spawn(move || {
        for stream in unix.incoming().map_while(Result::ok) {
            thread::spawn(|| answer(stream));
        }
    });
    let multi = tokio::runtime::Builder::new_multi_thread().enable_all().build().expect("a runtime");
    let tonic_multi = multi.block_on(async { TcpIncoming::bind("127.0.0.1:0".parse().expect("an address")) });
    let tonic_multi = tonic_multi.expect("a port").with_nodelay(Some(true));
    let multi_address = tonic_multi.local_addr().expect("an address");
    multi.spawn(server().add_service(Echo).serve_with_incoming(tonic_multi));
    let single = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
    single.block_on(async {
        let incoming = TcpIncoming::bind("127.0.0.1:0".parse().expect("an address")).expect("a port");
        let incoming = incoming.with_nodelay(Some(true));
        let unix = tokio::net::UnixListener::bind("tonic.sock").expect("a socket");
        let unix = tokio_stream::wrappers::UnixListenerStream::new(unix);
        let address = incoming.local_addr().expect("an address");
        println!("listening on {raw_tcp} {address} {multi_address}");
        let tcp = server().add_service(Echo).serve_with_incoming(incoming);
        let unix = server().add_service(Echo).serve_with_incoming(unix);
        tokio::try_join!(tcp, unix).expect("it serves until it is killed");
    });
}

fn server() -> Server {
    let server = Server::builder().max_concurrent_streams(MAX_STREAMS);
    server.initial_stream_window_size(WINDOW_BYTES).initial_connection_window_size(WINDOW_BYTES)
}

/// A plain socket that asks and waits.
pub struct Raw<S> {
    stream: S,
    request: Vec<u8>,
    reply: Vec<u8>,
}

impl Raw<TcpStream> {
    pub fn tcp(address: &str, request: usize, reply: usize) -> Self {
        let stream = TcpStream::connect(address).expect("connects");
        stream.set_nodelay(true).expect("a socket");
        Self::new(stream, request, reply)
    }
}

impl Raw<UnixStream> {
    pub fn unix(path: &str, request: usize, reply: usize) -> Self {
        Self::new(UnixStream::connect(Path::new(path)).expect("connects"), request, reply)
    }
}

impl<S: Read + Write> Raw<S> {
    fn new(mut stream: S, request: usize, reply: usize) -> Self {
        let sizes = [(request as u32).to_le_bytes(), (reply as u32).to_le_bytes()].concat();
        stream.write_all(&sizes).expect("sends");
        Self { stream, request: vec![0; request], reply: vec![0; reply] }
    }

    pub fn round_trip(&mut self) {
        self.stream.write_all(&self.request).expect("sends");
        self.stream.read_exact(&mut self.reply).expect("receives");
    }
}

/// Answers every request with as many bytes as its caller wants.
#[derive(Clone, Copy)]
struct Echo;

impl NamedService for Echo {
    const NAME: &'static str = "bench.Echo";
}

fn reply_of<T>(request: &Request<T>) -> Bytes {
    let wanted = request.metadata().get(REPLY_BYTES).and_then(|value| value.to_str().ok()?.parse().ok());
    vec![1; wanted.unwrap_or(0)].into()
}

impl UnaryService<Bytes> for Echo {
    type Response = Bytes;
    type Future = std::future::Ready<Result<Response<Bytes>, Status>>;

    fn call(&mut self, request: Request<Bytes>) -> Self::Future {
        std::future::ready(Ok(Response::new(reply_of(&request))))
    }
}

impl StreamingService<Bytes> for Echo {
    type Response = Bytes;
    type ResponseStream = BoxStream<Bytes>;
    type Future = std::future::Ready<Result<Response<Self::ResponseStream>, Status>>;

    fn call(&mut self, request: Request<Streaming<Bytes>>) -> Self::Future {
        let reply = reply_of(&request);
        let answers = request.into_inner().map(move |message| message.map(|_| reply.clone()));
        std::future::ready(Ok(Response::new(Box::pin(answers))))
    }
}

impl Service<http::Request<Body>> for Echo {
    type Response = http::Response<Body>;
    type Error = std::convert::Infallible;
    type Future = BoxFuture<Self::Response, Self::Error>;

    fn poll_ready(&mut self, _: &mut Context<'_>) -> Poll<Result<(), Self::Error>> {
        Poll::Ready(Ok(()))
    }

    fn call(&mut self, request: http::Request<Body>) -> Self::Future {
        Box::pin(async move {
            let mut grpc = Grpc::new(Plain).max_decoding_message_size(MAX_MESSAGE_BYTES);
            let unary = request.uri().path().ends_with("/Unary");
            Ok(if unary { grpc.unary(Self, request).await } else { grpc.streaming(Self, request).await })
        })
    }
}

/// A bare client of [`Echo`].
#[derive(Clone)]
pub struct Tonic {
    grpc: tonic::client::Grpc<Channel>,
    request: Bytes,
    reply: usize,
}

impl Tonic {
    pub async fn connect(address: &str, request: usize, reply: usize) -> Self {
        let uri = if address.starts_with("unix:") { address.to_owned() } else { format!("http://{address}") };
        let endpoint = Endpoint::from_shared(uri).expect("an address").initial_stream_window_size(WINDOW_BYTES);
        let channel = endpoint.initial_connection_window_size(WINDOW_BYTES).connect().await.expect("connects");
        let grpc = tonic::client::Grpc::new(channel).max_decoding_message_size(MAX_MESSAGE_BYTES);
        Self { grpc, request: vec![0; request].into(), reply }
    }

    fn request<T>(&self, message: T) -> Request<T> {
        let mut request = Request::new(message);
        request.metadata_mut().insert(REPLY_BYTES, self.reply.to_string().parse().expect("a number"));
        request
    }

    pub async fn unary(&mut self) {
        self.grpc.ready().await.expect("connected");
        let (request, path) =
            (self.request(self.request.clone()), http::uri::PathAndQuery::from_static("/bench.Echo/Unary"));
        let answer = self.grpc.unary(request, path, Plain).await.expect("answers");
        assert_eq!(answer.into_inner().len(), self.reply);
    }

    pub async fn bidi(mut self, in_flight: usize) -> Bidi {
        let (requests, body) = mpsc::channel(in_flight);
        self.grpc.ready().await.expect("connected");
        let path = http::uri::PathAndQuery::from_static("/bench.Echo/Bidi");
        let answers = self.grpc.streaming(self.request(ReceiverStream::new(body)), path, Plain);
        let answers = answers.await.expect("a stream").into_inner();
        Bidi { requests, answers, request: self.request, reply: self.reply }
    }
}

/// An open stream.
pub struct Bidi {
    requests: mpsc::Sender<Bytes>,
    answers: Streaming<Bytes>,
    request: Bytes,
    reply: usize,
}

impl Bidi {
    pub async fn send(&mut self) {
        self.requests.send(self.request.clone()).await.expect("the stream lives");
    }

    pub async fn receive(&mut self) {
        let answer = self.answers.message().await.expect("answers").expect("an answer");
        assert_eq!(answer.len(), self.reply);
    }
}
