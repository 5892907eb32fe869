//! The maze's own small value iteration, for the scripted driver that acts optimally under the true reward.
//!
//! Deliberately absent: anything general; planners for any model belong to the learner.

/// Discount under which the driver is optimal.
const DISCOUNT: f64 = 0.9;
/// More sweeps change no double: 0.9^1000 is below 1e-45.
const MAX_SWEEPS: usize = 1000;
/// Values within this much of the best, relative to the largest reward, are ties.
const TIE: f64 = 1e-9;

/// The optimal actions of every state as bit masks, with Q(s,a) = R(s) + γ Σ P(s'|s,a) V(s').
///
/// `next` has shape `(n_states, 4)`, `rewards` shape `(n_states,)`.
pub(super) fn optimal_actions(next: &[u32], slip: f64, rewards: &[f64]) -> Vec<u8> {
    let scale = rewards.iter().fold(f64::MIN_POSITIVE, |scale, reward| scale.max(reward.abs()));
    let mut values = vec![0.0; rewards.len()];
    let mut updated = values.clone();
    for _ in 0..MAX_SWEEPS {
        let mut change = 0.0_f64;
        for (state, value) in updated.iter_mut().enumerate() {
            *value = rewards[state]
                + DISCOUNT * action_values(next, slip, &values, state).into_iter().fold(f64::MIN, f64::max);
            change = change.max((*value - values[state]).abs());
        }
        std::mem::swap(&mut values, &mut updated);
        if change <= 1e-13 * scale {
            break;
        }
    }
    (0..rewards.len())
        .map(|state| {
            let expected = action_values(next, slip, &values, state);
            let best = expected.into_iter().fold(f64::MIN, f64::max);
            let tied = |value: f64| u8::from(value >= best - TIE * scale);
            expected.into_iter().enumerate().fold(0, |mask, (action, value)| mask | tied(value) << action)
        })
        .collect()
}

/// Σ P(s'|s,a) V(s') of each action.
fn action_values(next: &[u32], slip: f64, values: &[f64], state: usize) -> [f64; 4] {
    let entered: [f64; 4] = std::array::from_fn(|direction| values[next[state * 4 + direction] as usize]);
    let drawn = slip * 0.25 * (entered[0] + entered[1] + entered[2] + entered[3]);
    entered.map(|value| (1.0 - slip) * value + drawn)
}
