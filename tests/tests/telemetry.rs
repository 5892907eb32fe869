//! What services show of themselves: numbers, spans at a real collector, logs, health.

use mazeway_client::{Connection, Env, Learner, SessionOptions};
use mazeway_proto::{
    env::{self as env_pb, environment_service_client::EnvironmentServiceClient},
    learner as pb,
};
use mazeway_tests::{learner::trajectory, programs::program};
use opentelemetry_proto::tonic::{
    collector::trace::v1::{
        ExportTraceServiceRequest, ExportTraceServiceResponse,
        trace_service_server::{TraceService, TraceServiceServer},
    },
    common::v1::any_value::Value,
    trace::v1::Span,
};
use std::{
    io::{BufRead as _, BufReader, Read as _, Write as _},
    net::TcpStream,
    process::{Child, Command, Stdio},
    sync::{Arc, Mutex},
    time::Duration,
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

fn request_id(status: &Status) -> String {
    status.get_details_request_info().expect("the request's name among the details").request_id
}

#[tokio::test(flavor = "multi_thread")]
async fn a_server_counts_what_it_does() {
    let server = Shown::server(&["--max-sessions", "2"]);
    assert_eq!(server.get("/healthz").0, "HTTP/1.0 200 OK");
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
        assert_eq!(service.number(name), number, "{name}");
    }
    assert!(service.number("mazeway_learner_commit_seconds_count") >= 2.0);
    assert!(service.number("mazeway_learner_store_bytes") > bytes as f64);
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
