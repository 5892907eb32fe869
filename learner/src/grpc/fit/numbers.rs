//! Fits, counted and timed by method and outcome.

use super::super::status::CallError;
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

/// Fits that have ended.
#[derive(Debug, Clone)]
pub struct Fits(Family<Label, Times, OfFits>);

impl Fits {
    /// Shows them.
    pub fn new(telemetry: &Telemetry) -> Self {
        let fits = Self(Family::new_with_constructor(OfFits));
        telemetry.add("fit_seconds", "Time of a fit from its begin to its end, by method and outcome", fits.0.clone());
        fits
    }

    /// One has ended.
    pub fn ended<T>(&self, method: &'static str, outcome: &Result<T, CallError>, took: Duration) {
        let outcome = match outcome {
            Ok(_) => "fitted",
            Err(CallError::Cancelled) => "cancelled",
            Err(CallError::Internal(_) | CallError::Store(_)) => "failed",
            Err(_) => "refused",
        };
        self.0.get_or_create(&Label { method, outcome }).observe(took);
    }
}
