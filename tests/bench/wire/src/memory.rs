//! What the server takes: at rest, for a session, for its stream, for an environment of a batch.
//!
//! Names of the figures: `idle_server`; `session`, one environment each, `count` of them; `session_with_stream`, reset and
//! stepped; `environment`, one more in a batch of `count`; `environment_and_share`, the whole batch by its environments,
//! reset and stepped: what was allocated is in use.

use crate::{
    Setting,
    figures::Report,
    process::Process,
    round_trips::{current_thread, endless},
};
use mazeway_client::{Connection, Env, channel};
use mazeway_proto::env::{self as pb, environment_service_client::EnvironmentServiceClient};
use serde_json::json;
use tokio::runtime::Runtime;

/// Sessions of one connection.
pub const SESSIONS_A_CONNECTION: usize = 1000;

fn push(report: &mut Report, name: &str, env: Option<&str>, count: usize, bytes: f64, limit: Option<f64>) {
    let met = limit.map(|limit| bytes <= limit);
    let record = json!({"name": name, "env": env, "count": count, "bytes": bytes.round(), "limit": limit, "met": met});
    report.push_plain("memory", record);
}

pub async fn sessions(address: &str, env_id: &str, count: usize) -> Vec<Env> {
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
        let single = batch_bytes(setting, &runtime, env_id, 1);
        for &num_envs in sizes {
            let (bytes, envs) = (batch_bytes(setting, &runtime, env_id, num_envs), f64::from(num_envs));
            let (more, count) = ((bytes - single) / (envs - 1.0), num_envs as usize);
            push(report, "environment", Some(env_id), count, more, Some(limit));
            push(report, "environment_and_share", Some(env_id), count, bytes / envs, None);
        }
    }
}

/// Bytes of a session with `num_envs` environments that was reset and stepped, without a stream.
fn batch_bytes(setting: &Setting, runtime: &Runtime, env_id: &str, num_envs: u32) -> f64 {
    let process = Process::server(setting, "127.0.0.1:0");
    // Small batches are counted by the dozen, for memory comes in pages.
    let batches = (262_144 / num_envs).clamp(4, 2000);
    runtime.block_on(async {
        let channel = channel(process.address()).await.expect("connects");
        let mut service = EnvironmentServiceClient::new(channel).max_decoding_message_size(64 << 20);
        let make = pb::CreateSessionRequest {
            env_id: env_id.into(),
            num_envs,
            max_episode_steps: Some(0),
            ..Default::default()
        };
        let mut batch = async || {
            let session_id = service.create_session(make.clone()).await.expect("a session").into_inner().session_id;
            let reset = pb::ResetRequest { session_id: session_id.clone(), seed: Some(1), ..Default::default() };
            service.reset(reset).await.expect("resets");
            let step = pb::StepRequest { session_id, actions: vec![0; 4 * num_envs as usize].into() };
            service.step(step).await.expect("steps");
        };
        // What the first allocates for all is no session's.
        batch().await;
        let before = process.resident();
        for _ in 0..batches {
            batch().await;
        }
        (process.resident() - before) / f64::from(batches)
    })
}
