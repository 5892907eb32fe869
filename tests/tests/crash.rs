//! The power is cut at any moment of any history: see `mazeway_tests::crash`.

use mazeway_tests::crash::check::{Tally, run};
use rayon::prelude::*;

/// Cuts of the power in one run of the tests, unless `MAZEWAY_CUTS` says how many.
const CUTS: u64 = 10_000;
/// A store of the first release.
const OLD: &[u8] = include_bytes!("../data/store_v1.sqlite3");
/// Parts that run at the same time, each with a seed of its own.
const PARTS: u64 = 8;

#[test]
fn what_was_acknowledged_survives_every_cut_of_the_power() {
    let number = |name, otherwise| std::env::var(name).map_or(otherwise, |text| text.parse().expect("a number"));
    let (cuts, seed) = (number("MAZEWAY_CUTS", CUTS), number("MAZEWAY_SEED", 0));
    let parts = (seed * PARTS..(seed + 1) * PARTS).into_par_iter();
    let tallies = parts.map(|part| run(part, cuts / PARTS, OLD, false)).collect::<Vec<_>>();
    let mut sum = Tally::default();
    for tally in tallies {
        sum += tally.unwrap_or_else(|error| panic!("{error}"));
    }
    println!(
        "{} cuts of the power, {} of them within a request, of which {} left it whole and the others nothing of it; {} steps, \
         of which the disk made {} fail; {} acknowledged trajectories looked for, none missing; {} damaged after a cut and repaired",
        sum.cuts, sum.cuts_within, sum.kept_within, sum.steps, sum.failed_steps, sum.acknowledged, sum.damaged
    );
    assert!(sum.cuts >= cuts);
    // What is to be tried is tried: acknowledged data, cuts in the middle of requests with either end, broken disks.
    assert!(sum.acknowledged > cuts && sum.failed_steps > 100 && sum.damaged > cuts / 32);
    assert!(sum.kept_within > 100 && sum.cuts_within - sum.kept_within > 100);
}

#[test]
fn a_disk_that_lies_is_found_out() {
    let error = run(0, 1_000, OLD, true).expect_err("a loss");
    assert!(error.contains("after a cut the store holds") || error.contains("database"), "{error}");
}
