//! Full disks and full stores: recording is refused, everything else goes on, and recording resumes when there is room.

use mazeway_client::{ClientError, Code, Learner, Options, Recorder};
use mazeway_learner::config::Limits;
use mazeway_proto::learner as pb;
use mazeway_tests::{
    EnvServer,
    learner::{LearnerServer, export, trajectory},
};
use std::{
    fs,
    io::Write as _,
    path::{Path, PathBuf},
    process::Command,
};

/// A trajectory of so many bytes that a store is soon full.
fn large(number: u128, model_id: &str) -> pb::Trajectory {
    let small = trajectory(number);
    let many = |bytes: &[u8]| bytes.iter().copied().cycle().take(bytes.len() * 30).collect::<Vec<u8>>().into();
    pb::Trajectory {
        model_id: model_id.into(),
        states: many(&small.states),
        actions: many(&small.actions),
        rewards: many(&small.rewards),
        ..small
    }
}

/// Records one after the other until it is refused, and tells how many were acknowledged and what was said.
async fn fill(learner: &Learner, model_id: &str, first: u128) -> (Vec<pb::Trajectory>, ClientError) {
    let mut acknowledged = Vec::new();
    for number in first.. {
        let recorded = async {
            let mut recorder = learner.recorder();
            recorder.record(large(number, model_id)).await?;
            recorder.finish().await
        };
        match recorded.await {
            Ok(_) => acknowledged.push(large(number, model_id)),
            Err(error) => return (acknowledged, error),
        }
        assert!(number < 100_000, "it is never full");
    }
    unreachable!("it is full before the numbers are")
}

async fn maze() -> (EnvServer, mazeway_client::Model) {
    let environments = EnvServer::start();
    let model = mazeway_client::model(&environments.address(), "Maze-v0", &Options::default()).await.expect("a model");
    (environments, model)
}

