//! Demonstrations: what an expert was seen to do.
//!
//! Invariants: a [`Trajectory`] is never ragged or empty, and its indices lie within its process's sizes. Either every step has
//! its action or none has; without actions the state after the last step is known, so that every step is a transition.

use serde::{Deserialize, Serialize};

/// Index of a state.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct State(pub u32);

/// Index of an action.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Action(pub u32);

/// One demonstration: states before each step and the actions taken there, shape (steps,) each, or the states alone.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Trajectory {
    states: Vec<u32>,
    actions: Vec<u32>,
    final_state: Option<u32>,
}

/// Why arrays are not a trajectory.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum TrajectoryError {
    /// No step.
    #[error("expected at least one step, got none")]
    Empty,
    /// Without actions, a state that nothing follows.
    #[error("expected at least two states, the final one included, where there are no actions; got one")]
    NoTransition,
    /// Lengths differ.
    #[error("expected as many actions as states, got {states} states and {actions} actions")]
    Ragged {
        /// Number of states.
        states: usize,
        /// Number of actions.
        actions: usize,
    },
    /// A state outside the state set.
    #[error("expected states below {n_states}, got {state} at step {step}")]
    StateOutOfRange {
        /// Position in the trajectory.
        step: usize,
        /// What came.
        state: u32,
        /// Size of the state set.
        n_states: u32,
    },
    /// An action outside the action set.
    #[error("expected actions below {n_actions}, got {action} at step {step}")]
    ActionOutOfRange {
        /// Position in the trajectory.
        step: usize,
        /// What came.
        action: u32,
        /// Size of the action set.
        n_actions: u32,
    },
}

impl Trajectory {
    /// Checks and keeps a demonstration in a process of `n_states` states and `n_actions` actions.
    ///
    /// # Errors
    /// Empty or ragged arrays, indices out of range.
    pub fn new(
        states: Vec<u32>,
        actions: Vec<u32>,
        final_state: Option<u32>,
        n_states: u32,
        n_actions: u32,
    ) -> Result<Self, TrajectoryError> {
        if states.len() != actions.len() {
            return Err(TrajectoryError::Ragged { states: states.len(), actions: actions.len() });
        }
        if states.is_empty() {
            return Err(TrajectoryError::Empty);
        }
        for (step, &state) in states.iter().chain(&final_state).enumerate() {
            if state >= n_states {
                return Err(TrajectoryError::StateOutOfRange { step, state, n_states });
            }
        }
        if let Some((step, &action)) = actions.iter().enumerate().find(|&(_, &a)| a >= n_actions) {
            return Err(TrajectoryError::ActionOutOfRange { step, action, n_actions });
        }
        Ok(Self { states, actions, final_state })
    }

    /// Checks and keeps a demonstration of which only the states were seen: n states and a final one are n transitions.
    ///
    /// Where the final state is missing, the last of `states` is taken for it: n states are n − 1 transitions then.
    ///
    /// # Errors
    /// No transition, states out of range.
    pub fn states_only(mut states: Vec<u32>, final_state: Option<u32>, n_states: u32) -> Result<Self, TrajectoryError> {
        if states.is_empty() {
            return Err(TrajectoryError::Empty);
        }
        for (step, &state) in states.iter().chain(&final_state).enumerate() {
            if state >= n_states {
                return Err(TrajectoryError::StateOutOfRange { step, state, n_states });
            }
        }
        let final_state = final_state.or_else(|| states.pop());
        if states.is_empty() {
            return Err(TrajectoryError::NoTransition);
        }
        Ok(Self { states, actions: Vec::new(), final_state })
    }

    /// False where only the states were seen.
    pub fn has_actions(&self) -> bool {
        !self.actions.is_empty()
    }

    /// States before each step, shape (steps,).
    pub fn states(&self) -> &[u32] {
        &self.states
    }

