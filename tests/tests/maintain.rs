//! `learner verify`, `repair`, `backup` and `vacuum` as an operator meets them, a service at work meanwhile.

use mazeway_client::{Learner, Recorder};
use mazeway_proto::learner as pb;
use mazeway_tests::{
    learner::{export, trajectory},
    programs::{Service, program},
};
use serde_json::Value;
use std::{
    fs,
    path::Path,
    process::{Command, Output},
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
};

fn learner(arguments: &[&str], data: &Path) -> Output {
    let mut command = Command::new(program("learner"));
    for (name, _) in std::env::vars().filter(|(name, _)| name.starts_with("MAZEWAY_") || name == "RUST_LOG") {
        command.env_remove(name);
    }
    command.args(arguments).arg("--data").arg(data).output().expect("a process")
}

fn json(output: &Output) -> Value {
    serde_json::from_slice(&output.stdout).unwrap_or_else(|error| panic!("{error}: {output:?}"))
}

/// The `error:` and the `hint:` line.
fn complaint(output: &Output) -> (String, String) {
    let said = String::from_utf8_lossy(&output.stderr);
    let (error, hint) = said.split_once('\n').expect("two lines");
    (
        error.strip_prefix("error: ").expect("an error").into(),
        hint.strip_prefix("hint: ").expect("a hint").trim().into(),
    )
}

async fn recorded(data: &Path, numbers: std::ops::Range<u128>) {
    let service = Service::learner(data);
    let mut recorder = Recorder::connect(service.address()).await.expect("a learner");
    for number in numbers {
        recorder.record(trajectory(number)).await.expect("a trajectory");
    }
    recorder.finish().await.expect("everything stored");
}

#[tokio::test(flavor = "multi_thread")]
async fn what_is_damaged_is_said_and_repaired() {
    let data = tempfile::tempdir().expect("a directory");
    recorded(data.path(), 0..200).await;
    let sound = learner(&["verify", "--json"], data.path());
    assert_eq!((sound.status.code(), &json(&sound)["sound"]), (Some(0), &Value::Bool(true)));
    assert_eq!(json(&sound)["found"]["trajectories"]["sound"], 200);
    let nothing = learner(&["repair"], data.path());
    assert!(nothing.status.success() && String::from_utf8_lossy(&nothing.stdout).ends_with("nothing to repair\n"));

    // The log is written back, then a bit of one trajectory's rewards flips.
    assert!(learner(&["vacuum"], data.path()).status.success());
    let file = data.path().join("mazeway.sqlite3");
    let mut bytes = fs::read(&file).expect("a database");
    let victim = trajectory(31);
    // The last of them: what was moved to another page may lie where it was, unused.
    let at = bytes.windows(victim.rewards.len()).rposition(|w| w == victim.rewards).expect("its rewards");
    bytes[at + 3] ^= 16;
    fs::write(&file, &bytes).expect("a file");

    let damaged = learner(&["verify"], data.path());
    assert_eq!(damaged.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&damaged.stdout).contains(&victim.trajectory_id));
    let (error, hint) = complaint(&damaged);
    assert!(error.ends_with("is damaged: 1 trajectories") && hint.contains("learner repair"), "{error}, {hint}");
    let service = Service::learner(data.path());
    // All else can be had at once, the service at work or not.
    let file = data.path().join("exported.jsonl");
    let out = file.to_str().expect("a path");
    let stopped = learner(&["export", "--out", out], data.path());
    assert_eq!(stopped.status.code(), Some(1));
    assert!(complaint(&stopped).1.contains("--skip-damaged"), "{stopped:?}");
    assert!(
        fs::read_dir(data.path())
            .expect("a directory")
            .all(|file| { !file.expect("a file").file_name().to_string_lossy().starts_with("exported") })
    );
    let rest = learner(&["export", "--skip-damaged", "--out", out], data.path());
    assert!(rest.status.success(), "{rest:?}");
    let said = String::from_utf8_lossy(&rest.stderr);
    assert!(said.contains(&victim.trajectory_id) && said.contains("left out 1 damaged"), "{said}");
    let lines = fs::read_to_string(&file).expect("an export");
    let exported = lines.lines().map(|line| serde_json::from_str::<Value>(line).expect("a trajectory")["id"].clone());
    let ids = (0..200).filter(|&number| number != 31).map(|number| Value::from(trajectory(number).trajectory_id));
    assert!(exported.eq(ids));
    let calm = learner(&["export", "--skip-damaged", "--style", "calm"], data.path());
    assert!(calm.status.success() && calm.stdout.split(|byte| *byte == b'\n').count() == 68, "{calm:?}");
    let busy = learner(&["repair"], data.path());
    assert_eq!(busy.status.code(), Some(1));
    assert!(complaint(&busy).1.contains("stop the other program"), "{busy:?}");
    service.kill();
    let repaired = learner(&["repair", "--json"], data.path());
    assert!(repaired.status.success(), "{repaired:?}");
    let told = json(&repaired);
    assert_eq!((&told["repaired"], &told["found"]["trajectories"]["sound"]), (&Value::Bool(true), &Value::from(199)));
    assert_eq!(told["found"]["damage"][0]["name"], Value::from(victim.trajectory_id.as_str()));
    assert!(Path::new(told["kept"].as_str().expect("a path")).is_file());
    assert!(learner(&["verify"], data.path()).status.success());

    let service = Service::learner(data.path());
    let client = Learner::connect(service.address()).await.expect("a learner");
    let stored = export(&client, &pb::TrajectoryFilter::default()).await;
    let expected = (0..200).filter(|&number| number != 31).map(trajectory).collect::<Vec<_>>();
    assert!(stored == expected, "the others, as they were, in their order");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_backup_of_a_service_at_work_opens_and_holds_what_was_acknowledged() {
    let [data, copies] = [(); 2].map(|()| tempfile::tempdir().expect("a directory"));
    let service = Service::learner(data.path());
    let (stop, acknowledged) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicU64::new(0)));
    let load = tokio::spawn({
        let (stop, acknowledged, address) =
            (Arc::clone(&stop), Arc::clone(&acknowledged), service.address().to_owned());
        async move {
            let mut recorder = Recorder::connect(&address).await.expect("a learner");
            let mut number = 0;
            while !stop.load(Ordering::Relaxed) {
                recorder.record(trajectory(number)).await.expect("a trajectory");
                number += 1;
                if number % 20 == 0 {
                    acknowledged.store(recorder.flush().await.expect("stored").acknowledged(), Ordering::SeqCst);
                }
            }
            recorder.finish().await.expect("everything stored").acknowledged()
        }
    });
    let mut sizes = Vec::new();
    for copy in 0..3 {
        let before = loop {
            let now = acknowledged.load(Ordering::SeqCst);
            if now > sizes.last().copied().unwrap_or(0) {
                break now;
            }
            tokio::time::sleep(std::time::Duration::from_millis(2)).await;
        };
        let place = copies.path().join("deep").join(copy.to_string());
        let (from, to) = (data.path().to_owned(), place.clone());
        let output =
            tokio::task::spawn_blocking(move || learner(&["backup", to.to_str().expect("a path"), "--json"], &from));
        let output = output.await.expect("a process");
        assert!(output.status.success(), "{output:?}");
        let opened = Service::learner(&place);
        let client = Learner::connect(opened.address()).await.expect("a copy that opens");
        let stored = export(&client, &pb::TrajectoryFilter::default()).await;
        assert_eq!(json(&output)["found"]["trajectories"]["sound"], stored.len());
        assert!(stored.len() as u64 >= before, "what was acknowledged before the copy is in it");
        assert!(stored == (0..stored.len() as u128).map(trajectory).collect::<Vec<_>>(), "one moment, whole");
        sizes.push(stored.len() as u64);
    }
    stop.store(true, Ordering::Relaxed);
    assert!(load.await.expect("a client") >= *sizes.last().expect("copies"));
    // A copy is not written over another.
    let place = copies.path().join("deep").join("0");
    let again = learner(&["backup", place.to_str().expect("a path")], data.path());
    assert_eq!(again.status.code(), Some(1));
    let (error, hint) = complaint(&again);
    assert!(error.contains("already") && hint == "name another directory for the copy", "{again:?}");
    // It is the store that is missing, wherever the copy is to be.
    let none = learner(&["backup", copies.path().to_str().expect("a path")], &copies.path().join("none"));
    assert!(complaint(&none).1.contains("--data"), "{none:?}");
}