fn fit() -> pb::FitRequest {
    pb::FitRequest { method: "em".into(), filter: Some(pb::TrajectoryFilter::default()), ..Default::default() }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_store_that_may_grow_no_more_is_read_fitted_and_emptied() {
    let data = tempfile::tempdir().expect("a directory");
    let (_environments, model) = maze().await;
    let limits = Limits { max_store_bytes: Some(1 << 20), ..Limits::default() };
    let server = LearnerServer::with(data.path(), limits);
    let learner = server.client().await;
    learner.put_model(&model).await.expect("a model");
    let (acknowledged, error) = fill(&learner, &model.model_id, 0).await;
    assert_eq!((error.code(), error.field()), (Code::ResourceExhausted, Some("max_store_bytes")), "{error}");
    assert!(acknowledged.len() > 10 && error.to_string().contains("1048576 bytes"), "{error}");
    // What is stored already is acknowledged as ever, and all else goes on.
    let mut recorder = learner.recorder();
    recorder.record(acknowledged[0].clone()).await.expect("a trajectory");
    assert_eq!(recorder.finish().await.expect("an acknowledgement").duplicates, 1);
    assert!(export(&learner, &pb::TrajectoryFilter::default()).await == acknowledged);
    let fitted = learner.fit(fit(), |_| ()).await.expect("a fit");
    assert!(learner.get_fit(&fitted.fit_id).await.is_ok());
    // Room again.
    let brisk = pb::TrajectoryFilter { style: "brisk".into(), ..Default::default() };
    learner.delete_trajectories(&brisk).await.expect("deleted");
    let (more, _) = fill(&learner, &model.model_id, 1_000).await;
    assert!(!more.is_empty());
    let kept = acknowledged.into_iter().filter(|t| t.style != "brisk").chain(more).collect::<Vec<_>>();
    assert!(export(&learner, &pb::TrajectoryFilter::default()).await == kept);
}

/// A small file system of its own, where the tests may mount one.
struct SmallDisk {
    directory: tempfile::TempDir,
}

impl SmallDisk {
    fn mount(bytes: u64) -> Option<Self> {
        let directory = tempfile::tempdir().expect("a directory");
        let mut mount = Command::new("mount");
        mount.args(["-t", "tmpfs", "-o", &format!("size={bytes}"), "tmpfs"]).arg(directory.path());
        let mounted = cfg!(target_os = "linux") && mount.output().is_ok_and(|output| output.status.success());
        mounted.then_some(Self { directory })
    }

    fn path(&self) -> &Path {
        self.directory.path()
    }

    fn filler(&self) -> PathBuf {
        self.path().join("filler")
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        // What is left mounted goes with the machine.
        let _ = Command::new("umount").arg("-l").arg(self.path()).output();
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_full_disk_loses_nothing_and_is_told() {
    let Some(disk) = SmallDisk::mount(8 << 20) else {
        println!("skipped: nothing can be mounted here; the quota's test and the power cuts' full disks remain");
        return;
    };
    let (_environments, model) = maze().await;
    let server = LearnerServer::start(disk.path());
    let learner = server.client().await;
    learner.put_model(&model).await.expect("a model");
    fs::write(disk.filler(), vec![0; 4 << 20]).expect("a file that takes room");
    let (mut acknowledged, error) = fill(&learner, &model.model_id, 0).await;
    assert_eq!(error.code(), Code::ResourceExhausted, "{error}");
    assert!(error.to_string().contains("full"), "{error}");
    assert!(export(&learner, &pb::TrajectoryFilter::default()).await == acknowledged, "all there, nothing beside");
    // A fit that cannot be stored is still given.
    let fitted = learner.fit(fit(), |_| ()).await.expect("a fit");
    let stored = learner.get_fit(&fitted.fit_id).await.is_ok();
    assert_eq!(fitted.warnings.iter().any(|warning| warning.contains("not stored")), !stored, "{:?}", fitted.warnings);
    fs::remove_file(disk.filler()).expect("room again");
    let mut recorder = Recorder::connect(&server.address()).await.expect("a learner");
    for number in 5_000..5_020 {
        recorder.record(large(number, &model.model_id)).await.expect("a trajectory");
        acknowledged.push(large(number, &model.model_id));
    }
    recorder.finish().await.expect("recording resumes");
    assert!(export(&learner, &pb::TrajectoryFilter::default()).await == acknowledged);
    drop(learner);
    server.stop();
    assert!(mazeway_learner::store::verify(disk.path()).is_ok_and(|found| found.is_sound()));
}

/// All there, as they were, and nothing beside but perhaps what was refused in the end: a disk that is full may have taken a
/// request as a whole before it said so.
fn same(mut found: Vec<pb::Trajectory>, expected: &[pb::Trajectory], refused: &[pb::Trajectory]) {
    found.retain(|t| expected.contains(t) || !refused.contains(t));
    let ids = |all: &[pb::Trajectory]| all.iter().map(|t| t.trajectory_id.clone()).collect::<Vec<_>>();
    assert_eq!(ids(&found), ids(expected));
    assert!(found == expected);
}

/// Takes all the room that is left.
fn fill_up(disk: &SmallDisk) {
    let mut filler = fs::File::options().create(true).append(true).open(disk.filler()).expect("a file");
    while filler.write_all(&[b'.'; 4096]).is_ok() {}
}

#[tokio::test(flavor = "multi_thread")]
async fn a_store_opens_on_a_disk_that_has_filled_up_since_it_was_closed() {
    let Some(disk) = SmallDisk::mount(8 << 20) else {
        println!("skipped: nothing can be mounted here");
        return;
    };
    let (_environments, model) = maze().await;
    let (mut acknowledged, mut refused) = (Vec::new(), Vec::new());
    {
        let server = LearnerServer::start(disk.path());
        let learner = server.client().await;
        learner.put_model(&model).await.expect("a model");
        let mut recorder = learner.recorder();
        for number in 0..20 {
            recorder.record(large(number, &model.model_id)).await.expect("a trajectory");
            acknowledged.push(large(number, &model.model_id));
        }
        recorder.finish().await.expect("all stored");
        server.stop();
    }
    for _ in 0..3 {
        fill_up(&disk);
        assert!(mazeway_learner::store::verify(disk.path()).is_ok_and(|found| found.is_sound()));
        let server = LearnerServer::start(disk.path());
        let learner = server.client().await;
        same(export(&learner, &pb::TrajectoryFilter::default()).await, &acknowledged, &refused);
        learner.fit(fit(), |_| ()).await.expect("a fit");
        let (more, error) = fill(&learner, &model.model_id, 100).await;
        assert_eq!(error.code(), Code::ResourceExhausted, "{error}");
        refused.push(large(100 + more.len() as u128, &model.model_id));
        // The room that was given up holds some.
        acknowledged.extend(more.into_iter().filter(|t| !acknowledged.contains(t)).collect::<Vec<_>>());
        drop(learner);
        server.stop();
    }
    fs::remove_file(disk.filler()).expect("room again");
    let server = LearnerServer::start(disk.path());
    let learner = server.client().await;
    let mut recorder = learner.recorder();
    recorder.record(large(1_000, &model.model_id)).await.expect("a trajectory");
    recorder.finish().await.expect("recording resumes");
    acknowledged.push(large(1_000, &model.model_id));
    same(export(&learner, &pb::TrajectoryFilter::default()).await, &acknowledged, &refused);
}
