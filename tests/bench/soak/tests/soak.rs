//! A short soak: `MAZEWAY_SOAK_SECS` says how long the load lasts, a few seconds where it is not set.

#![cfg(target_os = "linux")]

use mazeway_bench_soak::{
    fits,
    run::{Plan, run},
};
use mazeway_tests::programs::program;
use std::{
    io::Write as _,
    sync::{Mutex, MutexGuard, PoisonError},
    time::Duration,
};

/// How much longer a step may take under load than without. The bound of a machine that does nothing else is five, which
/// `soak --pinned` keeps; tests run beside each other.
const RATIO: f64 = 100.0;

/// One at a time: each has the machine to itself.
fn turn() -> MutexGuard<'static, ()> {
    static TURN: Mutex<()> = Mutex::new(());
    TURN.lock().unwrap_or_else(PoisonError::into_inner)
}

fn plan(time: Duration) -> Plan {
    Plan { server: program("server"), soak: env!("CARGO_BIN_EXE_soak").into(), time, pinned: false }
}

/// Shows what was seen also where the test does well: what goes to standard error like this is not captured.
fn show(tables: &str) {
    let _ = write!(std::io::stderr(), "\n{tables}");
}

#[test]
fn a_server_under_load_serves_who_behaves_well_and_keeps_nothing() {
    let _turn = turn();
    let secs = std::env::var("MAZEWAY_SOAK_SECS").ok().map_or(5, |secs| secs.parse().expect("a number of seconds"));
    let report = run(&plan(Duration::from_secs(secs))).expect("a run that ends well, with nothing left");
    show(&report.tables());
    assert_eq!(report.missed(RATIO), Vec::<String>::new());
}

#[test]
fn steps_go_on_beside_fits() {
    let _turn = turn();
    let report = fits::run(&plan(Duration::from_secs(3)), &program("learner")).expect("a run that ends well");
    show(&report.tables());
    assert_eq!(report.missed(RATIO), Vec::<String>::new());
}
