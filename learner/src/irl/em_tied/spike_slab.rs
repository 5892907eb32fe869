//! The posterior of the reward under a sparse prior, by Markov chain Monte Carlo.
//!
//! Most states are worth nothing of their own, and those that are worth something are often worth the same: a weight is μu,
//! where u is 0 with probability 1 − p, exactly 1 with probability pρ, and otherwise Gamma-distributed with mean 1 (a spike and
//! a slab, Mitchell & Beauchamp 1988, with a second spike at the full reward: R lies in [0, 1], Hahn & Zoubir §3, up to the
//! temperature 1/μ). How sparse, how sharp and how alike the rewards are is learned from the data: p and ρ have Beta priors,
//! μ and the shape of the Gamma log-normal ones. The likelihood is em-tied's own, of the soft-optimal policy.
//! Metropolis-Hastings moves change one reward, let one appear or vanish, carry one to another place, or scale all.
//!
//! Invariant: a chain depends on its seed and index alone.

use super::soft_process::SoftProcess;
use crate::irl::random::Stream;
use crate::irl::{Basis, BasisKind};
use crate::mdp::TabularMdp;

/// Mean and standard deviation of log μ, a reward against the temperature: from about 4 to about 90.
const LOG_SCALE: (f64, f64) = (3.0, 0.75);
/// The same of log(shape of the Gamma): 1 is exponential, a large one makes all rewards alike.
const LOG_SHAPE: (f64, f64) = (0.7, 0.3);
/// ρ ~ Beta(this, 1): before any data, rewards are alike.
const ALIKE: f64 = 9.0;
/// p ~ Beta(1, this × number of weights): before any data, about two rewards are expected.
const SPARSITY: f64 = 0.5;
/// Share of places drawn uniformly.
const EVERYWHERE: f64 = 0.3;
/// Proposals between two changes of the prior's parameters.
const PRIOR_PERIOD: u32 = 10;

/// What the prior's parameters are, or are held at.
#[derive(Debug, Clone, Copy)]
pub(super) struct Prior {
    /// p: probability that a weight is not 0.
    pub inclusion: f64,
    /// ρ: probability that one that is not 0 is the full reward.
    pub full: f64,
    /// μ: the full reward, and the mean of the others.
    pub scale: f64,
    /// Shape of the Gamma distribution of the others.
    pub shape: f64,
}

impl Prior {
    /// Where a chain begins; with a strength all but p is held: rewards are exponential of that rate.
    pub(super) fn begin(strength: Option<f64>) -> Self {
        match strength {
            None => {
                Self { inclusion: 0.1, full: ALIKE / (ALIKE + 1.0), scale: LOG_SCALE.0.exp(), shape: LOG_SHAPE.0.exp() }
            }
            Some(strength) => Self { inclusion: 0.1, full: 0.0, scale: 1.0 / strength, shape: 1.0 },
        }
    }

    /// log density of u where it is neither 0 nor 1.
    fn log_slab(&self, u: f64) -> f64 {
        let k = self.shape;
        (k - 1.0) * u.ln() - k * u + k * k.ln() - ln_gamma(k)
    }
}

/// log density of a log-normal parameter against its logarithm, but for a constant.
fn log_hyper(x: f64, (mean, deviation): (f64, f64)) -> f64 {
    -0.5 * ((x.ln() - mean) / deviation).powi(2)
}

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
    prior: Prior,
    /// True where all but p is held.
    fixed: bool,
    proposals: u32,
    accepted: u64,
    tried: u64,
}

/// Where a reward is tried, and its true place may be: a fixed distribution, so that detailed balance is easy to keep.
#[derive(Debug)]
pub(super) struct Places {
    probability: Vec<f64>,
    cumulative: Vec<f64>,
}

