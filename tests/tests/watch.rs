//! Watching: what viewers see, and that nobody else notices them.

use mazeway_client::{
    Autoreset, ClientError, Code, Connection, Env, Frame, Frames, Observation, PictureMode, Seeds, SessionOptions,
    VectorEnv, WatchOptions, channel, packed::pack,
};
use mazeway_proto::env::{self as pb, environment_service_client::EnvironmentServiceClient};
use mazeway_server::Config;
use mazeway_tests::{
    EnvServer, config,
    worlds::{self, Worlds},
};
use std::time::{Duration, Instant};
use tokio::time::timeout;

/// Far longer than anything takes.
const PATIENCE: Duration = Duration::from_secs(30);

async fn maze(connection: &Connection) -> Env {
    Env::create(connection, "Maze-v0", SessionOptions::default()).await.expect("a session")
}

async fn next(frames: &mut Frames) -> Option<Frame> {
    timeout(PATIENCE, frames.next()).await.expect("a picture in time").expect("a picture")
}

fn text(frame: &Frame) -> String {
    String::from_utf8(frame.content.to_vec()).expect("text")
}

fn fast() -> WatchOptions {
    WatchOptions { max_fps: Some(60.0), ..WatchOptions::default() }
}

#[tokio::test]
async fn a_viewer_sees_every_step_of_a_slow_session_and_its_end() {
    let server = EnvServer::start();
    let (viewer, agent) = (Connection::open(&server.address()).await, Connection::open(&server.address()).await);
    let (viewer, mut env) = (viewer.expect("a server"), maze(&agent.expect("a server")).await);
    let mut frames = viewer.watch(env.session_id(), fast()).await.expect("a watch");
    env.reset(Some(7)).await.expect("resets");
    let first = next(&mut frames).await.expect("a first picture");
    assert_eq!((first.step, first.episode_step, first.skipped, first.episode_ended), (0, 0, 0, false));
    assert_eq!(text(&first), env.render_text().await.expect("a picture"));
    for step in 1..=5 {
        env.step(step % 4).await.expect("steps");
        let frame = next(&mut frames).await.expect("another");
        assert_eq!((frame.step, frame.episode_step, frame.skipped), (u64::from(step), step, 0));
        assert_eq!(text(&frame), env.render_text().await.expect("a picture"));
    }
    env.reset(None).await.expect("resets");
    let frame = next(&mut frames).await.expect("another");
    assert_eq!((frame.step, frame.episode_step), (5, 0));
    env.close().await.expect("closes");
    assert_eq!(next(&mut frames).await, None);
}

#[tokio::test]
async fn an_idle_session_is_seen_at_once_and_lives_no_longer_for_it() {
    let server = EnvServer::start();
    let connection = Connection::open(&server.address()).await.expect("a server");
    let options = SessionOptions { lease: Some(Duration::from_secs(1)), ..SessionOptions::default() };
    let mut env = Env::create(&connection, "Highway-v0", options).await.expect("a session");
    env.reset(Some(1)).await.expect("resets");
    let begun = Instant::now();
    // Slow viewers, of whom the later ones need not wait for the group's next look.
    let watch =
        WatchOptions { mode: PictureMode::Png, max_fps: Some(0.01), max_width: Some(200), ..WatchOptions::default() };
    let mut viewers = Vec::new();
    for _ in 0..3 {
        let mut frames = connection.watch(env.session_id(), watch).await.expect("a watch");
        let frame = next(&mut frames).await.expect("a picture");
        assert!(frame.content.starts_with(b"\x89PNG") && frame.width == 200 && frame.height > 0, "{frame:?}");
        viewers.push(frames);
    }
    for mut frames in viewers {
        assert_eq!(next(&mut frames).await, None, "the session ends");
    }
    assert!(begun.elapsed() < Duration::from_secs(20), "{:?}", begun.elapsed());
    assert_eq!(env.step(0).await.expect_err("it is gone").code(), Code::DeadlineExceeded);
}

