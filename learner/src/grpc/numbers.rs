//! What was refused, counted by reason.

use super::status::CallError;
use crate::store::StoreError;
use mazeway_serving::telemetry::{Telemetry, numbers::Counter};
use prometheus_client::{encoding::EncodeLabelSet, metrics::family::Family};
use tonic::Code;

/// Why.
#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct Reason {
    reason: &'static str,
}

/// Requests that were refused. Cloning shares it. Invariant: every reason that there is is shown from the beginning, so that
/// the first refusal is an increase.
#[derive(Debug, Clone)]
pub struct Refusals(Family<Reason, Counter>);

impl Refusals {
    /// Of the requests of recording streams.
    pub fn of_recordings(telemetry: &Telemetry) -> Self {
        let help = "Requests to record that were refused, by reason";
        let reasons = ["request", "limit", "exists", "quota", "store_full", "disk_full", "failed"];
        Self::shown(telemetry, "recordings_refused", help, &reasons)
    }

    /// Of models that were sent.
    pub fn of_models(telemetry: &Telemetry) -> Self {
        let help = "Models that were sent and refused, by reason";
        let reasons =
            ["request", "limit", "exists", "quota", "store_full", "disk_full", "failed", "queue_full", "slow"];
        Self::shown(telemetry, "models_refused", help, &reasons)
    }

    /// Of fits, before they had a place in the queue.
    pub fn of_fits(telemetry: &Telemetry) -> Self {
        let help = "Fits that were refused before they waited, by reason";
        Self::shown(telemetry, "fits_refused", help, &["request", "limit", "queue_full", "share", "quota"])
    }

    fn shown(telemetry: &Telemetry, name: &str, help: &str, reasons: &[&'static str]) -> Self {
        let refusals = Self(Family::default());
        for reason in reasons {
            drop(refusals.0.get_or_create(&Reason { reason }));
        }
        telemetry.add(name, help, refusals.0.clone());
        refusals
    }

    /// One was refused, if that is what the error is: whoever goes, or is told that the service stops, is not.
    pub fn count(&self, error: &CallError) {
        if let Some(reason) = reason(error) {
            self.because(reason);
        }
    }

    /// One was refused.
    pub fn because(&self, reason: &'static str) {
        self.0.get_or_create(&Reason { reason }).add(1);
    }
}

fn reason(error: &CallError) -> Option<&'static str> {
    Some(match error {
        CallError::Field(_) | CallError::NotFound { .. } | CallError::Precondition { .. } => "request",
        CallError::Limit { .. } => "limit",
        CallError::Full { .. } => "queue_full",
        CallError::Slow { .. } => "slow",
        CallError::Transport(status) if status.code() == Code::ResourceExhausted => "limit",
        CallError::Store(error) => match error {
            StoreError::TrajectoryExists { .. } | StoreError::ModelExists { .. } => "exists",
            StoreError::AllowanceSpent { .. } => "quota",
            StoreError::QuotaReached { .. } => "store_full",
            StoreError::DiskFull { .. } => "disk_full",
            _ => "failed",
        },
        CallError::Internal(_) => "failed",
        CallError::Transport(_) | CallError::Cancelled | CallError::ShuttingDown => return None,
    })
}
