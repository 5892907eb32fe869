//! What the demonstrations pass through, step by step, in the form that matching of visits needs.
//!
//! Trajectories end where they end: between step k and k + 1 a share 1 − n_{k+1}/n_k of those still under way does, whatever
//! state they are in (terminal states are the exception that [`Visits::ends`] makes).

use super::Problem;
use crate::mdp::TabularMdp;
use crate::statistics::Statistics;

/// Steps 0, 1, … of the demonstrations, cut at the horizon.
pub(super) struct Visits<'a> {
    statistics: &'a Statistics,
    discount: f64,
    /// n_k: trajectories that have a step k; never 0.
    alive: Vec<f64>,
}

impl<'a> Visits<'a> {
    pub(super) fn new(problem: &Problem<'a>) -> Self {
        let statistics = problem.statistics;
        let steps = problem.horizon().min(statistics.longest()) as usize;
        let alive = (0..steps).map(|k| statistics.step_counts(k).iter().map(|&(_, n)| n).sum::<f64>());
        Self { statistics, discount: problem.options.discount, alive: alive.take_while(|n| *n > 0.0).collect() }
    }

    /// Number of steps of the longest trajectory within the horizon.
    pub(super) fn steps(&self) -> usize {
        self.alive.len()
    }

    /// n_k; 0 beyond the last step.
    pub(super) fn alive(&self, k: usize) -> f64 {
        self.alive.get(k).copied().unwrap_or(0.0)
    }

    /// Share of the trajectories with a step k that have a step k + 1.
    pub(super) fn continuing(&self, k: usize) -> f64 {
        self.alive(k + 1) / self.alive[k]
    }

    /// N_0(s), shape (`n_states`,).
    pub(super) fn starts(&self) -> Vec<f64> {
        self.visits(0)
    }

    fn visits(&self, k: usize) -> Vec<f64> {
        let n_actions = self.statistics.n_actions();
        let mut visits = vec![0.0; self.statistics.n_states()];
        for &(pair, n) in self.statistics.step_counts(k) {
            visits[pair as usize / n_actions] += n;
        }
        visits
    }

    /// Σ_k γ^k N_k(s,a), shape (`n_states * n_actions`,).
    pub(super) fn discounted_counts(&self) -> Vec<f64> {
        let powers = std::iter::successors(Some(1.0), |power| Some(power * self.discount));
        let weights: Vec<f64> = powers.take(self.steps()).collect();
        self.statistics.weighted_counts(self.steps(), |k| weights[k])
    }

    /// Σ_k N_k(s,a), shape (`n_states * n_actions`,).
    pub(super) fn counts(&self) -> Vec<f64> {
        self.statistics.counts(Some(self.steps() as u32))
    }

    /// Σ_k γ^(k+1) E_k(s), E_k(s) the expected number of trajectories that end in s with step k as their last; shape (`n_states`,).
    ///
    /// Of the expected arrivals after step k those that go on are known; the ends are first looked for in terminal states that
    /// are not seen again, and what is left is spread over all other arrivals alike.
    pub(super) fn ends(&self, mdp: &TabularMdp) -> Vec<f64> {
        let n_actions = mdp.n_actions();
        let terminal: Vec<bool> = (0..mdp.n_states())
            .map(|state| {
                (0..n_actions).all(|action| {
                    let (next, p) = mdp.row(mdp.pair(state, action));
                    next.iter().zip(p).all(|(&s, &p)| s as usize == state || p == 0.0)
                })
            })
            .collect();
        let mut ends = vec![0.0; mdp.n_states()];
        let mut weight = 1.0;
        for k in 0..self.steps() {
            weight *= self.discount;
            let ended = self.alive[k] - self.alive(k + 1);
            if ended <= 0.0 {
                continue;
            }
            let mut arrivals = vec![0.0; mdp.n_states()];
            for &(pair, n) in self.statistics.step_counts(k) {
                let (next, p) = mdp.row(pair as usize);
                for (&s, &p) in next.iter().zip(p) {
                    arrivals[s as usize] += n * p;
                }
            }
            let seen_again = if k + 1 < self.steps() { self.visits(k + 1) } else { vec![0.0; mdp.n_states()] };
            let surplus = |state: usize| {
                if terminal[state] { f64::max(arrivals[state] - seen_again[state], 0.0) } else { 0.0 }
            };
            let at_terminals: f64 = (0..mdp.n_states()).map(surplus).sum();
            let scale = if at_terminals > ended { ended / at_terminals } else { 1.0 };
            let left = ended - scale * at_terminals;
            let others: f64 = (0..mdp.n_states()).map(|s| arrivals[s] - surplus(s)).sum();
            let share = if others > 0.0 { left / others } else { 0.0 };
            for (state, end) in ends.iter_mut().enumerate() {
                *end += weight * (scale * surplus(state) + share * (arrivals[state] - surplus(state)));
            }
        }
        ends
    }
}
