//! All ways to solve against a dense factorisation, on random sparse models.

use super::iterative::{Incomplete, Patience, bicgstab};
use super::*;
use crate::mdp::numeric::norm;
use nalgebra::{DMatrix, DVector};
use proptest::prelude::*;
use rand_core::Rng;
use rand_pcg::Pcg64;

/// `n` states in a ring with jumps, two actions; the last state may be absorbing.
fn ring(n: usize, jumps: usize, absorbing: bool, random: &mut Pcg64) -> TabularMdp {
    let (mut offsets, mut next, mut probabilities) = (vec![0], Vec::new(), Vec::new());
    for pair in 0..2 * n {
        let state = pair / 2;
        let mut row = vec![state as u32];
        if !(absorbing && state == n - 1) {
            row.push(((state + 1 + pair % 2 * (n - 2).min(7)) % n) as u32);
            row.extend((0..jumps).map(|_| (random.next_u64() % n as u64) as u32));
        }
        row.sort_unstable();
        row.dedup();
        let weights: Vec<f64> = row.iter().map(|_| 1e-3 + (random.next_u64() >> 40) as f64).collect();
        let sum: f64 = weights.iter().sum();
        probabilities.extend(weights.iter().map(|w| w / sum));
        next.extend(row);
        offsets.push(next.len());
    }
    TabularMdp::new(n, 2, offsets, next, probabilities, None).expect("a model")
}

fn dense(mdp: &TabularMdp, policy: &[f64], discount: f64) -> DMatrix<f64> {
    let mut matrix = DMatrix::identity(mdp.n_states(), mdp.n_states());
    for (pair, &weight) in policy.iter().enumerate() {
        let (next, probabilities) = mdp.row(pair);
        for (&s, &p) in next.iter().zip(probabilities) {
            matrix[(pair / mdp.n_actions(), s as usize)] -= discount * weight * p;
        }
    }
    matrix
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn all_ways_to_solve_agree_with_dense_elimination(
        n in 3_usize..120,
        jumps in 0_usize..3,
        absorbing: bool,
        hard: bool,
        seed: u64,
        one_minus_discount in prop_oneof![Just(0.5), Just(0.1), Just(0.01), Just(1e-3), Just(1e-4), 1e-4..0.5],
        transposed: bool,
    ) {
        let discount = 1.0 - one_minus_discount;
        let mut random = Pcg64::new(u128::from(seed), 7);
        let mdp = ring(n, jumps, absorbing, &mut random);
        let mut policy = Vec::new();
        for _ in 0..n {
            let p = if hard { 1.0 } else { (random.next_u64() >> 11) as f64 / (1_u64 << 53) as f64 };
            policy.extend([p, 1.0 - p]);
        }
        let b: Vec<f64> = (0..n).map(|i| (i as f64).sin()).collect();
        let full = dense(&mdp, &policy, discount);
        let full = if transposed { full.transpose() } else { full };
        let side = DVector::from_column_slice(&b);
        let want = full.clone().lu().solve(&side).expect("M is regular");
        let size = want.amax();

        let mut chosen = Resolvent::new(&mdp, &policy, discount);
        let mut factor: Factor = Factor::new(Symbolic::of(&chosen.matrix, u64::MAX).expect("an order"));
        factor.factorise(&chosen.matrix);
        let mut incomplete = Incomplete::default();
        incomplete.factorise(&chosen.matrix);
        let near = want.iter().map(|x| x * (1.0 + 1e-6)).collect::<Vec<_>>();
        let patience = Patience { most: 10_000, minds_pace: false };
        let iterate = |start| {
            let matrix = (&chosen.matrix, &incomplete);
            let iterated = bicgstab(matrix, &b, transposed, RELATIVE_TOLERANCE, start, patience);
            assert!(iterated.converged, "{} iterations", iterated.iterations);
            iterated.x
        };
        let (iterated, from_near) = (iterate(None), iterate(Some(&near)));
        let swept = incomplete.sweeps(&chosen.matrix, &b, transposed, near, RELATIVE_TOLERANCE, 20_000);
        // as if the model were large, after another policy, and with a factorisation that is forced early
        let mut lasting = Iterative::<f32>::default();
        let mut other = Matrix::of_model(&mdp);
        other.fill(&mdp, &vec![0.5; 2 * n], discount);
        lasting.set_policy(&other);
        lasting.solve(&other, &b, transposed, RELATIVE_TOLERANCE, None);
        if seed % 2 == 0 {
            lasting.buy(&other);
        }
        lasting.set_policy(&chosen.matrix);
        let lasted = lasting.solve(&chosen.matrix, &b, transposed, RELATIVE_TOLERANCE, None);
        let solution = chosen.solution(&b, transposed, RELATIVE_TOLERANCE, None);
        for (way, found) in [
            ("factor", factor.solve(&b, transposed)),
            ("bicgstab", iterated),
            ("from near", from_near),
            ("sweeps", swept),
            ("lasting", lasted),
            ("chosen", solution.x.clone()),
        ] {
            for (w, x) in want.iter().zip(&found) {
                prop_assert!((w - x).abs() <= 1e-8 * size, "{way}, {n} states, discount {discount}: {w} and {x}");
            }
        }
        // the residual that is stated is the true one
        let rest = &side - &full * DVector::from_column_slice(&solution.x);
        let rounding = 1e-14 * (1.0 + size / side.norm());
        prop_assert!((rest.norm() / side.norm() - solution.residual).abs() <= rounding);
        prop_assert!(solution.residual <= 1e-12 * (1.0 + size), "residual {}", solution.residual);
    }
}

