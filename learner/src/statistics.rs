//! Sufficient statistics of demonstrations, gathered one trajectory at a time.
//!
//! Memory is bounded by the model and the horizon, never by the amount of data: per step k = 1..K, the number of times each
//! state-action pair was seen. All that depends on the discount or the horizon prior is derived from these at fit time.
//! Deliberately absent: whole trajectories; the one method that needs them takes
//! [`Demonstrations`](crate::trajectory::Demonstrations).

mod counts;

use crate::mdp::TabularMdp;
use crate::trajectory::Trajectory;
use crate::transitions::{TransitionCounts, TransitionCountsBuilder};
use counts::Counts;
use std::collections::BTreeMap;

/// Gathers [`Statistics`].
#[derive(Debug, Clone)]
pub struct StatisticsBuilder {
    n_states: usize,
    n_actions: usize,
    horizon: usize,
    steps: Vec<Counts>,
    latent: TransitionCountsBuilder,
    n_trajectories: u64,
}

/// Indices as they are stored: little-endian, each in one, two or four bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PackedIndices<'a> {
    /// One byte each.
    U8(&'a [u8]),
    /// Two bytes each.
    U16(&'a [[u8; 2]]),
    /// Four bytes each.
    U32(&'a [[u8; 4]]),
}

impl<'a> PackedIndices<'a> {
    /// Of an array of 32-bit integers; bytes beyond the last whole one do not count.
    #[must_use]
    pub fn of_u32(bytes: &'a [u8]) -> Self {
        Self::U32(bytes.as_chunks().0)
    }

    /// Number of indices.
    #[must_use]
    pub fn len(&self) -> usize {
        match self {
            Self::U8(all) => all.len(),
            Self::U16(all) => all.len(),
            Self::U32(all) => all.len(),
        }
    }

    /// Whether there are none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The indices themselves.
    #[must_use]
    pub fn to_vec(&self) -> Vec<u32> {
        match self {
            Self::U8(all) => all.iter().map(Packed::index).collect(),
            Self::U16(all) => all.iter().map(Packed::index).collect(),
            Self::U32(all) => all.iter().map(Packed::index).collect(),
        }
    }
}

/// An index, however it is kept.
trait Packed {
    fn index(&self) -> u32;
}

impl Packed for u8 {
    fn index(&self) -> u32 {
        u32::from(*self)
    }
}

impl Packed for [u8; 2] {
    fn index(&self) -> u32 {
        u32::from(u16::from_le_bytes(*self))
    }
}

impl Packed for [u8; 4] {
    fn index(&self) -> u32 {
        u32::from_le_bytes(*self)
    }
}

impl Packed for u32 {
    fn index(&self) -> u32 {
        *self
    }
}

/// Why a trajectory or a model does not fit the statistics.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum StatisticsError {
    /// The trajectory belongs to another process.
    #[error(
        "expected states below {n_states} and actions below {n_actions}, got state {state} and action {action} at step {step}"
    )]
    OutOfRange {
        /// Number of states.
        n_states: usize,
        /// Number of actions.
        n_actions: usize,
        /// What came.
        state: u32,
        /// What came.
        action: u32,
        /// Position in the trajectory.
        step: usize,
    },
    /// The states of a trajectory without actions belong to another process.
    #[error("expected states below {n_states}, got {state} at step {step}")]
    StateOutOfRange {
        /// Number of states.
        n_states: usize,
        /// What came.
        state: u32,
        /// Position in the trajectory.
        step: usize,
    },
    /// No trajectory was added.
    #[error("expected at least one trajectory, got none")]
    Empty,
}

impl StatisticsBuilder {
    /// Counts the first `horizon` steps of each trajectory; all of them where `None`.
    #[must_use]
    pub fn new(n_states: usize, n_actions: usize, horizon: Option<u32>) -> Self {
        let horizon = horizon.map_or(usize::MAX, |k| k.max(1) as usize);
        Self {
            n_states,
            n_actions,
            horizon,
            steps: Vec::new(),
            latent: TransitionCountsBuilder::default(),
            n_trajectories: 0,
        }
    }

    /// Counts a trajectory.
    ///
    /// # Errors
    /// An index outside the process; nothing of the trajectory is counted then.
    pub fn add(&mut self, trajectory: &Trajectory) -> Result<(), StatisticsError> {
        if !trajectory.has_actions() {
            return self.add_states(trajectory);
        }
        self.add_steps(trajectory.states(), trajectory.actions())
    }

