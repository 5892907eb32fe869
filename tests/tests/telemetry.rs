//! What services show of themselves: numbers, spans at a real collector, logs, health.

use mazeway_client::{Connection, Env, Learner, SessionOptions};
use mazeway_proto::{
    env::{self as env_pb, environment_service_client::EnvironmentServiceClient},
    learner as pb,
    raw::Raw,
};
use mazeway_serving::grant::{Quotas, Scope};
use mazeway_tests::{
    authority::{Authority, bearing},
    learner::trajectory,
    programs::program,
};
use opentelemetry_proto::tonic::{
    collector::trace::v1::{
        ExportTraceServiceRequest, ExportTraceServiceResponse,
        trace_service_server::{TraceService, TraceServiceServer},
    },
    common::v1::any_value::Value,
    trace::v1::Span,
};
use std::{
    collections::BTreeSet,
    fs,
    io::{BufRead as _, BufReader, Read as _, Write as _},
    net::TcpStream,
    path::Path,
    process::{Child, Command, Stdio},
    sync::{Arc, Mutex},
    time::{Duration, Instant},
};
use tokio_stream::wrappers::TcpListenerStream;
use tonic::{Code, Request, Response, Status, transport::Server};
use tonic_health::pb::{HealthCheckRequest, health_check_response::ServingStatus, health_client::HealthClient};
use tonic_types::StatusExt as _;

/// A service as a process that shows its numbers; its log is kept.
struct Shown {
    child: Child,
    address: String,
    metrics: String,
}

impl Shown {
    fn start(mut command: Command) -> Self {
        command.args(["--listen", "127.0.0.1:0", "--metrics-listen", "127.0.0.1:0"]);
        let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("a process");
        let mut lines = BufReader::new(child.stdout.take().expect("a pipe")).lines();
        let mut said = |what: &str| {
            let line = lines.next().expect("a line").expect("a line");
            line.strip_prefix(what).unwrap_or_else(|| panic!("expected {what:?}, got {line:?}")).to_owned()
        };
        let (address, metrics) = (said("listening on "), said("metrics on http://"));
        Self { child, address, metrics: metrics.trim_end_matches("/metrics").to_owned() }
    }

    fn server(arguments: &[&str]) -> Self {
        let mut command = Command::new(program("server"));
        command.args(arguments);
        Self::start(command)
    }

    fn get(&self, path: &str) -> (String, String) {
        let mut stream = TcpStream::connect(&self.metrics).expect("connects");
        write!(stream, "GET {path} HTTP/1.0\r\nHost: test\r\n\r\n").expect("asks");
        let mut answer = String::new();
        stream.read_to_string(&mut answer).expect("an answer");
        let (head, body) = answer.split_once("\r\n\r\n").expect("a head and a body");
        (head.lines().next().unwrap_or_default().to_owned(), body.to_owned())
    }

