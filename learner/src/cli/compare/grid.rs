//! The fits of a comparison, on all cores.
//!
//! Invariants: a cell's numbers are a function of its data and options, whatever the number of threads; each fit has one core to
//! itself (a method that works in parallel does so on that one), so that times can be compared and no core waits for another.

use super::job::{Entry, Job};
use crate::cli::{fit::assemble::Truth, hexadecimal};
use mazeway_client::Model;
use mazeway_learner::{
    eval::{
        self,
        comparison::{Cell, Outcome, Score},
    },
    irl::{self, FitError, FitOptions, Problem},
    mdp::{Features, Policy, TabularMdp},
    statistics::Statistics,
    trajectory::{Demonstrations, Trajectory},
};
use sha2::{Digest as _, Sha256};
use std::{
    ops::ControlFlow,
    sync::{
        atomic::{AtomicBool, AtomicUsize, Ordering},
        mpsc,
    },
    time::{Instant, UNIX_EPOCH},
};

/// Version of what a cell holds and of how it comes about.
const SCHEMA: u32 = 1;

/// Demonstrations of one seed.
#[expect(clippy::struct_field_names, reason = "the seed of a seed's demonstrations")]
pub struct Seed {
    /// Of the first demonstration.
    pub seed: u32,
    /// As many as the largest number of demonstrations asks for.
    pub demonstrations: Vec<Trajectory>,
    /// What none of the fits sees.
    pub held_out: Vec<Trajectory>,
}

/// The process that everything happens in.
pub struct Ground {
    /// As served or stored.
    pub model: Model,
    /// The same, checked.
    pub mdp: TabularMdp,
    /// True reward, where it is known.
    pub truth: Option<Truth>,
    /// Users' features, where it has some.
    pub features: Option<Features>,
}

/// All that fits are made from.
pub struct Grid {
    mdp: TabularMdp,
    features: Option<Features>,
    truth: Option<(Vec<f64>, Policy)>,
    seeds: Vec<Seed>,
    entries: Vec<Entry>,
    horizon: u32,
    /// Hash of what all cells share.
    common: Vec<u8>,
}

/// One fit to be made.
#[derive(Debug, Clone)]
pub struct Task {
    entry: usize,
    trajectories: u32,
    seed: usize,
    /// Hash of everything that decides it.
    pub key: String,
}

impl Grid {
    /// Puts together what came from the services.
    pub fn new(job: &Job, ground: Ground, seeds: Vec<Seed>) -> Self {
        let n_actions = ground.mdp.n_actions();
        let truth = ground.truth.and_then(|truth| {
            // It came from a planner: it is a policy.
            Policy::new(n_actions, truth.optimal_policy).ok().map(|policy| (truth.reward, policy))
        });
        let mut hash = Sha256::new();
        hash.update(SCHEMA.to_le_bytes());
        hash.update(program());
        hash.update(&ground.model.model_id);
        hash.update(job.horizon.to_le_bytes());
        for p in &ground.model.initial_distribution {
            hash.update(p.to_bits().to_le_bytes());
        }
        if let Some((reward, _)) = &truth {
            for r in reward {
                hash.update(r.to_bits().to_le_bytes());
            }
        }
        if let Some(table) = &ground.model.features {
            for name in &table.names {
                hash.update((name.len() as u64).to_le_bytes());
                hash.update(name);
            }
            for value in &table.values {
                hash.update(value.to_bits().to_le_bytes());
            }
        }
        Self {
            mdp: ground.mdp,
            features: ground.features,
            truth,
            seeds,
            entries: job.entries.clone(),
            horizon: job.horizon,
            common: hash.finalize().to_vec(),
        }
    }

    /// All fits, with their keys.
    pub fn tasks(&self, trajectories: &[u32]) -> Vec<Task> {
        let mut tasks = Vec::new();
        for (rank, seed) in self.seeds.iter().enumerate() {
            let mut data = Sha256::new();
            absorb(&mut data, &seed.held_out);
            let mut absorbed = 0;
            for &l in trajectories {
                absorb(&mut data, &seed.demonstrations[absorbed..l as usize]);
                absorbed = l as usize;
                let data = data.clone().finalize();
                for entry in 0..self.entries.len() {
                    let mut hash = Sha256::new();
                    hash.update(&self.common);
                    hash.update(data);
                    hash.update(self.entries[entry].method.id());
                    // Every field of the options, by name and in a fixed order.
                    hash.update(serde_json::to_vec(&self.options(entry, seed.seed)).unwrap_or_default());
                    tasks.push(Task { entry, trajectories: l, seed: rank, key: hexadecimal(&hash.finalize()) });
                }
            }
        }
        tasks
    }

    /// The cell of a task, from what is known of an equal one.
    pub fn named(&self, task: &Task, outcome: Outcome) -> Cell {
        Cell {
            method: self.entries[task.entry].name.clone(),
            trajectories: task.trajectories,
            seed: self.seeds[task.seed].seed,
            outcome,
        }
    }

    fn options(&self, entry: usize, seed: u32) -> FitOptions {
        FitOptions { seed: u64::from(seed), ..self.entries[entry].options.clone() }
    }

