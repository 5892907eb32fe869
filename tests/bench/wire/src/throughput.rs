//! Steps a second: single ones sent ahead, and batches of all sizes.

use crate::{
    Setting,
    figures::{Report, Subject, in_rounds, mode_name},
    peers::{Bidi, Peers, Tonic},
    process::Process,
    round_trips::{current_thread, endless, sizes},
};
use mazeway_client::{Autoreset, VectorEnv};
use serde_json::json;

/// Single steps that are under way at a time.
const IN_FLIGHT: usize = 1000;

/// Sizes of batches.
const BATCHES: [u32; 7] = [1, 16, 64, 256, 1024, 4096, 65_536];

async fn vector_env(setting: &Setting, address: &str, env_id: &str, num_envs: u32) -> VectorEnv {
    let connection = setting.connect(address).await;
    let made = VectorEnv::create(&connection, env_id, num_envs, Autoreset::NextStep, endless()).await;
    let mut envs = made.expect("a session");
    envs.reset(1).await.expect("resets");
    envs
}

pub fn pipelined(setting: &Setting, report: &mut Report) {
    let (peers, server, runtime) = (Peers::start(), Process::server(setting, "127.0.0.1:0"), current_thread());
    let (request, reply) = runtime.block_on(sizes(server.address(), "Maze-v0", 1));
    let mut bidi: Bidi = runtime.block_on(async {
        let mut bidi = Tonic::connect(&peers.tonic_tcp, request, reply).await.bidi(IN_FLIGHT).await;
        for _ in 0..IN_FLIGHT {
            bidi.send().await;
        }
        bidi
    });
    let mut envs = runtime.block_on(async {
        let mut envs = vector_env(setting, server.address(), "Maze-v0", 1).await;
        for i in 0..IN_FLIGHT {
            envs.send_step(&[i as u32 % 4]).await.expect("sends");
        }
        envs
    });
    let mut subjects = [
        Subject::new("tonic_bidi_tcp", |times| {
            runtime.block_on(async {
                for _ in 0..times {
                    bidi.receive().await;
                    bidi.send().await;
                }
            });
        }),
        Subject::new("vector_env_tcp", |times| {
            runtime.block_on(async {
                for i in 0..times {
                    envs.receive_step().await.expect("steps");
                    envs.send_step(&[i as u32 % 4]).await.expect("sends");
                }
            });
        }),
    ];
    let spreads = in_rounds(&mut subjects, setting.rounds, setting.slice);
    for (subject, spread) in subjects.iter().zip(spreads) {
        let record = json!({"mode": mode_name(setting.mode), "name": subject.name, "in_flight": IN_FLIGHT});
        report.push("pipelined", record, spread.rate(1));
    }
}

pub fn batches(setting: &Setting, report: &mut Report) {
    let (peers, server, runtime) = (Peers::start(), Process::server(setting, "127.0.0.1:0"), current_thread());
    for env_id in ["Maze-v0", "Highway-v0"] {
        for num_envs in BATCHES {
            let (request, reply) = runtime.block_on(sizes(server.address(), env_id, num_envs));
            let mut envs = runtime.block_on(vector_env(setting, server.address(), env_id, num_envs));
            let actions: Vec<u32> = (0..num_envs).map(|env| env % envs.spec().n_actions).collect();
            let mut bidi =
                runtime.block_on(async { Tonic::connect(&peers.tonic_tcp, request, reply).await.bidi(1).await });
            let mut subjects = [
                Subject::new("tonic_bidi_echo", |times| {
                    runtime.block_on(async {
                        for _ in 0..times {
                            bidi.send().await;
                            bidi.receive().await;
                        }
                    });
                }),
                Subject::new("vector_env_step", |times| {
                    runtime.block_on(async {
                        for _ in 0..times {
                            envs.step(&actions).await.expect("steps");
                        }
                    });
                }),
            ];
            let spreads = in_rounds(&mut subjects, setting.rounds, setting.slice);
            for (subject, spread) in subjects.iter().zip(spreads) {
                let mode = mode_name(setting.mode);
                let record = json!({"mode": mode, "env": env_id, "num_envs": num_envs, "name": subject.name});
                report.push("batches", record, spread.rate(num_envs));
            }
            drop(subjects);
            runtime.block_on(envs.close()).expect("closes");
        }
    }
}
