//! Fits that are cut off by a kill, and data that are deleted while fits read them.

use mazeway_client::{Learner, Options, packed::Packed};
use mazeway_proto::learner as pb;
use mazeway_tests::{
    EnvServer,
    learner::{LearnerServer, export, trajectory},
    programs::Service,
};
use uuid::Uuid;

/// Trajectories of one style.
const GROUP: u128 = 600;
/// Times that data are deleted while they are read.
const ROUNDS: u32 = 12;

fn request(method: &str) -> pb::FitRequest {
    let filter = pb::TrajectoryFilter { env_id: "Maze-v0".into(), ..Default::default() };
    pb::FitRequest { method: method.into(), filter: Some(filter), ..Default::default() }
}

async fn model() -> mazeway_client::Model {
    let environments = EnvServer::start();
    mazeway_client::model(&environments.address(), "Maze-v0", &Options::default()).await.expect("a model")
}

/// The trajectories of one style, in the maze.
fn group(style: u128, model_id: &str) -> Vec<pb::Trajectory> {
    let of = |number: u128| pb::Trajectory {
        trajectory_id: Uuid::from_u128(style * 1_000_000 + number).to_string(),
        env_id: "Maze-v0".into(),
        model_id: model_id.into(),
        style: format!("style {style}"),
        ..trajectory(number)
    };
    (0..GROUP).map(of).collect()
}

async fn record(learner: &Learner, trajectories: Vec<pb::Trajectory>) {
    let mut recorder = learner.recorder();
    for trajectory in trajectories {
        recorder.record(trajectory).await.expect("a trajectory");
    }
    recorder.finish().await.expect("everything stored");
}

fn weights(fit: &pb::Fit) -> Vec<f64> {
    Packed::<f64>::new(fit.weights.clone()).expect("an array").to_vec()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_service_that_is_killed_in_a_fit_stores_nothing_of_it_and_repeats_it() {
    let (data, model) = (tempfile::tempdir().expect("a directory"), model().await);
    let service = Service::learner(data.path());
    let learner = Learner::connect(service.address()).await.expect("a learner");
    learner.put_model(&model).await.expect("a model");
    record(&learner, group(1, &model.model_id)).await;
    let mut long = request("birl");
    long.options.get_or_insert_default().draws = Some(4_000);
    let mut stream = learner.fit_stream(long.clone()).await.expect("a fit that begins");
    // The kill comes once it is at work.
    assert!(stream.next().await.expect("news").is_some());
    service.kill();
    loop {
        match stream.next().await {
            Ok(Some(_)) => {}
            Ok(None) => panic!("a fit that was cut off does not end well"),
            Err(_) => break,
        }
    }
    let service = Service::learner(data.path());
    let learner = Learner::connect(service.address()).await.expect("a learner");
    assert!(learner.list_fits("", "").await.expect("fits").is_empty());
    assert_eq!(export(&learner, &pb::TrajectoryFilter::default()).await, group(1, &model.model_id));
    let again = learner.fit(long.clone(), |_| ()).await.expect("a fit");
    assert_eq!(learner.list_fits("", "").await.expect("fits").len(), 1);
    // What a learner gives that nobody has killed.
    let elsewhere = tempfile::tempdir().expect("a directory");
    let server = LearnerServer::start(elsewhere.path());
    let learner = server.client().await;
    learner.put_model(&model).await.expect("a model");
    record(&learner, group(1, &model.model_id)).await;
    let undisturbed = learner.fit(long, |_| ()).await.expect("a fit");
    assert_eq!(weights(&again).len(), 57);
    assert_eq!(weights(&again), weights(&undisturbed));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_fit_sees_what_is_deleted_meanwhile_as_a_whole_or_not_at_all() {
    let (data, model) = (tempfile::tempdir().expect("a directory"), model().await);
    let server = LearnerServer::start(data.path());
    let learner = server.client().await;
    learner.put_model(&model).await.expect("a model");
    for style in 1..=3 {
        record(&learner, group(style, &model.model_id)).await;
    }
    let mut seen = Vec::new();
    for round in 0..ROUNDS {
        let style = u128::from(round % 3 + 1);
        let fits = (0..3).map(|_| {
            let learner = learner.clone();
            tokio::spawn(async move { learner.fit(request("em"), |_| ()).await.expect("a fit") })
        });
        let fits = fits.collect::<Vec<_>>();
        tokio::time::sleep(std::time::Duration::from_micros(u64::from(round) * 400)).await;
        let gone = pb::TrajectoryFilter { style: format!("style {style}"), ..Default::default() };
        assert_eq!(u128::from(learner.delete_trajectories(&gone).await.expect("deleted")), GROUP);
        for fit in fits {
            seen.push(fit.await.expect("a task"));
        }
        record(&learner, group(style, &model.model_id)).await;
    }
    let summaries = learner.list_fits("", "").await.expect("fits");
    assert_eq!(summaries.len(), seen.len());
    for summary in &summaries {
        let whole = u128::from(summary.trajectories);
        assert!(whole == 2 * GROUP || whole == 3 * GROUP, "a fit of {whole} trajectories");
    }
    // Styles differ in nothing but their names: fits of as many trajectories are the same, whatever went on beside them.
    for fit in &seen {
        let alike = seen.iter().find(|other| other.steps == fit.steps).expect("itself");
        assert_eq!(weights(fit), weights(alike));
    }
    assert!(mazeway_learner::store::verify(data.path()).is_ok_and(|found| found.is_sound()));
}