impl Places {
    /// Most often where a little reward would lower the log posterior least: `slopes` are its derivatives at the optimum with
    /// the sign changed, shape (`n_basis`,), 0 where a weight is free. A reward is tried everywhere now and then.
    pub(super) fn new(slopes: &[f64]) -> Self {
        let plausible: Vec<f64> = slopes.iter().map(|g| (1.0 + g.max(0.0)).powi(-2)).collect();
        let total: f64 = plausible.iter().sum();
        let n = slopes.len() as f64;
        let probability: Vec<f64> = plausible.iter().map(|p| EVERYWHERE / n + (1.0 - EVERYWHERE) * p / total).collect();
        let cumulative = probability
            .iter()
            .scan(0.0, |sum, p| {
                *sum += p;
                Some(*sum)
            })
            .collect();
        Self { probability, cumulative }
    }

    fn draw(&self, stream: &mut Stream) -> usize {
        let u = stream.uniform() * self.cumulative[self.cumulative.len() - 1];
        self.cumulative.partition_point(|&c| c <= u).min(self.cumulative.len() - 1)
    }
}

/// Basis functions near each other, both ways: where a reward may have its true place.
#[derive(Debug)]
pub(super) struct Neighbours(Vec<Vec<u32>>);

impl Neighbours {
    /// One step apart, for the Dirac bases; none for features.
    pub(super) fn new(mdp: &TabularMdp, kind: BasisKind, n_basis: usize) -> Self {
        let mut near = vec![Vec::new(); n_basis];
        if kind != BasisKind::Features {
            let mut link = |a: usize, b: usize| {
                if a != b {
                    near[a].push(b as u32);
                    near[b].push(a as u32);
                }
            };
            for pair in 0..mdp.n_pairs() {
                let (state, action) = (pair / mdp.n_actions(), pair % mdp.n_actions());
                for &next in mdp.row(pair).0 {
                    match kind {
                        BasisKind::State => link(state, next as usize),
                        _ => link(pair, mdp.pair(next as usize, action)),
                    }
                }
                if kind == BasisKind::StateAction {
                    (0..action).for_each(|other| link(pair, mdp.pair(state, other)));
                }
            }
        }
        for list in &mut near {
            list.sort_unstable();
            list.dedup();
        }
        Self(near)
    }
}

