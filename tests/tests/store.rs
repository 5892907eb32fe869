//! Stored data outlives releases and is shared between processes.

use mazeway_client::{Learner, Options, Recorder, packed::Packed};
use mazeway_proto::learner as pb;
use mazeway_tests::{
    EnvServer,
    learner::{LearnerServer, export, trajectory},
    programs::Service,
};
use std::path::{Path, PathBuf};

/// Trajectories in the sample.
const SAMPLE: u128 = 12;

fn sample() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("data").join("store_v1.sqlite3")
}

/// A trajectory of the sample: in the maze's model, so that it can be fitted.
fn sampled(number: u128, model_id: &str) -> pb::Trajectory {
    pb::Trajectory { model_id: model_id.into(), ..trajectory(number) }
}

/// Wrote the sample when its schema was new. Samples stay for ever: a new schema gets a new one beside them.
#[tokio::test(flavor = "multi_thread")]
#[ignore = "writes the sample of a new schema: run by hand, once"]
async fn write_the_sample() {
    let data = tempfile::tempdir().expect("a directory");
    let environments = EnvServer::start();
    let model = mazeway_client::model(&environments.address(), "Maze-v0", &Options::default()).await.expect("a model");
    let server = LearnerServer::start(data.path());
    let learner = server.client().await;
    learner.put_model(&model).await.expect("a model");
    let mut recorder = learner.recorder();
    for number in 0..SAMPLE {
        recorder.record(sampled(number, &model.model_id)).await.expect("a trajectory");
    }
    recorder.finish().await.expect("everything stored");
    let request =
        pb::FitRequest { method: "em".into(), filter: Some(pb::TrajectoryFilter::default()), ..Default::default() };
    learner.fit(request, |_| ()).await.expect("a fit");
    drop(learner);
    server.stop();
    std::fs::copy(data.path().join("mazeway.sqlite3"), sample()).expect("a copy");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_store_of_the_first_release_reads_and_goes_on() {
    let data = tempfile::tempdir().expect("a directory");
    std::fs::copy(sample(), data.path().join("mazeway.sqlite3")).expect("a copy");
    let server = LearnerServer::start(data.path());
    let learner = server.client().await;
    let models = learner.list_models("").await.expect("models");
    assert_eq!(models.len(), 1);
    assert_eq!((models[0].env_id.as_str(), models[0].n_states, models[0].n_actions), ("Maze-v0", 57, 4));
    let expected = (0..SAMPLE).map(|number| sampled(number, &models[0].model_id)).collect::<Vec<_>>();
    assert_eq!(export(&learner, &pb::TrajectoryFilter::default()).await, expected);
    let fits = learner.list_fits("", "").await.expect("fits");
    assert_eq!(fits.len(), 1);
    let old = learner.get_fit(&fits[0].fit_id).await.expect("a fit");
    let ids = expected.iter().map(|t| &t.trajectory_id);
    assert!(old.trajectory_ids.iter().eq(ids));
    // The stored request repeats the fit.
    let again = learner.fit(old.request.clone().expect("a request"), |_| ()).await.expect("a fit");
    let weights = |fit: &pb::Fit| Packed::<f64>::new(fit.weights.clone()).expect("an array").to_vec();
    assert_eq!(weights(&again).len(), 57);
    for (new, old) in weights(&again).into_iter().zip(weights(&old)) {
        assert!((new - old).abs() < 1e-9, "expected {old}, got {new}");
    }
    // What was stored then is still known now, and new data join it.
    let mut recorder = learner.recorder();
    for trajectory in expected.into_iter().chain([trajectory(1000)]) {
        recorder.record(trajectory).await.expect("a trajectory");
    }
    let receipt = recorder.finish().await.expect("everything stored");
    assert_eq!((receipt.stored, receipt.duplicates), (1, SAMPLE as u64));
}

#[tokio::test(flavor = "multi_thread")]
async fn two_processes_share_a_directory() {
    let data = tempfile::tempdir().expect("a directory");
    // One starts while the other does: both find the schema made, once.
    let path = data.path().to_owned();
    let other = std::thread::spawn({
        let path = path.clone();
        move || Service::learner(&path)
    });
    let services = [Service::learner(&path), other.join().expect("a service")];
    let clients = services.iter().enumerate().map(|(i, service)| {
        let address = service.address().to_owned();
        tokio::spawn(async move {
            let mut recorder = Recorder::connect(&address).await.expect("a learner");
            for number in 0..500_u128 {
                // Every fifth is common to both.
                let number = if number % 5 == 0 { number } else { number + 1000 * (i as u128 + 1) };
                recorder.record(trajectory(number)).await.expect("a trajectory");
                if number % 50 == 0 {
                    recorder.flush().await.expect("stored");
                }
            }
            recorder.finish().await.expect("everything stored")
        })
    });
    let mut stored = 0;
    for client in clients.collect::<Vec<_>>() {
        let receipt = client.await.expect("a client");
        assert_eq!(receipt.acknowledged(), 500);
        stored += receipt.stored;
    }
    assert_eq!(stored, 900);
    let mut seen = Vec::new();
    for service in &services {
        let learner = Learner::connect(service.address()).await.expect("a learner");
        seen.push(export(&learner, &pb::TrajectoryFilter::default()).await);
    }
    assert_eq!(seen[0].len(), 900);
    assert!(seen[0] == seen[1], "both see the same, in the same order");
}
