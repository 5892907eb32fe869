//! What the server takes: at rest, for a session, for its stream, for an environment of a batch; and many sessions at once.

use crate::{
    Setting,
    figures::{Report, Subject, in_rounds},
    process::Process,
    round_trips::{current_thread, endless},
};
use mazeway_client::{Autoreset, Connection, Env, VectorEnv};
use serde_json::json;
use std::sync::Arc;
use tokio::sync::Mutex;

/// Sessions of one connection.
const SESSIONS_A_CONNECTION: usize = 1000;

fn push(report: &mut Report, name: &str, env: Option<&str>, count: usize, bytes: f64, limit: Option<f64>) {
    let met = limit.map(|limit| bytes <= limit);
    let record = json!({"name": name, "env": env, "count": count, "bytes": bytes.round(), "limit": limit, "met": met});
    report.push_plain("memory", record);
}

async fn sessions(address: &str, env_id: &str, count: usize) -> Vec<Env> {
    let mut envs = Vec::with_capacity(count);
    for _ in 0..count.div_ceil(SESSIONS_A_CONNECTION) {
        let connection = Connection::open(address).await.expect("connects");
        for _ in 0..SESSIONS_A_CONNECTION.min(count - envs.len()) {
            envs.push(Env::create(&connection, env_id, endless()).await.expect("a session"));
        }
    }
    envs
}

pub fn measure(setting: &Setting, report: &mut Report) {
    let runtime = current_thread();
    let idle = Process::server(setting, "127.0.0.1:0");
    push(report, "idle_server", None, 1, idle.resident(), Some(20.0 * 1024.0 * 1024.0));
    drop(idle);
    let counts: &[usize] = if setting.quick { &[1, 10] } else { &[100, 1000, 10_000] };
    for (env_id, limit) in [("Maze-v0", Some(4096.0)), ("Highway-v0", None)] {
        for &count in counts {
            let process = Process::server(setting, "127.0.0.1:0");
            runtime.block_on(async {
                // What the first of its kind allocates for all is no session's.
                let mut first = sessions(process.address(), env_id, 1).await;
                first[0].reset(Some(1)).await.expect("resets");
                let before = process.resident();
                let mut envs = sessions(process.address(), env_id, count).await;
                let made = process.resident();
                push(report, "session", Some(env_id), count, (made - before) / count as f64, limit);
                for env in &mut envs {
                    env.reset(Some(1)).await.expect("resets");
                    env.step(1).await.expect("steps");
                }
                let open = process.resident();
                push(report, "session_with_stream", Some(env_id), count, (open - before) / count as f64, None);
                // Ended by the server's end, not one by one.
                std::mem::forget((first, envs));
            });
        }
    }
    let sizes: &[u32] = if setting.quick { &[64] } else { &[64, 1024, 16_384, 65_536] };
    for (env_id, limit) in [("Maze-v0", 64.0), ("Highway-v0", 1024.0)] {
        for &num_envs in sizes {
            let process = Process::server(setting, "127.0.0.1:0");
            runtime.block_on(async {
                let connection = Connection::open(process.address()).await.expect("connects");
                let mut first = Env::create(&connection, env_id, endless()).await.expect("a session");
                first.reset(Some(1)).await.expect("resets");
                // Small batches are counted by the dozen, for memory comes in pages.
                let batches = (65_536 / num_envs).max(1) as usize;
                let before = process.resident();
                let mut made = Vec::new();
                for _ in 0..batches {
                    let make = VectorEnv::create(&connection, env_id, num_envs, Autoreset::NextStep, endless());
                    made.push(make.await.expect("a session"));
                }
                let per_env = (process.resident() - before) / (batches * num_envs as usize) as f64;
                push(report, "environment", Some(env_id), num_envs as usize, per_env, Some(limit));
                std::mem::forget((first, made));
            });
        }
    }
}

pub fn scale(setting: &Setting, report: &mut Report) {
    let counts: &[usize] = if setting.quick { &[1, 10] } else { &[1, 10, 100, 1000, 10_000] };
    for &count in counts {
        let (process, runtime) = (Process::server(setting, "127.0.0.1:0"), current_thread());
        let envs = runtime.block_on(async {
            let mut envs = sessions(process.address(), "Maze-v0", count).await;
            for env in &mut envs {
                env.reset(Some(1)).await.expect("resets");
            }
            envs.into_iter().map(|env| Arc::new(Mutex::new(env))).collect::<Vec<_>>()
        });
        let mut subject = [Subject::new("sessions", |times| {
            runtime.block_on(async {
                let mut tasks = tokio::task::JoinSet::new();
                for env in &envs {
                    let env = Arc::clone(env);
                    tasks.spawn(async move {
                        let mut env = env.lock().await;
                        for i in 0..times {
                            env.step((i % 4) as u32).await.expect("steps");
                        }
                    });
                }
                while let Some(outcome) = tasks.join_next().await {
                    outcome.expect("a task that ends well");
                }
            });
        })];
        let slice = setting.slice * 5;
        let spread = in_rounds(&mut subject, setting.rounds.min(5), slice).remove(0).rate(count as u32);
        report.push("scale", json!({"sessions": count}), spread);
        drop(subject);
        std::mem::forget(envs);
    }
}