impl<'a> Chain<'a> {
    /// Starts at the weights `start`, shape (`n_basis`,), with the prior's parameters at `prior`, all but p held if `fixed`.
    pub(super) fn new(
        (mdp, basis, neighbours, places): (&'a TabularMdp, &'a Basis, &'a Neighbours, &'a Places),
        (counts, discount): (&'a [f64], f64),
        start: Vec<f64>,
        (prior, fixed): (Prior, bool),
        stream: Stream,
    ) -> Self {
        let reward = basis.reward(&start);
        let process = SoftProcess::new(mdp, discount, counts, &reward);
        let active = (0..start.len()).filter(|&b| start[b] > 0.0).collect();
        let units = start.iter().map(|w| w / prior.scale).collect();
        let (weights, proposals, accepted, tried) = (start, 0, 0, 0);
        Self {
            basis,
            neighbours,
            places,
            process,
            stream,
            units,
            weights,
            active,
            reward,
            prior,
            fixed,
            proposals,
            accepted,
            tried,
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
        if kind < 0.15 {
            self.walk();
        } else if kind < 0.3 {
            self.switch();
        } else if kind < 0.6 {
            self.appear_or_vanish();
        } else if kind < 0.85 {
            self.carry(kind < 0.75);
        } else if !self.fixed {
            let scale = self.prior.scale * (0.2 * self.stream.normal()).exp();
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

    /// A reward appears, drawn from the prior so that its density cancels, or one vanishes.
    fn appear_or_vanish(&mut self) {
        let b = self.places.draw(&mut self.stream);
        let odds = self.prior.inclusion.ln() - (-self.prior.inclusion).ln_1p();
        if self.units[b] > 0.0 {
            self.attempt(&[(b, 0.0)], self.prior.scale, -odds);
        } else {
            let full = self.stream.uniform() < self.prior.full;
            let new = if full { 1.0 } else { self.gamma(self.prior.shape) / self.prior.shape };
            self.attempt(&[(b, new)], self.prior.scale, odds);
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
            self.attempt(&[(b, self.units[other]), (other, self.units[b])], self.prior.scale, ratio);
        }
    }

    /// Accepts new units and a new scale with the Metropolis-Hastings probability; `ratio` is the log of all but the
    /// likelihood.
    fn attempt(&mut self, changes: &[(usize, f64)], scale: f64, ratio: f64) {
        self.tried += 1;
        // 1 − u lies in (0, 1]
        let threshold = self.process.log_likelihood() - ratio + (-self.stream.uniform()).ln_1p();
        if threshold.is_nan() || !scale.is_finite() || changes.iter().any(|(_, u)| !u.is_finite()) {
            return;
        }
        let before: Vec<(usize, f64)> = changes.iter().map(|&(b, _)| (b, self.units[b])).collect();
        let old = self.prior.scale;
        self.set(changes, scale);
        if self.process.propose(&self.reward, threshold).is_some() {
            self.process.accept();
            self.accepted += 1;
            let units = &self.units;
            self.active.retain(|&b| units[b] > 0.0);
            for &(b, u) in changes {
                if u > 0.0 && !self.active.contains(&b) {
                    self.active.push(b);
                }
            }
        } else {
            self.set(&before, old);
        }
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

/// log Γ(x) for x > 0: Stirling's series, shifted to where it is exact to 1e-13.
fn ln_gamma(x: f64) -> f64 {
    let (mut x, mut shift) = (x, 0.0);
    while x < 10.0 {
        shift += x.ln();
        x += 1.0;
    }
    let inverse = 1.0 / (x * x);
    let series = (1.0 / 12.0 - inverse * (1.0 / 360.0 - inverse * (1.0 / 1260.0 - inverse / 1680.0))) / x;
    (x - 0.5) * x.ln() - x + 0.5 * (2.0 * std::f64::consts::PI).ln() + series - shift
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn logarithms_of_gamma() {
        for (x, want) in [
            (1.0, 0.0),
            (2.0, 0.0),
            (0.5, 0.572_364_942_924_700_1),
            (5.0, 3.178_053_830_347_946),
            (100.0, 359.134_205_369_575_4),
        ] {
            assert!((ln_gamma(x) - want).abs() < 1e-10 * (1.0 + want), "{x}: {}", ln_gamma(x));
        }
    }

    #[test]
    fn a_slab_is_a_density() {
        let prior = Prior { inclusion: 0.1, full: 0.5, scale: 3.0, shape: 2.5 };
        let step = 0.001;
        let points = (0..60_000).map(|i| (f64::from(i) + 0.5) * step);
        let (mass, mean) = points.fold((0.0, 0.0), |(mass, mean), x| {
            let p = prior.log_slab(x).exp() * step;
            (mass + p, mean + x * p)
        });
        assert!((mass - 1.0).abs() < 1e-6 && (mean - 1.0).abs() < 1e-5, "{mass} {mean}");
    }

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
            let setting = (&mdp, &basis, &neighbours, &places);
            Chain::new(setting, (&counts, 0.9), vec![0.0; 6], (prior, fixed), Stream::new(11, u64::from(fixed)))
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

    #[test]
    fn gamma_draws_have_their_moments() {
        let mdp = TabularMdp::new(1, 1, vec![0, 1], vec![0], vec![1.0], None).expect("a model");
        let (basis, neighbours, places) =
            (Basis::state(&mdp), Neighbours::new(&mdp, BasisKind::State, 1), Places::new(&[0.0]));
        let setting = (&mdp, &basis, &neighbours, &places);
        let mut chain = Chain::new(setting, (&[0.0], 0.5), vec![0.0], (Prior::begin(None), true), Stream::new(1, 1));
        for shape in [0.3, 1.0, 7.5] {
            let draws: Vec<f64> = (0..40_000).map(|_| chain.gamma(shape)).collect();
            let mean = draws.iter().sum::<f64>() / 40_000.0;
            let variance = draws.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / 40_000.0;
            assert!((mean / shape - 1.0).abs() < 0.04 && (variance / shape - 1.0).abs() < 0.08, "{mean} {variance}");
        }
    }
}