    fn number(&self, name: &str) -> f64 {
        let (_, text) = self.get("/metrics");
        let line = text.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(' '));
        line.unwrap_or_else(|| panic!("no {name} in\n{text}")).parse().expect("a number")
    }

    /// Waits for a number that may be a moment behind the answer that told of it.
    fn reaches(&self, name: &str, number: f64) {
        let begun = Instant::now();
        while self.number(name) != number {
            assert!(begun.elapsed() < Duration::from_secs(10), "{name} is {}, not {number}", self.number(name));
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Tells it to stop, and gives its log.
    fn stop(mut self) -> String {
        let status = Command::new("kill").args(["-TERM", &self.child.id().to_string()]).status().expect("kill");
        assert!(status.success());
        let mut log = String::new();
        self.child.stderr.take().expect("a pipe").read_to_string(&mut log).expect("a log");
        let status = self.child.wait().expect("an end");
        assert!(status.success(), "{status}: {log}");
        log
    }
}

impl Drop for Shown {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A frame of HTTP/2.
fn frame(kind: u8, flags: u8, stream: u32, payload: &[u8]) -> Vec<u8> {
    let length = u32::try_from(payload.len()).expect("a short one").to_be_bytes();
    [&length[1..], &[kind, flags], &stream.to_be_bytes(), payload].concat()
}

/// The head of a call; its body is still to come.
fn head(stream: u32, path: &str, metadata: &[(&str, &str)]) -> Vec<u8> {
    let text = |text: &str| [&[u8::try_from(text.len()).expect("a short one")], text.as_bytes()].concat();
    // POST, http and the names of the path and the content type are known to HPACK.
    let mut fields = vec![0x83, 0x86, 0x04];
    fields.extend(text(path));
    fields.extend([0x0f, 0x10]);
    fields.extend(text("application/grpc"));
    for (name, value) in metadata {
        fields.push(0);
        fields.extend(text(name));
        fields.extend(text(value));
    }
    frame(1, 4, stream, &fields)
}

/// A connection on which so much was sent and read by the service.
fn greeted(address: &str, frames: &[u8]) -> TcpStream {
    let mut stream = TcpStream::connect(address).expect("connects");
    stream.set_read_timeout(Some(Duration::from_secs(20))).expect("a time");
    let sent = [b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n", &frame(4, 0, 0, &[])[..], frames, &frame(6, 0, 0, b"anybody?")];
    stream.write_all(&sent.concat()).expect("sends");
    let (mut heard, mut bytes) = (Vec::<u8>::new(), [0; 4096]);
    while !heard.windows(8).any(|window| window == b"anybody?") {
        let read = stream.read(&mut bytes).expect("an answer");
        assert!(read > 0, "it is closed");
        heard.extend(&bytes[..read]);
    }
    stream
}

fn request_id(status: &Status) -> String {
    status.get_details_request_info().expect("the request's name among the details").request_id
}

/// Names of one service's numbers in a text, without what a histogram adds to them.
fn names(text: &str, service: &str) -> BTreeSet<String> {
    let words = text.split(|c: char| !c.is_ascii_alphanumeric() && c != '_').filter(|word| word.starts_with(service));
    let ends = ["_bucket", "_count", "_sum"];
    // A name that ends in a line is the beginning of several.
    words
        .filter(|word| !word.ends_with('_'))
        .map(|word| ends.iter().find_map(|end| word.strip_suffix(end)).unwrap_or(word).to_owned())
        .collect()
}

/// What operators are told to look at is there.
fn what_the_documents_name_is_served(service: &str, shown: &Shown) {
    let served = names(&shown.get("/metrics").1, service);
    for document in ["alerts.yml", "OPERATIONS.md"] {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join("docs").join(document);
        let text = fs::read_to_string(path).expect("a document").replace("mazeway_(server|learner)_", service);
        let asked = names(&text, service);
        let unknown = asked.difference(&served).collect::<Vec<_>>();
        assert!(asked.len() > 4 && unknown.is_empty(), "{document}: {unknown:?}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_server_counts_what_it_does() {
    let server = Shown::server(&["--max-sessions", "2"]);
    assert_eq!(server.get("/healthz").0, "HTTP/1.0 200 OK");
    // What can be refused is there from the start, so that the first time is seen to grow.
    for name in [
        "mazeway_server_connections_refused_total",
        "mazeway_server_sessions_refused_total{reason=\"sessions\"}",
        "mazeway_server_sessions_refused_total{reason=\"environments\"}",
        "mazeway_server_sessions_refused_total{reason=\"stopping\"}",
        "mazeway_server_calls_total{method=\"mazeway.env.v1.EnvironmentService/Step\",code=\"INTERNAL\"}",
    ] {
        assert_eq!(server.number(name), 0.0, "{name}");
    }
    let connection = Connection::open(&server.address).await.expect("connects");
    let create = || Env::create(&connection, "Maze-v0", SessionOptions::default());
    let mut env = create().await.expect("a session");
    env.reset(Some(1)).await.expect("resets");
    for _ in 0..100 {
        env.step(1).await.expect("steps");
    }
    let _second = create().await.expect("a session");
    assert_eq!(create().await.expect_err("one too many").code(), Code::ResourceExhausted);
    for (name, number) in [
        ("mazeway_server_steps_total", 100.0),
        ("mazeway_server_step_seconds_count", 100.0),
        ("mazeway_server_sessions", 2.0),
        ("mazeway_server_environments", 2.0),
        ("mazeway_server_sessions_created_total", 2.0),
        ("mazeway_server_sessions_expired_total", 0.0),
        ("mazeway_server_sessions_refused_total{reason=\"sessions\"}", 1.0),
        ("mazeway_server_connections", 1.0),
        ("mazeway_server_calls_open", 1.0),
        ("mazeway_server_calls_total{method=\"mazeway.env.v1.EnvironmentService/CreateSession\",code=\"OK\"}", 2.0),
        (
            "mazeway_server_calls_total{method=\"mazeway.env.v1.EnvironmentService/CreateSession\",code=\"RESOURCE_EXHAUSTED\"}",
            1.0,
        ),
    ] {
        assert_eq!(server.number(name), number, "{name}");
    }
    assert!(server.number("mazeway_server_received_bytes_total") > 100.0 * 9.0);
    assert!(server.number("mazeway_server_sent_bytes_total") > 100.0 * 9.0);
    env.close().await.expect("closes");
    assert_eq!(server.number("mazeway_server_sessions"), 1.0);
    what_the_documents_name_is_served("mazeway_server_", &server);
    // A method that there is not makes no label.
    let mut client = tonic::client::Grpc::new(mazeway_client::channel(&server.address).await.expect("connects"));
    for number in 0..50 {
        client.ready().await.expect("ready");
        let codec = tonic_prost::ProstCodec::<(), ()>::default();
        let path = format!("/no.such.Service/Method{number}").parse().expect("a path");
        let error = client.unary(Request::new(()), path, codec).await.expect_err("no such method");
        assert_eq!(error.code(), Code::Unimplemented);
    }
    assert_eq!(server.number("mazeway_server_calls_total{method=\"other\",code=\"UNIMPLEMENTED\"}"), 50.0);
    assert!(!server.get("/metrics").1.contains("no.such"));
    assert!(server.get("/else").0.contains("404"));
    let (_, text) = server.get("/metrics");
    assert!(!text.contains("e+308") && text.contains("step_seconds_bucket{le=\"+Inf\"} 100\n"), "{text}");
}

#[tokio::test(flavor = "multi_thread")]
async fn whatever_paths_strangers_ask_for_numbers_stay_few() {
    let authority = Authority::new();
    let secret = authority.token("alice", &[Scope::Act], &Quotas::default());
    let server = Shown::server(&["--tokens", authority.path("tokens.toml").to_str().expect("a path")]);
    let bearer = format!("Bearer {secret}");
    let tokenless: &[_] = &[];
    let untimely: &[_] = &[("authorization", bearer.as_str()), ("grpc-timeout", "nonsense")];
    let given_up: &[_] = &[("authorization", bearer.as_str())];
    let ask = |paths: std::ops::Range<u32>| {
        let mut frames = Vec::new();
        for (number, path) in paths.enumerate() {
            let path = match path % 4 {
                0 => format!("/mazeway.env.v1.EnvironmentService/Method{path}"),
                1 => format!("/grpc.health.v1.Health/Method{path}"),
                2 => format!("//service{path}/Method/Method"),
                _ => format!("/service{path}/Method"),
            };
            for (kind, metadata) in [tokenless, untimely, given_up].into_iter().enumerate() {
                let stream = u32::try_from(6 * number + 2 * kind + 1).expect("a short one");
                frames.extend(head(stream, &path, metadata));
                if kind == 2 {
                    frames.extend(frame(3, 0, stream, &8_u32.to_be_bytes()));
                }
            }
        }
        greeted(&server.address, &frames);
    };
    // Once all of them are counted: what methods there are, and how many lines.
    let series = |calls: f64| {
        let begun = Instant::now();
        loop {
            let (_, text) = server.get("/metrics");
            let line = |line: &&str| line.starts_with("mazeway_server_calls_total{method=\"other\",");
            let counted = text.lines().filter(line).map(|line| line.rsplit_once(' ').expect("a number").1);
            let counted: f64 = counted.map(|number| number.parse::<f64>().expect("a number")).sum();
            if counted == calls {
                let methods =
                    text.split("method=\"").skip(1).map(|rest| rest.split('"').next().expect("a name").to_owned());
                return (methods.collect::<BTreeSet<_>>(), text.lines().count());
            }
            assert!(counted < calls && begun.elapsed() < Duration::from_secs(20), "{counted} of {calls} in\n{text}");
            std::thread::sleep(Duration::from_millis(20));
        }
    };
    ask(0..8);
    let (methods, lines) = series(24.0);
    for ten in 1..101 {
        ask(10 * ten..10 * ten + 10);
    }
    let after = series(3024.0);
    assert_eq!(after.0, methods);
    // A call that is given up has ended before that was heard, or not.
    assert!(after.1 <= lines + 2, "{} lines became {}", lines, after.1);
}

#[tokio::test(flavor = "multi_thread")]
async fn half_requests_for_numbers_are_cut_off_and_hold_up_nobody() {
    let server = Shown::server(&[]);
    let mut halves = Vec::new();
    let begun = Instant::now();
    for _ in 0..300 {
        let mut half = TcpStream::connect(&server.metrics).expect("connects");
        half.write_all(b"GET /metrics HT").expect("asks");
        halves.push(half);
    }
    assert!(server.get("/metrics").0.contains("200"));
    assert!(begun.elapsed() < Duration::from_secs(2), "{:?}", begun.elapsed());
    for mut half in halves {
        let left = Duration::from_secs(10).checked_sub(begun.elapsed()).expect("an end of all in time");
        half.set_read_timeout(Some(left.max(Duration::from_millis(1)))).expect("a time");
        // A short word of why, or none, or a reset.
        let end = half.read_to_end(&mut Vec::new());
        assert!(!end.is_err_and(|error| error.kind() == std::io::ErrorKind::WouldBlock), "it is still there");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_learner_counts_what_it_stores_and_fits() {
    let data = tempfile::tempdir().expect("a directory");
    let mut command = Command::new(program("learner"));
    command.args(["serve", "--data"]).arg(data.path());
    let service = Shown::start(command);
    let learner = Learner::connect(&service.address).await.expect("connects");
    let all: Vec<pb::Trajectory> = (0..20).map(trajectory).collect();
    let bytes: usize = all.iter().map(|t| t.states.len() + t.actions.len() + t.rewards.len()).sum();
    let steps: usize = all.iter().map(|t| t.states.len() / 4).sum();
    for _ in 0..2 {
        let mut recorder = learner.recorder();
        for trajectory in all.clone() {
            recorder.record(trajectory).await.expect("a trajectory");
        }
        recorder.finish().await.expect("stored");
    }
    let filter = pb::TrajectoryFilter { env_id: "Test-v0".into(), ..Default::default() };
    let request = pb::FitRequest { method: "bc".into(), filter: Some(filter), ..Default::default() };
    learner.fit(request, |_| ()).await.expect_err("there is no model");
    for (name, number) in [
        ("mazeway_learner_recorded_trajectories_total", 20.0),
        ("mazeway_learner_recorded_steps_total", steps as f64),
        ("mazeway_learner_recorded_bytes_total", bytes as f64),
        ("mazeway_learner_fits_waiting", 0.0),
        ("mazeway_learner_fits_running", 0.0),
        ("mazeway_learner_fit_seconds_count{method=\"bc\",outcome=\"refused\"}", 1.0),
        ("mazeway_learner_commit_failures_total", 0.0),
        ("mazeway_learner_writable", 1.0),
    ] {
        service.reaches(name, number);
    }
    assert!(service.number("mazeway_learner_commit_seconds_count") >= 2.0);
    assert!(service.number("mazeway_learner_store_bytes") > bytes as f64);
    what_the_documents_name_is_served("mazeway_learner_", &service);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_store_that_is_full_says_so_until_there_is_room() {
    let data = tempfile::tempdir().expect("a directory");
    let mut command = Command::new(program("learner"));
    command.args(["serve", "--max-store-bytes", "600000", "--data"]).arg(data.path());
    let service = Shown::start(command);
    let learner = Learner::connect(&service.address).await.expect("connects");
    let channel = mazeway_client::channel(&service.address).await.expect("connects");
    let status = async |name: &str| {
        let request = HealthCheckRequest { service: name.into() };
        HealthClient::new(channel.clone()).check(request).await.expect("health").into_inner().status()
    };
    let recording = "mazeway.learner.v1.LearnerService/RecordTrajectories";
    let becomes = async |wanted: ServingStatus| {
        for _ in 0..200 {
            if status(recording).await == wanted {
                return;
            }
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
        panic!("recording does not become {wanted:?}");
    };
    becomes(ServingStatus::Serving).await;
    let large = |number: u128| pb::Trajectory {
        states: 7_u32.to_le_bytes().repeat(5_000).into(),
        actions: 1_u32.to_le_bytes().repeat(5_000).into(),
        rewards: prost::bytes::Bytes::new(),
        ..trajectory(number)
    };
    let mut stored = 0;
    let error = loop {
        let mut recorder = learner.recorder();
        let recorded = match recorder.record(large(stored)).await {
            Ok(()) => recorder.finish().await.map(drop),
            Err(error) => Err(error),
        };
        match recorded {
            Ok(()) => stored += 1,
            Err(error) => break error,
        }
        assert!(stored < 100, "the store is limited");
    };
    assert_eq!(error.code(), Code::ResourceExhausted);
    becomes(ServingStatus::NotServing).await;
    // Trials do not change that, and all else goes on.
    tokio::time::sleep(Duration::from_secs(3)).await;
    becomes(ServingStatus::NotServing).await;
    assert_eq!(service.number("mazeway_learner_writable"), 0.0);
    assert_eq!(status("mazeway.learner.v1.LearnerService").await, ServingStatus::Serving);
    let all = pb::TrajectoryFilter { env_id: "Test-v0".into(), ..Default::default() };
    assert_eq!(learner.delete_trajectories(&all).await.expect("deleted"), stored as u64);
    becomes(ServingStatus::Serving).await;
}

/// A collector that keeps what it is sent.
#[derive(Debug, Clone, Default)]
struct Collector(Arc<Mutex<Vec<(String, Span)>>>);

#[tonic::async_trait]
impl TraceService for Collector {
    async fn export(
        &self,
        request: Request<ExportTraceServiceRequest>,
    ) -> Result<Response<ExportTraceServiceResponse>, Status> {
        for resource in request.into_inner().resource_spans {
            let attributes = resource.resource.unwrap_or_default().attributes;
            let service =
                attributes.iter().find(|attribute| attribute.key == "service.name").map(text).unwrap_or_default();
            let spans = resource.scope_spans.into_iter().flat_map(|scope| scope.spans);
            self.0.lock().expect("not poisoned").extend(spans.map(|span| (service.clone(), span)));
        }
        Ok(Response::new(ExportTraceServiceResponse::default()))
    }
}

fn text(attribute: &opentelemetry_proto::tonic::common::v1::KeyValue) -> String {
    match attribute.value.clone().and_then(|value| value.value) {
        Some(Value::StringValue(text)) => text,
        other => format!("{other:?}"),
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_collector_gets_a_span_a_call_under_the_callers_trace() {
    let collector = Collector::default();
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let endpoint = format!("http://{}", listener.local_addr().expect("an address"));
    let serving = Server::builder().add_service(TraceServiceServer::new(collector.clone()));
    tokio::spawn(serving.serve_with_incoming(TcpListenerStream::new(listener)));
    let server = Shown::server(&["--otlp-endpoint", &endpoint, "--log", "off"]);
    let channel = mazeway_client::channel(&server.address).await.expect("connects");
    let mut client = EnvironmentServiceClient::new(channel);
    let mut request = Request::new(env_pb::ListEnvironmentsRequest {});
    let (trace, parent) = ("0af7651916cd43dd8448eb211c80319c", "b7ad6b7169203331");
    request.metadata_mut().insert("traceparent", format!("00-{trace}-{parent}-01").parse().expect("a value"));
    request.metadata_mut().insert("x-request-id", "mine-1".parse().expect("a value"));
    let answer = client.list_environments(request).await.expect("an answer");
    assert_eq!(answer.metadata().get("x-request-id").expect("its name"), "mine-1");
    let close = env_pb::CloseSessionRequest { session_id: "0".repeat(32) };
    let error = client.close_session(close).await.expect_err("no such session");
    let failed = request_id(&error);
    assert!(!failed.is_empty());
    server.stop();
    let spans = collector.0.lock().expect("not poisoned").clone();
    let attribute =
        |span: &Span, key: &str| span.attributes.iter().find(|a| a.key == key).map(text).unwrap_or_default();
    let of = |id: &str| spans.iter().find(|(_, span)| attribute(span, "request_id") == id).expect("its span").clone();
    let (service, span) = of("mine-1");
    assert_eq!(service, "mazeway-server");
    assert_eq!(span.name, "mazeway.env.v1.EnvironmentService/ListEnvironments");
    assert_eq!(span.trace_id, u128::from_str_radix(trace, 16).expect("a trace").to_be_bytes());
    assert_eq!(span.parent_span_id, u64::from_str_radix(parent, 16).expect("a span").to_be_bytes());
    assert!(span.end_time_unix_nano >= span.start_time_unix_nano);
    let (_, span) = of(&failed);
    assert_eq!(attribute(&span, "rpc.method"), "CloseSession");
    assert!(attribute(&span, "rpc.grpc.status_code").contains('5'), "{span:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn logs_name_the_call_and_hold_neither_tokens_nor_demonstrations() {
    let server = Shown::server(&["--log-format", "json", "--log", "trace"]);
    let channel = mazeway_client::channel(&server.address).await.expect("connects");
    let mut client = EnvironmentServiceClient::new(channel);
    let mut request = Request::new(env_pb::CloseSessionRequest { session_id: "nonsense".into() });
    request.metadata_mut().insert("authorization", "Bearer secret-of-a-caller".parse().expect("a value"));
    request.metadata_mut().insert("x-request-id", "not \"sane\"".parse().expect("a value"));
    let error = client.close_session(request).await.expect_err("no id");
    let id = request_id(&error);
    assert!(!id.contains('"'));
    let log = server.stop();
    let line = log.lines().find(|line| line.contains("a call was refused")).expect("a line");
    let line: serde_json::Value = serde_json::from_str(line).expect("an object");
    assert_eq!(line["span"]["request_id"], id.as_str());
    let ours = |line: &&str| line.contains("\"target\":\"mazeway");
    assert!(!log.lines().filter(ours).any(|line| line.contains("secret-of-a-caller")), "{log}");

    let data = tempfile::tempdir().expect("a directory");
    let mut command = Command::new(program("learner"));
    command
        .args(["serve", "--log", "mazeway=trace,mazeway_learner=trace,mazeway_serving=trace", "--data"])
        .arg(data.path());
    let service = Shown::start(command);
    let learner = Learner::connect(&service.address).await.expect("connects");
    let mut recorder = learner.recorder();
    let demonstration = pb::Trajectory {
        states: 0x7b7b_7b7b_u32.to_le_bytes().repeat(3).into(),
        style: "a style of mine".into(),
        n_states: 0x7fff_ffff,
        actions: 0_u32.to_le_bytes().repeat(3).into(),
        rewards: prost::bytes::Bytes::new(),
        final_state: None,
        ..trajectory(1)
    };
    recorder.record(demonstration).await.expect("a trajectory");
    recorder.finish().await.expect("stored");
    let log = service.stop();
    for raw in ["{{{{", "2071690107", "7b7b7b7b"] {
        assert!(!log.contains(raw), "{log}");
    }
}

#[test]
fn wrong_flags_are_refused_before_anything_starts() {
    for (arguments, expected) in [
        (["--metrics-listen", "0.0.0.0:0"], "would be reached from other machines"),
        (["--otlp-endpoint", "collector"], "expected a URL"),
        (["--log", "loud=loud"], "expected a level"),
        (["--log-format", "xml"], "invalid value"),
    ] {
        let output =
            Command::new(program("server")).args(["--listen", "127.0.0.1:0"]).args(arguments).output().expect("runs");
        let error = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {error}");
        assert!(error.contains(expected) && error.lines().count() == 2 && error.contains("\nhint: "), "{error}");
    }
    let taken = std::net::TcpListener::bind("127.0.0.1:0").expect("a port");
    let address = taken.local_addr().expect("an address").to_string();
    let output =
        Command::new(program("server")).args(["--listen", "127.0.0.1:0", "--metrics-listen", &address]).output();
    let output = output.expect("runs");
    assert_eq!(output.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&output.stderr).contains(&address));
}

#[tokio::test(flavor = "multi_thread")]
async fn what_cannot_be_decoded_is_the_callers_fault() {
    let server = Shown::server(&[]);
    let data = tempfile::tempdir().expect("a directory");
    let mut command = Command::new(program("learner"));
    command.args(["serve", "--data"]).arg(data.path());
    let learner = Shown::start(command);
    let services = [
        (&server, "mazeway_server", "mazeway.env.v1.EnvironmentService", ["Step", "Interact", "Rollout"]),
        (
            &learner,
            "mazeway_learner",
            "mazeway.learner.v1.LearnerService",
            ["GetFit", "RecordTrajectories", "PutModel"],
        ),
    ];
    for (shown, prefix, service, methods) in services {
        let mut client = tonic::client::Grpc::new(mazeway_client::channel(&shown.address).await.expect("connects"));
        for method in methods {
            client.ready().await.expect("ready");
            let path = format!("/{service}/{method}").parse().expect("a path");
            let requests = Request::new(tokio_stream::iter([bytes::Bytes::from_static(&[0x0a, 0xff])]));
            let status = match client.streaming(requests, path, Raw).await {
                Ok(answers) => answers.into_inner().message().await.expect_err("it is refused"),
                Err(status) => status,
            };
            assert_eq!(status.code(), Code::InvalidArgument, "{method}: {status}");
            assert!(status.message().starts_with("failed to decode"), "{method}: {status}");
            assert!(!request_id(&status).is_empty());
            let name = |code| format!("{prefix}_calls_total{{method=\"{service}/{method}\",code=\"{code}\"}}");
            assert_eq!(shown.number(&name("INVALID_ARGUMENT")), 1.0);
            assert_eq!(shown.number(&name("INTERNAL")), 0.0);
        }
        // In the middle of a message, the caller hangs up.
        let method = methods[1];
        for _ in 0..5 {
            let half = frame(0, 0, 1, &[0, 0, 0, 0, 9, 0x0a]);
            drop(greeted(&shown.address, &[head(1, &format!("/{service}/{method}"), &[]), half].concat()));
        }
        let cancelled = format!("{prefix}_calls_total{{method=\"{service}/{method}\",code=\"CANCELLED\"}} 5");
        let begun = Instant::now();
        while !shown.get("/metrics").1.lines().any(|line| line == cancelled) {
            let (_, text) = shown.get("/metrics");
            assert!(begun.elapsed() < Duration::from_secs(10), "no {cancelled} in\n{text}");
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
        assert_eq!(
            shown.number(&format!("{prefix}_calls_total{{method=\"{service}/{method}\",code=\"UNKNOWN\"}}")),
            0.0
        );
    }
    for log in [server.stop(), learner.stop()] {
        assert!(log.is_empty(), "{log}");
    }
}

/// The objects of a log.
fn lines(log: &str) -> Vec<serde_json::Value> {
    log.lines().map(|line| serde_json::from_str(line).unwrap_or_else(|_| panic!("no object: {line}"))).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_stream_that_is_ended_from_outside_is_named_in_the_log() {
    let authority = Authority::new();
    let alice = authority.token("alice", &[Scope::Act], &Quotas::default());
    let file = std::fs::read_to_string(authority.path("tokens.toml")).expect("a file");
    let bob = authority.token("bob", &[Scope::Act], &Quotas::default());
    let tokens = authority.path("tokens.toml");
    let arguments = ["--log-format", "json", "--log", "info", "--stall-timeout-secs", "0.5", "--tokens"];
    let server = Shown::server(&[&arguments[..], &[tokens.to_str().expect("a path")]].concat());
    let channel = mazeway_client::channel(&server.address).await.expect("connects");
    let mut of_bob = EnvironmentServiceClient::new(bearing(channel.clone(), &bob));
    let mut request = Request::new(tokio_stream::pending());
    request.metadata_mut().insert("x-request-id", "revoked-1".parse().expect("a value"));
    let mut revoked = of_bob.interact(request).await.expect("a stream").into_inner();
    let mut of_alice = EnvironmentServiceClient::new(bearing(channel, &alice));
    let mut request = Request::new(env_pb::RolloutRequest {
        env_id: "Maze-v0".into(),
        controller: Some(env_pb::rollout_request::Controller::Driver("random".into())),
        episodes: 1_000_000,
        steps: 100,
        ..Default::default()
    });
    request.metadata_mut().insert("x-request-id", "unread-1".parse().expect("a value"));
    let unread = of_alice.rollout(request).await.expect("a stream");
    std::fs::write(&tokens, file).expect("writes");
    revoked.message().await.expect_err("it is ended");
    tokio::time::sleep(Duration::from_secs(2)).await;
    drop(unread);
    let log = server.stop();
    for (message, id, method, caller) in [
        ("a call whose token holds no more is ended", "revoked-1", "Interact", "bob"),
        ("a stream that nobody reads is ended", "unread-1", "Rollout", "alice"),
    ] {
        let lines = lines(&log);
        let line = lines.iter().find(|line| line["message"] == message).unwrap_or_else(|| panic!("{message}: {log}"));
        let span = &line["span"];
        assert_eq!(
            (&span["request_id"], &span["rpc.method"], &span["caller"]),
            (&id.into(), &method.into(), &caller.into())
        );
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_service_says_when_it_begins_and_ends_and_no_health_stream_holds_it_up() {
    let authority = Authority::new();
    authority.token("alice", &[Scope::Act], &Quotas::default());
    let tokens = authority.path("tokens.toml");
    let server =
        Shown::server(&["--log", "info", "--shutdown-grace-secs", "20", "--tokens", tokens.to_str().expect("a path")]);
    let data = tempfile::tempdir().expect("a directory");
    let mut command = Command::new(program("learner"));
    command.args(["serve", "--log", "info", "--shutdown-grace-secs", "20", "--data"]).arg(data.path());
    let learner = Shown::start(command);
    for (shown, auth) in [(server, "tokens"), (learner, "nobody")] {
        let address = shown.address.clone();
        let mut health = HealthClient::new(mazeway_client::channel(&address).await.expect("connects"));
        let mut watched = health.watch(HealthCheckRequest::default()).await.expect("health").into_inner();
        let first = watched.message().await.expect("health").map(|answer| answer.status());
        assert_eq!(first, Some(ServingStatus::Serving));
        let begun = Instant::now();
        let stopping = std::thread::spawn(move || shown.stop());
        let last = watched.message().await.expect("health").map(|answer| answer.status());
        assert_eq!(last, Some(ServingStatus::NotServing));
        let status = watched.message().await.expect_err("it is ended");
        assert_eq!(status.code(), Code::Unavailable, "{status}");
        let log = stopping.join().expect("an end");
        assert!(begun.elapsed() < Duration::from_secs(10), "{:?}", begun.elapsed());
        assert!(!log.contains('\x1b'), "no colours where nobody sees them: {log:?}");
        let told: Vec<_> = log.lines().filter(|line| line.contains("the service ")).collect();
        assert_eq!(told.len(), 3, "{log}");
        assert!(told[0].contains("takes calls") && told[0].contains(&address), "{log}");
        assert!(told[0].contains("tls=false") && told[0].contains(auth), "{log}");
        assert!(told[1].contains("told to stop") && told[2].contains("has stopped"), "{log}");
    }
}
