//! The face of `dm_env_rpc`: DeepMind's own client and compliance tests, the numbers of the other face, shared limits,
//! lives of worlds, and hostile requests.

use mazeway_client::{Autoreset, Code, Connection, Seeds, SessionOptions, VectorEnv};
use mazeway_proto::dm_env::{
    self as pb, EnvironmentStateType as State, environment_request::Payload as Request,
    environment_response::Payload as Response,
};
use mazeway_server::Config;
use mazeway_tests::{
    EnvServer, config,
    faces::{Face, Make, Reply, Subject},
    venv::Venv,
    worlds::{Settings, Worlds, int32s, integer, number, packed, settings, text, unsigned},
};
use std::{fs, path::Path, time::Duration};
use tokio::time::{sleep, timeout};
use tonic_types::{Status, StatusExt as _};

/// Far longer than anything takes.
const PATIENCE: Duration = Duration::from_mins(1);

#[test]
fn deepminds_client_adaptor_and_compliance_tests_pass() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("dm_env_rpc");
    let venv = Venv::new("dm-env-rpc", &folder.join("requirements.txt"));
    let server = EnvServer::start();
    let descriptors = tempfile::NamedTempFile::new().expect("a file");
    fs::write(descriptors.path(), mazeway_proto::DM_ENV_RPC_FILE_DESCRIPTOR_SET).expect("descriptors");
    let mut pytest = venv.module("pytest");
    pytest.args(["-p", "no:cacheprovider", "--quiet", "-rs", "."]).current_dir(&folder);
    pytest.env("MAZEWAY_ADDRESS", server.address()).env("MAZEWAY_DM_ENV_RPC_DESCRIPTORS", descriptors.path());
    let said = venv.run(&mut pytest);
    assert!(!said.contains(" skipped"), "tests were skipped:\n{said}");
}

/// The settings that make the world of a native session.
fn same_world(make: &Make, batched: bool, seed: u64) -> Settings {
    let mut all = settings([("env_id", text(make.env_id)), ("seed", unsigned(seed))]);
    if batched {
        all.insert("num_envs".into(), integer(make.num_envs as i64));
    }
    if let Some(steps) = make.max_episode_steps {
        all.insert("max_episode_steps".into(), integer(steps.into()));
    }
    // Every option that a JSON value can express.
    all.insert("options".into(), text(&serde_json::Value::Object(make.options.clone()).to_string()));
    all
}

/// What a step shows, as the other face packs it.
fn as_reply(step: &pb::StepResponse) -> Reply {
    let observation = |number: u64| packed(&step.observations[&number]);
    Reply {
        observations: observation(1),
        rewards: observation(2).as_chunks::<8>().0.iter().map(|bits| f64::from_le_bytes(*bits)).collect(),
        terminated: observation(3),
        truncated: observation(4),
        infos: step.observations.range(5..).map(|(_, tensor)| packed(tensor)).collect(),
        ..Reply::default()
    }
}

