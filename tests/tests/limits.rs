//! What a peer may take of the transport, and for how long: deadlines, idle and silent connections, readers that do not
//! read, calls given up without end, metadata beyond all bounds. Each limit is tried against a real server, beside a
//! neighbour that it must not touch.

use mazeway_client::{Code, channel, packed::pack};
use mazeway_proto::env::{
    self as pb, environment_service_client::EnvironmentServiceClient, rollout_request::Controller,
};
use mazeway_server::Config;
use mazeway_serving::DoorConfig;
use mazeway_tests::{EnvServer, config};
use std::time::Duration;
use tokio::{
    io::{AsyncReadExt as _, AsyncWriteExt as _},
    net::TcpStream,
    sync::mpsc,
    time::{Instant, sleep, timeout},
};
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Request, Response, Status, Streaming, transport::Channel};
use tonic_health::pb::{HealthCheckRequest, HealthCheckResponse, health_client::HealthClient};

type Service = EnvironmentServiceClient<Channel>;

fn server(door: DoorConfig) -> EnvServer {
    EnvServer::with(Config { door, ..config() })
}

async fn service(server: &EnvServer) -> Service {
    EnvironmentServiceClient::new(channel(&server.address()).await.expect("a channel"))
}

async fn lists(service: &mut Service) -> bool {
    service.list_environments(pb::ListEnvironmentsRequest {}).await.is_ok()
}

/// A server, and a call to it that takes long.
async fn with_long_call(door: DoorConfig) -> (EnvServer, Service, pb::CreateSessionRequest) {
    let server = EnvServer::with(Config { door, max_envs_per_session: 65_536, ..config() });
    let service = service(&server).await;
    let large = pb::CreateSessionRequest { env_id: "Highway-v0".into(), num_envs: 65_536, ..Default::default() };
    (server, service, large)
}

#[tokio::test]
async fn a_call_that_asks_for_no_deadline_has_one() {
    let door = DoorConfig { call_deadline: Duration::from_millis(1), ..DoorConfig::default() };
    let (_server, mut service, large) = with_long_call(door).await;
    let status = service.create_session(large).await.expect_err("it takes longer");
    assert_eq!(status.code(), Code::DeadlineExceeded, "{status}");
    // A stream has the deadline that it asks for, and none otherwise.
    let begun = Instant::now();
    let mut request = Request::new(tokio_stream::pending());
    request.metadata_mut().insert("grpc-timeout", "300m".parse().expect("a value"));
    let mut asked = service.interact(request).await.expect("a stream").into_inner();
    let mut unasked = service.interact(tokio_stream::pending()).await.expect("a stream").into_inner();
    let status = asked.message().await.expect_err("it ends");
    assert_eq!(status.code(), Code::DeadlineExceeded, "{status}");
    assert!(begun.elapsed() >= Duration::from_millis(290), "{:?}", begun.elapsed());
    timeout(Duration::from_millis(200), unasked.message()).await.expect_err("it goes on");
    let mut wrong = Request::new(pb::ListEnvironmentsRequest {});
    wrong.metadata_mut().insert("grpc-timeout", "soon".parse().expect("a value"));
    let status = service.list_environments(wrong).await.expect_err("no time");
    assert!(status.code() == Code::InvalidArgument && status.message().starts_with("grpc-timeout: "), "{status}");
}

#[tokio::test]
async fn a_deadline_is_cut_to_the_longest_there_is() {
    let door = DoorConfig { max_call_deadline: Duration::from_millis(1), ..DoorConfig::default() };
    let (_server, mut service, large) = with_long_call(door).await;
    let mut request = Request::new(large);
    request.set_timeout(Duration::from_hours(1));
    let status = service.create_session(request).await.expect_err("it takes longer");
    assert_eq!(status.code(), Code::DeadlineExceeded, "{status}");
}

#[tokio::test]
async fn streams_beyond_the_limit_of_their_connection_wait_for_their_turn() {
    let server = EnvServer::with(Config { max_streams_per_connection: 2, ..config() });
    let (mut full, mut other) = (service(&server).await, service(&server).await);
    let (first, requests) = mpsc::channel(1);
    let _answers = full.interact(ReceiverStream::new(requests)).await.expect("a stream");
    let _second = full.interact(tokio_stream::pending()).await.expect("a stream");
    timeout(Duration::from_millis(200), lists(&mut full.clone())).await.expect_err("there is no room");
    assert!(lists(&mut other).await, "another connection has its own");
    // Who says that there are no more requests ends a stream.
    drop(first);
    assert!(timeout(Duration::from_secs(10), lists(&mut full)).await.expect("its turn comes"));
}