#[tokio::test]
async fn sessions_of_every_kind_of_call_are_seen() {
    let server = EnvServer::start();
    let connection = Connection::open(&server.address()).await.expect("a server");
    // A batch that is stepped on a thread for blocking work.
    let large = SessionOptions::default();
    let mut envs = VectorEnv::create(&connection, "Maze-v0", 500, Autoreset::NextStep, large).await.expect("a session");
    let watch = WatchOptions { index: 499, ..fast() };
    let mut frames = connection.watch(envs.session_id(), watch).await.expect("a watch");
    envs.reset(Seeds::From(3)).await.expect("resets");
    assert_eq!(next(&mut frames).await.expect("a picture").step, 0);
    envs.step(&[1; 500]).await.expect("steps");
    let frame = next(&mut frames).await.expect("a picture");
    assert_eq!((frame.step, text(&frame)), (1, envs.render_text(499).await.expect("a picture")));

    // A world of dm_env_rpc, stepped by an agent that knows nothing of viewers.
    let mut agent = Worlds::connect(&server.address()).await;
    let name = agent.create(worlds::settings([("env_id", worlds::text("Maze-v0"))])).await.expect("a world");
    agent.join(&name).await.expect("joins");
    let mut frames = connection.watch(&name, fast()).await.expect("a watch");
    for step in 0..3 {
        agent.step(worlds::int32s(vec![1], vec![]), vec![]).await.expect("steps");
        let frame = next(&mut frames).await.expect("a picture");
        assert_eq!((frame.step, frame.skipped), (step, 0));
    }
    agent.leave().await.expect("leaves");
    agent.destroy(&name).await.expect("ends");
    assert_eq!(next(&mut frames).await, None);

    // Unary calls, which hold the session for a call alone.
    let mut service = EnvironmentServiceClient::new(channel(&server.address()).await.expect("a channel"));
    let request = pb::CreateSessionRequest { env_id: "Maze-v0".into(), ..Default::default() };
    let session_id = service.create_session(request).await.expect("a session").into_inner().session_id;
    let mut frames = connection.watch(&session_id, fast()).await.expect("a watch");
    let reset = pb::ResetRequest { session_id: session_id.clone(), seed: Some(1), ..Default::default() };
    service.reset(reset).await.expect("resets");
    assert_eq!(next(&mut frames).await.expect("a picture").step, 0);
    for step in 1..4 {
        let actions = pack([0_i32]);
        service.step(pb::StepRequest { session_id: session_id.clone(), actions }).await.expect("steps");
        let frame = next(&mut frames).await.expect("a picture");
        assert_eq!((frame.step, frame.skipped), (step, 0));
    }
}

