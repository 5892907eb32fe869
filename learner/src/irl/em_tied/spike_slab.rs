//! The posterior of the reward under a sparse prior, by Markov chain Monte Carlo.
//!
//! Most states are worth nothing of their own, and those that are worth something are often worth the same: a weight is μu,
//! where u is 0 with probability 1 − p, exactly 1 with probability pρ, and otherwise Gamma-distributed with mean 1 (a spike and
//! a slab, Mitchell & Beauchamp 1988, with a second spike at the full reward: R lies in [0, 1], Hahn & Zoubir §3, up to the
//! temperature 1/μ). How sparse, how sharp and how alike the rewards are is learned from the data: p and ρ have Beta priors,
//! μ and the shape of the Gamma log-normal ones. The likelihood is em-tied's own, of the soft-optimal policy.
//! Metropolis-Hastings moves change one reward, let one appear or vanish, carry one to another place, or scale all. Where a
//! move seldom fits the data, the tangent of the likelihood turns it down before anything is solved.
//!
//! Invariant: a chain depends on its seed and index alone.

use super::places::{Neighbours, Places};
use super::prior::{ALIKE, LOG_SCALE, LOG_SHAPE, Prior, SPARSITY, log_hyper};
use super::soft_process::SoftProcess;
use crate::irl::Basis;
use crate::irl::random::Stream;

/// Proposals between two changes of the prior's parameters.
const PRIOR_PERIOD: u32 = 10;
/// Standard deviations of steps of log μ: small ones for what the data determine, large ones to its other modes.
const SCALE_STEPS: (f64, f64) = (0.1, 1.0);
/// Most weights that a proposal changes.
const MAX_CHANGES: usize = 2;

/// One Markov chain.
pub(super) struct Chain<'a> {
    basis: &'a Basis,
    neighbours: &'a Neighbours,
    places: &'a Places,
    process: SoftProcess<'a>,
    stream: Stream,
    /// u, shape (`n_basis`,).
    units: Vec<f64>,
    /// μu, shape (`n_basis`,).
    weights: Vec<f64>,
    /// Weights that are not 0, in no order of meaning.
    active: Vec<usize>,
    reward: Vec<f64>,
    /// dℓ/dw, shape (`n_basis`,).
    slopes: Vec<f64>,
    prior: Prior,
    /// True where all but p is held.
    fixed: bool,
    /// Power to which the likelihood is raised.
    coldness: f64,
    proposals: u32,
    accepted: u64,
    tried: u64,
}

