//! What the states and actions of a report are called, and what the greedy policy does in each state.

use super::Report;
use super::format::clip;

/// Speed levels of the highway, m/s.
pub(crate) const SPEEDS_MPS: [u32; 4] = [20, 25, 30, 35];
/// Lanes of the highway, from lane 0 on.
pub(crate) const LANES: [&str; 3] = ["right", "middle", "left"];
/// Traffic ahead on the highway, from 0 on.
pub(crate) const TRAFFIC: [&str; 3] = ["clear", "passable", "boxed in"];

/// What the host of the highway does across the road.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum LaneChange {
    Keep,
    Left,
    Right,
}

/// Lane change and speed level of a highway action: 4 × lane change + speed level.
pub(crate) fn highway_action(action: usize) -> (LaneChange, usize) {
    let change = match action / 4 {
        0 => LaneChange::Keep,
        1 => LaneChange::Left,
        _ => LaneChange::Right,
    };
    (change, action % 4)
}

/// Index of a highway state: (lane × 4 + speed level) × 3 + traffic.
pub(crate) fn highway_state(lane: usize, speed: usize, traffic: usize) -> usize {
    (lane * 4 + speed) * 3 + traffic
}

/// Where an action leads on a grid drawn with row 0 on top.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Heading {
    North,
    South,
    East,
    West,
    Stay,
}

impl Heading {
    /// Right and down.
    pub(crate) fn vector(self) -> (f64, f64) {
        match self {
            Self::North => (0.0, -1.0),
            Self::South => (0.0, 1.0),
            Self::East => (1.0, 0.0),
            Self::West => (-1.0, 0.0),
            Self::Stay => (0.0, 0.0),
        }
    }

    fn from_label(label: &str) -> Option<Self> {
        let label = label.to_lowercase();
        let word = |names: &[&str]| label.split(|c: char| !c.is_alphanumeric()).any(|part| names.contains(&part));
        if word(&["north", "up", "n"]) {
            Some(Self::North)
        } else if word(&["south", "down", "s"]) {
            Some(Self::South)
        } else if word(&["east", "right", "e"]) {
            Some(Self::East)
        } else if word(&["west", "left", "w"]) {
            Some(Self::West)
        } else if word(&["stay", "noop", "wait", "none"]) {
            Some(Self::Stay)
        } else {
            None
        }
    }
}

impl Report {
    /// Name of a state, at most `most` characters.
    pub(crate) fn state_name(&self, state: usize, most: usize) -> String {
        self.state_labels.get(state).map_or_else(|| format!("state {state}"), |label| clip(label, most))
    }

    /// Name of an action, at most `most` characters.
    pub(crate) fn action_name(&self, action: usize, most: usize) -> String {
        self.action_labels.get(action).map_or_else(|| format!("action {action}"), |label| clip(label, most))
    }

    /// Heading of each action on the grid; north, south, east, west where four actions have no telling names.
    /// `None` where an action has none.
    pub(crate) fn headings(&self) -> Option<Vec<Heading>> {
        let named: Option<Vec<_>> = self.action_labels.iter().map(|label| Heading::from_label(label)).collect();
        match named {
            Some(headings) if headings.len() == self.actions() => Some(headings),
            _ if self.n_actions == 4 => Some(vec![Heading::North, Heading::South, Heading::East, Heading::West]),
            _ => None,
        }
    }

    /// Whether the demonstrations visit a state.
    pub(crate) fn visited(&self, state: usize) -> bool {
        self.state_visits[state] > 0.0
    }

    /// Actions that `policy` takes in a state, with their probabilities: those of at least half of the largest.
    pub(crate) fn choices(&self, policy: &[f64], state: usize) -> Vec<(usize, f64)> {
        let row = &policy[state * self.actions()..(state + 1) * self.actions()];
        let most = row.iter().copied().filter(|p| p.is_finite()).fold(0.0, f64::max);
        if most <= 0.0 {
            return Vec::new();
        }
        row.iter().copied().enumerate().filter(|&(_, p)| p >= 0.5 * most).collect()
    }

    /// Reward of what the greedy policy does in a state: the mean of R(s,a) under π(a|s); not a number
    /// where it does nothing.
    pub(crate) fn greedy_reward(&self, state: usize) -> f64 {
        mean_reward(&self.reward, &self.greedy_policy, state, self.actions())
    }

    /// The true reward of each state: R(s), or R(s,a) under the optimal policy where it depends on the action.
    pub(crate) fn true_state_reward(&self) -> Option<Vec<f64>> {
        let reward = self.true_reward.as_ref()?;
        let (s, a) = (self.states(), self.actions());
        if reward.len() == s && a != 1 {
            return Some(reward.clone());
        }
        let uniform = vec![1.0 / a as f64; s * a];
        let policy = self.optimal_policy.as_ref().unwrap_or(&uniform);
        Some((0..s).map(|state| mean_reward(reward, policy, state, a)).collect())
    }

    /// At most `most` states, those visited most, in order of their index, and whether that is all of them.
    pub(crate) fn leading_states(&self, most: usize) -> (Vec<usize>, bool) {
        let mut states: Vec<usize> = (0..self.states()).collect();
        if states.len() <= most {
            return (states, true);
        }
        states.sort_by(|&i, &j| self.state_visits[j].total_cmp(&self.state_visits[i]).then(i.cmp(&j)));
        states.truncate(most);
        states.sort_unstable();
        (states, false)
    }
}

fn mean_reward(reward: &[f64], policy: &[f64], state: usize, n_actions: usize) -> f64 {
    let row = state * n_actions..(state + 1) * n_actions;
    let taken = || reward[row.clone()].iter().zip(&policy[row.clone()]).filter(|&(_, &p)| p > 0.0);
    if taken().next().is_none() { f64::NAN } else { taken().map(|(r, p)| r * p).sum() }
}