#[cfg(unix)]
#[tokio::test(flavor = "multi_thread")]
async fn what_is_stored_stays_with_whom_it_belongs_to() {
    use std::os::unix::fs::{MetadataExt as _, PermissionsExt as _};
    let mode = |path: &Path| fs::metadata(path).expect("a file").mode() & 0o777;
    let base = tempfile::tempdir().expect("a directory");
    let (data, copies) = (base.path().join("deep/data"), base.path().join("copies/today"));
    recorded(&data, 0..40).await;
    for made in [base.path().join("deep"), data.clone()] {
        assert_eq!(mode(&made), 0o700, "{}", made.display());
    }
    assert!(learner(&["vacuum"], &data).status.success());

    let file = data.join("mazeway.sqlite3");
    fs::set_permissions(&file, fs::Permissions::from_mode(0o600)).expect("permissions");
    let copied = learner(&["backup", copies.to_str().expect("a path")], &data);
    assert!(copied.status.success(), "{copied:?}");
    assert_eq!((mode(&copies), mode(&copies.join("mazeway.sqlite3"))), (0o700, 0o600));

    let mut bytes = fs::read(&file).expect("a database");
    let victim = trajectory(31);
    let at = bytes.windows(victim.rewards.len()).rposition(|w| w == victim.rewards).expect("its rewards");
    bytes[at + 3] ^= 16;
    fs::write(&file, &bytes).expect("a file");
    // Only root may give files away: then it is somebody else's, as where root repairs what a service writes.
    let owner = if std::os::unix::fs::chown(&file, Some(4321), Some(1234)).is_ok() {
        (4321, 1234)
    } else {
        let own = fs::metadata(&file).expect("a file");
        (own.uid(), own.gid())
    };
    let repaired = learner(&["repair"], &data);
    assert!(repaired.status.success(), "{repaired:?}");
    let new = fs::metadata(&file).expect("a file");
    assert_eq!((new.mode() & 0o777, (new.uid(), new.gid())), (0o600, owner));
    assert!(learner(&["verify"], &data).status.success());
}

#[tokio::test(flavor = "multi_thread")]
async fn what_is_deleted_gives_its_room_back() {
    let data = tempfile::tempdir().expect("a directory");
    recorded(data.path(), 0..1000).await;
    assert!(learner(&["delete", "--style", "brisk", "--yes"], data.path()).status.success());
    let vacuumed = learner(&["vacuum", "--json"], data.path());
    assert!(vacuumed.status.success(), "{vacuumed:?}");
    let told = json(&vacuumed);
    let bytes = |name: &str| told[name].as_u64().expect("a size");
    assert!(bytes("bytes") * 2 < bytes("bytes_before"), "{told}");
    assert_eq!(json(&learner(&["verify", "--json"], data.path()))["found"]["trajectories"]["sound"], 334);
    let none = learner(&["vacuum"], &data.path().join("none"));
    assert_eq!(none.status.code(), Some(1));
    assert!(complaint(&none).0.contains("holds no"), "{none:?}");
}
