//! How fast demonstrations are counted from a store, and in how much memory.
//!
//! `cargo run --release -p mazeway-learner --example count_from_store -- DIR [TRAJECTORIES [STEPS]]` fills the store in DIR
//! where it is empty (2,000,000 trajectories of 50 steps in a process of 57 states and 4 actions, with rewards of 0 and 1,
//! unless said otherwise) and counts what it holds three times, so that the last ones find the file in the page cache. A
//! `learner fit --data DIR --env Ring-v0 --style drawn` takes the same way.

use mazeway_learner::{
    statistics::Statistics,
    store::{Arrays, Collection, Filter, Model, Recording, Rows, Store, pack_f64, pack_u32},
};
use mazeway_proto::env::ModelHeader;
use rand_core::Rng as _;
use rand_pcg::Pcg64;
use std::{error::Error, ops::ControlFlow, path::Path, time::Instant};
use uuid::Uuid;

const N_STATES: u32 = 57;
const N_ACTIONS: u32 = 4;
/// Trajectories of one request.
const TOGETHER: u64 = 1000;

/// A ring in which action a leads a + 1 states on.
fn ring() -> Result<Model, Box<dyn Error>> {
    let header =
        ModelHeader { env_id: "Ring-v0".into(), n_states: N_STATES, n_actions: N_ACTIONS, ..ModelHeader::default() };
    let pairs = (N_STATES * N_ACTIONS) as usize;
    let next = (0..N_STATES).flat_map(|s| (1..=N_ACTIONS).map(move |a| (s + a) % N_STATES)).collect::<Vec<_>>();
    let rows = Rows {
        row_lengths: pack_u32(&vec![1; pairs]),
        next_states: pack_u32(&next),
        probabilities: pack_f64(&vec![1.0; pairs]),
        ..Rows::default()
    };
    Ok(Model::new(header, rows)?)
}

/// A walk on it.
fn drawn(number: u64, steps: u32, collection: &Collection) -> Result<Recording, Box<dyn Error>> {
    let mut random = Pcg64::new(u128::from(number), 7);
    let mut state = random.next_u32() % N_STATES;
    let (mut states, mut actions) = (Vec::new(), Vec::new());
    for _ in 0..steps {
        let action = random.next_u32() % N_ACTIONS;
        states.push(state);
        actions.push(action);
        state = (state + action + 1) % N_STATES;
    }
    let arrays = Arrays {
        rewards: pack_f64(&states.iter().map(|s| f64::from(u8::from(s % 9 == 0))).collect::<Vec<_>>()),
        states: pack_u32(&states),
        actions: pack_u32(&actions),
        final_state: Some(state),
        ..Arrays::default()
    };
    let id = (u128::from(random.next_u64()) << 64) | u128::from(random.next_u64());
    Ok(Recording::new(Uuid::from_u128(id), collection.clone(), Some(number), arrays)?)
}

fn fill(store: &Store, trajectories: u64, steps: u32) -> Result<(), Box<dyn Error>> {
    let runtime = tokio::runtime::Builder::new_current_thread().build()?;
    let model = ring()?;
    let collection = Collection {
        env_id: "Ring-v0".into(),
        model_id: model.model_id().into(),
        style: "drawn".into(),
        source: "walk".into(),
        n_states: N_STATES,
        n_actions: N_ACTIONS,
    };
    runtime.block_on(store.put_model(model, false))?;
    let begun = Instant::now();
    for first in (0..trajectories).step_by(TOGETHER as usize) {
        let numbers = first..trajectories.min(first + TOGETHER);
        let recordings = numbers.map(|number| drawn(number, steps, &collection)).collect::<Result<Vec<_>, _>>()?;
        runtime.block_on(store.record(recordings))?;
    }
    println!("filled in {:.1} s", begun.elapsed().as_secs_f64());
    Ok(())
}

/// Most bytes that this process has had in memory, as Linux tells.
fn peak_mib() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|line| line.starts_with("VmHWM:"))?;
    Some(line.split_whitespace().nth(1)?.parse::<f64>().ok()? / 1024.0)
}

fn main() -> Result<(), Box<dyn Error>> {
    let arguments = std::env::args().skip(1).collect::<Vec<_>>();
    let directory = arguments.first().ok_or("expected the directory of a store")?;
    let number = |rank: usize, otherwise: u64| arguments.get(rank).map_or(Ok(otherwise), |text| text.parse());
    let store = Store::open(Path::new(directory))?;
    if store.count(&Filter::default())? == 0 {
        fill(&store, number(1, 2_000_000)?, u32::try_from(number(2, 50)?)?)?;
    }
    let bytes = std::fs::metadata(store.path())?.len();
    for _ in 0..3 {
        let begun = Instant::now();
        let mut builder = Statistics::builder(N_STATES as usize, N_ACTIONS as usize, None);
        let mut ids = store.id_list();
        let outcome = store.for_each(&Filter::default(), |stored| {
            let counted = builder.add_packed(stored.states(), stored.actions()).map_err(|e| e.to_string());
            match counted.and_then(|()| ids.push(stored.id()).map_err(|e| e.to_string())) {
                Ok(()) => ControlFlow::Continue(()),
                Err(error) => ControlFlow::Break(error),
            }
        })?;
        if let ControlFlow::Break(error) = outcome {
            return Err(error.into());
        }
        let (secs, steps) = (begun.elapsed().as_secs_f64(), builder.finish()?.n_steps(None));
        println!(
            "{} trajectories, {steps} steps, {:.0} MiB on the disk, in {secs:.2} s: {:.1} million steps a second, {:.1} MiB at most",
            ids.len(),
            bytes as f64 / f64::from(1 << 20),
            steps as f64 / secs / 1e6,
            peak_mib().unwrap_or(f64::NAN),
        );
    }
    Ok(())
}
