//! The object that `--json` prints: one line, its keys in a fixed order, for programs.
//!
//! Invariant: every number is finite; what is not known or not finite is `null`, so that a strict parser reads it.

use super::uncertainty::UncertaintySource;
use super::{DriverMetrics, Drivers, Interval, Report};
use serde::{Serialize, Serializer};
use std::path::Path;

/// The object as text, without a final newline. `report` is the path of `report.html`.
///
/// Keys: `env, style, method, trajectories, horizon, drivers, agreement, states_covered, stopped, iterations, fit_secs,
/// total_secs, report`, and, where there are any, `uncertainty`, `hyperparameters`, `validation`, `transfer` and
/// `features`; where no driver is rolled out (a maze) `expected_value_difference` stands in place of `drivers`.
pub fn to_string(report: &Report, path: Option<&Path>) -> String {
    serde_json::to_string(&Summary::new(report, path)).expect("plain structs of numbers and text serialise")
}

/// Order of the fields is the order of the keys.
#[derive(Serialize)]
struct Summary<'a> {
    env: &'a str,
    style: &'a str,
    method: &'a str,
    trajectories: u64,
    horizon: u32,
    #[serde(flatten)]
    evaluation: Evaluation,
    agreement: Finite,
    states_covered: u32,
    stopped: crate::irl::Stopped,
    iterations: u32,
    fit_secs: Finite,
    total_secs: Finite,
    report: Option<String>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    features: Vec<FeatureJson<'a>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    uncertainty: Option<UncertaintyJson<'a>>,
    #[serde(skip_serializing_if = "<[_]>::is_empty")]
    hyperparameters: &'a [crate::irl::Hyperparameter],
    // What is not finite becomes null: the ends of an interval over one trajectory.
    #[serde(skip_serializing_if = "Option::is_none")]
    validation: Option<&'a crate::eval::validation::Validation>,
    #[serde(skip_serializing_if = "Option::is_none")]
    transfer: Option<TransferJson<'a>>,
}

/// A feature's weight, and how much of it there is a step.
#[derive(Serialize)]
struct FeatureJson<'a> {
    name: &'a str,
    weight: IntervalJson,
    demonstrated: Finite,
    learned: Finite,
    random: Finite,
}

/// An infinite standard deviation and the ends of its interval are null.
#[derive(Serialize)]
struct UncertaintyJson<'a> {
    source: &'static str,
    weights: &'a [f64],
    standard_deviations: &'a [f64],
    low: &'a [f64],
    high: &'a [f64],
    #[serde(skip_serializing_if = "Option::is_none")]
    diagnostics: Option<&'a crate::irl::Diagnostics>,
}

#[derive(Serialize)]
struct TransferJson<'a> {
    target: &'a str,
    new_states: u64,
    rows: Vec<TransferRowJson<'a>>,
}

#[derive(Serialize)]
struct TransferRowJson<'a> {
    name: &'a str,
    agreement: Option<f64>,
    expected_value_difference: Option<f64>,
    metrics: Option<MetricsJson>,
}

impl<'a> Summary<'a> {
    fn new(report: &'a Report, path: Option<&Path>) -> Self {
        let driven = report.drivers.is_some() || report.is_highway();
        Self {
            env: &report.env_id,
            style: &report.style,
            method: &report.method,
            trajectories: report.trajectories,
            horizon: report.horizon,
            evaluation: if driven {
                Evaluation::Drivers(report.drivers.map(|drivers| Box::new(drivers.into())))
            } else {
                Evaluation::ExpectedValueDifference(Finite(report.expected_value_difference.unwrap_or(f64::NAN)))
            },
            agreement: Finite(report.agreement),
            states_covered: report.states_covered,
            stopped: report.stopped,
            iterations: report.iterations,
            fit_secs: Finite(report.fit_secs),
            total_secs: Finite(report.total_secs),
            report: path.map(|path| path.display().to_string()),
            features: report.features.iter().map(FeatureJson::new).collect(),
            uncertainty: report.uncertainty.as_ref().map(|uncertainty| UncertaintyJson {
                source: match uncertainty.source {
                    UncertaintySource::StandardErrors => "standard-errors",
                    UncertaintySource::Posterior => "posterior",
                },
                weights: &report.weights,
                standard_deviations: &uncertainty.standard_deviations,
                low: &uncertainty.low,
                high: &uncertainty.high,
                diagnostics: uncertainty.diagnostics.as_ref(),
            }),
            hyperparameters: &report.hyperparameters,
            validation: report.validation.as_ref(),
            transfer: report.transfer.as_ref().map(|transfer| TransferJson {
                target: &transfer.target,
                new_states: transfer.new_states,
                rows: transfer
                    .rows
                    .iter()
                    .map(|row| TransferRowJson {
                        name: &row.name,
                        agreement: row.agreement,
                        expected_value_difference: row.expected_value_difference,
                        metrics: row.metrics.map(Into::into),
                    })
                    .collect(),
            }),
        }
    }
}

impl<'a> FeatureJson<'a> {
    fn new(row: &'a super::FeatureRow) -> Self {
        Self {
            name: &row.name,
            weight: row.weight.into(),
            demonstrated: Finite(row.demonstrated),
            learned: Finite(row.learned),
            random: Finite(row.random),
        }
    }
}

/// How well the policy does: one key or the other.
#[derive(Serialize)]
#[serde(rename_all = "snake_case")]
enum Evaluation {
    Drivers(Option<Box<DriversJson>>),
    ExpectedValueDifference(Finite),
}

#[derive(Serialize)]
struct DriversJson {
    expert: Option<MetricsJson>,
    learned: MetricsJson,
    random: MetricsJson,
}

impl From<Drivers> for DriversJson {
    fn from(drivers: Drivers) -> Self {
        Self { expert: drivers.expert.map(Into::into), learned: drivers.learned.into(), random: drivers.random.into() }
    }
}

#[derive(Serialize)]
struct MetricsJson {
    speed_mps: IntervalJson,
    collisions: IntervalJson,
    overtakes_left: IntervalJson,
    overtakes_right: IntervalJson,
}

impl From<DriverMetrics> for MetricsJson {
    fn from(metrics: DriverMetrics) -> Self {
        Self {
            speed_mps: metrics.speed_mps.into(),
            collisions: metrics.collisions.into(),
            overtakes_left: metrics.overtakes_left.into(),
            overtakes_right: metrics.overtakes_right.into(),
        }
    }
}

#[derive(Serialize)]
struct IntervalJson {
    mean: Finite,
    low: Finite,
    high: Finite,
}

impl From<Interval> for IntervalJson {
    fn from(interval: Interval) -> Self {
        Self { mean: Finite(interval.mean), low: Finite(interval.low), high: Finite(interval.high) }
    }
}

/// A number, or `null` where it is none.
struct Finite(f64);

impl Serialize for Finite {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        if self.0.is_finite() { serializer.serialize_f64(self.0) } else { serializer.serialize_none() }
    }
}