    /// Makes the fits, `threads` at a time; hands them over as they are finished, several where several are. Ends early where
    /// `cancelled` says so or `finished` breaks.
    pub fn run<E>(
        &self,
        tasks: &[Task],
        threads: usize,
        cancelled: &AtomicBool,
        mut finished: impl FnMut(Vec<(String, Cell)>) -> Result<(), E>,
    ) -> Result<(), E> {
        let next = AtomicUsize::new(0);
        let (send, receive) = mpsc::channel();
        std::thread::scope(|scope| {
            for _ in 0..threads.min(tasks.len()) {
                let (send, next) = (send.clone(), &next);
                scope.spawn(move || {
                    // Of one thread: a method that works in parallel keeps to the core of its fit.
                    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().ok();
                    while let Some(task) = tasks.get(next.fetch_add(1, Ordering::Relaxed)) {
                        let fit = || self.fit(task, cancelled);
                        let outcome = match &pool {
                            Some(pool) => pool.install(fit),
                            None => fit(),
                        };
                        let Some(outcome) = outcome else { return };
                        if send.send((task.key.clone(), self.named(task, outcome))).is_err() {
                            return;
                        }
                    }
                });
            }
            drop(send);
            while let Ok(first) = receive.recv() {
                let outcome = finished(std::iter::once(first).chain(receive.try_iter()).collect());
                if outcome.is_err() {
                    cancelled.store(true, Ordering::Relaxed);
                    return outcome;
                }
            }
            Ok(())
        })
    }

    /// One fit and what it is worth; `None` where it was cancelled.
    fn fit(&self, task: &Task, cancelled: &AtomicBool) -> Option<Outcome> {
        if cancelled.load(Ordering::Relaxed) {
            return None;
        }
        let seed = &self.seeds[task.seed];
        let options = self.options(task.entry, seed.seed);
        let trajectories = &seed.demonstrations[..task.trajectories as usize];
        let mut builder = Statistics::builder(self.mdp.n_states(), self.mdp.n_actions(), Some(self.horizon));
        let statistics = match builder.extend(trajectories).and_then(|()| builder.finish()) {
            Ok(statistics) => statistics,
            Err(error) => return Some(Outcome::Refused(error.to_string())),
        };
        let demonstrations = Demonstrations::new(trajectories.to_vec());
        let problem = Problem {
            mdp: &self.mdp,
            options: &options,
            statistics: &statistics,
            demonstrations: Some(&demonstrations),
            features: self.features.as_ref(),
        };
        let mut progress = |_: &irl::TraceEntry| {
            if cancelled.load(Ordering::Relaxed) { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        };
        let begun = Instant::now();
        let fit = irl::fit(self.entries[task.entry].method, &problem, &mut progress);
        let fit_secs = begun.elapsed().as_secs_f64();
        match fit {
            Ok(fit) => Some(self.judge(&fit, seed, fit_secs).map_or_else(Outcome::Refused, Outcome::Fitted)),
            Err(FitError::Cancelled) => None,
            Err(error) => Some(Outcome::Refused(error.to_string())),
        }
    }

    fn judge(&self, fit: &irl::Fit, seed: &Seed, fit_secs: f64) -> Result<Score, String> {
        let n_actions = self.mdp.n_actions();
        let greedy = Policy::new(n_actions, fit.greedy_policy.clone()).map_err(|error| error.to_string())?;
        let held_out = eval::held_out(&fit.policy, n_actions, &seed.held_out).ok_or("nothing to judge by")?;
        let (agreement, evd) = if let Some((reward, optimal)) = &self.truth {
            let discount = self.entries[0].options.discount;
            let lost = eval::expected_value_difference(&self.mdp, reward, discount, Some(self.horizon), &greedy)
                .map_err(|error| error.to_string())?;
            (eval::state_agreement(&fit.greedy_policy, optimal.probabilities(), n_actions), Some(lost.difference))
        } else {
            let mut counts = vec![0.0; self.mdp.n_pairs()];
            for trajectory in &seed.held_out {
                for (&state, &action) in trajectory.states().iter().zip(trajectory.actions()) {
                    counts[self.mdp.pair(state as usize, action as usize)] += 1.0;
                }
            }
            (eval::step_agreement(&fit.greedy_policy, &counts), None)
        };
        let score = Score { agreement, evd, log_likelihood: held_out.log_likelihood.mean, fit_secs };
        let finite = score.agreement.is_finite() && score.log_likelihood.is_finite() && evd.is_none_or(f64::is_finite);
        if finite { Ok(score) } else { Err(format!("the fit is no number: {score:?}")) }
    }
}

/// Version of this program, and which build of it: another build may fit otherwise.
fn program() -> String {
    let file = std::env::current_exe().and_then(std::fs::metadata);
    let built = file.as_ref().ok().and_then(|file| file.modified().ok()?.duration_since(UNIX_EPOCH).ok());
    format!(
        "{} {} {}",
        env!("CARGO_PKG_VERSION"),
        file.map_or(0, |file| file.len()),
        built.unwrap_or_default().as_nanos()
    )
}

fn absorb(hash: &mut Sha256, trajectories: &[Trajectory]) {
    for trajectory in trajectories {
        hash.update((trajectory.len() as u64).to_le_bytes());
        for (state, action) in trajectory.states().iter().zip(trajectory.actions()) {
            hash.update(state.to_le_bytes());
            hash.update(action.to_le_bytes());
        }
        hash.update(trajectory.final_state().unwrap_or(u32::MAX).to_le_bytes());
    }
}
