//! What the Gaussian process is over: points, which pairs they stand for, and the parts of their covariance.
//!
//! With the user's features, pairs of the same features are one point and the covariance is an ARD kernel of the standardised
//! features plus a white part. Without, points are states (or pairs) and their nearness is that of the process itself: the heat
//! kernel of the undirected graph of the uniformly random policy, plus a white part.

use super::kernel::Part;
use crate::irl::{Basis, BasisKind, FitError};
use crate::mdp::{Features, TabularMdp};
use nalgebra::{DMatrix, SymmetricEigen};
use std::collections::BTreeMap;

/// Most points: the Hessian costs states times points squared.
const MAX_POINTS: usize = 1000;
/// Most states.
const MAX_STATES: usize = 2000;
/// Most features of an ARD kernel.
const MAX_FEATURES: usize = 100;
/// Most entries of the table from pairs to points of features.
const MAX_TABLE: usize = 50_000_000;

pub(super) struct Inputs {
    /// Rewards of points to rewards of pairs.
    pub basis: Basis,
    pub parts: Vec<Part>,
}

impl Inputs {
    pub(super) fn new(mdp: &TabularMdp, kind: BasisKind, features: Option<&Features>) -> Result<Self, FitError> {
        let too_large =
            |what, limit, got| if got > limit { Err(FitError::TooLarge { what, limit, got }) } else { Ok(()) };
        too_large("states for gpirl", MAX_STATES, mdp.n_states())?;
        if let Some(features) = features {
            too_large("features for gpirl", MAX_FEATURES, features.len())?;
        }
        match (kind, features) {
            (BasisKind::Features, Some(features)) => {
                let (point, rows) = distinct(features);
                too_large("distinct rows of features for gpirl", MAX_POINTS, rows.len())?;
                too_large(
                    "entries (pairs times distinct rows of features) for gpirl",
                    MAX_TABLE,
                    point.len() * rows.len(),
                )?;
                let mut table = vec![0.0; point.len() * rows.len()];
                for (pair, &p) in point.iter().enumerate() {
                    table[pair * rows.len() + p] = 1.0;
                }
                let names = (0..rows.len()).map(|p| p.to_string()).collect();
                let points = Features::of_pairs(mdp.n_pairs(), names, &table)
                    .map_err(|error| FitError::InvalidOption { field: "basis", message: error.to_string() })?;
                Ok(Self {
                    basis: Basis::features(&points),
                    parts: vec![Part::White, squared_exponential(features.names(), &rows)],
                })
            }
            (BasisKind::StateAction, features) => {
                too_large("state-action pairs for gpirl", MAX_POINTS, mdp.n_pairs())?;
                let state: Vec<usize> = (0..mdp.n_pairs()).map(|pair| pair / mdp.n_actions()).collect();
                let mut parts = vec![Part::White];
                if let Some(features) = features {
                    let rows: Vec<Vec<f64>> = (0..mdp.n_pairs()).map(|pair| dense(features, pair)).collect();
                    parts.push(squared_exponential(features.names(), &rows));
                } else {
                    parts.push(Part::Grouped(state.clone()));
                    parts.push(diffusion(mdp, state));
                }
                Ok(Self { basis: Basis::state_action(mdp), parts })
            }
            (_, features) => {
                too_large("states as points for gpirl", MAX_POINTS, mdp.n_states())?;
                let nearness = match features {
                    Some(features) => squared_exponential(features.names(), &state_means(mdp, features)),
                    None => diffusion(mdp, (0..mdp.n_states()).collect()),
                };
                Ok(Self { basis: Basis::state(mdp), parts: vec![Part::White, nearness] })
            }
        }
    }
}

fn dense(features: &Features, pair: usize) -> Vec<f64> {
    let mut row = vec![0.0; features.len()];
    let (columns, values) = features.row(pair);
    for (&column, &value) in columns.iter().zip(values) {
        row[column as usize] = value;
    }
    row
}

/// The point of each pair, and the features of each point.
fn distinct(features: &Features) -> (Vec<usize>, Vec<Vec<f64>>) {
    let mut known = BTreeMap::new();
    let mut rows = Vec::new();
    let point = (0..features.n_pairs())
        .map(|pair| {
            let row = dense(features, pair);
            // −0 and 0 are one value
            let key: Vec<u64> = row.iter().map(|x| (x + 0.0).to_bits()).collect();
            *known.entry(key).or_insert_with(|| {
                rows.push(row);
                rows.len() - 1
            })
        })
        .collect();
    (point, rows)
}

/// Mean features of the actions of each state.
fn state_means(mdp: &TabularMdp, features: &Features) -> Vec<Vec<f64>> {
    let share = 1.0 / mdp.n_actions() as f64;
    (0..mdp.n_states())
        .map(|state| {
            let mut mean = vec![0.0; features.len()];
            for action in 0..mdp.n_actions() {
                let (columns, values) = features.row(mdp.pair(state, action));
                for (&column, &value) in columns.iter().zip(values) {
                    mean[column as usize] += share * value;
                }
            }
            mean
        })
        .collect()
}

/// Coordinates in units of each feature's standard deviation over the points.
fn squared_exponential(names: &[String], rows: &[Vec<f64>]) -> Part {
    let n = rows.len() as f64;
    let mut coordinates = DMatrix::from_fn(rows.len(), names.len(), |i, k| rows[i][k]);
    for mut column in coordinates.column_iter_mut() {
        let largest = column.amax();
        if largest > 0.0 {
            // features near the largest number must not overflow when squared
            column /= largest;
            let mean = column.sum() / n;
            let deviation = (column.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / n).sqrt();
            for x in &mut column {
                *x = if deviation > 1e-12 { (*x - mean) / deviation } else { 0.0 };
            }
        }
    }
    Part::SquaredExponential { names: names.to_vec(), coordinates }
}

/// Eigenvectors of the normalised Laplacian of the graph that joins states by how often the random policy passes between them.
fn diffusion(mdp: &TabularMdp, node: Vec<usize>) -> Part {
    let n = mdp.n_states();
    let mut adjacency = DMatrix::zeros(n, n);
    for state in 0..n {
        for action in 0..mdp.n_actions() {
            let (states, probabilities) = mdp.row(mdp.pair(state, action));
            for (&s, &p) in states.iter().zip(probabilities).filter(|&(&s, _)| s as usize != state) {
                adjacency[(state, s as usize)] += p;
                adjacency[(s as usize, state)] += p;
            }
        }
    }
    let degrees: Vec<f64> = (0..n).map(|s| adjacency.row(s).sum()).collect();
    let laplacian = DMatrix::from_fn(n, n, |i, j| {
        let own = f64::from(u8::from(i == j && degrees[i] > 0.0));
        if adjacency[(i, j)] > 0.0 { own - adjacency[(i, j)] / (degrees[i] * degrees[j]).sqrt() } else { own }
    });
    let eigen = SymmetricEigen::new(laplacian);
    Part::Diffusion {
        values: eigen.eigenvalues.iter().map(|v| v.max(0.0)).collect(),
        vectors: eigen.eigenvectors,
        node,
    }
}
