//! Demonstrations: what an expert was seen to do.
//!
//! Invariant: a [`Trajectory`] is never ragged or empty, and its indices lie within its process's sizes.

use serde::{Deserialize, Serialize};

/// Index of a state.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct State(pub u32);

/// Index of an action.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Action(pub u32);

/// One demonstration: states before each step and the actions taken there. Shape (steps,) each.
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

    /// States before each step, shape (steps,).
    pub fn states(&self) -> &[u32] {
        &self.states
    }

    /// Actions, shape (steps,).
    pub fn actions(&self) -> &[u32] {
        &self.actions
    }

    /// State after the last step, where known.
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
            actions: self.actions[..n].to_vec(),
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