/// Plays the same actions through both faces and compares every number of every step, over several ends of episodes.
async fn plays_alike(server: &EnvServer, make: Make, batched: bool, seed: u64) {
    let mut native = Subject::make(Face::Interact, &server.address(), &make).await;
    let mut worlds = Worlds::connect(&server.address()).await;
    let world = worlds.create(same_world(&make, batched, seed)).await.expect("creates");
    let specs = worlds.join(&world).await.expect("joins");
    let all: Vec<u64> = specs.observations.keys().copied().collect();
    let n_actions = match specs.actions[&1].max.as_ref().and_then(|max| max.payload.as_ref()) {
        Some(pb::tensor_spec::value::Payload::Int32s(max)) => max.array[0] as u32 + 1,
        other => panic!("{other:?}"),
    };
    let shape = specs.actions[&1].shape.clone();
    let (mut expected, mut ends) = (native.reset(Seeds::From(seed), None).await.expect("resets"), 0);
    let mut state = seed as u32;
    let first = int32s(vec![], vec![]);
    let step = worlds.step(first, all.clone()).await.expect("begins");
    assert_eq!((step.state(), as_reply(&step)), (State::Running, expected.clone()), "{make:?}");
    for _ in 0..120 {
        let actions: Vec<u32> = (0..make.num_envs)
            .map(|_| {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                (state >> 16) % n_actions
            })
            .collect();
        let ended = !batched && expected.ended(0);
        expected = native.step(&actions).await.expect("steps");
        let packed = int32s(actions.iter().map(|&action| action as i32).collect(), shape.clone());
        let step = worlds.step(packed, all.clone()).await.expect("steps");
        assert_eq!(as_reply(&step), expected, "{make:?}");
        let wanted = match (batched || ended, expected.terminated[0] == 1, expected.truncated[0] == 1) {
            (false, true, _) => State::Terminated,
            (false, false, true) => State::Interrupted,
            _ => State::Running,
        };
        assert_eq!(step.state(), wanted);
        ends += usize::from(expected.ended(0));
    }
    assert!(ends >= 3, "{make:?}: {ends} ends");
    worlds.leave().await.expect("leaves");
    worlds.destroy(&world).await.expect("destroys");
}

#[tokio::test]
async fn every_number_is_that_of_the_other_face() {
    let server = EnvServer::start();
    let options = |value: serde_json::Value| value.as_object().expect("options").clone();
    let kinematics = serde_json::json!({"observation": "kinematics", "density": 6, "terminate_on_collision": true});
    let rewards = serde_json::json!({"slip": 0.5, "rewards": [[0, 0], [4, 4, -0.5]]});
    for (env_id, options) in [
        ("Maze-v0", options(serde_json::json!({}))),
        ("Maze-v0", options(rewards)),
        ("Highway-v0", options(serde_json::json!({"style": "legal"}))),
        ("Highway-v0", options(kinematics)),
    ] {
        for (num_envs, batched, seed) in [(1, false, 7), (1, true, u64::MAX), (3, true, 11), (300, true, 3)] {
            let make = Make::new(env_id, num_envs, Autoreset::NextStep);
            let make = Make { options: options.clone(), max_episode_steps: Some(25), ..make };
            plays_alike(&server, make, batched, seed).await;
        }
    }
}

#[tokio::test]
async fn sequences_are_seeded_and_reset_as_episodes_are() {
    let server = EnvServer::start();
    let mut native =
        Subject::make(Face::Interact, &server.address(), &Make::new("Maze-v0", 1, Autoreset::NextStep)).await;
    let mut worlds = Worlds::connect(&server.address()).await;
    let world = worlds.create(settings([("env_id", text("Maze-v0")), ("seed", integer(5))])).await.expect("creates");
    let specs = worlds.join(&world).await.expect("joins");
    let act = |action| int32s(vec![action], vec![]);
    let first = native.reset(Seeds::From(5), None).await.expect("resets");
    assert_eq!(as_reply(&worlds.step(act(0), (1..=7).collect()).await.expect("begins")), first);
    // A reset without settings goes on with the generator, and twice is once.
    assert_eq!(worlds.reset(Settings::new()).await.expect("resets"), specs);
    assert_eq!(worlds.reset(Settings::new()).await.expect("resets"), specs);
    let again = native.reset(Seeds::Continue, None).await.expect("resets");
    assert_eq!(as_reply(&worlds.step(act(3), (1..=7).collect()).await.expect("begins")), again);
    let next = native.step(&[3]).await.expect("steps");
    assert_eq!(as_reply(&worlds.step(act(3), (1..=7).collect()).await.expect("steps")), next);
    // A seed in the settings is that of the next sequence.
    worlds.reset(settings([("seed", integer(5))])).await.expect("resets");
    assert_eq!(as_reply(&worlds.step(act(1), (1..=7).collect()).await.expect("begins")), first);
    // Leaving and joining begins a sequence, with the generator where it is.
    worlds.leave().await.expect("leaves");
    assert_eq!(worlds.join(&world).await.expect("joins"), specs);
    assert_eq!(as_reply(&worlds.step(act(1), (1..=7).collect()).await.expect("begins")), again);
    // Options change the specs, and the answer has them.
    let changed = worlds.reset(settings([("options.layout", text("...\n.#.\n..."))])).await.expect("resets");
    assert_ne!(changed, specs);
    assert_eq!(worlds.step(act(0), vec![1]).await.expect("begins").observations.len(), 1);
}