/// Steps as fast as it goes for some time; returns what was seen of the first steps, and how many there were.
async fn drive(env: &mut Env, time: Duration) -> (Vec<(Observation, f64)>, u64) {
    env.reset(Some(11)).await.expect("resets");
    let (begun, mut seen, mut steps) = (Instant::now(), Vec::new(), 0);
    while begun.elapsed() < time || steps < 2_000 {
        let step = env.step((steps % 12) as u32).await.expect("steps");
        steps += 1;
        if seen.len() < 2_000 {
            seen.push((step.observation, step.reward));
        }
        if step.terminated || step.truncated {
            env.reset(None).await.expect("resets");
        }
    }
    (seen, steps)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn fifty_viewers_of_whom_forty_read_nothing_change_nothing() {
    let server = EnvServer::start();
    let agent = Connection::open(&server.address()).await.expect("a server");
    let highway = async || Env::create(&agent, "Highway-v0", SessionOptions::default()).await.expect("a session");
    let time = Duration::from_secs(2);
    let (unseen, _) = drive(&mut highway().await, time).await;

    let mut env = highway().await;
    let (mut idle, mut readers) = (Vec::new(), Vec::new());
    for viewer in 0..50 {
        let connection = Connection::open(&server.address()).await.expect("a server");
        let mode = if viewer % 2 == 0 { PictureMode::Rgb } else { PictureMode::Png };
        let frames = connection.watch(env.session_id(), WatchOptions { mode, ..fast() }).await.expect("a watch");
        if viewer < 40 { idle.push(frames) } else { readers.push(frames) }
    }
    let readers: Vec<_> = readers
        .into_iter()
        .map(|mut frames| {
            tokio::spawn(async move {
                let (mut pictures, mut changes) = (0_u64, 0);
                while let Some(frame) = next(&mut frames).await {
                    assert!(frame.skipped == 0 || pictures > 0, "a first picture skips nothing");
                    (pictures, changes) = (pictures + 1, changes + frame.skipped + 1);
                }
                (pictures, changes)
            })
        })
        .collect();
    let (seen, steps) = drive(&mut env, time).await;
    env.close().await.expect("closes");
    assert!(seen == unseen, "the trajectory is another with viewers");
    for reader in readers {
        let (pictures, changes) = reader.await.expect("a reader");
        // Far fewer pictures than steps, and what they skipped accounts for the rest: resets are changes too.
        assert!((3..=60 * 30).contains(&pictures), "{pictures} pictures");
        assert!(changes <= steps + steps / 100 + 2 && changes > pictures, "{changes} changes in {steps} steps");
    }
    // One who read nothing finds some old pictures, and then the end.
    let mut late = 0;
    while next(&mut idle[0]).await.is_some() {
        late += 1;
    }
    assert!(late < 1000, "{late} pictures were kept for a viewer who read none");
}

#[track_caller]
fn refused(error: &ClientError, code: Code, field: &str, message: &str) {
    assert_eq!((error.code(), error.field(), error.to_string().as_str()), (code, Some(field), message));
}

#[tokio::test]
async fn wrong_watches_name_their_field_and_viewers_have_limits() {
    let server = EnvServer::with(Config { max_viewers: 3, max_viewers_per_session: 2, ..config() });
    let connection = Connection::open(&server.address()).await.expect("a server");
    let mut env = maze(&connection).await;
    let id = env.session_id().to_owned();
    let refusal = async |id: &str, options: WatchOptions| match connection.watch(id, options).await {
        Ok(mut frames) => timeout(PATIENCE, frames.next()).await.expect("an answer").expect_err("a refusal"),
        Err(error) => error,
    };
    let unknown = "0123456789abcdef0123456789abcdef";
    let error = refusal(unknown, fast()).await;
    refused(&error, Code::NotFound, "session_id", "no such session");
    let error = refusal("", fast()).await;
    refused(&error, Code::InvalidArgument, "session_id", "expected a session id, got none");
    let error = refusal(&id, WatchOptions { index: 1, ..fast() }).await;
    refused(&error, Code::InvalidArgument, "index", "expected an index below 1, got 1");
    for fps in [-1.0, f32::NAN, f32::INFINITY, 0.001] {
        let error = refusal(&id, WatchOptions { max_fps: Some(fps), ..fast() }).await;
        assert_eq!((error.code(), error.field()), (Code::InvalidArgument, Some("max_fps")), "{error}");
    }
    let error = refusal(&id, WatchOptions { max_width: Some(80), ..fast() }).await;
    refused(&error, Code::InvalidArgument, "max_width", "expected none with text, which has no pixels");

    let other = maze(&connection).await;
    let watch = async |env: &Env| connection.watch(env.session_id(), fast()).await;
    let (first, _second) = (watch(&env).await.expect("a place"), watch(&env).await.expect("a place"));
    let error = watch(&env).await.expect_err("a limit");
    refused(&error, Code::ResourceExhausted, "viewers", "expected at most 2 viewers of a session, asked for 3");
    let _third = watch(&other).await.expect("a place");
    let error = watch(&other).await.expect_err("a limit");
    refused(&error, Code::ResourceExhausted, "viewers", "expected at most 3 viewers on this server, asked for 4");
    // A place is free again once its viewer has gone.
    drop(first);
    let begun = Instant::now();
    let mut frames = loop {
        match watch(&env).await {
            Ok(frames) => break frames,
            Err(error) => assert!(begun.elapsed() < PATIENCE, "{error}"),
        }
    };
    env.reset(Some(1)).await.expect("resets");
    assert_eq!(next(&mut frames).await.expect("a picture").step, 0);
    // A server that stops tells its viewers.
    server.stop();
    let error = timeout(PATIENCE, frames.next()).await.expect("an end").expect_err("an error");
    assert_eq!(error.code(), Code::Unavailable, "{error}");
}