#[tokio::test]
async fn a_peer_that_answers_no_ping_is_let_go() {
    let server = EnvServer::with(Config { keepalive: Duration::from_millis(200), ..config() });
    let mut service = service(&server).await;
    let mut stream = service.interact(tokio_stream::pending()).await.expect("a stream").into_inner();
    let mut mute = TcpStream::connect(server.socket()).await.expect("connects");
    mute.write_all(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\0\0\0\x04\0\0\0\0\0").await.expect("greets");
    // It has ten seconds to answer.
    let lasted = ends(mute).await;
    assert!(lasted >= Duration::from_secs(10), "{lasted:?}");
    timeout(Duration::from_millis(100), stream.message()).await.expect_err("one that answers stays");
}

/// Waits for the end of a connection, and says how long that took.
async fn ends(mut connection: TcpStream) -> Duration {
    let begun = Instant::now();
    let mut bytes = [0; 1024];
    let end = async { while matches!(connection.read(&mut bytes).await, Ok(1..)) {} };
    timeout(Duration::from_secs(20), end).await.expect("an end");
    begun.elapsed()
}

#[tokio::test]
async fn silent_and_idle_connections_are_closed_and_used_ones_stay() {
    let door = DoorConfig {
        handshake_timeout: Duration::from_millis(300),
        idle_timeout: Duration::from_millis(900),
        ..DoorConfig::default()
    };
    let server = server(door);
    let mut service = service(&server).await;
    let mut stream = service.interact(tokio_stream::pending()).await.expect("a stream").into_inner();
    let silent = TcpStream::connect(server.socket()).await.expect("connects");
    let mut idle = TcpStream::connect(server.socket()).await.expect("connects");
    idle.write_all(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\0\0\0\x04\0\0\0\0\0").await.expect("greets");
    let (silent, idle) = tokio::join!(ends(silent), ends(idle));
    assert!(silent >= Duration::from_millis(250) && idle >= Duration::from_millis(800), "{silent:?}, {idle:?}");
    // Half a greeting is no better than none, nor is one without its last byte.
    for half in [&b"PRI * HTT"[..], b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r"] {
        let mut connection = TcpStream::connect(server.socket()).await.expect("connects");
        connection.write_all(half).await.expect("greets");
        let half = ends(connection).await;
        assert!(half >= Duration::from_millis(250) && half < Duration::from_millis(800), "{half:?}");
    }
    timeout(Duration::from_millis(100), stream.message()).await.expect_err("it goes on");
}

async fn watch(channel: &Channel) -> Result<Streaming<HealthCheckResponse>, Status> {
    let mut watched = HealthClient::new(channel.clone()).watch(HealthCheckRequest::default()).await?.into_inner();
    watched.message().await?.expect("a status");
    Ok(watched)
}

#[tokio::test]
async fn health_streams_keep_no_connection_and_end_with_theirs() {
    let server = server(DoorConfig { idle_timeout: Duration::from_millis(600), ..DoorConfig::default() });
    let (strangers, used) = (channel(&server.address()).await, channel(&server.address()).await);
    let (strangers, used) = (strangers.expect("a channel"), used.expect("a channel"));
    let mut service = EnvironmentServiceClient::new(used.clone());
    let mut stream = service.interact(tokio_stream::pending()).await.expect("a stream").into_inner();
    let mut kept = watch(&used).await.expect("health");
    let begun = Instant::now();
    let mut watched = watch(&strangers).await.expect("health");
    let checking = async {
        // Nor do calls that are over at once.
        loop {
            HealthClient::new(strangers.clone()).check(HealthCheckRequest::default()).await.expect("health");
            sleep(Duration::from_millis(100)).await;
        }
    };
    let status = tokio::select! {
        ended = timeout(Duration::from_secs(5), watched.message()) => ended.expect("an end").expect_err("a status"),
        () = checking => unreachable!("it never ends"),
    };
    assert_eq!(status.code(), Code::Unavailable, "{status}");
    assert!(begun.elapsed() >= Duration::from_millis(500), "{:?}", begun.elapsed());
    // Who is told so comes again.
    watch(&strangers).await.expect("health");
    timeout(Duration::from_millis(100), kept.message()).await.expect_err("it goes on beside a stream that is used");
    timeout(Duration::from_millis(100), stream.message()).await.expect_err("it goes on");
}

#[tokio::test]
async fn calls_that_need_nothing_are_few_on_a_connection() {
    let server = server(DoorConfig::default());
    let channel = channel(&server.address()).await.expect("a channel");
    let mut watched = Vec::new();
    for _ in 0..32 {
        watched.push(watch(&channel).await.expect("health"));
    }
    let status = watch(&channel).await.expect_err("one too many");
    assert_eq!(status.code(), Code::ResourceExhausted, "{status}");
    assert!(lists(&mut EnvironmentServiceClient::new(channel.clone())).await, "all else goes on");
    watched.pop();
    let again = async {
        while watch(&channel).await.is_err() {
            sleep(Duration::from_millis(10)).await;
        }
    };
    timeout(Duration::from_secs(5), again).await.expect("there is room again");
}

#[tokio::test]
async fn a_stream_that_nobody_reads_ends_and_its_neighbour_goes_on() {
    let server = server(DoorConfig { stall_timeout: Duration::from_millis(500), ..DoorConfig::default() });
    let mut service = service(&server).await;
    let request = pb::RolloutRequest {
        env_id: "Maze-v0".into(),
        controller: Some(Controller::Driver("random".into())),
        episodes: 1_000_000,
        steps: 100,
        ..Default::default()
    };
    let mut unread = service.rollout(request).await.expect("a stream").into_inner();
    let session = pb::CreateSessionRequest { env_id: "Maze-v0".into(), ..Default::default() };
    let session_id = service.create_session(session).await.expect("a session").into_inner().session_id;
    let reset = pb::ResetRequest { session_id: session_id.clone(), seed: Some(1), ..Default::default() };
    service.reset(reset).await.expect("resets");
    let begun = Instant::now();
    while begun.elapsed() < Duration::from_secs(3) {
        let step = pb::StepRequest { session_id: session_id.clone(), actions: pack([0_i32]) };
        service.step(step).await.expect("steps on the same connection");
        sleep(Duration::from_millis(20)).await;
    }
    // What had come is there; then it ends, long before the roll-out would.
    let rest = async {
        loop {
            match unread.message().await {
                Ok(Some(_)) => {}
                end => return end,
            }
        }
    };
    timeout(Duration::from_secs(10), rest).await.expect("an end").expect_err("it is cut off");
}

#[tokio::test]
async fn calls_given_up_without_end_close_their_connection() {
    let server = server(DoorConfig { max_resets_per_second: 50, ..DoorConfig::default() });
    let (mut hostile, mut neighbour) = (service(&server).await, service(&server).await);
    let session = pb::CreateSessionRequest { env_id: "Maze-v0".into(), ..Default::default() };
    let session_id = neighbour.create_session(session).await.expect("a session").into_inner().session_id;
    // A call whose request is whole: dropping its answer resets it.
    let open = async |service: &mut Service| {
        let request = pb::WatchRequest { session_id: session_id.clone(), ..Default::default() };
        service.watch(request).await.map(Response::into_inner)
    };
    let pending = tokio_stream::pending;
    let mut of_hostile = hostile.interact(pending()).await.expect("a stream").into_inner();
    let mut of_neighbour = neighbour.interact(pending()).await.expect("a stream").into_inner();
    // As many as a client may need.
    for _ in 0..30 {
        drop(open(&mut neighbour).await.expect("a stream"));
    }
    let ended = async {
        loop {
            // Its channel connects anew by itself: that it was closed is seen by the stream that it had.
            drop(open(&mut hostile).await);
            if timeout(Duration::from_micros(1), of_hostile.message()).await.is_ok() {
                return;
            }
        }
    };
    timeout(Duration::from_secs(20), ended).await.expect("the connection is closed");
    timeout(Duration::from_millis(100), of_neighbour.message()).await.expect_err("the neighbour's stream goes on");
    assert!(lists(&mut neighbour).await, "the neighbour pays for it");
}

#[tokio::test]
async fn metadata_is_bounded() {
    let server = server(DoorConfig::default());
    let mut service = service(&server).await;
    let with = |bytes: usize| {
        let mut request = Request::new(pb::ListEnvironmentsRequest {});
        for name in ["x-one", "x-two", "x-three", "x-four"] {
            request.metadata_mut().insert(name, "a".repeat(bytes / 4).parse().expect("a value"));
        }
        request
    };
    service.list_environments(with(8 << 10)).await.expect("half is no matter");
    for _ in 0..10 {
        service.list_environments(with(24 << 10)).await.expect_err("more than there may be");
    }
    assert!(lists(&mut service).await, "it serves the next call");
}
