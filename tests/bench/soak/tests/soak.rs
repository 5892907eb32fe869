//! A short soak: `MAZEWAY_SOAK_SECS` says how long the load lasts, a few seconds where it is not set.

#![cfg(target_os = "linux")]

use mazeway_bench_soak::run::{Plan, run};
use std::time::Duration;

/// Bytes that may be resident after a load beyond what a first one left: what an allocator keeps varies.
const SLACK_BYTES: f64 = 8.0 * 1024.0 * 1024.0;
/// Most that a session may take, its part of a connection and of what is unread included.
const SESSION_BYTES: f64 = 96.0 * 1024.0;
/// How much longer a step may take under load than without. The bound of a machine that does nothing else is five, which
/// docs/RELIABILITY.md has; tests run beside each other.
const RATIO: f64 = 100.0;

#[test]
fn a_server_under_load_serves_who_behaves_well_and_keeps_nothing() {
    let secs = std::env::var("MAZEWAY_SOAK_SECS").ok().map_or(5, |secs| secs.parse().expect("a number of seconds"));
    let plan = Plan {
        server: mazeway_tests::programs::program("server"),
        soak: env!("CARGO_BIN_EXE_soak").into(),
        time: Duration::from_secs(secs),
        pinned: false,
    };
    let report = run(&plan).expect("a run that ends well, with nothing left");
    println!("{}", report.tables());
    assert!(report.bytes_a_session() < SESSION_BYTES, "{} bytes", report.bytes_a_session());
    assert!(report.bytes_left() < SLACK_BYTES, "{} bytes are left", report.bytes_left());
    let (before, after) = report.files();
    assert_eq!(before, after, "open files");
    assert!(report.ratio() < RATIO, "{:.1} times the median without load", report.ratio());
}