#[tokio::test]
async fn limits_count_the_worlds_of_both_faces() {
    let server = EnvServer::with(Config { max_sessions: 2, max_total_envs: 10, max_envs_per_session: 8, ..config() });
    let connection = Connection::open(&server.address()).await.expect("connects");
    let make = SessionOptions::default();
    let native =
        VectorEnv::create(&connection, "Maze-v0", 5, Autoreset::NextStep, make.clone()).await.expect("creates");
    let mut worlds = Worlds::connect(&server.address()).await;
    let batch = |n| settings([("env_id", text("Maze-v0")), ("num_envs", integer(n))]);
    refused(worlds.create(batch(9)).await, Code::ResourceExhausted, "settings.num_envs");
    refused(worlds.create(batch(6)).await, Code::ResourceExhausted, "settings.num_envs");
    let world = worlds.create(batch(5)).await.expect("creates");
    refused(worlds.create(batch(1)).await, Code::ResourceExhausted, "worlds");
    let full = VectorEnv::create(&connection, "Maze-v0", 1, Autoreset::NextStep, make).await;
    assert_eq!(full.err().map(|error| error.code()), Some(Code::ResourceExhausted));
    worlds.destroy(&world).await.expect("destroys");
    drop(native);
    worlds.create(batch(5)).await.expect("there is room");
}

#[tokio::test]
async fn a_world_ends_with_its_connection_or_by_its_lease() {
    let server = EnvServer::with(Config { default_lease: Duration::from_millis(300), ..config() });
    let mut observer = Worlds::connect(&server.address()).await;
    let maze = || settings([("env_id", text("Maze-v0"))]);
    let leased = || settings([("env_id", text("Maze-v0")), ("lease_secs", number(600.0))]);

    // A world ends with its maker's connection, joined or not, unless it was given a lease.
    let mut maker = Worlds::connect(&server.address()).await;
    let joined = maker.create(maze()).await.expect("creates");
    let kept = maker.create(leased()).await.expect("creates");
    maker.join(&joined).await.expect("joins");
    drop(maker);
    eventually_refused(&mut observer, &joined, Code::NotFound).await;
    observer.join(&kept).await.expect("it lives on");
    observer.step(int32s(vec![], vec![]), vec![1]).await.expect("begins");
    observer.leave().await.expect("leaves");
    observer.destroy(&kept).await.expect("destroys");

    // Nobody uses it: the lease ends it, whether somebody sits in it or not, and the connection goes on.
    let mut sitter = Worlds::connect(&server.address()).await;
    let idle = sitter.create(maze()).await.expect("creates");
    sitter.join(&idle).await.expect("joins");
    eventually_refused(&mut observer, &idle, Code::DeadlineExceeded).await;
    let step = sitter.step(int32s(vec![0], vec![]), vec![]).await;
    refused(step, Code::DeadlineExceeded, "world_name");
    sitter.leave().await.expect("leaves");
    refused(sitter.step(int32s(vec![0], vec![]), vec![]).await, Code::FailedPrecondition, "");
    let next = sitter.create(maze()).await.expect("creates");
    sitter.join(&next).await.expect("joins");
}

/// Joins until that is refused as it should be in the end; another refusal than "somebody is in it" fails.
async fn eventually_refused(worlds: &mut Worlds, name: &str, code: Code) {
    let waits = async {
        loop {
            match worlds.join(name).await {
                Err(status) if status.code == i32::from(code) => return,
                Err(status) => assert_eq!(status.code, i32::from(Code::FailedPrecondition), "{status:?}"),
                Ok(_) => worlds.leave().await.expect("leaves"),
            }
            sleep(Duration::from_millis(50)).await;
        }
    };
    timeout(PATIENCE, waits).await.expect("it ends");
}

