//! Covariances of rewards: K(θ) = Σ σ² C(shape) over a few parts, with derivatives with respect to all θ.
//!
//! θ holds logarithms: of the variance of each part, then of its shape (a diffusion time, or one length scale a feature).
//! Invariant: one part is white, so that K is positive definite. Each θ has a wide normal prior about 0, for inputs
//! come standardised and rewards are in units of the expert's own noise.

use nalgebra::{Cholesky, DMatrix, Dyn};

/// Standard deviation of the prior of the logarithm of a variance.
const VARIANCE_SPREAD: f64 = 3.0;
/// Standard deviation of the prior of the logarithm of a shape.
const SHAPE_SPREAD: f64 = 1.0;
/// Logarithms beyond which θ is cut, so that no exponential overflows.
pub(super) const LARGEST_LOG: f64 = 20.0;
/// Added to the diagonal, relative to its mean, where K is not positive definite in floating point.
const JITTER: [f64; 4] = [1e-10, 1e-8, 1e-6, 1e-4];

/// One summand of the covariance, of unit variance.
pub(super) enum Part {
    /// Every point on its own.
    White,
    /// Points of the same group move together: `group[point]`.
    Grouped(Vec<usize>),
    /// exp(−τ · Laplacian) between the nodes of the points (Kondor & Lafferty 2002), from the Laplacian's eigenvectors.
    Diffusion { vectors: DMatrix<f64>, values: Vec<f64>, node: Vec<usize> },
    /// exp(−½ Σ_k (x_k − x'_k)² / length_k²): one column of coordinates a feature, with the feature's name.
    SquaredExponential { names: Vec<String>, coordinates: DMatrix<f64> },
}

impl Part {
    fn n_shapes(&self) -> usize {
        match self {
            Self::White | Self::Grouped(_) => 0,
            Self::Diffusion { .. } => 1,
            Self::SquaredExponential { names, .. } => names.len(),
        }
    }

    fn names(&self) -> Vec<String> {
        match self {
            Self::White => vec!["white_variance".to_owned()],
            Self::Grouped(_) => vec!["state_variance".to_owned()],
            Self::Diffusion { .. } => vec!["diffusion_variance".to_owned(), "diffusion_time".to_owned()],
            Self::SquaredExponential { names, .. } => std::iter::once("feature_variance".to_owned())
                .chain(names.iter().map(|name| format!("length_scale_{name}")))
                .collect(),
        }
    }

    /// C, and for a diffusion dC/dlog τ.
    fn correlation(&self, n: usize, shapes: &[f64]) -> (DMatrix<f64>, Option<DMatrix<f64>>) {
        match self {
            Self::White => (DMatrix::identity(n, n), None),
            Self::Grouped(group) => (DMatrix::from_fn(n, n, |i, j| f64::from(u8::from(group[i] == group[j]))), None),
            Self::Diffusion { vectors, values, node } => {
                let time = shapes[0].exp();
                let spectral = |f: &dyn Fn(f64) -> f64| {
                    let mut scaled = vectors.clone();
                    for (mut column, &value) in scaled.column_iter_mut().zip(values) {
                        column *= f(value);
                    }
                    let nodes = scaled * vectors.transpose();
                    DMatrix::from_fn(n, n, |i, j| nodes[(node[i], node[j])])
                };
                let heat = spectral(&|value| (-time * value).exp());
                let slope = spectral(&|value| -time * value * (-time * value).exp());
                (heat, Some(slope))
            }
            Self::SquaredExponential { coordinates, .. } => {
                let precisions: Vec<f64> = shapes.iter().map(|log| (-2.0 * log).exp()).collect();
                let correlation = DMatrix::from_fn(n, n, |i, j| {
                    let distance: f64 = precisions
                        .iter()
                        .enumerate()
                        .map(|(k, p)| p * (coordinates[(i, k)] - coordinates[(j, k)]).powi(2))
                        .sum();
                    (-0.5 * distance).exp()
                });
                (correlation, None)
            }
        }
    }
}

pub(super) struct Kernel {
    n: usize,
    parts: Vec<Part>,
}

impl Kernel {
    /// Over `n` points; one of `parts` is white.
    pub(super) fn new(n: usize, parts: Vec<Part>) -> Self {
        debug_assert!(parts.iter().any(|part| matches!(part, Part::White)));
        Self { n, parts }
    }

    /// What each θ is, in its own unit, not its logarithm.
    pub(super) fn names(&self) -> Vec<String> {
        self.parts.iter().flat_map(Part::names).collect()
    }

    /// The means of the priors.
    pub(super) fn start(&self) -> Vec<f64> {
        vec![0.0; self.parts.iter().map(|part| 1 + part.n_shapes()).sum()]
    }

    /// log p(θ) up to a constant.
    pub(super) fn log_prior(&self, theta: &[f64]) -> f64 {
        theta.iter().zip(self.spreads()).map(|(t, spread)| -0.5 * (t / spread).powi(2)).sum()
    }

    fn spreads(&self) -> Vec<f64> {
        let of_part =
            |part: &Part| std::iter::once(VARIANCE_SPREAD).chain(std::iter::repeat_n(SHAPE_SPREAD, part.n_shapes()));
        self.parts.iter().flat_map(of_part).collect()
    }