    /// Counts the transitions of a trajectory whose actions were not seen.
    fn add_states(&mut self, trajectory: &Trajectory) -> Result<(), StatisticsError> {
        let n_states = self.n_states;
        let seen = trajectory.len().min(self.horizon);
        let states = trajectory.states().iter().copied().chain(trajectory.final_state()).take(seen + 1);
        if let Some((step, state)) = states.enumerate().find(|&(_, state)| state as usize >= n_states) {
            return Err(StatisticsError::StateOutOfRange { n_states, state, step });
        }
        self.latent.add(trajectory.states().iter().copied().zip(trajectory.next_states()).take(seen));
        self.n_trajectories += 1;
        Ok(())
    }

    /// Counts a trajectory as it is stored, without unpacking it first. Of arrays that differ in length, what goes beyond the
    /// shorter one does not count; without a step there is no trajectory. States alone go through
    /// [`StatisticsBuilder::add`].
    ///
    /// # Errors
    /// As [`StatisticsBuilder::add`].
    pub fn add_packed(&mut self, states: PackedIndices<'_>, actions: PackedIndices<'_>) -> Result<(), StatisticsError> {
        match states {
            PackedIndices::U8(states) => self.add_beside(states, actions),
            PackedIndices::U16(states) => self.add_beside(states, actions),
            PackedIndices::U32(states) => self.add_beside(states, actions),
        }
    }

    fn add_beside<S: Packed>(&mut self, states: &[S], actions: PackedIndices<'_>) -> Result<(), StatisticsError> {
        match actions {
            PackedIndices::U8(actions) => self.add_steps(states, actions),
            PackedIndices::U16(actions) => self.add_steps(states, actions),
            PackedIndices::U32(actions) => self.add_steps(states, actions),
        }
    }

    fn add_steps<S: Packed, A: Packed>(&mut self, states: &[S], actions: &[A]) -> Result<(), StatisticsError> {
        let n = states.len().min(actions.len()).min(self.horizon);
        if n == 0 {
            return Ok(());
        }
        let (states, actions) = (&states[..n], &actions[..n]);
        let (n_states, n_actions) = (self.n_states, self.n_actions);
        // two plain maxima first: nothing may be counted of a trajectory that is refused
        if largest(states) >= n_states || largest(actions) >= n_actions {
            let pairs = states.iter().map(Packed::index).zip(actions.iter().map(Packed::index));
            for (step, (state, action)) in pairs.enumerate() {
                if state as usize >= n_states || action as usize >= n_actions {
                    return Err(StatisticsError::OutOfRange { n_states, n_actions, state, action, step });
                }
            }
        }
        if self.steps.len() < n {
            self.steps.resize_with(n, Counts::default);
        }
        let n_pairs = n_states.saturating_mul(n_actions);
        for (counts, (state, action)) in self.steps.iter_mut().zip(states.iter().zip(actions)) {
            // no model has more pairs than 32 bits count, so whatever wraps is refused with its model
            counts.add(state.index().wrapping_mul(n_actions as u32).wrapping_add(action.index()), n_pairs);
        }
        self.n_trajectories += 1;
        Ok(())
    }

    /// Counts a whole collection.
    ///
    /// # Errors
    /// As [`StatisticsBuilder::add`]; the trajectories before the wrong one stay counted.
    pub fn extend<'a>(
        &mut self,
        trajectories: impl IntoIterator<Item = &'a Trajectory>,
    ) -> Result<(), StatisticsError> {
        trajectories.into_iter().try_for_each(|trajectory| self.add(trajectory))
    }

    /// Ends the gathering.
    ///
    /// # Errors
    /// No trajectory was added.
    pub fn finish(self) -> Result<Statistics, StatisticsError> {
        if self.n_trajectories == 0 {
            return Err(StatisticsError::Empty);
        }
        let steps = self.steps.into_iter().map(Counts::into_sorted).collect();
        Ok(Statistics {
            n_states: self.n_states,
            n_actions: self.n_actions,
            n_trajectories: self.n_trajectories,
            steps,
            latent: self.latent.finish(),
        })
    }
}

fn largest<T: Packed>(values: &[T]) -> usize {
    values.iter().map(Packed::index).fold(0, u32::max) as usize
}