#[tokio::test]
async fn another_connection_resets_a_world_with_the_agents_next_step() {
    let server = EnvServer::start();
    let mut agent = Worlds::connect(&server.address()).await;
    let mut host = Worlds::connect(&server.address()).await;
    let world = host.create(settings([("env_id", text("Maze-v0")), ("seed", integer(1))])).await.expect("creates");
    agent.join(&world).await.expect("joins");
    refused(host.join(&world).await, Code::FailedPrecondition, "world_name");
    refused(host.destroy(&world).await, Code::FailedPrecondition, "world_name");
    let act = || int32s(vec![0], vec![]);
    let first = agent.step(act(), vec![1]).await.expect("begins");
    let last = agent.step(act(), vec![1]).await.expect("steps");
    let reset = |seed| {
        let settings = settings([("seed", integer(seed))]);
        Request::ResetWorld(pb::ResetWorldRequest { world_name: world.clone(), settings })
    };
    host.send(Some(reset(1))).await;
    // The agent learns of it by a step that shows what it saw last; then the host has its answer.
    let told = async {
        loop {
            let step = agent.step(act(), vec![1]).await.expect("steps");
            if step.state() == State::Interrupted {
                return;
            }
        }
    };
    timeout(PATIENCE, told).await.expect("it is told");
    assert!(matches!(host.receive().await, Ok(Response::ResetWorld(_))));
    assert_eq!(agent.step(act(), vec![1]).await.expect("begins"), first);
    assert_eq!(agent.step(act(), vec![1]).await.expect("steps"), last);
    // Specs that would change are refused, and the sequence goes on.
    let layout = settings([("options.layout", text("..."))]);
    host.send(Some(Request::ResetWorld(pb::ResetWorldRequest { world_name: world.clone(), settings: layout }))).await;
    let mut refusal = Box::pin(host.receive());
    let refusal = loop {
        tokio::select! {
            refusal = &mut refusal => break refusal,
            step = agent.step(act(), vec![1]) => assert_eq!(step.expect("steps").state(), State::Running),
        }
    };
    refused(refusal, Code::FailedPrecondition, "settings.options.layout");
}

/// Checks the code and the field of a refusal, in the message and in the details.
#[track_caller]
fn refused<T: std::fmt::Debug>(outcome: Result<T, Status>, code: Code, field: &str) {
    let status = outcome.expect_err("it is refused");
    assert_eq!(status.code, i32::from(code), "{status:?}");
    assert!(field.is_empty() || status.message.starts_with(&format!("{field}: ")), "{field:?}: {status:?}");
    assert!(!status.message.is_empty() && status.message.len() < 600, "{status:?}");
    let details = prost::Message::encode_to_vec(&status).into();
    let status = tonic::Status::with_details(code, status.message, details);
    let details = status.get_error_details();
    let fields = match code {
        Code::FailedPrecondition => {
            details.precondition_failure().map(|d| d.violations.iter().map(|v| v.subject.clone()).collect())
        }
        Code::ResourceExhausted => {
            details.quota_failure().map(|d| d.violations.iter().map(|v| v.subject.clone()).collect())
        }
        _ => details.bad_request().map(|d| d.field_violations.iter().map(|v| v.field.clone()).collect()),
    };
    assert_eq!(fields, Some(vec![field.to_owned()]), "{status:?}");
}

