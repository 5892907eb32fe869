//! One episode: a controller acts, the simulator answers, a recorder writes it down.

use super::{
    Controller, RolloutPlan, TabularPolicy,
    rewards::RewardTable,
    steps::{RewardFormat, StepFormat},
};
use crate::sim::{
    Driver, Rng, Simulator,
    rng::{Purpose, stream},
};

/// Steps after which a long episode looks whether anyone still waits for it.
const CANCEL_CHECK_STEPS: u32 = 4096;

enum Acting<'a, S> {
    Driver(Box<dyn Driver<S>>),
    Policy(&'a TabularPolicy),
}

impl<'a, S: Simulator> Acting<'a, S> {
    fn new(controller: &'a Controller, simulator: &S) -> Self {
        match controller {
            Controller::Driver(name) => Self::Driver(simulator.driver(name).expect("the plan was checked")),
            Controller::Policy(policy) => Self::Policy(policy),
        }
    }

    #[inline]
    fn act(&mut self, simulator: &S, state: impl FnOnce() -> u32, rng: &mut Rng) -> u32 {
        match self {
            Self::Driver(driver) => driver.act(simulator, rng),
            Self::Policy(policy) => policy.draw(state(), rng),
        }
    }
}

/// Writes down what happens in each step, or nothing.
pub(super) trait Recorder {
    /// Of step `at` of the episode; false where it cannot be written down.
    fn record(&mut self, at: usize, state: impl FnOnce() -> u32, action: u32, reward: f64) -> bool;
}

/// Nothing is written down.
pub(super) struct Nothing;

impl Recorder for Nothing {
    #[inline]
    fn record(&mut self, _at: usize, _state: impl FnOnce() -> u32, _action: u32, _reward: f64) -> bool {
        true
    }
}

/// Where the steps of one episode go.
pub(super) struct Packed<'a> {
    pub format: StepFormat,
    pub states: &'a mut [u8],
    pub actions: &'a mut [u8],
    pub rewards: &'a mut [u8],
    pub table: &'a mut RewardTable,
}

impl Recorder for Packed<'_> {
    #[inline]
    fn record(&mut self, at: usize, state: impl FnOnce() -> u32, action: u32, reward: f64) -> bool {
        self.format.states.put(self.states, at, state());
        self.format.actions.put(self.actions, at, action);
        match self.format.rewards {
            RewardFormat::Values => self.rewards.as_chunks_mut::<8>().0[at] = reward.to_le_bytes(),
            RewardFormat::Ranks => match self.table.rank(reward) {
                Some(rank) => self.rewards[at] = rank,
                None => return false,
            },
        }
        true
    }
}

/// What an episode comes to.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Summary {
    pub length: u32,
    pub final_state: u32,
    pub terminated: bool,
    pub total_reward: f64,
}

/// Why there is no episode.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Stopped {
    /// Nobody waits for it.
    Cancelled,
    /// More distinct rewards than ranks.
    ManyRewards,
}

/// Runs the episode of rank `rank`; `totals` receives the sums of the info columns `summed`.
pub(super) fn run<S: Simulator>(
    simulator: &mut S,
    plan: &RolloutPlan,
    rank: u32,
    summed: &[usize],
    totals: &mut [f64],
    recorder: &mut impl Recorder,
    cancelled: &(dyn Fn() -> bool + Sync),
) -> Result<Summary, Stopped> {
    let seed = plan.seed.wrapping_add(u64::from(rank));
    let (mut dynamics, mut choices) = (stream(seed, Purpose::Dynamics), stream(seed, Purpose::Controller));
    simulator.reset(&mut dynamics);
    let mut acting = Acting::new(&plan.controller, simulator);
    let check = |step: u32| {
        if step.is_multiple_of(CANCEL_CHECK_STEPS) && cancelled() { Err(Stopped::Cancelled) } else { Ok(()) }
    };
    for step in 0..plan.burn_in_steps {
        check(step)?;
        let action = acting.act(simulator, || simulator.tabular_state(), &mut choices);
        if simulator.step(action, &mut dynamics).terminated {
            simulator.reset(&mut dynamics);
            acting = Acting::new(&plan.controller, simulator);
        }
    }
    let mut summary = Summary::default();
    for step in 0..plan.steps {
        check(step)?;
        let state = simulator.tabular_state();
        let action = acting.act(simulator, || state, &mut choices);
        let outcome = simulator.step(action, &mut dynamics);
        if !recorder.record(step as usize, || state, action, outcome.reward) {
            return Err(Stopped::ManyRewards);
        }
        summary.length += 1;
        summary.total_reward += outcome.reward;
        for (total, &column) in totals.iter_mut().zip(summed) {
            *total += simulator.info_value(column);
        }
        if outcome.terminated {
            summary.terminated = true;
            break;
        }
    }
    summary.final_state = simulator.tabular_state();
    Ok(summary)
}