#[test]
fn large_models_are_iterated_and_their_patterns_reused() {
    let mut random = Pcg64::new(3, 4);
    let n = 6000;
    let mdp = ring(n, 2, false, &mut random);
    let b = vec![1.0; n];
    for (discount, policy) in [(0.9, [0.5, 0.5]), (0.9999, [1.0, 0.0]), (0.99, [0.2, 0.8])] {
        let policy = policy.repeat(n);
        let mut resolvent = Resolvent::of_model(&mdp, discount);
        resolvent.set_policy(&mdp, &vec![0.5; 2 * n]);
        resolvent.set_policy(&mdp, &policy);
        assert!(matches!(resolvent.solver, Solver::Iterative(_)));
        // M 1 = (1 − γ) 1
        let solution = resolvent.solution(&b, false, RELATIVE_TOLERANCE, None);
        assert!(solution.x.iter().all(|x| (x * (1.0 - discount) - 1.0).abs() < 1e-9), "discount {discount}");
        let occupancy = resolvent.solution(&b, true, RELATIVE_TOLERANCE, None);
        let total: f64 = occupancy.x.iter().sum();
        assert!((total * (1.0 - discount) / n as f64 - 1.0).abs() < 1e-9, "discount {discount}");
        assert!(solution.residual < 1e-10 && occupancy.residual < 1e-10);
    }
}

#[test]
fn nothing_to_solve() {
    let mdp = TabularMdp::new(1, 1, vec![0, 1], vec![0], vec![1.0], None).expect("a model");
    let mut resolvent = Resolvent::new(&mdp, &[1.0], 0.75);
    assert_eq!(resolvent.solve(&[1.0]), [4.0]);
    assert_eq!(resolvent.solve_transposed_from(&[0.0], None), Solution { x: vec![0.0], residual: 0.0 });
}

/// Chains that hardly mix: cliques of states between which a step leads with probability 1e-9.
fn cliques(n_cliques: usize, size: usize) -> TabularMdp {
    let n = n_cliques * size;
    let (mut offsets, mut next, mut probabilities) = (vec![0], Vec::new(), Vec::new());
    for state in 0..n {
        let clique = state / size;
        let leap = ((clique + 1) % n_cliques * size + state % size) as u32;
        let mut row: Vec<(u32, f64)> =
            (0..size).map(|i| ((clique * size + i) as u32, (1.0 - 1e-9) / size as f64)).collect();
        row.push((leap, 1e-9));
        row.sort_by_key(|entry| entry.0);
        next.extend(row.iter().map(|entry| entry.0));
        probabilities.extend(row.iter().map(|entry| entry.1));
        offsets.push(next.len());
    }
    TabularMdp::new(n, 1, offsets, next, probabilities, None).expect("a model")
}

#[test]
fn nearly_singular_chains_end_with_a_small_residual() {
    // more states than are factored at once
    let mdp = cliques(700, 9);
    let mut random = Pcg64::new(9, 9);
    let b: Vec<f64> = (0..mdp.n_states()).map(|_| (random.next_u64() % 100) as f64).collect();
    for discount in [0.9, 0.999, 0.9999, 1.0 - 1e-9] {
        for transposed in [false, true] {
            let mut resolvent = Resolvent::new(&mdp, &vec![1.0; mdp.n_states()], discount);
            let solution = resolvent.solution(&b, transposed, RELATIVE_TOLERANCE, None);
            let size = norm(&solution.x) / norm(&b);
            assert!(solution.residual <= 1e-12 * (1.0 + size), "discount {discount}: {}", solution.residual);
        }
    }
}

#[test]
fn what_is_too_much_to_factor_ends_all_the_same() {
    // random leaps over many states: elimination fills everything
    let mut random = Pcg64::new(5, 5);
    let mdp = ring(12_000, 3, false, &mut random);
    let policy = [1.0, 0.0].repeat(12_000);
    let mut resolvent = Resolvent::new(&mdp, &policy, 0.9999);
    assert!(Symbolic::of(&resolvent.matrix, 4_000_000_000).is_none());
    let Solver::Iterative(iterative) = &mut resolvent.solver else { panic!("it is factored at once") };
    iterative.buy(&resolvent.matrix);
    let solution = resolvent.solution(&vec![1.0; 12_000], false, RELATIVE_TOLERANCE, None);
    assert!(solution.residual < 1e-9, "{}", solution.residual);
}

#[test]
fn a_factorisation_lasts_over_policies_that_are_near() {
    let mut random = Pcg64::new(6, 6);
    let mdp = ring(6000, 0, false, &mut random);
    let b: Vec<f64> = (0..6000).map(|i| f64::from(i).sin()).collect();
    let mut resolvent = Resolvent::of_model(&mdp, 0.999);
    for turn in 0..20 {
        let first = 0.5 + 0.02 * f64::from(turn);
        resolvent.set_policy(&mdp, &[first, 1.0 - first].repeat(6000));
        if let (0, Solver::Iterative(iterative)) = (turn, &mut resolvent.solver) {
            iterative.buy(&resolvent.matrix);
        }
        for transposed in [false, true] {
            let solution = resolvent.solution(&b, transposed, RELATIVE_TOLERANCE, None);
            assert!(solution.residual < 1e-12, "turn {turn}: {}", solution.residual);
        }
    }
}