    /// States after each step, as far as they are known.
    pub fn next_states(&self) -> impl Iterator<Item = u32> + '_ {
        self.states[1..].iter().copied().chain(self.final_state)
    }

    /// Actions, shape (steps,); empty where only the states were seen.
    pub fn actions(&self) -> &[u32] {
        &self.actions
    }

    /// State after the last step, where known; always known without actions.
    pub fn final_state(&self) -> Option<u32> {
        self.final_state
    }

    /// Number of steps, at least 1.
    #[expect(clippy::len_without_is_empty, reason = "a trajectory is never empty")]
    pub fn len(&self) -> usize {
        self.states.len()
    }

    /// The first `horizon` steps; the whole trajectory where it is shorter.
    #[must_use]
    pub fn truncated(&self, horizon: usize) -> Self {
        let n = horizon.clamp(1, self.len());
        Self {
            states: self.states[..n].to_vec(),
            actions: self.actions[..n.min(self.actions.len())].to_vec(),
            final_state: if n < self.len() { Some(self.states[n]) } else { self.final_state },
        }
    }
}

/// Trajectories in the order in which they were given, whole: for methods whose sufficient statistics are the trajectories
/// themselves.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Demonstrations(Vec<Trajectory>);

impl Demonstrations {
    /// Keeps trajectories.
    #[must_use]
    pub fn new(trajectories: Vec<Trajectory>) -> Self {
        Self(trajectories)
    }

    /// Adds one.
    pub fn push(&mut self, trajectory: Trajectory) {
        self.0.push(trajectory);
    }

    /// The trajectories.
    pub fn trajectories(&self) -> &[Trajectory] {
        &self.0
    }

    /// One after the other.
    pub fn iter(&self) -> std::slice::Iter<'_, Trajectory> {
        self.0.iter()
    }

    /// Number of trajectories.
    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// True where there is none.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }
}

impl<'a> IntoIterator for &'a Demonstrations {
    type Item = &'a Trajectory;
    type IntoIter = std::slice::Iter<'a, Trajectory>;

    fn into_iter(self) -> Self::IntoIter {
        self.iter()
    }
}

impl FromIterator<Trajectory> for Demonstrations {
    fn from_iter<I: IntoIterator<Item = Trajectory>>(trajectories: I) -> Self {
        Self(trajectories.into_iter().collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_no_trajectory_is_refused() {
        let new =
            |states: &[u32], actions: &[u32], last| Trajectory::new(states.to_vec(), actions.to_vec(), last, 3, 2);
        assert_eq!(new(&[], &[], None), Err(TrajectoryError::Empty));
        assert_eq!(new(&[0], &[], None), Err(TrajectoryError::Ragged { states: 1, actions: 0 }));
        assert_eq!(
            new(&[0, 3], &[0, 0], None),
            Err(TrajectoryError::StateOutOfRange { step: 1, state: 3, n_states: 3 })
        );
        assert_eq!(new(&[0], &[0], Some(3)), Err(TrajectoryError::StateOutOfRange { step: 1, state: 3, n_states: 3 }));
        assert_eq!(
            new(&[0, 1], &[1, 2], None),
            Err(TrajectoryError::ActionOutOfRange { step: 1, action: 2, n_actions: 2 })
        );
    }

    #[test]
    fn states_alone_are_transitions() {
        let with = Trajectory::states_only(vec![0, 1], Some(2), 3).expect("a trajectory");
        let without = Trajectory::states_only(vec![0, 1, 2], None, 3).expect("a trajectory");
        assert_eq!(with, without);
        assert_eq!((with.len(), with.has_actions(), with.final_state()), (2, false, Some(2)));
        assert_eq!(with.next_states().collect::<Vec<_>>(), [1, 2]);
        let short = with.truncated(1);
        assert_eq!((short.states(), short.actions(), short.final_state()), ([0].as_slice(), [].as_slice(), Some(1)));
        assert_eq!(Trajectory::states_only(vec![], Some(1), 3), Err(TrajectoryError::Empty));
        assert_eq!(Trajectory::states_only(vec![1], None, 3), Err(TrajectoryError::NoTransition));
        assert_eq!(
            Trajectory::states_only(vec![1], Some(3), 3),
            Err(TrajectoryError::StateOutOfRange { step: 1, state: 3, n_states: 3 })
        );
    }

    #[test]
    fn truncation_keeps_what_follows() {
        let whole = Trajectory::new(vec![0, 1, 2], vec![1, 0, 1], Some(0), 3, 2).expect("a trajectory");
        let short = whole.truncated(2);
        assert_eq!(
            (short.states(), short.actions(), short.final_state()),
            ([0, 1].as_slice(), [1, 0].as_slice(), Some(2))
        );
        assert_eq!(whole.truncated(9), whole);
        assert_eq!(whole.truncated(0).len(), 1);
    }
}
