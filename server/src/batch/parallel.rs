//! A batch on all cores: blocks of it wait in a row, and every core takes the next one until none is left.
//!
//! The caller works along, so that a core which is slow to wake up delays nothing. Invariant: a lock and a copy of the
//! shared part of the environments a block, nothing an environment. Batches have a pool of their own, so that a step never
//! waits behind a roll-out or a model; a caller who is in a pool already stays in that one.

use super::block::{Block, Rules, Work};
use crate::sim::Simulator;
use rayon::{Scope, ThreadPool, ThreadPoolBuilder};
use std::sync::{
    LazyLock, Mutex, PoisonError,
    atomic::{AtomicBool, Ordering},
};

/// Made with the first batch that is worth it; `None` where the system grants no threads.
static POOL: LazyLock<Option<ThreadPool>> =
    LazyLock::new(|| ThreadPoolBuilder::new().thread_name(|i| format!("batch-{i}")).build().ok());

/// Work of one block: waking another core for less costs more than it saves.
const BLOCK_NANOS: usize = 40_000;

/// Environments of a block.
pub(super) const fn block_envs<S: Simulator>() -> usize {
    BLOCK_NANOS.div_ceil(S::STEP_NANOS)
}

/// Works on `whole` in blocks of about `block_envs`; as [`Block::run`].
pub(super) fn run<S: Simulator>(
    mut whole: Block<'_, S>,
    block_envs: usize,
    rules: Rules<'_>,
    work: Work<'_>,
    scratch: &mut S,
) -> bool {
    let pool = if rayon::current_thread_index().is_some() { None } else { POOL.as_ref() };
    let cores = match pool {
        Some(pool) => pool.current_num_threads(),
        None if rayon::current_thread_index().is_some() => rayon::current_num_threads(),
        None => 1,
    };
    let threads = cores.min(whole.len() / block_envs);
    if threads < 2 {
        return whole.run(rules, work, scratch);
    }
    let (waiting, any_final) = (Mutex::new(Some(whole)), AtomicBool::new(false));
    let drain = |scratch: &mut S| {
        while let Some(mut block) = take(&waiting, block_envs) {
            if block.run(rules, work, scratch) {
                any_final.store(true, Ordering::Relaxed);
            }
        }
    };
    match pool {
        Some(pool) => pool.in_place_scope(|scope| share(scope, threads - 1, &drain, scratch)),
        None => rayon::in_place_scope(|scope| share(scope, threads - 1, &drain, scratch)),
    }
    any_final.into_inner()
}

/// Has `others` cores drain along with the caller.
fn share<'scope, S: Simulator>(
    scope: &Scope<'scope>,
    others: usize,
    drain: &'scope (impl Fn(&mut S) + Sync),
    scratch: &mut S,
) {
    for _ in 0..others {
        let mut scratch = scratch.clone();
        scope.spawn(move |_| drain(&mut scratch));
    }
    drain(scratch);
}

/// The next block, the last one up to twice as long.
fn take<'a, S: Simulator>(waiting: &Mutex<Option<Block<'a, S>>>, block_envs: usize) -> Option<Block<'a, S>> {
    let mut waiting = waiting.lock().unwrap_or_else(PoisonError::into_inner);
    let rest = waiting.take()?;
    if rest.len() < 2 * block_envs {
        return Some(rest);
    }
    let (block, rest) = rest.split(block_envs);
    *waiting = Some(rest);
    Some(block)
}
