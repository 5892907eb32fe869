//! Roll-outs over the wire: few bytes that say the same, and a reader that sets the pace.

use mazeway_client::{Connection, Controller, Episodes, Rollout, channel, packed::Packed};
use mazeway_proto::env::{self as pb, environment_service_client::EnvironmentServiceClient};
use mazeway_tests::EnvServer;
#[cfg(target_os = "linux")]
use mazeway_tests::programs::Service;
use std::time::Duration;
use tokio::time::sleep;

fn cases() -> Vec<Rollout> {
    let uniform = |states: usize, actions: usize| Controller::Policy(vec![1.0 / actions as f64; states * actions]);
    let options = |value: serde_json::Value| value.as_object().expect("an object").clone();
    vec![
        Rollout { seed: 3, ..Rollout::new("Maze-v0", uniform(57, 4), 700, 150) },
        Rollout {
            options: options(serde_json::json!({"terminate_on_collision": true, "style": "legal"})),
            burn_in_steps: 7,
            ..Rollout::new("Highway-v0", Controller::driver("bad"), 300, 100)
        },
        // States of two bytes.
        Rollout {
            options: options(serde_json::json!({"layout": vec![".".repeat(30); 30]})),
            ..Rollout::new("Maze-v0", Controller::driver("random"), 50, 100)
        },
        Rollout { totals_only: true, ..Rollout::new("Highway-v0", uniform(36, 12), 60, 100) },
    ]
}

/// The same roll-out as a client sees it that does not ask for compact answers.
async fn whole(address: &str, rollout: &Rollout) -> (Episodes, usize) {
    use prost::Message as _;
    let mut service = EnvironmentServiceClient::new(channel(address).await.expect("a channel"));
    let request = pb::RolloutRequest { compact: false, ..rollout.clone().into_wire() };
    let mut answers = service.rollout(request).await.expect("runs").into_inner();
    let (mut all, mut bytes) = (Episodes::default(), 0);
    while let Some(answer) = answers.message().await.expect("answers") {
        bytes += answer.encoded_len();
        assert_eq!((answer.states_dtype, answer.actions_dtype, answer.reward_values.len()), (0, 0, 0));
        let u32s = |bytes| Packed::<u32>::new(bytes).expect("whole elements").to_vec();
        let f64s = |bytes| Packed::<f64>::new(bytes).expect("whole elements").to_vec();
        all.lengths.extend(u32s(answer.lengths));
        all.states.extend(u32s(answer.states));
        all.actions.extend(u32s(answer.actions));
        all.rewards.extend(f64s(answer.rewards));
        all.final_states.extend(u32s(answer.final_states));
        all.terminated.extend(answer.terminated.iter().map(|&flag| flag == 1));
        all.returns.extend(f64s(answer.returns));
        all.totals.resize_with(answer.totals.len(), Default::default);
        for ((name, values), totals) in all.totals.iter_mut().zip(answer.totals) {
            *name = totals.name;
            values.extend(f64s(totals.values));
        }
    }
    (all, bytes)
}

#[tokio::test]
async fn few_bytes_say_the_same() {
    let server = EnvServer::start();
    let connection = Connection::open(&server.address()).await.expect("connects");
    for rollout in cases() {
        let (whole, bytes) = whole(&server.address(), &rollout).await;
        let compact = connection.rollout(rollout.clone()).await.expect("runs");
        assert!(compact == whole, "{rollout:?}");
        let steps = whole.total_steps() as usize;
        assert_eq!(whole.rewards.len(), if rollout.totals_only { 0 } else { steps });
        // The same into room that is used again.
        let (mut stream, mut part) = (connection.rollout_stream(rollout).await.expect("runs"), Episodes::default());
        let mut all = Vec::new();
        while stream.next_into(&mut part).await.expect("comes") {
            all.extend(part.iter().map(|episode| (episode.rank, episode.states.to_vec(), episode.total_reward)));
        }
        assert!(all.iter().cloned().eq(whole.iter().map(|e| (e.rank, e.states.to_vec(), e.total_reward))));
        assert!(bytes > 16 * whole.rewards.len());
    }
}

/// Clock ticks that a process has computed and bytes of memory that it holds.
#[cfg(target_os = "linux")]
fn usage(pid: u32) -> (u64, u64) {
    let read = |name: &str| std::fs::read_to_string(format!("/proc/{pid}/{name}")).expect("a process");
    let stat = read("stat");
    let fields: Vec<_> = stat[stat.rfind(')').expect("a name")..].split(' ').collect();
    let number = |text: &str| text.parse::<u64>().expect("a number");
    let status = read("status");
    let resident = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).expect("its memory");
    (number(fields[12]) + number(fields[13]), 1024 * number(resident.split_whitespace().next().expect("a number")))
}

/// Waits until a process computes no more.
#[cfg(target_os = "linux")]
async fn rests(pid: u32) {
    for _ in 0..200 {
        let before = usage(pid).0;
        sleep(Duration::from_millis(400)).await;
        if usage(pid).0 - before <= 1 {
            return;
        }
    }
    panic!("it computes on although nobody reads");
}

#[cfg(target_os = "linux")]
#[tokio::test]
async fn a_reader_sets_the_pace() {
    let server = Service::server();
    let connection = Connection::open(server.address()).await.expect("connects");
    let rollout =
        |seed, episodes| Rollout { seed, ..Rollout::new("Maze-v0", Controller::driver("random"), episodes, 1000) };
    // So that the pool's threads and the buffers of a connection are there.
    let reference = connection.rollout(rollout(9, 2_000)).await.expect("runs");
    rests(server.pid()).await;
    let (_, before) = usage(server.pid());
    // Half a billion steps: 1.5 GB of messages that nobody reads.
    let mut streams = Vec::new();
    for _ in 0..4 {
        let mut stream = connection.rollout_stream(rollout(9, 500_000)).await.expect("runs");
        let first = stream.next().await.expect("comes").expect("episodes");
        assert_eq!(first.states[..], reference.states[..first.states.len()]);
        streams.push((stream, first.len()));
    }
    rests(server.pid()).await;
    let grown = usage(server.pid()).1.saturating_sub(before);
    assert!(grown < 64 << 20, "{grown} bytes for four readers that do not read");
    // Where they left off, nothing is missing.
    for (stream, seen) in &mut streams {
        while *seen < 2_000 {
            let next = stream.next().await.expect("comes").expect("episodes");
            let shared = next.lengths.len().min(2_000 - *seen) * 1000;
            assert_eq!(next.states[..shared], reference.states[*seen * 1000..][..shared]);
            *seen += next.len();
        }
    }
    // Who goes takes the work along.
    drop(streams);
    rests(server.pid()).await;
    assert_eq!(connection.rollout(rollout(9, 10)).await.expect("runs").states, reference.states[..10_000]);
}