impl<'a> Chain<'a> {
    /// Starts at the weights `start`, shape (`n_basis`,), with the prior's parameters at `prior`, all but p held if `fixed`;
    /// `process` is one at the reward 0.
    pub(super) fn new(
        (basis, neighbours, places): (&'a Basis, &'a Neighbours, &'a Places),
        mut process: SoftProcess<'a>,
        start: Vec<f64>,
        (prior, fixed): (Prior, bool),
        stream: Stream,
    ) -> Self {
        let mut weights = start;
        if process.propose(&basis.reward(&weights), f64::NEG_INFINITY).is_some() {
            process.settle();
            process.accept();
        } else {
            weights.fill(0.0);
        }
        Self {
            basis,
            neighbours,
            places,
            stream,
            units: weights.iter().map(|w| w / prior.scale).collect(),
            active: (0..weights.len()).filter(|&b| weights[b] > 0.0).collect(),
            reward: basis.reward(&weights),
            slopes: basis.project(process.slopes()),
            process,
            weights,
            prior,
            fixed,
            coldness: 1.0,
            proposals: 0,
            accepted: 0,
            tried: 0,
        }
    }

    /// Weights, shape (`n_basis`,).
    pub(super) fn weights(&self) -> &[f64] {
        &self.weights
    }

    /// π(a|s) of the weights, shape (`n_states * n_actions`,).
    pub(super) fn policy(&self) -> &[f64] {
        self.process.policy()
    }

    /// The prior's parameters.
    pub(super) fn prior(&self) -> Prior {
        self.prior
    }

    /// Raises the likelihood to a power in (0, 1]: less than 1 while the chain warms up and should move freely.
    pub(super) fn set_coldness(&mut self, coldness: f64) {
        self.coldness = coldness;
    }

    /// Share of proposals that were accepted.
    pub(super) fn acceptance(&self) -> f64 {
        self.accepted as f64 / self.tried.max(1) as f64
    }

    /// Makes so many proposals.
    pub(super) fn advance(&mut self, proposals: u32) {
        for _ in 0..proposals {
            self.propose();
            self.proposals += 1;
            if self.proposals.is_multiple_of(PRIOR_PERIOD) {
                self.learn_prior();
            }
        }
    }

    /// One Metropolis-Hastings step.
    fn propose(&mut self) {
        let kind = self.stream.uniform();
        if kind < 0.1 {
            self.walk();
        } else if kind < 0.2 {
            self.switch();
        } else if kind < 0.6 {
            self.appear_or_vanish();
        } else if kind < 0.9 {
            self.carry(kind < 0.8);
        } else if !self.fixed {
            let step = if kind < 0.95 { SCALE_STEPS.0 } else { SCALE_STEPS.1 };
            let scale = self.prior.scale * (step * self.stream.normal()).exp();
            let ratio = log_hyper(scale, LOG_SCALE) - log_hyper(self.prior.scale, LOG_SCALE);
            self.attempt(&[], scale, ratio);
        }
    }

    /// A reward that is not 0; `None` where all are.
    fn any_active(&mut self) -> Option<usize> {
        if self.active.is_empty() {
            return None;
        }
        let chosen = below(&mut self.stream, self.active.len());
        Some(self.active[chosen])
    }

    /// One reward of the slab takes a step.
    fn walk(&mut self) {
        let Some(b) = self.any_active().filter(|&b| self.units[b] != 1.0) else { return };
        let factor = (0.5 * self.stream.normal()).exp();
        let (old, new) = (self.units[b], self.units[b] * factor);
        let ratio = factor.ln() + self.prior.log_slab(new) - self.prior.log_slab(old);
        self.attempt(&[(b, new)], self.prior.scale, ratio);
    }

    /// A full reward becomes one of the slab, drawn from it so that its density cancels, or the other way round.
    fn switch(&mut self) {
        let Some(b) = self.any_active().filter(|_| !self.fixed) else { return };
        let odds = self.prior.full.ln() - (-self.prior.full).ln_1p();
        if self.units[b] == 1.0 {
            let new = self.gamma(self.prior.shape) / self.prior.shape;
            self.attempt(&[(b, new)], self.prior.scale, -odds);
        } else {
            self.attempt(&[(b, 1.0)], self.prior.scale, odds);
        }
    }

    /// A reward appears, its size drawn from the prior so that its density cancels, or one of those that are there vanishes.
    fn appear_or_vanish(&mut self) {
        let odds = self.prior.inclusion.ln() - (-self.prior.inclusion).ln_1p();
        let k = self.active.len() as f64;
        if self.stream.uniform() < 0.5 {
            let b = self.places.draw(&mut self.stream);
            if self.units[b] > 0.0 {
                return;
            }
            let full = self.stream.uniform() < self.prior.full;
            let new = if full { 1.0 } else { self.gamma(self.prior.shape) / self.prior.shape };
            self.attempt_screened(&[(b, new)], odds - ((k + 1.0) * self.places.probability[b]).ln());
        } else if let Some(b) = self.any_active() {
            self.attempt_screened(&[(b, 0.0)], (k * self.places.probability[b]).ln() - odds);
        }
    }

    /// A reward and another, 0 as a rule, change places.
    fn carry(&mut self, nearby: bool) {
        let Some(b) = self.any_active() else { return };
        let near = &self.neighbours.0;
        let (other, ratio) = if nearby && !near[b].is_empty() {
            let other = near[b][below(&mut self.stream, near[b].len())] as usize;
            (other, (near[b].len() as f64 / near[other].len() as f64).ln())
        } else {
            let other = self.places.draw(&mut self.stream);
            (other, (self.places.probability[b] / self.places.probability[other]).ln())
        };
        if other != b {
            // where both are rewards the move is its own reverse
            let ratio = if self.units[other] > 0.0 { 0.0 } else { ratio };
            self.attempt_screened(&[(b, self.units[other]), (other, self.units[b])], ratio);
        }
    }

    /// Accepts new units and a new scale with the Metropolis-Hastings probability; `ratio` is the log of all but the
    /// likelihood.
    fn attempt(&mut self, changes: &[(usize, f64)], scale: f64, ratio: f64) {
        self.tried += 1;
        self.decide(changes, scale, ratio, 0.0, |_| 0.0);
    }

    /// As [`Self::attempt`] at the present scale, in two stages (delayed acceptance, Christen & Fox 2005): the tangent of the
    /// likelihood turns most proposals down before anything is solved, and the second stage makes up for its error.
    fn attempt_screened(&mut self, changes: &[(usize, f64)], ratio: f64) {
        self.tried += 1;
        let scale = self.prior.scale;
        let rise = |slopes: &[f64], sign: f64, units: &[f64]| {
            changes.iter().zip(units).map(|(&(b, new), old)| sign * slopes[b] * scale * (new - old)).sum::<f64>()
        };
        let mut before = [0.0; MAX_CHANGES];
        for (old, &(b, _)) in before.iter_mut().zip(changes) {
            *old = self.units[b];
        }
        let coldness = self.coldness;
        let first = (ratio + coldness * rise(&self.slopes, 1.0, &before)).min(0.0);
        if (-self.stream.uniform()).ln_1p() > first {
            return;
        }
        self.decide(changes, scale, ratio, first, |slopes| (coldness * rise(slopes, -1.0, &before) - ratio).min(0.0));
    }

    /// The stage that solves: `first` is the log of the probability with which the stage before let this proposal pass, and
    /// `back` gives the same of its reverse from the slopes there.
    fn decide(&mut self, changes: &[(usize, f64)], scale: f64, ratio: f64, first: f64, back: impl Fn(&[f64]) -> f64) {
        // 1 − u lies in (0, 1]
        let least = first - ratio + (-self.stream.uniform()).ln_1p();
        let threshold = self.process.log_likelihood() + least / self.coldness;
        if threshold.is_nan() || !scale.is_finite() || changes.iter().any(|(_, u)| !u.is_finite()) {
            return;
        }
        let mut before = [(0, 0.0); MAX_CHANGES];
        for (old, &(b, _)) in before.iter_mut().zip(changes) {
            *old = (b, self.units[b]);
        }
        let old = self.prior.scale;
        self.set(changes, scale);
        // the reverse passes its first stage with a probability of at most 1
        if self.process.propose(&self.reward, threshold).is_some() {
            let (log_likelihood, slopes) = self.process.settle();
            let slopes = self.basis.project(slopes);
            if log_likelihood + back(&slopes) / self.coldness >= threshold {
                self.process.accept();
                self.slopes = slopes;
                self.accepted += 1;
                let units = &self.units;
                self.active.retain(|&b| units[b] > 0.0);
                for &(b, u) in changes {
                    if u > 0.0 && !self.active.contains(&b) {
                        self.active.push(b);
                    }
                }
                return;
            }
        }
        self.set(&before[..changes.len()], old);
    }

    /// Sets units, the scale and what follows from them, exactly as a fresh start would.
    fn set(&mut self, changes: &[(usize, f64)], scale: f64) {
        for &(b, u) in changes {
            self.units[b] = u;
            self.weights[b] = u * scale;
        }
        if scale == self.prior.scale {
            self.basis.update_reward(&self.weights, changes.iter().map(|c| c.0), &mut self.reward);
        } else {
            self.prior.scale = scale;
            for (w, u) in self.weights.iter_mut().zip(&self.units) {
                *w = u * scale;
            }
            self.basis.update_reward(&self.weights, self.active.iter().copied(), &mut self.reward);
        }
    }

    /// p and ρ by Gibbs sampling, the shape by a Metropolis-Hastings step.
    fn learn_prior(&mut self) {
        let (n, k) = (self.units.len() as f64, self.active.len() as f64);
        self.prior.inclusion = self.beta(1.0 + k, SPARSITY * n + n - k);
        if self.fixed {
            return;
        }
        let full = self.active.iter().filter(|&&b| self.units[b] == 1.0).count() as f64;
        self.prior.full = self.beta(ALIKE + full, 1.0 + k - full);
        let log_density = |prior: &Prior| {
            let slab = self.active.iter().map(|&b| self.units[b]).filter(|&u| u != 1.0);
            slab.map(|u| prior.log_slab(u)).sum::<f64>() + log_hyper(prior.shape, LOG_SHAPE)
        };
        let now = log_density(&self.prior);
        let (step, u) = (self.stream.normal(), self.stream.uniform());
        let new = Prior { shape: self.prior.shape * (0.7 * step).exp(), ..self.prior };
        if (0.05..1e4).contains(&new.shape) && (-u).ln_1p() < log_density(&new) - now {
            self.prior = new;
        }
    }

    /// Beta(a, b), kept off its ends so that odds stay finite.
    fn beta(&mut self, a: f64, b: f64) -> f64 {
        let (x, y) = (self.gamma(a), self.gamma(b));
        (x / (x + y)).clamp(1e-12, 1.0 - 1e-12)
    }

    /// Gamma(shape, 1), after Marsaglia & Tsang (2000).
    fn gamma(&mut self, shape: f64) -> f64 {
        if shape < 1.0 {
            let boost = (1.0 - self.stream.uniform()).powf(1.0 / shape);
            return self.gamma(shape + 1.0) * boost;
        }
        let d = shape - 1.0 / 3.0;
        let c = 1.0 / (9.0 * d).sqrt();
        loop {
            let x = self.stream.normal();
            let v = (1.0 + c * x).powi(3);
            if v > 0.0 && (-self.stream.uniform()).ln_1p() < 0.5 * x * x + d - d * v + d * v.ln() {
                return d * v;
            }
        }
    }
}

fn below(stream: &mut Stream, n: usize) -> usize {
    ((stream.uniform() * n as f64) as usize).min(n - 1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::irl::BasisKind;
    use crate::irl::em_tied::Likelihood;
    use crate::mdp::TabularMdp;

    /// Without data the chain must give back its prior: the surest test that every move keeps detailed balance.
    #[test]
    fn without_data_the_chain_samples_the_prior() {
        let n = 6;
        let next: Vec<u32> = (0..n).flat_map(|s| [(s + 1) % n, s]).collect();
        let mdp = TabularMdp::new(6, 2, (0..=12).collect(), next, vec![1.0; 12], None).expect("a model");
        let basis = Basis::state(&mdp);
        let neighbours = Neighbours::new(&mdp, BasisKind::State, 6);
        assert!(neighbours.0.iter().all(|near| near.len() == 2));
        let places = Places::new(&[0.0, 1.0, 5.0, 0.0, 20.0, 2.0]);
        let counts = vec![0.0; 12];
        let chain = |fixed: bool| {
            let prior = Prior::begin(fixed.then_some(0.5));
            let process = SoftProcess::new(&mdp, 0.9, &counts).expect("a small process");
            let setting = (&basis, &neighbours, &places);
            Chain::new(setting, process, vec![0.0; 6], (prior, fixed), Stream::new(11, u64::from(fixed)))
        };
        let mut sampled = chain(true);
        let (mut sizes, mut sums, mut present, mut means) = ([0.0; 7], 0.0, [0.0; 6], 0.0);
        let draws = 40_000;
        for _ in 0..draws {
            sampled.advance(3);
            let k = sampled.weights.iter().filter(|w| **w > 0.0).count();
            assert_eq!(k, sampled.active.len());
            sizes[k] += 1.0 / f64::from(draws);
            sums += sampled.weights.iter().sum::<f64>();
            means += k as f64;
            for (p, w) in present.iter_mut().zip(&sampled.weights) {
                *p += f64::from(u8::from(*w > 0.0)) / f64::from(draws);
            }
        }
        // p ~ Beta(1, 3) over 6 weights: beta-binomial
        let want = [1.0 / 3.0, 0.25 * 6.0 / 7.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        assert!((sizes[0] - want[0]).abs() < 0.02 && (means / f64::from(draws) - 1.5).abs() < 0.06, "{sizes:?}");
        assert!((sums / means - 2.0).abs() < 0.08, "mean of a slab of rate 0.5: {}", sums / means);
        assert!(present.iter().all(|p| (p - 0.25).abs() < 0.025), "every place alike: {present:?}");

        let mut learned = chain(false);
        let (mut log_scale, mut log_shape, mut full) = (0.0, 0.0, 0.0);
        for _ in 0..draws {
            learned.advance(10);
            log_scale += learned.prior.scale.ln() / f64::from(draws);
            log_shape += learned.prior.shape.ln() / f64::from(draws);
            full += learned.prior.full / f64::from(draws);
            assert!(learned.weights.iter().zip(&learned.units).all(|(w, u)| *w == u * learned.prior.scale));
        }
        assert!(
            (log_scale - LOG_SCALE.0).abs() < 0.1 && (log_shape - LOG_SHAPE.0).abs() < 0.1,
            "{log_scale} {log_shape}"
        );
        assert!((full - ALIKE / (ALIKE + 1.0)).abs() < 0.03, "{full}");
    }

    /// With data and all rewards alike, against the sum over all subsets: the two stages of a move keep detailed balance too.
    #[test]
    fn with_data_the_chain_samples_the_posterior() {
        let n = 8_u32;
        let next: Vec<u32> = (0..n).flat_map(|s| [(s + 1) % n, s, (s + n - 1) % n]).collect();
        let mdp = TabularMdp::new(8, 3, (0..=24).collect(), next, vec![1.0; 24], None).expect("a model");
        let basis = Basis::state(&mdp);
        let neighbours = Neighbours::new(&mdp, BasisKind::State, 8);
        let places = Places::new(&[0.0, 4.0, 0.5, 9.0, 0.0, 2.0, 1.0, 3.0]);
        let mut counts = vec![0.0; 24];
        for (pair, count) in [(0, 2.0), (3, 1.0), (7, 3.0), (11, 2.0), (14, 1.0), (17, 2.0), (20, 1.0), (22, 1.0)] {
            counts[pair] = count;
        }
        let scale = 2.5;
        let mut likelihood = Likelihood::new(&mdp, &basis, counts.clone(), 0.8);
        let (mut present, mut total) = ([0.0; 8], 0.0);
        for subset in 0..256_u32 {
            let k = subset.count_ones();
            let weights: Vec<f64> = (0..8).map(|b| scale * f64::from(subset >> b & 1)).collect();
            // p ~ Beta(1, 4): the number of rewards is beta-binomial
            let prior = libm::lgamma(1.0 + f64::from(k)) + libm::lgamma(4.0 + f64::from(8 - k));
            let mass = (prior + likelihood.value_and_gradient(&weights).0).exp();
            total += mass;
            (0..8).filter(|b| subset >> b & 1 == 1).for_each(|b| present[b] += mass);
        }
        let prior = Prior { full: 1.0, scale, ..Prior::begin(None) };
        let process = SoftProcess::new(&mdp, 0.8, &counts).expect("a small process");
        let setting = (&basis, &neighbours, &places);
        let mut chain = Chain::new(setting, process, vec![0.0; 8], (prior, true), Stream::new(3, 0));
        let draws = 60_000;
        let mut found = [0.0; 8];
        for _ in 0..draws {
            chain.advance(5);
            for (f, w) in found.iter_mut().zip(chain.weights()) {
                *f += f64::from(u8::from(*w > 0.0)) / f64::from(draws);
            }
        }
        let want = present.map(|mass| mass / total);
        let worst = found.iter().zip(&want).map(|(f, w)| (f - w).abs()).fold(0.0, f64::max);
        assert!(worst < 0.02, "{found:.3?} for {want:.3?}");
        assert!(want.iter().any(|w| *w > 0.6) && want.iter().any(|w| *w < 0.2), "{want:.3?}");
    }

    #[test]
    fn gamma_draws_have_their_moments() {
        let mdp = TabularMdp::new(1, 1, vec![0, 1], vec![0], vec![1.0], None).expect("a model");
        let (basis, neighbours, places) =
            (Basis::state(&mdp), Neighbours::new(&mdp, BasisKind::State, 1), Places::new(&[0.0]));
        let process = SoftProcess::new(&mdp, 0.5, &[0.0]).expect("a small process");
        let setting = (&basis, &neighbours, &places);
        let mut chain = Chain::new(setting, process, vec![0.0], (Prior::begin(None), true), Stream::new(1, 1));
        for shape in [0.3, 1.0, 7.5] {
            let draws: Vec<f64> = (0..40_000).map(|_| chain.gamma(shape)).collect();
            let mean = draws.iter().sum::<f64>() / 40_000.0;
            let variance = draws.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / 40_000.0;
            assert!((mean / shape - 1.0).abs() < 0.04 && (variance / shape - 1.0).abs() < 0.08, "{mean} {variance}");
        }
    }
}