    /// K(θ), shape (`n_points`, `n_points`).
    pub(super) fn matrix(&self, theta: &[f64]) -> DMatrix<f64> {
        let mut sum = DMatrix::zeros(self.n, self.n);
        self.for_each_part(theta, |part, variance, shapes, _| {
            sum += part.correlation(self.n, shapes).0 * variance;
        });
        sum
    }

    /// Σ_ij G_ij dK_ij/dθ_k for every k, G symmetric.
    fn pull_back(&self, theta: &[f64], g: &DMatrix<f64>) -> Vec<f64> {
        let mut by_theta = vec![0.0; theta.len()];
        self.for_each_part(theta, |part, variance, shapes, first| {
            let (correlation, slope) = part.correlation(self.n, shapes);
            by_theta[first] = variance * g.dot(&correlation);
            if let Some(slope) = slope {
                by_theta[first + 1] = variance * g.dot(&slope);
            }
            if let Part::SquaredExponential { coordinates, .. } = part {
                let weighted = g.component_mul(&correlation);
                for (k, log) in shapes.iter().enumerate() {
                    let mut sum = 0.0;
                    for j in 0..self.n {
                        for i in 0..self.n {
                            sum += weighted[(i, j)] * (coordinates[(i, k)] - coordinates[(j, k)]).powi(2);
                        }
                    }
                    by_theta[first + 1 + k] = variance * sum * (-2.0 * log).exp();
                }
            }
        });
        by_theta
    }

    fn for_each_part(&self, theta: &[f64], mut visit: impl FnMut(&Part, f64, &[f64], usize)) {
        let mut first = 0;
        for part in &self.parts {
            let next = first + 1 + part.n_shapes();
            let cut: Vec<f64> = theta[first..next].iter().map(|t| t.clamp(-LARGEST_LOG, LARGEST_LOG)).collect();
            visit(part, cut[0].exp(), &cut[1..], first);
            first = next;
        }
    }

    /// −E[log p(u|θ)] − log p(θ) for ⟨uuᵀ⟩ = `second_moment`, up to a constant, and its derivative:
    /// ½ tr(K⁻¹S) + ½ log|K|, with derivative ½ (K⁻¹ − K⁻¹SK⁻¹) by K.
    pub(super) fn expected_cost(&self, theta: &[f64], second_moment: &DMatrix<f64>) -> (f64, Vec<f64>) {
        let Some(factor) = factor(self.matrix(theta)) else {
            return (f64::INFINITY, vec![0.0; theta.len()]);
        };
        let inverse = factor.inverse();
        let log_determinant = 2.0 * factor.l_dirty().diagonal().iter().map(|d| d.ln()).sum::<f64>();
        let value = 0.5 * (inverse.dot(second_moment) + log_determinant) - self.log_prior(theta);
        let by_matrix = (&inverse - &inverse * second_moment * &inverse) * 0.5;
        let mut gradient = self.pull_back(theta, &by_matrix);
        for ((g, t), spread) in gradient.iter_mut().zip(theta).zip(self.spreads()) {
            *g += t / (spread * spread);
        }
        (value, gradient)
    }
}

/// Cholesky's factorisation, with as much on the diagonal as it takes.
pub(super) fn factor(matrix: DMatrix<f64>) -> Option<Cholesky<f64, Dyn>> {
    let size = matrix.trace() / matrix.nrows() as f64;
    if !size.is_finite() {
        return None;
    }
    if let Some(factor) = Cholesky::new(matrix.clone()) {
        return Some(factor);
    }
    JITTER.iter().find_map(|share| {
        let mut lifted = matrix.clone();
        for i in 0..lifted.nrows() {
            lifted[(i, i)] += share * size;
        }
        Cholesky::new(lifted)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::irl::random::Stream;

    #[test]
    fn the_gradient_matches_differences() {
        let mut stream = Stream::new(4, 0);
        let n = 6;
        let mut laplacian = DMatrix::from_fn(3, 3, |i, j| if i == j { 2.0 } else { -1.0 });
        laplacian[(0, 0)] = 2.5;
        let eigen = laplacian.symmetric_eigen();
        let coordinates = DMatrix::from_fn(n, 2, |_, _| stream.normal());
        let kernel = Kernel::new(
            n,
            vec![
                Part::White,
                Part::Grouped(vec![0, 0, 1, 1, 2, 2]),
                Part::Diffusion {
                    vectors: eigen.eigenvectors,
                    values: eigen.eigenvalues.as_slice().to_vec(),
                    node: vec![0, 0, 1, 1, 2, 2],
                },
                Part::SquaredExponential { names: vec!["x".to_owned(), "y".to_owned()], coordinates },
            ],
        );
        assert_eq!(kernel.names().len(), kernel.start().len());
        let half = DMatrix::from_fn(n, n, |_, _| stream.normal());
        let second_moment = &half * half.transpose();
        let theta: Vec<f64> = kernel.start().iter().map(|_| 0.5 * stream.normal()).collect();
        let (_, gradient) = kernel.expected_cost(&theta, &second_moment);
        for (k, g) in gradient.iter().enumerate() {
            let at = |delta: f64| {
                let mut moved = theta.clone();
                moved[k] += delta;
                kernel.expected_cost(&moved, &second_moment).0
            };
            let slope = (at(1e-5) - at(-1e-5)) / 2e-5;
            assert!((slope - g).abs() < 1e-5 * (1.0 + g.abs()), "{}: {slope} and {g}", kernel.names()[k]);
        }
    }
}
