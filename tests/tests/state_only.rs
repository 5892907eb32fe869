//! Demonstrations of states alone, from the recorder to the fit.

use mazeway_client::{ClientError, Code, Demonstration, Learner, Model, Options, packed::Packed};
use mazeway_proto::learner as pb;
use mazeway_tests::{EnvServer, learner::LearnerServer, learner::export};
use serde_json::Value;
use std::path::Path;

fn demonstrations(model_id: &str) -> Vec<Demonstration> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("data/maze_demonstrations.json");
    let file: Value = serde_json::from_str(&std::fs::read_to_string(path).expect("a file")).expect("JSON");
    let rows = |name: &str| file[name].as_array().expect("rows").clone();
    let numbers =
        |row: &Value| row.as_array().expect("a row").iter().map(|v| v.as_u64().expect("a number") as u32).collect();
    let all = rows("states").into_iter().zip(rows("actions"));
    all.map(|(states, actions)| Demonstration {
        env_id: "Maze-v0".into(),
        model_id: model_id.into(),
        style: "seen".into(),
        n_states: 57,
        n_actions: 4,
        states: numbers(&states),
        actions: numbers(&actions),
        ..Demonstration::default()
    })
    .collect()
}

async fn maze() -> Model {
    let server = EnvServer::start();
    let model = mazeway_client::model(&server.address(), "Maze-v0", &Options::default()).await.expect("a model");
    tokio::task::spawn_blocking(move || server.stop()).await.expect("a stop");
    model
}

async fn record(learner: &Learner, demonstrations: impl IntoIterator<Item = Demonstration>) {
    let mut recorder = learner.recorder();
    for demonstration in demonstrations {
        recorder.record(demonstration).await.expect("a demonstration");
    }
    recorder.finish().await.expect("everything stored");
}

async fn fit(learner: &Learner, method: &str, style: &str) -> Result<pb::Fit, ClientError> {
    let request = pb::FitRequest {
        method: method.into(),
        filter: Some(pb::TrajectoryFilter { style: style.into(), ..Default::default() }),
        ..Default::default()
    };
    learner.fit(request, |_| ()).await
}

fn doubles(packed: &prost::bytes::Bytes) -> Vec<f64> {
    Packed::<f64>::new(packed.clone()).expect("an array").to_vec()
}

#[tokio::test(flavor = "multi_thread")]
async fn states_alone_teach_nearly_what_states_and_actions_do() {
    let data = tempfile::tempdir().expect("a directory");
    let server = LearnerServer::start(data.path());
    let learner = server.client().await;
    let model = maze().await;
    learner.put_model(&model).await.expect("a model");
    let seen = demonstrations(&model.model_id);
    record(&learner, seen.clone()).await;
    let unseen = seen.into_iter().map(|d| Demonstration { style: "unseen".into(), actions: Vec::new(), ..d });
    record(&learner, unseen).await;

    let stored = export(&learner, &pb::TrajectoryFilter { style: "unseen".into(), ..Default::default() }).await;
    assert!(stored.iter().all(|t| t.actions.is_empty() && t.states.len() == 200));
    let listed = learner
        .list_trajectories(&pb::TrajectoryFilter { style: "unseen".into(), ..Default::default() })
        .await
        .expect("a list");
    assert!(listed.iter().all(|t| t.steps == 49), "50 states are 49 transitions");

    let full = fit(&learner, "em-tied", "seen").await.expect("a fit");
    let blind = fit(&learner, "em-tied", "unseen").await.expect("a fit");
    assert_eq!((full.steps, blind.steps), (20 * 50, 20 * 49));
    assert!(blind.warnings.iter().any(|w| w.contains("actions of 980 of 980 steps")), "{:?}", blind.warnings);
    assert!(blind.log_likelihood_per_step.is_finite() && blind.log_likelihood_per_step < 0.0);
    let (full, blind_policy) = (doubles(&full.greedy_policy), doubles(&blind.greedy_policy));
    let same = full.iter().zip(&blind_policy).map(|(p, q)| p.min(*q)).sum::<f64>() / 57.0;
    println!("greedy actions that agree: {same:.3}; agreement with the data {:.3}", blind.agreement);
    assert!(same > 0.8, "greedy actions that agree: {same}");

    // methods that need whole trajectories say so, and so does what no action explains
    let error = fit(&learner, "em-mixture", "unseen").await.expect_err("a refusal");
    assert_eq!((error.code(), error.field()), (Code::InvalidArgument, Some("method")), "{error}");
    let jump = Demonstration {
        env_id: "Maze-v0".into(),
        model_id: model.model_id.clone(),
        style: "jump".into(),
        n_states: 57,
        n_actions: 4,
        states: vec![0, 56],
        ..Demonstration::default()
    };
    record(&learner, [jump]).await;
    let error = fit(&learner, "em-tied", "jump").await.expect_err("a refusal");
    assert_eq!(error.code(), Code::FailedPrecondition, "{error}");
    assert!(error.to_string().contains("got 1 that none makes, the first from state 0 to state 56"), "{error}");
}