/// Counts of demonstrated state-action pairs, per step, and of transitions whose actions were not seen apart from them.
/// Invariant: at least one trajectory, hence at least one step.
#[derive(Debug, Clone, PartialEq)]
pub struct Statistics {
    n_states: usize,
    n_actions: usize,
    n_trajectories: u64,
    /// Per step: rising pairs and their counts.
    steps: Vec<Vec<(u32, f64)>>,
    latent: TransitionCounts,
}

impl Statistics {
    /// Starts to gather; see [`StatisticsBuilder::new`].
    #[must_use]
    pub fn builder(n_states: usize, n_actions: usize, horizon: Option<u32>) -> StatisticsBuilder {
        StatisticsBuilder::new(n_states, n_actions, horizon)
    }

    /// As if every trajectory had been seen `times` times.
    #[must_use]
    pub fn repeated(&self, times: u64) -> Self {
        let mut repeated = self.clone();
        repeated.n_trajectories = self.n_trajectories.saturating_mul(times);
        repeated.latent.scale(times as f64);
        for (_, count) in repeated.steps.iter_mut().flatten() {
            *count *= times as f64;
        }
        repeated
    }

    /// Number of states.
    pub fn n_states(&self) -> usize {
        self.n_states
    }

    /// Number of actions.
    pub fn n_actions(&self) -> usize {
        self.n_actions
    }

    /// Number of trajectories L.
    pub fn n_trajectories(&self) -> u64 {
        self.n_trajectories
    }

    /// Length of the longest trajectory, cut at the builder's horizon; at least 1.
    pub fn longest(&self) -> u32 {
        self.steps.len().max(self.latent.n_steps()) as u32
    }

    /// Transitions whose actions were not seen; no other method here but those that say so counts them.
    pub fn latent(&self) -> &TransitionCounts {
        &self.latent
    }

    /// The same trajectories with pairs in place of what was not seen: `inferred` holds for each step pairs and their expected
    /// counts, in any order.
    pub(crate) fn completed(&self, inferred: Vec<Vec<(u32, f64)>>) -> Self {
        let mut steps: Vec<BTreeMap<u32, f64>> = vec![BTreeMap::new(); self.steps.len().max(inferred.len())];
        for (sums, counts) in steps.iter_mut().zip(&self.steps) {
            sums.extend(counts.iter().copied());
        }
        for (sums, counts) in steps.iter_mut().zip(inferred) {
            for (pair, count) in counts {
                *sums.entry(pair).or_insert(0.0) += count;
            }
        }
        Self {
            steps: steps.into_iter().map(|sums| sums.into_iter().collect()).collect(),
            latent: TransitionCounts::default(),
            ..*self
        }
    }

    /// `N_k(s,a)` of step `k` = 0, 1, …: rising pairs and how often they were seen there; empty beyond the longest trajectory
    /// with actions.
    pub fn step_counts(&self, k: usize) -> &[(u32, f64)] {
        self.steps.get(k).map_or(&[], Vec::as_slice)
    }

    /// Σ_{k < horizon} `weight(k)` `N_k(s,a)`, shape (`n_states * n_actions`,), with k from 0.
    pub fn weighted_counts(&self, horizon: usize, mut weight: impl FnMut(usize) -> f64) -> Vec<f64> {
        let mut counts = vec![0.0; self.n_states * self.n_actions];
        for (k, step) in self.steps.iter().enumerate().take(horizon) {
            let weight = weight(k);
            for &(pair, count) in step {
                counts[pair as usize] += weight * count;
            }
        }
        counts
    }

    /// N(s,a) of the first `horizon` steps (all where `None`), shape (`n_states * n_actions`,).
    pub fn counts(&self, horizon: Option<u32>) -> Vec<f64> {
        self.weighted_counts(horizon.map_or(usize::MAX, |k| k as usize), |_| 1.0)
    }

    /// N(s) of the first `horizon` steps (all where `None`), seen with or without action, shape (`n_states`,).
    pub fn state_visits(&self, horizon: Option<u32>) -> Vec<f64> {
        let mut visits: Vec<f64> =
            self.counts(horizon).chunks_exact(self.n_actions).map(|row| row.iter().sum()).collect();
        for (_, transition) in self.latent.iter(horizon) {
            visits[transition.state as usize] += transition.count;
        }
        visits
    }

