//! Whether demonstrations can have happened in a model, and what is done about those that cannot.

use mazeway_client::Model;
use mazeway_learner::files::{Demonstration, Names};
use std::path::Path;

/// Examples that are kept.
const EXAMPLES: usize = 3;

/// Transitions that the model rules out.
#[derive(Debug, Default, Clone)]
pub struct Impossible {
    /// How many.
    pub transitions: u64,
    /// In how many trajectories.
    pub trajectories: u64,
    /// The first of them, in words.
    pub examples: Vec<String>,
}

/// Whether (s, a) may lead to s'; without an action, whether any does.
fn possible(model: &Model, state: u32, action: Option<u32>, next: u32) -> bool {
    let leads = |action| {
        let (states, probabilities) = model.row(state, action);
        states.binary_search(&next).is_ok_and(|at| probabilities[at] > 0.0)
    };
    match action {
        Some(action) => leads(action),
        None => (0..model.n_actions).any(leads),
    }
}

/// Steps after which the impossible happens, rising.
pub fn breaks(model: &Model, d: &Demonstration) -> Vec<usize> {
    let after = |step: usize| d.states.get(step + 1).copied().or(d.final_state);
    let broken = |&step: &usize| {
        after(step).is_some_and(|next| !possible(model, d.states[step], d.actions.get(step).copied(), next))
    };
    (0..d.states.len()).filter(broken).collect()
}

impl Impossible {
    /// Counts a demonstration's.
    pub fn add(&mut self, file: &Path, names: (&Names, &Names), d: &Demonstration, breaks: &[usize]) {
        self.transitions += breaks.len() as u64;
        self.trajectories += u64::from(!breaks.is_empty());
        for &step in breaks.iter().take(EXAMPLES.saturating_sub(self.examples.len())) {
            let next = d.states.get(step + 1).copied().or(d.final_state).unwrap_or_default();
            let by = d.actions.get(step).map_or_else(String::new, |&a| format!(" by action '{}'", names.1.name(a)));
            self.examples.push(format!(
                "{}:{} from state '{}'{by} to '{}'",
                file.display(),
                d.places[step],
                names.0.name(d.states[step]),
                names.0.name(next),
            ));
        }
    }
}

/// The parts between the breaks. The step before a break keeps its action, which was taken; what it led to is forgotten.
/// Of states alone, a part of one state says nothing and goes.
pub fn split(d: Demonstration, breaks: &[usize]) -> Vec<Demonstration> {
    let steps = d.states.len();
    let mut parts = Vec::new();
    let mut begin = 0;
    for end in breaks.iter().map(|step| step + 1).chain([steps]) {
        let last = end == steps && breaks.last() != Some(&(steps - 1));
        let mut part = Demonstration {
            states: d.states[begin..end].to_vec(),
            actions: d.actions.get(begin..end).unwrap_or_default().to_vec(),
            rewards: d.rewards.get(begin..end).unwrap_or_default().to_vec(),
            places: d.places[begin..end].to_vec(),
            final_state: d.final_state.filter(|_| last),
            terminated: d.terminated && last,
            truncated: d.truncated && last,
            ..d.clone_labels()
        };
        if part.actions.is_empty() && part.final_state.is_none() {
            part.final_state = part.states.pop();
            part.places.truncate(part.states.len());
            part.rewards.truncate(part.states.len());
        }
        if !part.states.is_empty() {
            parts.push(part);
        }
        begin = end;
        if begin == steps {
            break;
        }
    }
    parts
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A ring of three states: action 0 goes on, action 1 stays.
    fn ring() -> Model {
        Model {
            env_id: "Ring".into(),
            model_id: String::new(),
            n_states: 3,
            n_actions: 2,
            state_labels: Vec::new(),
            action_labels: Vec::new(),
            initial_distribution: vec![1.0 / 3.0; 3],
            row_offsets: (0..=6).collect(),
            next_states: vec![1, 0, 2, 1, 0, 2],
            probabilities: vec![1.0; 6],
            visit_counts: None,
            estimated: false,
            rewards: Vec::new(),
            grid: None,
            features: None,
            terminal_states: Vec::new(),
        }
    }

    fn seen(states: &[u32], actions: &[u32], final_state: Option<u32>) -> Demonstration {
        Demonstration {
            name: "d".into(),
            states: states.to_vec(),
            actions: actions.to_vec(),
            final_state,
            places: (2..).take(states.len()).collect(),
            terminated: true,
            ..Demonstration::default()
        }
    }

    #[test]
    fn the_impossible_is_counted_and_cut_out() {
        let d = seen(&[0, 1, 0, 0], &[0, 0, 1, 0], Some(0));
        let found = breaks(&ring(), &d);
        assert_eq!(found, [1, 3]);
        let mut impossible = Impossible::default();
        let names = (Names::numbered("state", 3), Names::numbered("action", 2));
        impossible.add(Path::new("x.csv"), (&names.0, &names.1), &d, &found);
        assert_eq!((impossible.transitions, impossible.trajectories), (2, 1));
        assert_eq!(impossible.examples[0], "x.csv:3 from state '1' by action '0' to '0'");
        let parts = split(d, &found);
        let arrays: Vec<_> = parts.iter().map(|p| (p.states.clone(), p.actions.clone(), p.final_state)).collect();
        assert_eq!(arrays, [(vec![0, 1], vec![0, 0], None), (vec![0, 0], vec![1, 0], None)]);
        assert!(parts.iter().all(|part| !part.terminated && breaks(&ring(), part).is_empty()));
    }

    #[test]
    fn states_alone_are_cut_between_two_of_them() {
        let d = seen(&[0, 1, 0], &[], Some(1));
        assert_eq!(breaks(&ring(), &d), [1]);
        let parts = split(d, &[1]);
        let arrays: Vec<_> = parts.iter().map(|p| (p.states.clone(), p.final_state, p.terminated)).collect();
        assert_eq!(arrays, [(vec![0], Some(1), false), (vec![0], Some(1), true)]);
        assert_eq!(split(seen(&[2, 0], &[], Some(2)), &[1]).len(), 1, "a lone state says nothing");
    }
}
