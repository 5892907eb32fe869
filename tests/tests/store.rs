//! Stored data outlives releases and is shared between processes.

use mazeway_client::{Learner, Options, Recorder, packed::Packed};
use mazeway_learner::store;
use mazeway_proto::learner as pb;
use mazeway_tests::{
    EnvServer,
    learner::{LearnerServer, export, trajectory},
    programs::Service,
};
use std::path::{Path, PathBuf};

/// Trajectories in the sample.
const SAMPLE: u128 = 12;

/// The newest schema.
const NEWEST: i64 = 2;
/// A sample of every format that was released: of the schemas, and of schema 2 since documents hold the hashes of what lies beside
/// them. The last is the newest.
const SAMPLES: [&str; 3] = ["v1", "v2", "v2_hashed"];

fn sample(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("data").join(format!("store_{name}.sqlite3"))
}

/// A trajectory of the sample: in the maze's model, so that it can be fitted.
fn sampled(number: u128, model_id: &str) -> pb::Trajectory {
    pb::Trajectory { model_id: model_id.into(), ..trajectory(number) }
}

/// Wrote the sample when its format was new. Samples stay for ever: a new format gets a new one beside them.
#[tokio::test(flavor = "multi_thread")]
#[ignore = "writes the sample of a new format: run by hand, once"]
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
    std::fs::copy(data.path().join("mazeway.sqlite3"), sample(SAMPLES[SAMPLES.len() - 1])).expect("a copy");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_store_of_every_format_reads_and_goes_on() {
    for name in SAMPLES {
        reads_and_goes_on(&sample(name)).await;
    }
}

async fn reads_and_goes_on(sample: &Path) {
    let data = tempfile::tempdir().expect("a directory");
    let file = data.path().join("mazeway.sqlite3");
    std::fs::copy(sample, &file).expect("a copy");
    // As it is, before anything brings it up to date.
    let found = store::verify(data.path()).expect("a store");
    let sound = |found: &store::Verification| {
        (found.is_sound(), found.trajectories.sound, found.models.sound, found.fits.sound)
    };
    assert_eq!(sound(&found), (true, SAMPLE as u64, 1, 1), "{found:?}");
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
    assert!(learner.fit_trajectories(&old.fit_id).await.expect("ids").iter().eq(ids));
    assert_eq!(old.trajectories, SAMPLE as u64);
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
    assert_eq!((again.trajectories, &again.trajectories_digest), (old.trajectories, &old.trajectories_digest));
    drop(learner);
    server.stop();
    let found = store::verify(data.path()).expect("a store");
    assert_eq!((sound(&found), found.schema), ((true, SAMPLE as u64 + 1, 1, 2), NEWEST), "{found:?}");
}

#[test]
fn a_damaged_store_of_the_first_schema_is_repaired_into_the_newest() {
    let data = tempfile::tempdir().expect("a directory");
    let file = data.path().join("mazeway.sqlite3");
    let mut bytes = std::fs::read(sample(SAMPLES[0])).expect("a sample");
    let victim = sampled(7, "");
    let at = bytes.windows(victim.rewards.len()).rposition(|w| w == victim.rewards).expect("its rewards");
    bytes[at] ^= 1;
    std::fs::write(&file, bytes).expect("a copy");
    let repair = store::repair(data.path()).expect("a repair");
    assert_eq!((repair.found.trajectories.damaged, repair.found.fits.sound), (1, 1), "{:?}", repair.found);
    assert_eq!(repair.found.damage[0].name, victim.trajectory_id);
    let found = store::verify(data.path()).expect("a store");
    assert!(found.is_sound() && found.schema == NEWEST, "{found:?}");
    let store = store::Store::open(data.path()).expect("a store");
    let fit = store.fits("", "", i64::MAX, 10).expect("fits").remove(0);
    let (ids, total) = store.fit_trajectories(&fit.fit_id, 0, 100).expect("ids").expect("a fit");
    assert_eq!((ids.len(), total), (SAMPLE as usize, SAMPLE as u64), "what it used, whether it is left or not");
}

#[test]
fn a_flipped_bit_of_a_fit_is_found_by_its_hash() {
    let data = tempfile::tempdir().expect("a directory");
    let file = data.path().join("mazeway.sqlite3");
    std::fs::copy(sample(SAMPLES[SAMPLES.len() - 1]), &file).expect("a copy");
    let weights = {
        let store = store::Store::open(data.path()).expect("a store");
        let id = store.fits("", "", i64::MAX, 1).expect("fits").remove(0).fit_id;
        store.fit(&id).expect("reads").expect("a fit").weights
    };
    let mut bytes = std::fs::read(&file).expect("a database");
    // A page holds a part of them alone.
    let part = &weights[..64];
    let at = bytes.windows(part.len()).position(|w| w == part).expect("its weights");
    bytes[at] ^= 1;
    std::fs::write(&file, bytes).expect("a database");
    let found = store::verify(data.path()).expect("a store");
    assert_eq!((found.fits.sound, found.fits.damaged), (0, 1), "{found:?}");
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