    /// Number of steps among the first `horizon` of each trajectory (all where `None`), seen with or without action.
    pub fn n_steps(&self, horizon: Option<u32>) -> u64 {
        let steps = self.steps.iter().take(horizon.map_or(usize::MAX, |k| k as usize));
        let counted: f64 = steps.flatten().map(|&(_, count)| count).sum();
        (counted + self.latent.total(horizon)).round() as u64
    }

    /// Number of states that the first `horizon` steps visit (all where `None`).
    pub fn states_covered(&self, horizon: Option<u32>) -> usize {
        self.state_visits(horizon).iter().filter(|&&n| n > 0.0).count()
    }
}

/// Transition-side sum Σ_{s,a} N(s,a) P(s'|s,a): how often the model expects each state to follow, shape (`n_states`,).
pub fn expected_arrivals(mdp: &TabularMdp, counts: &[f64]) -> Vec<f64> {
    mdp.propagate(counts)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::collections::BTreeMap;

    fn trajectory(states: &[u32], actions: &[u32]) -> Trajectory {
        Trajectory::new(states.to_vec(), actions.to_vec(), None, 9, 9).expect("a trajectory")
    }

    #[test]
    fn counts_by_step() {
        let mut builder = Statistics::builder(3, 2, Some(2));
        builder.add(&trajectory(&[0, 1, 2], &[0, 1, 0])).expect("counted");
        builder.add(&trajectory(&[0], &[1])).expect("counted");
        builder.add(&trajectory(&[0, 2], &[0, 0])).expect("counted");
        let statistics = builder.finish().expect("counts");
        assert_eq!((statistics.n_trajectories(), statistics.longest()), (3, 2));
        assert_eq!(statistics.step_counts(0), [(0, 2.0), (1, 1.0)]);
        assert_eq!(statistics.step_counts(1), [(3, 1.0), (4, 1.0)]);
        assert_eq!(statistics.step_counts(2), []);
        assert_eq!(statistics.counts(None), [2.0, 1.0, 0.0, 1.0, 1.0, 0.0]);
        assert_eq!(statistics.counts(Some(1)), [2.0, 1.0, 0.0, 0.0, 0.0, 0.0]);
        assert_eq!(statistics.weighted_counts(2, |k| [1.0, 0.5][k]), [2.0, 1.0, 0.0, 0.5, 0.5, 0.0]);
        assert_eq!(statistics.state_visits(None), [3.0, 1.0, 1.0]);
        assert_eq!((statistics.n_steps(None), statistics.n_steps(Some(1))), (5, 3));
        assert_eq!((statistics.states_covered(None), statistics.states_covered(Some(1))), (3, 1));
    }

    proptest! {
        #[test]
        fn equals_a_naive_count(
            n_states in 1_u32..60,
            n_actions in 1_u32..6,
            horizon in proptest::option::of(1_u32..12),
            draws in proptest::collection::vec(proptest::collection::vec((any::<u32>(), any::<u32>()), 1..16), 1..200),
        ) {
            let mut builder = Statistics::builder(n_states as usize, n_actions as usize, horizon);
            let mut packed = builder.clone();
            let mut naive = vec![BTreeMap::<u32, f64>::new(); 16];
            for draw in &draws {
                // squares crowd the small states: steps with many repetitions beside steps with few
                let states: Vec<u32> = draw.iter().map(|d| (d.0 % n_states) * (d.0 % n_states) / n_states).collect();
                let actions: Vec<u32> = draw.iter().map(|d| d.1 % n_actions).collect();
                for (k, (s, a)) in states.iter().zip(&actions).take(horizon.unwrap_or(99) as usize).enumerate() {
                    *naive[k].entry(s * n_actions + a).or_default() += 1.0;
                }
                let bytes = |values: &[u32]| values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
                let small = |values: &[u32]| values.iter().map(|&v| v as u8).collect::<Vec<_>>();
                let (wide, small, small_actions) = (bytes(&states), small(&states), small(&actions));
                let half = states.iter().map(|&s| (s as u16).to_le_bytes()).collect::<Vec<_>>();
                // however they are kept, in turn
                let kept = match states.len() % 3 {
                    0 => PackedIndices::of_u32(&wide),
                    1 => PackedIndices::U16(half.as_slice()),
                    _ => PackedIndices::U8(&small),
                };
                prop_assert_eq!((&kept.to_vec(), kept.len()), (&states, states.len()));
                packed.add_packed(kept, PackedIndices::U8(&small_actions)).expect("counted");
                builder.add(&Trajectory::new(states, actions, None, n_states, n_actions).expect("a trajectory"))
                    .expect("counted");
            }
            let statistics = builder.finish().expect("counts");
            prop_assert_eq!(&statistics, &packed.finish().expect("counts"));
            for (k, naive) in naive.iter().enumerate() {
                let naive: Vec<(u32, f64)> = naive.iter().map(|(&pair, &n)| (pair, n)).collect();
                prop_assert_eq!(statistics.step_counts(k), naive.as_slice());
            }
        }
    }

    #[test]
    fn memory_does_not_grow_with_the_data() {
        let mut builder = Statistics::builder(3000, 2, None);
        let one = trajectory(&[0, 1, 2], &[0, 1, 0]);
        builder.add(&one).expect("counted");
        let before: usize = builder.steps.iter().map(Counts::bytes).sum();
        for _ in 0..1000 {
            builder.add(&one).expect("counted");
        }
        assert_eq!(builder.steps.iter().map(Counts::bytes).sum::<usize>(), before);
        // a long trajectory that never comes back does not take the whole model a step
        let states: Vec<u32> = (0..3000).collect();
        let states = states.iter().flat_map(|s| s.to_le_bytes()).collect::<Vec<u8>>();
        builder.add_packed(PackedIndices::of_u32(&states), PackedIndices::U8(&[0; 3000])).expect("counted");
        assert!(builder.steps.iter().map(Counts::bytes).sum::<usize>() < 3000 * 200);
    }

    #[test]
    fn a_wrong_trajectory_leaves_no_trace() {
        let mut builder = Statistics::builder(3, 2, None);
        builder.add(&trajectory(&[0], &[0])).expect("counted");
        let before = builder.clone().finish();
        assert!(matches!(builder.add(&trajectory(&[0, 3], &[0, 0])), Err(StatisticsError::OutOfRange { step: 1, .. })));
        assert!(matches!(builder.add(&trajectory(&[0, 2], &[0, 2])), Err(StatisticsError::OutOfRange { step: 1, .. })));
        let refused = builder.add_packed(PackedIndices::U16(&[[0, 0], [3, 0]]), PackedIndices::U8(&[0, 0]));
        assert!(matches!(refused, Err(StatisticsError::OutOfRange { step: 1, state: 3, .. })));
        assert_eq!(builder.finish(), before);
        assert_eq!(Statistics::builder(3, 2, None).finish(), Err(StatisticsError::Empty));
    }

    #[test]
    fn transitions_without_actions_are_counted_apart() {
        let mut builder = Statistics::builder(3, 2, Some(2));
        builder.add(&trajectory(&[0, 1], &[1, 0])).expect("counted");
        builder.add(&Trajectory::states_only(vec![0, 1, 2], Some(0), 9).expect("a trajectory")).expect("counted");
        let wrong = Trajectory::states_only(vec![0, 1], Some(3), 9).expect("a trajectory");
        assert_eq!(builder.add(&wrong), Err(StatisticsError::StateOutOfRange { n_states: 3, state: 3, step: 2 }));
        let statistics = builder.finish().expect("counts");
        assert_eq!((statistics.n_trajectories(), statistics.longest(), statistics.n_steps(None)), (2, 2, 4));
        assert_eq!(statistics.counts(None), [0.0, 1.0, 1.0, 0.0, 0.0, 0.0]);
        assert_eq!(statistics.state_visits(None), [2.0, 2.0, 0.0]);
        let latent: Vec<_> = statistics.latent().iter(None).map(|(k, t)| (k, t.state, t.next_state)).collect();
        assert_eq!((latent, statistics.latent().total(Some(1))), (vec![(0, 0, 1), (1, 1, 2)], 1.0));
        let completed = statistics.completed(vec![vec![(1, 0.5), (0, 0.5)], vec![(3, 1.0)]]);
        assert_eq!(completed.step_counts(0), [(0, 0.5), (1, 1.5)]);
        assert_eq!(completed.step_counts(1), [(2, 1.0), (3, 1.0)]);
        assert!(completed.latent().is_empty());
    }

    #[test]
    fn arrivals_follow_the_model() {
        let mdp = TabularMdp::new(2, 1, vec![0, 2, 3], vec![0, 1, 1], vec![0.25, 0.75, 1.0], None).expect("a model");
        assert_eq!(expected_arrivals(&mdp, &[4.0, 2.0]), [1.0, 5.0]);
    }
}
