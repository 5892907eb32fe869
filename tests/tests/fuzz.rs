//! A short run of every fuzzing target; `tests/bench/reliability.sh fuzz` runs them for long. See `mazeway_tests::fuzz`.

use mazeway_tests::fuzz::{
    run,
    targets::{TARGETS, Target},
};
use rayon::prelude::*;

/// Executions of one target; a database or a call takes longer than a line of text.
fn executions(target: &Target) -> u64 {
    match target.name {
        "store-file" => 400,
        "environment-requests" | "learner-requests" => 1_500,
        _ => 8_000,
    }
}

#[test]
fn whatever_the_bytes_are_reading_them_ends_well() {
    std::panic::set_hook(Box::new(|_| ()));
    let outcome = std::panic::catch_unwind(|| {
        TARGETS.par_iter().for_each(|target| {
            let meter = |work: &mut dyn FnMut()| allocation_counter::measure(work).bytes_max;
            let tally = run(target, executions(target), 1, meter);
            assert!(tally.accepted > 0 && tally.answers > 3, "{}: {tally:?}", target.name);
        });
    });
    let _ = std::panic::take_hook();
    if let Err(failure) = outcome {
        let said = failure.downcast_ref::<String>().cloned();
        panic!("{}", said.unwrap_or_else(|| "a target failed".into()));
    }
}
