//! Many sessions at once, each with a stream of its own and one step under way, beside as many bare streams.

use crate::{
    Setting,
    figures::{Report, Subject, in_rounds},
    memory::{SESSIONS_A_CONNECTION, sessions},
    peers::{Bidi, Peers, Tonic},
    process::Process,
    round_trips::{current_thread, sizes},
};
use mazeway_client::Env;
use serde_json::json;
use std::{future::Future, sync::Arc};
use tokio::{
    runtime::Runtime,
    sync::{Mutex, OwnedMutexGuard},
};

/// As many streams over as many connections as the sessions have.
async fn streams(address: &str, count: usize, (request, reply): (usize, usize)) -> Vec<Bidi> {
    let mut streams = Vec::with_capacity(count);
    for _ in 0..count.div_ceil(SESSIONS_A_CONNECTION) {
        let tonic = Tonic::connect(address, request, reply).await;
        for _ in 0..SESSIONS_A_CONNECTION.min(count - streams.len()) {
            streams.push(tonic.clone().bidi(1).await);
        }
    }
    streams
}

/// Has each of `all` do `work`, at once.
fn at_once<T: Send + 'static, F: Future<Output = ()> + Send + 'static>(
    runtime: &Runtime,
    all: &[Arc<Mutex<T>>],
    work: impl Fn(OwnedMutexGuard<T>) -> F,
) {
    runtime.block_on(async {
        let mut tasks = tokio::task::JoinSet::new();
        for one in all {
            tasks.spawn(work(Arc::clone(one).try_lock_owned().expect("nobody else has it")));
        }
        while let Some(outcome) = tasks.join_next().await {
            outcome.expect("a task that ends well");
        }
    });
}

fn shared<T>(all: Vec<T>) -> Vec<Arc<Mutex<T>>> {
    all.into_iter().map(|one| Arc::new(Mutex::new(one))).collect()
}

pub fn measure(setting: &Setting, report: &mut Report) {
    let counts: &[usize] = if setting.quick { &[1, 10] } else { &[1, 10, 100, 1000, 10_000] };
    for &count in counts {
        let (process, peers, runtime) = (Process::server(setting, "127.0.0.1:0"), Peers::start(), current_thread());
        let bytes = runtime.block_on(sizes(process.address(), "Maze-v0", 1));
        let bidis = shared(runtime.block_on(streams(&peers.tonic_tcp, count, bytes)));
        let envs = shared(runtime.block_on(async {
            let mut envs = sessions(process.address(), "Maze-v0", count).await;
            for env in &mut envs {
                env.reset(Some(1)).await.expect("resets");
            }
            envs
        }));
        let mut subjects = [
            Subject::new("tonic_bidi_tcp", |times| {
                at_once(&runtime, &bidis, |mut bidi| async move {
                    for _ in 0..times {
                        bidi.send().await;
                        bidi.receive().await;
                    }
                });
            }),
            Subject::new("env_step_tcp", |times| {
                at_once(&runtime, &envs, |mut env: OwnedMutexGuard<Env>| async move {
                    for i in 0..times {
                        env.step((i % 4) as u32).await.expect("steps");
                    }
                });
            }),
        ];
        let spreads = in_rounds(&mut subjects, setting.rounds.min(5), setting.slice * 5);
        for (subject, spread) in subjects.iter().zip(spreads) {
            let record = json!({"sessions": count, "name": subject.name});
            report.push("scale", record, spread.rate(count as u32));
        }
        drop(subjects);
        // Ended by the servers' end, not one by one.
        std::mem::forget((bidis, envs));
    }
}
