//! What fifty viewers cost a session, forty of whom read nothing.
//!
//! Two sessions of one server are stepped in turn, one of them watched: as long as a session stands still, nothing of it is
//! drawn, so that viewers weigh on its own slices alone. They watch from a thread of this process, over connections of
//! their own.

use crate::{
    Setting,
    figures::{Report, Subject, in_rounds, mode_name},
    process::Process,
    round_trips::{current_thread, endless},
};
use mazeway_client::{Connection, Env, PictureMode, WatchOptions};
use serde_json::json;
use std::{
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
        mpsc,
    },
    thread,
    time::Duration,
};

/// Who watches in all, and who of them reads.
const VIEWERS: (usize, usize) = (50, 10);

/// Opens the viewers' streams and reads those of the readers until the session ends; counts the pictures.
fn view(address: String, session_id: String, pictures: Arc<AtomicU64>) -> thread::JoinHandle<()> {
    let (ready, is_ready) = mpsc::channel();
    let viewers = thread::spawn(move || {
        current_thread().block_on(async {
            let (mut idle, mut readers) = (Vec::new(), Vec::new());
            for viewer in 0..VIEWERS.0 {
                let connection = Connection::open(&address).await.expect("connects");
                let options = WatchOptions { mode: PictureMode::Png, ..WatchOptions::default() };
                let mut frames = connection.watch(&session_id, options).await.expect("a watch");
                if viewer >= VIEWERS.1 {
                    idle.push(frames);
                    continue;
                }
                let pictures = Arc::clone(&pictures);
                readers.push(tokio::spawn(async move {
                    while let Ok(Some(_)) = frames.next().await {
                        pictures.fetch_add(1, Ordering::Relaxed);
                    }
                }));
            }
            ready.send(()).expect("the measurement waits");
            for reader in readers {
                reader.await.expect("a reader");
            }
        });
    });
    is_ready.recv().expect("viewers");
    viewers
}

pub fn measure(setting: &Setting, report: &mut Report) {
    let (server, runtime) = (Process::server(setting, "127.0.0.1:0"), current_thread());
    for env_id in ["Maze-v0", "Highway-v0"] {
        let open = || {
            runtime.block_on(async {
                let mut env = Env::connect(server.address(), env_id, endless()).await.expect("a session");
                env.reset(Some(1)).await.expect("resets");
                env
            })
        };
        let (mut unwatched, mut watched, pictures) = (open(), open(), Arc::new(AtomicU64::new(0)));
        let viewers = view(server.address().to_owned(), watched.session_id().to_owned(), Arc::clone(&pictures));
        let step = async |env: &mut Env, times: u64| {
            for i in 0..times {
                let step = env.step((i % 4) as u32).await.expect("steps");
                if step.terminated {
                    env.reset(None).await.expect("resets");
                }
            }
        };
        let mut subjects = [
            Subject::new("unwatched", |times| runtime.block_on(step(&mut unwatched, times))),
            Subject::new("watched", |times| runtime.block_on(step(&mut watched, times))),
        ];
        // Longer than from one picture to the next.
        let slice = setting.slice.max(Duration::from_millis(500));
        let spreads = in_rounds(&mut subjects, setting.rounds, slice);
        let seen = [0, pictures.load(Ordering::Relaxed)];
        for ((subject, spread), pictures) in subjects.iter().zip(spreads).zip(seen) {
            let mode = mode_name(setting.mode);
            let record = json!({"mode": mode, "env": env_id, "name": subject.name, "pictures": pictures});
            report.push("watching", record, spread);
        }
        drop(subjects);
        runtime.block_on(watched.close()).expect("closes");
        viewers.join().expect("viewers");
    }
}
