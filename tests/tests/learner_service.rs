//! The learner service over real sockets: what it answers to right and to wrong calls.

use mazeway_client::{
    ClientError, Code, ConnectOptions, Demonstration, Learner, Model, Options, Recorder, Token, packed::Packed,
    packed::pack,
};
use mazeway_learner::{Config, ServeError, config::Limits};
use mazeway_proto::{
    env::{ModelPart, model_part::Part},
    learner::{self as pb, fit_response::Event, learner_service_client::LearnerServiceClient},
};
use mazeway_serving::{
    Listener, Telemetry,
    grant::{Quotas, Scope},
};
use mazeway_tests::{
    EnvServer,
    authority::Authority,
    learner::{LearnerServer, export, trajectory},
};
use serde_json::Value;
use sha2::{Digest as _, Sha256};
use std::{
    path::Path,
    sync::Arc,
    time::{Duration, Instant},
};
use tempfile::TempDir;
use tokio::{
    sync::{Notify, mpsc},
    task::JoinHandle,
    time::{sleep, timeout},
};
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Status, transport::Channel};
use uuid::Uuid;

/// Time within which anything here ends, unless it hangs.
const PATIENCE: Duration = Duration::from_mins(1);
/// Time within which anything ends that waits for nobody else.
const SOON: Duration = Duration::from_secs(20);

/// Makes a trajectory wrong.
type TrajectoryChange = fn(&mut pb::Trajectory);
/// Makes a model wrong.
type ModelChange = fn(&mut Vec<ModelPart>);

fn header(parts: &mut [ModelPart]) -> &mut mazeway_proto::env::ModelHeader {
    match &mut parts[0].part {
        Some(Part::Header(header)) => header,
        _ => panic!("the first part is the header"),
    }
}

fn rows(parts: &mut [ModelPart]) -> &mut mazeway_proto::env::RowBlock {
    match &mut parts[1].part {
        Some(Part::Rows(rows)) => rows,
        _ => panic!("the second part is rows"),
    }
}

fn start() -> (TempDir, LearnerServer) {
    let data = tempfile::tempdir().expect("a directory");
    let server = LearnerServer::start(data.path());
    (data, server)
}

/// The generated client, for calls that the real client would not make.
async fn raw(server: &LearnerServer) -> LearnerServiceClient<Channel> {
    let channel = mazeway_client::channel(&server.address()).await.expect("a learner that answers");
    LearnerServiceClient::new(channel).max_encoding_message_size(usize::MAX)
}

/// Sends requests on one stream and collects the answers, and how the stream ended.
async fn record(
    server: &LearnerServer,
    requests: Vec<Vec<pb::Trajectory>>,
) -> (Vec<pb::RecordTrajectoriesResponse>, Result<(), Status>) {
    let requests = requests.into_iter().map(|trajectories| pb::RecordTrajectoriesRequest { trajectories });
    let stream = raw(server).await.record_trajectories(tokio_stream::iter(requests.collect::<Vec<_>>())).await;
    let mut answers = match stream {
        Ok(answers) => answers.into_inner(),
        Err(status) => return (Vec::new(), Err(status)),
    };
    let mut all = Vec::new();
    loop {
        match timeout(PATIENCE, answers.message()).await.expect("an answer") {
            Ok(Some(answer)) => all.push(answer),
            Ok(None) => return (all, Ok(())),
            Err(status) => return (all, Err(status)),
        }
    }
}

fn blamed(status: Status) -> (Code, String) {
    let error = ClientError::from(status);
    (error.code(), error.field().unwrap_or_default().to_owned())
}

fn blame(error: &ClientError) -> (Code, String) {
    (error.code(), error.field().unwrap_or_default().to_owned())
}

async fn maze() -> Model {
    let server = EnvServer::start();
    let model = mazeway_client::model(&server.address(), "Maze-v0", &Options::default()).await.expect("a model");
    tokio::task::spawn_blocking(move || server.stop()).await.expect("a stop");
    model
}

fn reference(name: &str) -> Value {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("data").join(name);
    serde_json::from_str(&std::fs::read_to_string(path).expect("a file")).expect("JSON")
}

fn demonstrations(model_id: &str) -> Vec<Demonstration> {
    let file = reference("maze_demonstrations.json");
    let rows = |name: &str| file[name].as_array().expect("rows").clone();
    let numbers =
        |row: &Value| row.as_array().expect("a row").iter().map(|v| v.as_u64().expect("a number") as u32).collect();
    let all = rows("states").into_iter().zip(rows("actions"));
    all.map(|(states, actions)| Demonstration {
        env_id: "Maze-v0".into(),
        model_id: model_id.into(),
        style: "goals".into(),
        source: "maze_demonstrations.json".into(),
        n_states: 57,
        n_actions: 4,
        states: numbers(&states),
        actions: numbers(&actions),
        ..Demonstration::default()
    })
    .collect()
}

/// A learner that knows the maze and its demonstrations.
async fn with_demonstrations(server: &LearnerServer) -> (Learner, Model) {
    let learner = server.client().await;
    let model = demonstrate(&learner).await;
    (learner, model)
}

/// Records twenty demonstrations of a maze.
async fn demonstrate(learner: &Learner) -> Model {
    let model = maze().await;
    learner.put_model(&model).await.expect("a model");
    let mut recorder = learner.recorder();
    for demonstration in demonstrations(&model.model_id) {
        recorder.record(demonstration).await.expect("a demonstration");
    }
    let receipt = recorder.finish().await.expect("everything stored");
    assert_eq!((receipt.stored, receipt.duplicates), (20, 0));
    model
}

