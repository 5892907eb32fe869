//! Kills the real learner in the middle of recordings and looks for what it had acknowledged.

use mazeway_client::{Learner, Recorder};
use mazeway_proto::learner::{self as pb, learner_service_client::LearnerServiceClient};
use mazeway_tests::{
    learner::{export, trajectory},
    programs::Service,
};
use std::{
    collections::HashMap,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::Duration,
};
use tokio::sync::mpsc;

/// Kills of one test, unless `MAZEWAY_KILLS` says how many.
const ROUNDS: u128 = 6;
/// Clients that record at the same time.
const CLIENTS: u128 = 4;
/// Trajectories of one request.
const BATCH: u128 = 5;

/// Records batches on one stream until the service dies, and tells which batches were acknowledged.
async fn record_until_death(address: String, first: u128, acknowledged: Arc<AtomicU64>) -> Vec<u128> {
    let mut service = LearnerServiceClient::connect(format!("http://{address}")).await.expect("a learner that answers");
    let (requests, stream) = mpsc::channel(8);
    let sender = tokio::spawn(async move {
        for batch in 0_u128.. {
            let numbers = first + batch * BATCH..first + (batch + 1) * BATCH;
            let request = pb::RecordTrajectoriesRequest { trajectories: numbers.map(trajectory).collect() };
            if requests.send(request).await.is_err() {
                return;
            }
        }
    });
    let stream = tokio_stream::wrappers::ReceiverStream::new(stream);
    // The service may die before this stream has begun: then nothing of it was acknowledged.
    let Ok(answers) = service.record_trajectories(stream).await else {
        sender.abort();
        return Vec::new();
    };
    let mut answers = answers.into_inner();
    let mut safe = Vec::new();
    while let Ok(Some(answer)) = answers.message().await {
        let begin = first + (safe.len() as u128);
        let numbers = begin..begin + BATCH;
        let ids = numbers.clone().map(|n| trajectory(n).trajectory_id).collect::<Vec<_>>();
        assert_eq!(answer.trajectory_ids, ids, "answers come in the order of the requests");
        safe.extend(numbers);
        acknowledged.fetch_add(BATCH as u64, Ordering::Relaxed);
    }
    sender.abort();
    safe
}

#[tokio::test(flavor = "multi_thread")]
async fn what_was_acknowledged_survives_kills() {
    let rounds = std::env::var("MAZEWAY_KILLS").map_or(ROUNDS, |rounds| rounds.parse().expect("a number"));
    let data = tempfile::tempdir().expect("a directory");
    let mut safe: Vec<u128> = Vec::new();
    for round in 0..rounds {
        let service = Service::learner(data.path());
        let learner = Learner::connect(service.address()).await.expect("a learner that opens what was killed");
        let stored = export(&learner, &pb::TrajectoryFilter::default()).await;
        let stored = stored.into_iter().map(|t| (t.trajectory_id.clone(), t)).collect::<HashMap<_, _>>();
        for &number in &safe {
            let expected = trajectory(number);
            assert_eq!(stored.get(&expected.trajectory_id), Some(&expected), "acknowledged before round {round}");
        }
        let count = Arc::new(AtomicU64::new(0));
        let clients = (0..CLIENTS).map(|client| {
            // Numbers of different rounds and clients never meet.
            let first = (round + 1) * 1_000_000_000 + client * 1_000_000;
            tokio::spawn(record_until_death(service.address().to_owned(), first, Arc::clone(&count)))
        });
        let clients = clients.collect::<Vec<_>>();
        // In the middle: every round a little later, and never before something was acknowledged.
        let enough = 50 + (round % ROUNDS) as u64 * 150;
        while count.load(Ordering::Relaxed) < enough {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
        service.kill();
        for client in clients {
            safe.extend(client.await.expect("a client"));
        }
    }
    let service = Service::learner(data.path());
    let learner = Learner::connect(service.address()).await.expect("a learner");
    let stored = export(&learner, &pb::TrajectoryFilter::default()).await;
    let ids = stored.iter().map(|t| t.trajectory_id.as_str()).collect::<std::collections::HashSet<_>>();
    assert_eq!(ids.len(), stored.len(), "no trajectory is stored twice");
    let stored = stored.iter().map(|t| (t.trajectory_id.clone(), t)).collect::<HashMap<_, _>>();
    assert!(safe.len() as u128 >= rounds * 50);
    for &number in &safe {
        let expected = trajectory(number);
        assert_eq!(stored.get(&expected.trajectory_id).copied(), Some(&expected));
    }
    println!(
        "{rounds} kills under {CLIENTS} clients: {} trajectories acknowledged, {} of them found, {} found beside them",
        safe.len(),
        safe.len(),
        stored.len() - safe.len()
    );
    drop(learner);
    service.kill();
    let found = mazeway_learner::store::verify(data.path()).expect("findings");
    assert!(found.is_sound() && found.trajectories.sound == stored.len() as u64, "{found:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_recorder_goes_on_where_a_killed_learner_left_off() {
    let data = tempfile::tempdir().expect("a directory");
    let service = Service::learner(data.path());
    let address = service.address().to_owned();
    let mut recorder = Recorder::connect(&address).await.expect("a learner");
    let total = 20_000_u128;
    for number in 0..total / 2 {
        recorder.record(trajectory(number)).await.expect("a trajectory");
    }
    assert!(recorder.unacknowledged() > 0, "the kill comes in the middle");
    service.kill();
    // The same place, opened again while the recorder looks for it.
    let again = std::thread::spawn({
        let data = data.path().to_owned();
        move || {
            std::thread::sleep(Duration::from_millis(300));
            let mut command = std::process::Command::new(mazeway_tests::programs::program("learner"));
            command.args(["serve", "--listen", &address, "--data"]).arg(data);
            Service::start(command)
        }
    });
    for number in total / 2..total {
        recorder.record(trajectory(number)).await.expect("a trajectory");
    }
    let receipt = recorder.finish().await.expect("everything acknowledged");
    assert_eq!(receipt.acknowledged(), total as u64);
    let service = again.join().expect("a service");
    let learner = Learner::connect(service.address()).await.expect("a learner");
    let stored = export(&learner, &pb::TrajectoryFilter::default()).await;
    assert!(stored.iter().eq(&(0..total).map(trajectory).collect::<Vec<_>>()), "all, once, in the order recorded");
}