#[tokio::test]
async fn hostile_requests_are_answered_and_the_stream_goes_on() {
    use pb::tensor::{self, Payload};
    let server = EnvServer::start();
    let mut worlds = Worlds::connect(&server.address()).await;
    let maze = |name: &str, value| settings([("env_id", text("Maze-v0")), (name, value)]);
    let shaped = |payload, shape: &[i32]| pb::Tensor { payload: Some(payload), shape: shape.to_vec() };
    let doubles = |array: Vec<f64>, shape: &[i32]| shaped(Payload::Doubles(tensor::DoubleArray { array }), shape);

    // Out of order.
    worlds.send(None).await;
    refused(worlds.receive().await, Code::InvalidArgument, "payload");
    refused(worlds.step(int32s(vec![0], vec![]), vec![1]).await, Code::FailedPrecondition, "");
    refused(worlds.reset(Settings::new()).await, Code::FailedPrecondition, "");
    worlds.leave().await.expect("does nothing");
    for (name, code) in [("", Code::InvalidArgument), ("foo", Code::NotFound), (&"f".repeat(100_000), Code::NotFound)] {
        refused(worlds.join(name).await, code, "world_name");
        refused(worlds.destroy(name).await, code, "world_name");
    }

    // Settings.
    let long = "x".repeat(500_000);
    let deep = format!("{{\"rewards\": {}0{}}}", "[".repeat(100_000), "]".repeat(100_000));
    let wrong: Vec<(Settings, Code, &str)> = vec![
        (Settings::new(), Code::InvalidArgument, "settings.env_id"),
        (settings([("env_id", integer(1))]), Code::InvalidArgument, "settings.env_id"),
        (settings([("env_id", pb::Tensor::default())]), Code::InvalidArgument, "settings.env_id"),
        (settings([("env_id", text("Maze-v9"))]), Code::NotFound, "settings.env_id"),
        (settings([("env_id", text(&long))]), Code::NotFound, "settings.env_id"),
        (maze("seed", integer(-1)), Code::InvalidArgument, "settings.seed"),
        (maze("seed", number(0.5)), Code::InvalidArgument, "settings.seed"),
        (maze("seed", number(f64::NAN)), Code::InvalidArgument, "settings.seed"),
        (maze("seed", int32s(vec![1, 2], vec![2])), Code::InvalidArgument, "settings.seed"),
        (maze("num_envs", integer(0)), Code::InvalidArgument, "settings.num_envs"),
        (maze("num_envs", integer(i64::MAX)), Code::InvalidArgument, "settings.num_envs"),
        (maze("num_envs", unsigned(u64::from(u32::MAX))), Code::ResourceExhausted, "settings.num_envs"),
        (maze("max_episode_steps", unsigned(1 << 32)), Code::InvalidArgument, "settings.max_episode_steps"),
        (maze("lease_secs", number(f64::INFINITY)), Code::InvalidArgument, "settings.lease_secs"),
        (maze("lease_secs", number(-1.0)), Code::InvalidArgument, "settings.lease_secs"),
        (maze("lease_secs", number(1e9)), Code::InvalidArgument, "settings.lease_secs"),
        (maze("options", text("[1]")), Code::InvalidArgument, "settings.options"),
        (maze("options", text(&format!("{long:?}"))), Code::InvalidArgument, "settings.options"),
        (maze("options", text(&deep)), Code::InvalidArgument, "settings.options"),
        (maze("options.slip", text("much")), Code::InvalidArgument, "settings.options.slip"),
        (maze("options.slip", doubles(vec![0.1], &[2])), Code::InvalidArgument, "settings.options.slip"),
        (maze("options.slip", doubles(vec![0.1, 0.2], &[])), Code::InvalidArgument, "settings.options.slip"),
        (maze("options.slip", doubles(vec![0.1], &[i32::MAX; 3])), Code::InvalidArgument, "settings.options.slip"),
        (maze("options.slip", doubles(vec![0.1], &[1 << 30])), Code::InvalidArgument, "settings.options.slip"),
        (maze("options.slip", doubles(vec![], &[1 << 30, 0])), Code::InvalidArgument, "settings.options.slip"),
        (maze("options.slip", doubles(vec![], &[-1, 0])), Code::InvalidArgument, "settings.options.slip"),
        (maze("options.slip", doubles(vec![0.1; 4], &[-1, -1])), Code::InvalidArgument, "settings.options.slip"),
        (maze("options.slip", doubles(vec![0.1], &vec![1; 100_000])), Code::InvalidArgument, "settings.options.slip"),
        (
            maze("options.rewards", doubles(vec![1.0; 57 * 4], &[57, 4])),
            Code::InvalidArgument,
            "settings.options.rewards",
        ),
        (maze("options.layout", text(&long)), Code::InvalidArgument, "settings.options.layout"),
        (maze("options.nothing", number(1.0)), Code::InvalidArgument, "settings.options.nothing"),
        (maze("nothing", number(1.0)), Code::InvalidArgument, "settings.nothing"),
    ];
    for (settings, code, field) in wrong {
        refused(worlds.create(settings).await, code, field);
    }
    let refusal = worlds.create(maze(&long, number(1.0))).await.expect_err("refused");
    assert!(refusal.message.len() < 400 && refusal.code == i32::from(Code::InvalidArgument), "{refusal:?}");
    let twice =
        settings([("env_id", text("Maze-v0")), ("options", text("{\"slip\": 0.1}")), ("options.slip", number(0.2))]);
    refused(worlds.create(twice).await, Code::InvalidArgument, "settings.options.slip");

    // In a world: twice, destroyed under oneself, wrong settings.
    let batch = settings([("env_id", text("Highway-v0")), ("num_envs", integer(4)), ("seed", integer(3))]);
    let world = worlds.create(batch).await.expect("creates");
    let specs = worlds.join(&world).await.expect("joins");
    refused(worlds.join(&world).await, Code::FailedPrecondition, "");
    refused(worlds.destroy(&world).await, Code::FailedPrecondition, "world_name");
    refused(worlds.reset(settings([("env_id", text("Maze-v0"))])).await, Code::InvalidArgument, "settings.env_id");
    refused(
        worlds.reset(settings([("options.style", text("rude"))])).await,
        Code::InvalidArgument,
        "settings.options.style",
    );

    // Steps: what is unknown, of the wrong type, shape or range. None of it moves the world.
    let act = |array: Vec<i32>, shape: &[i32]| int32s(array, shape.to_vec());
    for wrong in [0, specs.observations.len() as u64 + 1, 64, 65, u64::MAX] {
        refused(
            worlds.step(act(vec![0], &[4]), vec![1, wrong]).await,
            Code::InvalidArgument,
            "requested_observations[1]",
        );
    }
    let all: Vec<u64> = specs.observations.keys().copied().collect();
    let first = worlds.step(pb::Tensor::default(), all.clone()).await.expect("begins, whatever the action");
    let wrong = [
        pb::Tensor::default(),
        act(vec![], &[]),
        act(vec![0], &[]),
        act(vec![0; 4], &[]),
        act(vec![0; 3], &[3]),
        act(vec![0; 3], &[4]),
        act(vec![0; 5], &[-1]),
        act(vec![0; 4], &[4, 1]),
        act(vec![0; 4], &[-1, -1]),
        act(vec![0; 4], &[-4, -4]),
        act(vec![0], &[-1]),
        act(vec![0], &[i32::MAX]),
        act(vec![0], &[i32::MAX, i32::MAX, i32::MAX]),
        act(vec![0; 4], &vec![1; 100_000]),
        act(vec![0, 0, 0, 12], &[4]),
        act(vec![0, 0, -1, 0], &[4]),
        act(vec![i32::MIN], &[4]),
        act(vec![0; 200_000], &[-1]),
        doubles(vec![0.0; 4], &[4]),
        shaped(Payload::Int64s(tensor::Int64Array { array: vec![0; 4] }), &[4]),
        shaped(Payload::Int8s(tensor::Int8Array { array: vec![0; 4].into() }), &[4]),
        shaped(Payload::Bools(tensor::BoolArray { array: vec![false; 4] }), &[4]),
        shaped(Payload::Strings(tensor::StringArray { array: vec!["0".into(); 4] }), &[4]),
        shaped(Payload::Protos(tensor::ProtoArray { array: vec![prost_types::Any::default(); 4] }), &[4]),
    ];
    for action in wrong {
        refused(worlds.step(action, all.clone()).await, Code::InvalidArgument, "actions[1]");
    }
    let request = |actions: &[(u64, pb::Tensor)]| pb::StepRequest {
        actions: actions.iter().cloned().collect(),
        requested_observations: vec![],
    };
    for (actions, field) in [
        (request(&[]), "actions[1]"),
        (request(&[(9, act(vec![0], &[4]))]), "actions[9]"),
        (request(&[(1, act(vec![0], &[4])), (u64::MAX, act(vec![0], &[4]))]), "actions[18446744073709551615]"),
    ] {
        refused(worlds.ask(Request::Step(actions)).await, Code::InvalidArgument, field);
    }
    // One element for all, and a dimension that is inferred, are as good; nothing before has moved the world.
    let next = worlds.step(act(vec![5], &[4]), all.clone()).await.expect("steps");
    worlds.reset(settings([("seed", integer(3))])).await.expect("resets");
    assert_eq!(worlds.step(act(vec![], &[]), all.clone()).await.expect("begins"), first);
    assert_eq!(worlds.step(act(vec![5; 4], &[-1]), all).await.expect("steps"), next);

    // Extensions.
    for (type_url, value, code, field) in [
        ("", vec![], Code::Unimplemented, "extension.type_url"),
        ("type.googleapis.com/google.protobuf.Struct", vec![], Code::Unimplemented, "extension.type_url"),
        (PROPERTIES, vec![0xff; 100], Code::InvalidArgument, "extension.value"),
        (PROPERTIES, vec![], Code::InvalidArgument, "extension.value.payload"),
    ] {
        let any = prost_types::Any { type_url: type_url.into(), value };
        refused(worlds.ask(Request::Extension(any)).await, code, field);
    }
}