#[tokio::test(flavor = "multi_thread")]
async fn every_request_is_answered_in_order_and_read_back_byte_for_byte() {
    let (_data, server) = start();
    let requests = (0..40_u128).map(|i| (i * 10..i * 10 + 10).map(trajectory).collect::<Vec<_>>()).collect::<Vec<_>>();
    let (answers, end) = record(&server, requests.clone()).await;
    end.expect("a stream that ends well");
    assert_eq!(answers.len(), requests.len());
    for (answer, request) in answers.iter().zip(&requests) {
        assert!(answer.trajectory_ids.iter().eq(request.iter().map(|t| &t.trajectory_id)));
        assert_eq!(answer.stored, 10);
    }
    // A second time: acknowledged, not stored.
    let (again, end) = record(&server, requests.clone()).await;
    end.expect("a stream that ends well");
    assert!(again.iter().all(|answer| answer.stored == 0 && answer.trajectory_ids.len() == 10));
    let learner = server.client().await;
    assert_eq!(export(&learner, &pb::TrajectoryFilter::default()).await, requests.concat());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_wrong_request_ends_the_stream_and_leaves_what_came_before() {
    let (_data, server) = start();
    let mut wrong = trajectory(101);
    wrong.actions = pack([9_u32; 3]);
    let (answers, end) = record(
        &server,
        vec![
            vec![trajectory(0)],
            vec![trajectory(1), trajectory(2)],
            vec![trajectory(100), wrong],
            vec![trajectory(3)],
        ],
    )
    .await;
    assert_eq!(answers.len(), 2);
    assert_eq!(blamed(end.expect_err("refused")), (Code::InvalidArgument, "trajectories[1].actions".into()));
    let (answers, end) = record(&server, vec![vec![trajectory(4)], vec![]]).await;
    assert_eq!(answers.len(), 1);
    assert_eq!(blamed(end.expect_err("refused")), (Code::InvalidArgument, "trajectories".into()));
    // The same id with another content.
    let mut other = trajectory(1);
    other.style = "other".into();
    let (answers, end) = record(&server, vec![vec![trajectory(5)], vec![trajectory(6), other]]).await;
    assert_eq!(answers.len(), 1);
    assert_eq!(blamed(end.expect_err("refused")), (Code::AlreadyExists, "trajectories[1].trajectory_id".into()));
    let stored = export(&server.client().await, &pb::TrajectoryFilter::default()).await;
    assert_eq!(stored, [0, 1, 2, 4, 5].map(trajectory));
}

#[tokio::test(flavor = "multi_thread")]
async fn each_wrong_field_of_a_trajectory_is_named() {
    let (_data, server) = start();
    let cases: [(&str, TrajectoryChange); 12] = [
        ("trajectory_id", |t| t.trajectory_id = "7".into()),
        ("trajectory_id", |t| t.trajectory_id = Uuid::nil().simple().to_string()),
        ("env_id", |t| t.env_id.clear()),
        ("style", |t| t.style = "x".repeat(201)),
        ("model_id", |t| t.model_id = "model".into()),
        ("n_states", |t| t.n_states = 0),
        ("n_actions", |t| t.n_actions = u32::MAX),
        ("states", |t| t.states = vec![0; 13].into()),
        ("states", |t| t.states = pack([-1_i32, 0, 0])),
        ("actions", |t| t.actions = t.actions.slice(4..)),
        ("rewards", |t| t.rewards = pack([f64::NAN; 3])),
        ("final_state", |t| t.final_state = Some(57)),
    ];
    for (field, change) in cases {
        let mut wrong = trajectory(40);
        change(&mut wrong);
        let (answers, end) = record(&server, vec![vec![wrong]]).await;
        assert!(answers.is_empty());
        let expected = (Code::InvalidArgument, format!("trajectories[0].{field}"));
        assert_eq!(blamed(end.expect_err("refused")), expected);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn limits_are_refused_with_resource_exhausted() {
    let data = tempfile::tempdir().expect("a directory");
    let limits = Limits {
        max_message_bytes: 10_000,
        max_trajectories_per_request: 3,
        max_steps_per_trajectory: 50,
        max_model_rows: 100,
        ..Limits::default()
    };
    let server = LearnerServer::with(data.path(), limits);
    let long = |steps: usize| pb::Trajectory { states: pack(vec![0_u32; steps]), ..trajectory(0) };
    for (request, field) in [
        ((0..4).map(trajectory).collect(), "trajectories"),
        (vec![trajectory(1), long(51)], "trajectories[1].states"),
        (vec![long(5000)], ""),
    ] {
        let (_, end) = record(&server, vec![request]).await;
        assert_eq!(blamed(end.expect_err("refused")), (Code::ResourceExhausted, field.into()));
    }
    let error = server.client().await.put_model(&maze().await).await.expect_err("refused");
    assert_eq!(blame(&error), (Code::ResourceExhausted, "part.header.n_states".into()));
}

#[tokio::test(flavor = "multi_thread")]
async fn lists_come_in_pages_and_deletions_need_a_condition() {
    let (_data, server) = start();
    let learner = server.client().await;
    let mut recorder = learner.recorder();
    for number in 0..25 {
        recorder.record(trajectory(number)).await.expect("a trajectory");
    }
    recorder.finish().await.expect("everything stored");
    let filter = pb::TrajectoryFilter { style: "brisk".into(), ..Default::default() };
    let expected = (0..25).filter(|n| n % 3 != 0).map(|n| trajectory(n).trajectory_id).collect::<Vec<_>>();
    let (mut listed, mut token) = (Vec::new(), String::new());
    loop {
        let page = learner.list_trajectories_page(&filter, 5, &token).await.expect("a page");
        assert_eq!(page.total, expected.len() as u64);
        assert!(page.trajectories.len() <= 5);
        listed.extend(page.trajectories.into_iter().map(|t| t.trajectory_id));
        token = page.next_page_token;
        if token.is_empty() {
            break;
        }
        // A token belongs to its filter.
        let error =
            learner.list_trajectories_page(&pb::TrajectoryFilter::default(), 5, &token).await.expect_err("refused");
        assert_eq!(blame(&error), (Code::InvalidArgument, "page_token".into()));
    }
    assert_eq!(listed, expected);
    let error = learner.list_trajectories_page(&filter, 10_001, "").await.expect_err("refused");
    assert_eq!(blame(&error), (Code::InvalidArgument, "page_size".into()));
    let wrong = pb::TrajectoryFilter { trajectory_ids: vec!["x".into()], ..Default::default() };
    let error = learner.list_trajectories(&wrong).await.expect_err("refused");
    assert_eq!(blame(&error), (Code::InvalidArgument, "filter.trajectory_ids[0]".into()));

    let error = learner.delete_trajectories(&pb::TrajectoryFilter::default()).await.expect_err("refused");
    assert_eq!(blame(&error), (Code::InvalidArgument, "filter".into()));
    assert_eq!(learner.delete_trajectories(&filter).await.expect("deleted"), expected.len() as u64);
    assert_eq!(learner.count_trajectories(&pb::TrajectoryFilter::default()).await.expect("a count"), 9);
}

#[tokio::test(flavor = "multi_thread")]
async fn models_are_verified_named_and_stored_once() {
    let (_data, server) = start();
    let learner = server.client().await;
    let model = maze().await;
    let first = learner.put_model(&model).await.expect("a model");
    assert_eq!((first.model_id.as_str(), first.already_stored), (model.model_id.as_str(), false));
    assert!(learner.put_model(&model).await.expect("a model").already_stored);
    let listed = learner.list_models("Maze-v0").await.expect("models");
    assert_eq!(listed.len(), 1);
    assert_eq!((listed[0].n_states, listed[0].n_actions), (57, 4));
    assert_eq!(listed[0].n_transitions, model.probabilities.len() as u64);
    assert!(learner.list_models("Other-v0").await.expect("models").is_empty());

    let cases: [(&str, ModelChange); 13] = [
        ("part", |p| p[0].part = None),
        ("part.header", |p| p.clear()),
        ("part.header", |p| p.insert(1, p[0].clone())),
        ("part.rows", |p| p.swap(0, 1)),
        ("part.rows.first_row", |p| rows(p).first_row = 1),
        ("part.rows.row_lengths", |p| p.truncate(1)),
        ("part.rows.next_states", |p| rows(p).next_states = pack([0_u32])),
        ("part.rows.probabilities", |p| {
            let mut all = Packed::<f64>::new(rows(p).probabilities.clone()).expect("an array").to_vec();
            all[0] += 1e-6;
            rows(p).probabilities = pack(all);
        }),
        ("part.header.model_id", |p| header(p).model_id = "0".repeat(64)),
        ("part.header.env_id", |p| header(p).env_id.clear()),
        ("part.header.state_labels", |p| header(p).state_labels = vec!["one".into()]),
        ("part.header.initial_distribution", |p| header(p).initial_distribution = pack([0.5; 57])),
        ("part.header.rewards[0].values", |p| header(p).rewards[0].values = pack([0.0])),
    ];
    for (field, change) in cases {
        let mut parts = model.parts().collect::<Vec<_>>();
        change(&mut parts);
        let error = learner.put_model_parts(parts).await.expect_err(field);
        assert_eq!(blame(&error), (Code::InvalidArgument, field.into()), "{error}");
    }
    assert_eq!(learner.list_models("").await.expect("models").len(), 1);
}

/// A stream of `PutModel` whose sender has the sending half: what is not sent, it says nothing of.
async fn putting(
    server: &LearnerServer,
    first: Option<ModelPart>,
) -> (mpsc::Sender<pb::PutModelRequest>, JoinHandle<Result<pb::PutModelResponse, Status>>) {
    let (parts, stream) = mpsc::channel(1);
    let mut client = raw(server).await;
    let call = tokio::spawn(async move {
        let answer = client.put_model(ReceiverStream::new(stream)).await;
        answer.map(tonic::Response::into_inner)
    });
    if let Some(part) = first {
        parts.send(pb::PutModelRequest { part: Some(part), replace: false }).await.expect("a stream");
    }
    (parts, call)
}

#[tokio::test(flavor = "multi_thread")]
async fn models_that_nobody_sends_keep_nobody_waiting() {
    let (_data, server) = start();
    let mut silent = Vec::new();
    for _ in 0..20 {
        silent.push(putting(&server, None).await);
    }
    // They have arrived.
    sleep(Duration::from_millis(300)).await;
    let learner = server.client().await;
    let model = timeout(SOON, demonstrate(&learner)).await.expect("no wait for a model that nobody sends");
    timeout(SOON, learner.model(&model.model_id)).await.expect("no wait").expect("the model");
    let request = pb::FitRequest {
        method: "bc".into(),
        filter: Some(pb::TrajectoryFilter { style: "goals".into(), ..Default::default() }),
        ..Default::default()
    };
    timeout(SOON, learner.fit(request, |_| ())).await.expect("no wait").expect("a fit");
    // Whoever has waited long with its first part may still send it.
    let (parts, call) = silent.pop().expect("one of them");
    for part in model.parts() {
        parts.send(pb::PutModelRequest { part: Some(part), replace: false }).await.expect("a stream");
    }
    drop(parts);
    let answer = timeout(PATIENCE, call).await.expect("an answer").expect("a task").expect("a model");
    assert!(answer.already_stored);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_model_whose_sender_or_reader_falls_silent_is_given_up() {
    let data = tempfile::tempdir().expect("a directory");
    let limits = Limits { max_concurrent_models: 1, model_patience: Duration::from_millis(500), ..Limits::default() };
    let server = LearnerServer::with(data.path(), limits);
    let learner = server.client().await;
    let large = everywhere(500, 4);
    let (parts, call) = putting(&server, Some(large[0].clone())).await;
    sleep(Duration::from_millis(100)).await;
    let model_id = timeout(SOON, learner.put_model_parts(large)).await.expect("its turn").expect("a model").model_id;
    let status = timeout(SOON, call).await.expect("an end").expect("a task").expect_err("it is given up");
    assert_eq!(status.code(), Code::DeadlineExceeded, "{status}");
    drop(parts);
    // Larger than what may be under way: the rest waits for a reader that reads nothing.
    let request = pb::GetModelRequest { model_id: model_id.clone() };
    let mut unread = raw(&server).await.get_model(request).await.expect("a model").into_inner();
    timeout(SOON, learner.model(&model_id)).await.expect("its turn").expect("the model");
    let status = loop {
        match timeout(SOON, unread.message()).await.expect("an end") {
            Ok(Some(_)) => {}
            Ok(None) => panic!("it was cut off and says that it is whole"),
            Err(status) => break status,
        }
    };
    assert_eq!(status.code(), Code::DeadlineExceeded, "{status}");
}

#[tokio::test(flavor = "multi_thread")]
async fn models_that_wait_with_their_first_part_take_no_more_memory_than_that() {
    let data = tempfile::tempdir().expect("a directory");
    let server = LearnerServer::with(data.path(), Limits { max_concurrent_models: 1, ..Limits::default() });
    let (first, under_way) = putting(&server, Some(everywhere(2, 1)[0].clone())).await;
    sleep(Duration::from_millis(100)).await;
    // Ten bytes each in millions: six fit into 64 MiB.
    let mut waiting = Vec::new();
    for _ in 0..9 {
        let mut part = everywhere(2, 1)[0].clone();
        header(std::slice::from_mut(&mut part)).env_id = "x".repeat(10_000_000);
        waiting.push(putting(&server, Some(part)).await);
    }
    let refused = async {
        while waiting.iter().filter(|(_, call)| call.is_finished()).count() < 3 {
            sleep(Duration::from_millis(10)).await;
        }
    };
    timeout(SOON, refused).await.expect("three answers");
    drop(first);
    under_way.await.expect("a task").expect_err("it has no rows");
    let mut codes = Vec::new();
    for (parts, call) in waiting {
        drop(parts);
        let status = timeout(SOON, call).await.expect("an answer").expect("a task").expect_err("refused");
        let error = ClientError::from(status);
        codes.push((error.code(), error.field().unwrap_or_default().to_owned()));
    }
    let full = codes.iter().filter(|(code, field)| *code == Code::ResourceExhausted && field == "part").count();
    let wrong = codes.iter().filter(|(code, _)| *code == Code::InvalidArgument).count();
    assert_eq!((full, wrong), (3, 6), "{codes:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn fits_over_the_wire_reproduce_the_reference_and_are_kept() {
    let (data, server) = start();
    let (learner, model) = with_demonstrations(&server).await;
    let cases = reference("maze_fits.json")["cases"].as_array().expect("cases").clone();
    let mut ids = Vec::new();
    for case in cases.iter().filter(|case| case["method"] == "em") {
        let uniform = case["horizon_prior"] == "uniform";
        let simplex = case["m_step"] == "simplex";
        let request = pb::FitRequest {
            method: "em".into(),
            filter: Some(pb::TrajectoryFilter { style: "goals".into(), ..Default::default() }),
            options: Some(pb::FitOptions {
                horizon_prior: if uniform { pb::HorizonPrior::Uniform } else { pb::HorizonPrior::Geometric } as i32,
                m_step: if simplex { pb::MStep::Simplex } else { pb::MStep::Nnls } as i32,
                ..Default::default()
            }),
            ..Default::default()
        };
        let mut progress = 0;
        let fit = learner.fit(request, |_| progress += 1).await.expect("a fit");
        assert!(progress >= 1);
        let weights = Packed::<f64>::new(fit.weights.clone()).expect("an array").to_vec();
        let expected = case["weights"].as_array().expect("weights").iter().map(|v| v.as_f64().expect("a number"));
        assert_eq!(weights.len(), 57);
        for (state, (w, e)) in weights.iter().zip(expected).enumerate() {
            assert!((w - e).abs() < 1e-6, "{} {state}: expected {e}, got {w}", case["m_step"]);
        }
        assert_eq!((fit.env_id.as_str(), fit.style.as_str()), ("Maze-v0", "goals"));
        assert_eq!((&fit.model_id, fit.trajectories, fit.steps), (&model.model_id, 20, 1000));
        assert_eq!(fit.trace.len(), fit.iterations as usize);
        let visits = Packed::<f64>::new(fit.state_visits.clone()).expect("an array");
        assert_eq!(visits.iter().sum::<f64>(), 1000.0);
        assert_eq!(fit.states_covered as usize, visits.iter().filter(|&n| n > 0.0).count());
        // The defaults are written down.
        let options = fit.request.clone().expect("a request").options.expect("options");
        assert_eq!((options.discount, options.max_iterations), (Some(0.9), Some(1000)));
        assert_eq!(options.basis, pb::Basis::State as i32);
        // What was stored is what was sent, and a prefix names it.
        assert_eq!(learner.get_fit(&fit.fit_id[..8]).await.expect("the fit"), fit);
        ids.push(fit.fit_id);
    }
    assert_eq!(ids.len(), 4);
    server.stop();
    let server = LearnerServer::start(data.path());
    let learner = server.client().await;
    let listed = learner.list_fits("Maze-v0", "goals").await.expect("fits");
    assert!(listed.iter().map(|fit| &fit.fit_id).eq(ids.iter().rev()), "newest first");
    assert!(learner.list_fits("", "other").await.expect("fits").is_empty());
    learner.delete_fit(&ids[0]).await.expect("deleted");
    for error in [
        learner.delete_fit(&ids[0]).await.expect_err("gone"),
        learner.get_fit(&ids[0]).await.map(drop).expect_err("gone"),
    ] {
        assert_eq!(blame(&error), (Code::NotFound, "fit_id".into()));
    }
    let error = learner.get_fit("abc").await.expect_err("too short");
    assert_eq!(blame(&error), (Code::InvalidArgument, "fit_id".into()));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_fit_without_what_it_needs_is_refused() {
    let (_data, server) = start();
    let (learner, model) = with_demonstrations(&server).await;
    let mut recorder = learner.recorder();
    for number in 0..3 {
        recorder.record(trajectory(number)).await.expect("no model");
    }
    let mut elsewhere = trajectory(50);
    elsewhere.model_id = "0".repeat(64);
    elsewhere.style = "elsewhere".into();
    recorder.record(elsewhere).await.expect("an unknown model");
    let mut smaller = trajectory(51);
    (smaller.style, smaller.n_states) = ("smaller".into(), 60);
    recorder.record(smaller).await.expect("another process");
    recorder.finish().await.expect("everything stored");

    let request = |method: &str, style: &str| pb::FitRequest {
        method: method.into(),
        filter: Some(pb::TrajectoryFilter { style: style.into(), ..Default::default() }),
        ..Default::default()
    };
    let options = |options: pb::FitOptions| pb::FitRequest { options: Some(options), ..request("em", "goals") };
    let in_model = |style: &str, id: &str| pb::FitRequest { model_id: id.into(), ..request("bc", style) };
    let cases = [
        (request("magic", "goals"), Code::InvalidArgument, "method"),
        (options(pb::FitOptions { planner: 99, ..Default::default() }), Code::InvalidArgument, "options.planner"),
        (options(pb::FitOptions { horizon: Some(0), ..Default::default() }), Code::InvalidArgument, "options.horizon"),
        (
            options(pb::FitOptions { discount: Some(1.5), ..Default::default() }),
            Code::InvalidArgument,
            "options.discount",
        ),
        (
            options(pb::FitOptions { horizon: Some(u32::MAX), ..Default::default() }),
            Code::ResourceExhausted,
            "options.horizon",
        ),
        (
            options(pb::FitOptions { max_iterations: Some(u32::MAX), ..Default::default() }),
            Code::ResourceExhausted,
            "options.max_iterations",
        ),
        (in_model("goals", "no id"), Code::InvalidArgument, "model_id"),
        (in_model("goals", &"1".repeat(64)), Code::NotFound, "model_id"),
        (request("bc", "elsewhere"), Code::NotFound, "model_id"),
        (in_model("smaller", &model.model_id), Code::InvalidArgument, "model_id"),
        (request("bc", "nobody"), Code::FailedPrecondition, "filter"),
        (pb::FitRequest { max_trajectories: 21, ..request("bc", "goals") }, Code::FailedPrecondition, "filter"),
        (request("bc", "brisk"), Code::FailedPrecondition, "model_id"),
        (request("bc", ""), Code::FailedPrecondition, "model_id"),
    ];
    for (request, code, field) in cases {
        let error = learner.fit(request.clone(), |_| ()).await.expect_err("refused");
        assert_eq!(blame(&error), (code, field.into()), "{request:?}: {error}");
    }
    assert!(learner.list_fits("", "").await.expect("fits").is_empty());
    // The first ten, cut at five steps.
    let request = pb::FitRequest {
        max_trajectories: 10,
        options: Some(pb::FitOptions { horizon: Some(5), ..Default::default() }),
        ..request("bc", "goals")
    };
    let fit = learner.fit(request, |_| ()).await.expect("a fit");
    assert_eq!((fit.trajectories, fit.steps, fit.longest), (10, 50, 5));
    let pairs = Packed::<f64>::new(fit.pair_visits.clone()).expect("an array");
    assert_eq!((pairs.len(), pairs.iter().sum::<f64>()), (57 * 4, 50.0));
    let filter = pb::TrajectoryFilter { style: "goals".into(), ..Default::default() };
    let first = learner.list_trajectories_page(&filter, 10, "").await.expect("a page").trajectories;
    let used = learner.fit_trajectories(&fit.fit_id).await.expect("ids");
    assert!(first.iter().map(|t| &t.trajectory_id).eq(&used));
    let bytes = used.iter().flat_map(|id| Uuid::parse_str(id).expect("an id").into_bytes()).collect::<Vec<u8>>();
    assert_eq!(fit.trajectories_digest[..], Sha256::digest(bytes)[..]);
    assert_eq!(fit.sources.iter().map(|s| s.trajectories).sum::<u64>(), 10);
    // Page by page, and whole, what is left of them.
    let page = learner.fit_trajectories_page(&fit.fit_id[..8], 4, "").await.expect("a page");
    assert_eq!((&page.trajectory_ids[..], page.total), (&used[..4], 10));
    let page = learner.fit_trajectories_page(&fit.fit_id[..8], 4, &page.next_page_token).await.expect("a page");
    assert_eq!(page.trajectory_ids, used[4..8]);
    let last = learner.fit_trajectories_page(&fit.fit_id[..8], 4, &page.next_page_token).await.expect("a page");
    assert_eq!((&last.trajectory_ids[..], last.next_page_token.as_str()), (&used[8..], ""));
    let gone = pb::TrajectoryFilter { trajectory_ids: vec![used[3].clone()], ..Default::default() };
    assert_eq!(learner.delete_trajectories(&gone).await.expect("a deletion"), 1);
    let mut stream = learner.export_fit_trajectories(&fit.fit_id, &filter).await.expect("an export");
    let mut left = Vec::new();
    while let Some(part) = stream.next().await.expect("a page") {
        left.extend(part.into_iter().map(|t| t.trajectory_id));
    }
    assert!(left.iter().eq(used.iter().filter(|&id| *id != used[3])));
    let nobody = Uuid::nil().to_string();
    for (id, code) in [(nobody.as_str(), Code::NotFound), ("zz", Code::InvalidArgument)] {
        let error = learner.fit_trajectories(id).await.expect_err("no fit");
        assert_eq!(blame(&error), (code, "fit_id".into()));
        let error = learner.export_fit_trajectories(id, &filter).await.expect_err("no fit");
        assert_eq!(blame(&error), (code, "fit_id".into()));
    }
}

/// A model in which every state leads to every other, more likely to those that follow it.
fn everywhere(n_states: u32, n_actions: u32) -> Vec<ModelPart> {
    let header =
        mazeway_proto::env::ModelHeader { env_id: "Everywhere-v0".into(), n_states, n_actions, ..Default::default() };
    let mut parts = vec![ModelPart { part: Some(Part::Header(header)) }];
    for state in 0..n_states {
        let first_row = state * n_actions;
        let weight = move |action: u32, next: u32| 1.0 + f64::from((next + n_states - state) * (action + 1) % n_states);
        let probabilities = (0..n_actions).flat_map(|action| {
            let sum = (0..n_states).map(|next| weight(action, next)).sum::<f64>();
            (0..n_states).map(move |next| weight(action, next) / sum)
        });
        let rows = mazeway_proto::env::RowBlock {
            first_row,
            row_lengths: pack(vec![n_states; n_actions as usize]),
            next_states: pack((0..n_actions).flat_map(|_| 0..n_states)),
            probabilities: pack(probabilities),
            ..Default::default()
        };
        parts.push(ModelPart { part: Some(Part::Rows(rows)) });
    }
    parts
}

/// A fit that would run for minutes, and what it works on in the store.
async fn endless(learner: &Learner) -> pb::FitRequest {
    // Every iteration solves for 500 states that all lead everywhere, and without a penalty the likelihood of what was
    // never seen has no maximum: it would run for minutes.
    let model = everywhere(500, 4);
    let model_id = learner.put_model_parts(model).await.expect("a model").model_id;
    let mut recorder = learner.recorder();
    let demonstration = Demonstration {
        env_id: "Everywhere-v0".into(),
        style: "wandering".into(),
        model_id,
        n_states: 500,
        n_actions: 4,
        states: (0..200).map(|step| step * 7 % 500).collect(),
        actions: (0..200).map(|step| step * step % 4).collect(),
        ..Demonstration::default()
    };
    recorder.record(demonstration).await.expect("a demonstration");
    recorder.finish().await.expect("stored");
    pb::FitRequest {
        method: "em-tied".into(),
        filter: Some(pb::TrajectoryFilter { style: "wandering".into(), ..Default::default() }),
        options: Some(pb::FitOptions {
            basis: pb::Basis::StateAction as i32,
            penalty: pb::Penalty::None as i32,
            tolerance: Some(0.0),
            max_iterations: Some(1_000_000),
            ..Default::default()
        }),
        ..Default::default()
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_fit_ends_when_its_caller_goes_and_the_next_one_begins() {
    let data = tempfile::tempdir().expect("a directory");
    let limits = Limits { max_concurrent_fits: 1, max_queued_fits: 1, ..Limits::default() };
    let server = LearnerServer::with(data.path(), limits);
    let (learner, _) = with_demonstrations(&server).await;
    let filter = |style: &str| Some(pb::TrajectoryFilter { style: style.into(), ..Default::default() });
    let endless = endless(&learner).await;
    let quick = pb::FitRequest { method: "bc".into(), filter: filter("goals"), ..Default::default() };
    let mut running = learner.fit_stream(endless.clone()).await.expect("a stream");
    let first = timeout(PATIENCE, running.next()).await.expect("progress").expect("progress");
    assert!(matches!(first, Some(Event::Progress(_))));
    // One runs, one waits: a third is refused.
    let mut waiting = learner.fit_stream(quick.clone()).await.expect("a place in the queue");
    let error = learner.fit_stream(quick.clone()).await.expect_err("a full queue");
    assert_eq!(error.code(), Code::ResourceExhausted);
    let place = timeout(PATIENCE, waiting.next()).await.expect("a place").expect("a place");
    assert_eq!(place, Some(Event::Queued(pb::FitQueued { place: 1, length: 1 })));
    assert!(timeout(Duration::from_millis(300), waiting.next()).await.is_err(), "it waits its turn");
    drop(running);
    let fit = loop {
        match timeout(PATIENCE, waiting.next()).await.expect("its turn").expect("a fit") {
            Some(Event::Fit(fit)) => break fit,
            Some(Event::Progress(_) | Event::Queued(_)) => {}
            None => panic!("the stream of a fit ended without a fit"),
        }
    };
    // The place is free again.
    learner.fit(quick.clone(), |_| ()).await.expect("a fit");
    let stored = learner.list_fits("", "").await.expect("fits");
    assert!(stored.iter().any(|f| f.fit_id == fit.fit_id));
    assert!(stored.iter().all(|f| f.method == "bc"), "the fit whose caller went is not stored");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_hundred_fits_wait_their_turn_and_nothing_else_does() {
    let data = tempfile::tempdir().expect("a directory");
    let server = LearnerServer::with(data.path(), Limits { max_concurrent_fits: 1, ..Limits::default() });
    let (learner, _) = with_demonstrations(&server).await;
    let endless = endless(&learner).await;
    let quick = pb::FitRequest {
        method: "bc".into(),
        filter: Some(pb::TrajectoryFilter { style: "goals".into(), ..Default::default() }),
        ..Default::default()
    };
    let mut running = learner.fit_stream(endless).await.expect("a stream");
    timeout(PATIENCE, running.next()).await.expect("it runs").expect("progress");
    let mut waiting = Vec::new();
    for length in 1..=100 {
        let mut stream = learner.fit_stream(quick.clone()).await.expect("a place in the queue");
        let place = timeout(PATIENCE, stream.next()).await.expect("a place").expect("a place");
        assert_eq!(place, Some(Event::Queued(pb::FitQueued { place: length, length })));
        waiting.push(stream);
    }
    // One in the middle goes: the last moves up.
    drop(waiting.remove(50));
    let mut last = waiting.pop().expect("the last");
    let moved = async {
        loop {
            if let Some(Event::Queued(pb::FitQueued { place: 99, length: 99 })) = last.next().await.expect("a place") {
                return;
            }
        }
    };
    timeout(PATIENCE, moved).await.expect("its new place");
    // All threads of fits are taken: recording and reading go on.
    for number in 0..50 {
        let mut recorder = learner.recorder();
        recorder.record(trajectory(number)).await.expect("a trajectory");
        let receipt = timeout(PATIENCE, recorder.finish()).await.expect("no wait for a fit").expect("stored");
        assert_eq!(receipt.stored, 1);
    }
    assert!(learner.list_fits("", "").await.expect("fits").is_empty());
    drop(running);
    waiting.push(last);
    for mut stream in waiting {
        loop {
            match timeout(PATIENCE, stream.next()).await.expect("its turn").expect("a fit") {
                Some(Event::Fit(_)) => break,
                Some(_) => {}
                None => panic!("the stream of a fit ended without a fit"),
            }
        }
    }
    assert_eq!(learner.list_fits("", "").await.expect("fits").len(), 99);
}

#[tokio::test(flavor = "multi_thread")]
async fn callers_take_turns_at_fits_and_each_has_its_quota() {
    let authority = Authority::new();
    let scopes = [Scope::Record, Scope::Fit];
    let alice = authority.token("alice", &scopes, &Quotas::default());
    let bob = authority.token("bob", &scopes, &Quotas { max_fits: Some(1), ..Quotas::default() });
    let data = tempfile::tempdir().expect("a directory");
    let limits = Limits { max_concurrent_fits: 1, ..Limits::default() };
    let config = Config { door: authority.tokens(), limits, ..Config::new(data.path()) };
    let server = LearnerServer::configured("127.0.0.1:0".parse().expect("an address"), config);
    let known_by = async |secret: &str| {
        let token = Some(Token::new(secret).expect("a token"));
        let options = ConnectOptions { token, ..ConnectOptions::default() };
        Learner::connect_with(&server.address(), &options).await.expect("a learner that knows it")
    };
    let (alice, bob) = (known_by(&alice).await, known_by(&bob).await);
    demonstrate(&alice).await;
    let endless = endless(&alice).await;
    let quick = pb::FitRequest {
        method: "bc".into(),
        filter: Some(pb::TrajectoryFilter { style: "goals".into(), ..Default::default() }),
        ..Default::default()
    };
    let mut running = alice.fit_stream(endless).await.expect("a stream");
    timeout(PATIENCE, running.next()).await.expect("it runs").expect("progress");
    let mut waiting = Vec::new();
    for _ in 0..50 {
        waiting.push(alice.fit_stream(quick.clone()).await.expect("a place in the queue"));
    }
    // Fifty of another came before, and but one of them goes before it.
    let mut late = bob.fit_stream(quick.clone()).await.expect("a place in the queue");
    let place = timeout(PATIENCE, late.next()).await.expect("a place").expect("a place");
    let Some(Event::Queued(pb::FitQueued { place, length: 51 })) = place else {
        panic!("expected a place, got {place:?}")
    };
    assert!(place <= 2, "place {place}");
    let error = bob.fit_stream(quick.clone()).await.expect_err("more than it may");
    assert_eq!((error.code(), error.field()), (Code::ResourceExhausted, Some("max_fits")), "{error}");
    drop(running);
    loop {
        match timeout(PATIENCE, late.next()).await.expect("its turn").expect("a fit") {
            Some(Event::Fit(_)) => break,
            Some(_) => {}
            None => panic!("the stream of a fit ended without a fit"),
        }
    }
    bob.fit(quick, |_| ()).await.expect("there is room again");
}

/// A learner whose numbers the test reads.
struct Counted {
    address: String,
    numbers: Arc<Telemetry>,
    task: JoinHandle<Result<(), ServeError>>,
    stop: Arc<Notify>,
}

impl Counted {
    async fn start(config: Config) -> Self {
        let listener = Listener::bind(&"127.0.0.1:0".parse().expect("an address")).await.expect("a port");
        let address = listener.address().expect("an address").to_string();
        let (numbers, stop) = (Arc::new(mazeway_learner::telemetry()), Arc::new(Notify::new()));
        let (counted, stopped) = (Arc::clone(&numbers), Arc::clone(&stop));
        let task = tokio::spawn(async move {
            mazeway_learner::serve_observed(config, listener, counted, async move { stopped.notified().await }).await
        });
        while !numbers.is_serving() {
            assert!(!task.is_finished(), "it ends before it serves");
            sleep(Duration::from_millis(5)).await;
        }
        Self { address, numbers, task, stop }
    }

    async fn known_by(&self, secret: &str) -> Learner {
        let token = Some(Token::new(secret).expect("a token"));
        let options = ConnectOptions { token, ..ConnectOptions::default() };
        Learner::connect_with(&self.address, &options).await.expect("a learner that knows it")
    }

    fn number(&self, name: &str) -> f64 {
        let text = self.numbers.text().expect("numbers");
        let line =
            text.lines().find_map(|line| line.strip_prefix("mazeway_learner_")?.strip_prefix(name)?.strip_prefix(' '));
        line.unwrap_or_else(|| panic!("no {name} in\n{text}")).parse().expect("a number")
    }

    async fn becomes(&self, name: &str, number: f64) {
        let begun = Instant::now();
        while self.number(name) != number {
            assert!(begun.elapsed() < SOON, "{name} is {} and not {number}", self.number(name));
            sleep(Duration::from_millis(10)).await;
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn what_is_refused_is_counted_by_reason_and_what_waits_by_how_that_ends() {
    let authority = Authority::new();
    let scopes = [Scope::Record, Scope::Fit];
    let alice = authority.token("alice", &scopes, &Quotas::default());
    let bob = authority.token("bob", &scopes, &Quotas { max_fits: Some(1), ..Quotas::default() });
    let carol = authority.token("carol", &scopes, &Quotas { max_recorded_bytes: Some(10), ..Quotas::default() });
    let data = tempfile::tempdir().expect("a directory");
    let limits =
        Limits { max_concurrent_fits: 1, max_queued_fits: 2, max_trajectories_per_request: 50, ..Limits::default() };
    let service = Counted::start(Config { door: authority.tokens(), limits, ..Config::new(data.path()) }).await;
    for name in ["fits_refused_total{reason=\"share\"}", "fit_wait_seconds_count{outcome=\"stopped\"}"] {
        assert_eq!(service.number(name), 0.0, "{name} is shown from the beginning");
    }
    let (alice, bob, carol) =
        (service.known_by(&alice).await, service.known_by(&bob).await, service.known_by(&carol).await);
    demonstrate(&alice).await;
    let endless = endless(&alice).await;
    let quick = pb::FitRequest {
        method: "bc".into(),
        filter: Some(pb::TrajectoryFilter { style: "goals".into(), ..Default::default() }),
        ..Default::default()
    };
    alice.fit(quick.clone(), |_| ()).await.expect("a fit");
    let mut running = alice.fit_stream(endless.clone()).await.expect("a stream");
    timeout(PATIENCE, running.next()).await.expect("it runs").expect("progress");
    let refused = async |by: &Learner, request: &pb::FitRequest, reason: &str| {
        by.fit_stream(request.clone()).await.map(drop).expect_err(reason);
        assert_eq!(service.number(&format!("fits_refused_total{{reason=\"{reason}\"}}")), 1.0, "{reason}");
    };
    refused(&alice, &pb::FitRequest { method: "magic".into(), ..quick.clone() }, "request").await;
    let options = Some(pb::FitOptions { max_iterations: Some(u32::MAX), ..Default::default() });
    refused(&alice, &pb::FitRequest { options, ..quick.clone() }, "limit").await;
    let waiting = alice.fit_stream(quick.clone()).await.expect("a place");
    refused(&alice, &quick, "share").await;
    let mut of_bob = bob.fit_stream(quick.clone()).await.expect("a place");
    refused(&bob, &quick, "quota").await;
    refused(&carol, &quick, "queue_full").await;
    drop(waiting);
    service.becomes("fit_wait_seconds_count{outcome=\"cancelled\"}", 1.0).await;
    drop(running);
    while !matches!(timeout(PATIENCE, of_bob.next()).await.expect("a turn").expect("a fit"), Some(Event::Fit(_))) {}
    service.becomes("fit_seconds_count{method=\"em-tied\",outcome=\"cancelled\"}", 1.0).await;
    assert_eq!(service.number("fit_seconds_count{method=\"bc\",outcome=\"fitted\"}"), 2.0);
    assert_eq!(service.number("fit_wait_seconds_count{outcome=\"begun\"}"), 3.0);
    assert!(service.number("fit_wait_seconds_sum{outcome=\"begun\"}") > 0.0);

    let recorded = async |by: &Learner, all: Vec<pb::Trajectory>| {
        let mut recorder = by.recorder();
        for trajectory in all {
            recorder.record(trajectory).await?;
        }
        recorder.finish().await
    };
    recorded(&alice, vec![trajectory(1)]).await.expect("stored");
    recorded(&carol, vec![trajectory(2)]).await.expect_err("more than it may");
    let other = pb::Trajectory { source: "other".into(), ..trajectory(1) };
    recorded(&alice, vec![other]).await.expect_err("another content");
    recorded(&alice, vec![pb::Trajectory { style: "x".repeat(201), ..trajectory(3) }]).await.expect_err("too long");
    for reason in ["quota", "exists", "request"] {
        assert!(service.number(&format!("recordings_refused_total{{reason=\"{reason}\"}}")) >= 1.0, "{reason}");
    }
    assert_eq!(service.number("recordings_refused_total{reason=\"store_full\"}"), 0.0);
    // Told while it waits that the service stops.
    let mut running = alice.fit_stream(endless.clone()).await.expect("a stream");
    timeout(PATIENCE, running.next()).await.expect("it runs").expect("progress");
    let _waiting = alice.fit_stream(quick).await.expect("a place");
    service.stop.notify_one();
    service.becomes("fit_wait_seconds_count{outcome=\"stopped\"}", 1.0).await;
    drop(running);
    timeout(PATIENCE, service.task).await.expect("an end").expect("a task").expect("it ends well");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_full_store_tells_its_limit_and_not_what_others_keep_in_it() {
    let data = tempfile::tempdir().expect("a directory");
    let limits = Limits { max_store_bytes: Some(1), ..Limits::default() };
    let service = Counted::start(Config { limits, ..Config::new(data.path()) }).await;
    let learner = Learner::connect(&service.address).await.expect("connects");
    let mut recorder = learner.recorder();
    let recorded = match recorder.record(trajectory(1)).await {
        Ok(()) => recorder.finish().await.map(drop),
        Err(error) => Err(error),
    };
    let put = learner.put_model_parts(everywhere(2, 1)).await.map(drop);
    for (error, number) in [
        (recorded.expect_err("no room"), "recordings_refused_total{reason=\"store_full\"}"),
        (put.expect_err("no room"), "models_refused_total{reason=\"store_full\"}"),
    ] {
        assert_eq!(blame(&error), (Code::ResourceExhausted, "max_store_bytes".into()));
        let numbers = error.to_string().split(|c: char| !c.is_ascii_digit()).filter(|n| !n.is_empty()).count();
        assert!(error.to_string().contains("may hold 1 bytes") && numbers == 1, "{error}");
        assert!(service.number(number) >= 1.0, "{number}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_stop_loses_nothing_that_was_acknowledged() {
    let (data, server) = start();
    let address = server.socket();
    let mut recorder = Recorder::connect(&server.address()).await.expect("a learner");
    for number in 0..10_000 {
        recorder.record(trajectory(number)).await.expect("a trajectory");
    }
    let acknowledged = recorder.receipt().acknowledged();
    assert!(acknowledged > 0 && recorder.unacknowledged() > 0);
    tokio::task::spawn_blocking(move || server.stop()).await.expect("a stop");
    let server = LearnerServer::at(address, data.path(), Limits::default());
    let stored = export(&server.client().await, &pb::TrajectoryFilter::default()).await;
    assert!(stored.len() as u64 >= acknowledged);
    assert!(stored.iter().enumerate().all(|(i, t)| *t == trajectory(i as u128)));
    // The recorder goes on where the other left off.
    let receipt = timeout(PATIENCE, recorder.finish()).await.expect("an end").expect("everything stored");
    assert_eq!(receipt.acknowledged(), 10_000);
    assert_eq!(export(&server.client().await, &pb::TrajectoryFilter::default()).await.len(), 10_000);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_recorder_gives_up_what_is_refused_and_nothing_else() {
    let (_data, server) = start();
    let mut recorder = Recorder::connect(&server.address()).await.expect("a learner");
    recorder.record(trajectory(1)).await.expect("a trajectory");
    recorder.flush().await.expect("stored");
    let mut other = trajectory(1);
    other.source = "other".into();
    let id = other.trajectory_id.clone();
    for trajectory in [trajectory(2), other, trajectory(3)] {
        recorder.record(trajectory).await.expect("taken");
    }
    let error = recorder.flush().await.expect_err("one is refused");
    assert_eq!(blame(&error), (Code::AlreadyExists, "trajectory_id".into()));
    assert!(error.to_string().contains(&id), "{error}");
    let receipt = recorder.finish().await.expect("the others are stored");
    assert_eq!((receipt.stored, receipt.duplicates), (3, 0));
    let stored = export(&server.client().await, &pb::TrajectoryFilter::default()).await;
    assert_eq!(stored, [1, 2, 3].map(trajectory));
}

#[tokio::test(flavor = "multi_thread")]
async fn health_and_reflection_answer() {
    use tonic_health::pb::{HealthCheckRequest, health_check_response::ServingStatus, health_client::HealthClient};
    use tonic_reflection::pb::v1::{
        ServerReflectionRequest, server_reflection_client::ServerReflectionClient,
        server_reflection_request::MessageRequest, server_reflection_response::MessageResponse,
    };
    let (_data, server) = start();
    let channel = mazeway_client::channel(&server.address()).await.expect("a learner");
    let service = "mazeway.learner.v1.LearnerService".to_owned();
    let request = HealthCheckRequest { service: service.clone() };
    let health = HealthClient::new(channel.clone()).check(request).await.expect("health").into_inner();
    assert_eq!(health.status(), ServingStatus::Serving);
    let ask = ServerReflectionRequest {
        host: String::new(),
        message_request: Some(MessageRequest::ListServices(String::new())),
    };
    let mut answers = ServerReflectionClient::new(channel)
        .server_reflection_info(tokio_stream::iter([ask]))
        .await
        .expect("reflection")
        .into_inner();
    let answer = answers.message().await.expect("an answer").expect("an answer").message_response;
    let Some(MessageResponse::ListServicesResponse(list)) = answer else { panic!("expected services, got {answer:?}") };
    assert!(list.service.iter().any(|s| s.name == service), "{list:?}");
}
