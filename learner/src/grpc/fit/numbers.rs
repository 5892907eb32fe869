//! Fits, counted and timed: those refused by reason, those that waited by how that ended, those that ran by method and
//! outcome.

use super::{
    super::{numbers::Refusals, status::CallError},
    turns::Full,
};
use mazeway_serving::telemetry::{Telemetry, numbers::Times};
use prometheus_client::{
    encoding::EncodeLabelSet,
    metrics::family::{Family, MetricConstructor},
};
use std::time::Duration;

/// Which fits.
#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct Label {
    method: &'static str,
    outcome: &'static str,
}

#[derive(Debug, Clone, Copy, Default)]
struct OfFits;

impl MetricConstructor<Times> for OfFits {
    fn new_metric(&self) -> Times {
        Times::of_fits()
    }
}

/// How waiting for a turn ended.
#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct WaitLabel {
    outcome: &'static str,
}

/// The turn came.
pub const BEGUN: &str = "begun";
/// The caller went before.
pub const CANCELLED: &str = "cancelled";
/// The service was told to stop before.
pub const STOPPED: &str = "stopped";

/// What is counted of fits. Cloning shares it.
#[derive(Debug, Clone)]
pub struct Fits {
    took: Family<Label, Times, OfFits>,
    waited: Family<WaitLabel, Times, OfFits>,
    refused: Refusals,
}

impl Fits {
    /// Shows them.
    pub fn new(telemetry: &Telemetry) -> Self {
        let fits = Self {
            took: Family::new_with_constructor(OfFits),
            waited: Family::new_with_constructor(OfFits),
            refused: Refusals::of_fits(telemetry),
        };
        for outcome in [BEGUN, CANCELLED, STOPPED] {
            drop(fits.waited.get_or_create(&WaitLabel { outcome }));
        }
        let help = "Time of a fit from its begin to its end, by method and outcome";
        telemetry.add("fit_seconds", help, fits.took.clone());
        let help = "Time of a fit in the queue, by how its wait ended";
        telemetry.add("fit_wait_seconds", help, fits.waited.clone());
        fits
    }

    /// One was refused for what it asked.
    pub fn refuses(&self, error: &CallError) {
        self.refused.count(error);
    }

    /// One found no place in the queue.
    pub fn finds_no_place(&self, full: Full) {
        self.refused.because(match full {
            Full::Queue { .. } => "queue_full",
            Full::Share { .. } => "share",
            Full::Quota { .. } => "quota",
        });
    }

    /// One waits no more.
    pub fn waited(&self, outcome: &'static str, time: Duration) {
        self.waited.get_or_create(&WaitLabel { outcome }).observe(time);
    }

    /// One has ended.
    pub fn ended<T>(&self, method: &'static str, outcome: &Result<T, CallError>, took: Duration) {
        let outcome = match outcome {
            Ok(_) => "fitted",
            Err(CallError::Cancelled) => CANCELLED,
            Err(CallError::ShuttingDown) => STOPPED,
            Err(CallError::Internal(_) | CallError::Store(_)) => "failed",
            Err(_) => "refused",
        };
        self.took.get_or_create(&Label { method, outcome }).observe(took);
    }
}