const PROPERTIES: &str = "type.googleapis.com/dm_env_rpc.v1.extensions.properties.PropertyRequest";

#[tokio::test]
async fn a_peer_that_reads_nothing_is_held_up_and_nobody_else() {
    let server = EnvServer::start();
    let address = server.address();
    let mut deaf = Worlds::connect(&address).await;
    let batch = settings([("env_id", text("Highway-v0")), ("num_envs", integer(2000)), ("seed", integer(1))]);
    let world = deaf.create(batch).await.expect("creates");
    let specs = deaf.join(&world).await.expect("joins");
    let all: Vec<u64> = specs.observations.keys().copied().collect();
    let request = || {
        let actions = [(1, int32s(vec![3; 2000], vec![2000]))].into();
        Some(Request::Step(pb::StepRequest { actions, requested_observations: all.clone() }))
    };
    // Far more than the windows hold: sending stops, for the server reads no further than it is read.
    let sent = async {
        for _ in 0..3000 {
            deaf.send(request()).await;
        }
    };
    assert!(timeout(Duration::from_secs(3), sent).await.is_err(), "6 MB of requests were read ahead of their answers");
    let mut other = Worlds::connect(&address).await;
    let world = other.create(settings([("env_id", text("Maze-v0"))])).await.expect("creates");
    other.join(&world).await.expect("joins");
    other.step(int32s(vec![0], vec![]), vec![1]).await.expect("is served");
    // It was held up, not cut off.
    for _ in 0..20 {
        assert!(matches!(deaf.receive().await, Ok(Response::Step(_))));
    }
}

#[tokio::test]
async fn a_request_beyond_the_limit_ends_the_stream_and_no_other() {
    let server = EnvServer::start();
    let mut worlds = Worlds::connect(&server.address()).await;
    worlds.send(Some(Request::DestroyWorld(pb::DestroyWorldRequest { world_name: "f".repeat(2 << 20) }))).await;
    assert_eq!(worlds.end().await, Some(Code::OutOfRange));
    let mut other = Worlds::connect(&server.address()).await;
    other.create(settings([("env_id", text("Maze-v0"))])).await.expect("is served");
}
