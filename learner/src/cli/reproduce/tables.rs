//! The tables of `learner reproduce`, as the documentation quotes them.

use crate::cli::table::table;
use mazeway_learner::{
    eval::{self, Interval},
    report::{DriverMetrics, Report, Transfer},
};

/// A row of [`maze`].
pub fn maze_row(method: &str, report: &Report) -> [String; 5] {
    let optional = |value: Option<f64>| value.map_or_else(|| "–".to_owned(), |value| format!("{value:.3}"));
    [
        method.to_owned(),
        format!("{:.3}", report.agreement),
        optional(report.expected_value_difference),
        report.iterations.to_string(),
        format!("{:.1} ms", report.fit_secs * 1e3),
    ]
}

/// Methods on the maze.
pub fn maze(rows: &[[String; 5]]) -> String {
    table(["method", "#agreement", "#EVD", "#iterations", "#time of the fit"], rows.to_vec()) + "\n"
}

/// A column: its title, and what it shows of a driver.
type Event = (&'static str, fn(&DriverMetrics) -> Interval);

const EVENTS: [Event; 4] = [
    ("speed, m/s", |m| m.speed_mps),
    ("collisions a step", |m| m.collisions),
    ("overtakes left", |m| m.overtakes_left),
    ("overtakes right", |m| m.overtakes_right),
];

fn interval(value: Interval, decimals: usize) -> String {
    let half = f64::midpoint(value.high - value.mean, value.mean - value.low);
    if half.is_finite() {
        format!("{:.decimals$} ± {half:.decimals$}", value.mean)
    } else {
        format!("{:.decimals$}", value.mean)
    }
}

fn metrics(metrics: &DriverMetrics) -> [String; 4] {
    [0, 1, 2, 3].map(|i| interval((EVENTS[i].1)(metrics), if i == 0 { 2 } else { 4 }))
}

/// One style: the expert, what each method learned, and a random driver.
pub fn drivers(style: &str, reports: &[(&str, Report)]) -> String {
    let mut rows = Vec::new();
    let mut row = |name: &str, agreement: String, driver: &DriverMetrics| {
        let [speed, collisions, left, right] = metrics(driver);
        rows.push([name.to_owned(), agreement, speed, collisions, left, right]);
    };
    let drivers = reports.first().and_then(|(_, report)| report.drivers);
    if let Some(expert) = drivers.and_then(|drivers| drivers.expert) {
        row("expert", String::new(), &expert);
    }
    for (method, report) in reports {
        if let Some(drivers) = &report.drivers {
            let unseen = report.agreement_held_out.unwrap_or(report.agreement);
            row(method, format!("{unseen:.3}"), &drivers.learned);
        }
    }
    if let Some(drivers) = &drivers {
        row("random", String::new(), &drivers.random);
    }
    let names = EVENTS.map(|(name, _)| format!("#{name}"));
    let header = [style, "#takes the expert's action (unseen)", &names[0], &names[1], &names[2], &names[3]];
    table(header, rows) + "\n"
}

/// Correlation of the learned weights with the visits and with the true reward.
pub fn counts(rows: &[(&str, Report)]) -> String {
    let mut methods: Vec<&str> = rows.iter().map(|(method, _)| *method).collect();
    methods.dedup();
    let of = |method: &str, other: fn(&Report) -> Option<Vec<f64>>| {
        let values: Vec<f64> = rows
            .iter()
            .filter(|(name, _)| *name == method)
            .filter_map(|(_, report)| correlation(&learned(report), &other(report)?))
            .collect();
        eval::mean_interval(&values).map_or_else(|| "–".to_owned(), |value| interval(value, 3))
    };
    let table = table(
        ["weights of", "#correlation with visits", "#correlation with the true reward"],
        methods.iter().map(|method| {
            [
                (*method).to_owned(),
                of(method, |report| Some(report.state_visits.clone())),
                of(method, |report| {
                    let n = report.n_actions as usize;
                    let reward = report.true_reward.as_ref()?;
                    Some(reward.chunks(n).map(|row| row.iter().sum::<f64>() / n as f64).collect())
                }),
            ]
        }),
    );
    format!("Counts against rewards: 100 demonstrations of the maze\n{table}\n")
}

/// R(s), the mean over actions.
fn learned(report: &Report) -> Vec<f64> {
    let n = report.n_actions as usize;
    report.reward.chunks(n).map(|row| row.iter().sum::<f64>() / n as f64).collect()
}

/// Pearson's; `None` where one of them does not vary.
fn correlation(x: &[f64], y: &[f64]) -> Option<f64> {
    let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
    let (mx, my) = (mean(x), mean(y));
    let sum = |f: fn(f64, f64) -> f64| x.iter().zip(y).map(|(a, b)| f(a - mx, b - my)).sum::<f64>();
    let (xy, xx, yy) = (sum(|a, b| a * b), sum(|a, _| a * a), sum(|_, b| b * b));
    (x.len() == y.len() && xx > 0.0 && yy > 0.0).then(|| xy / (xx * yy).sqrt())
}

/// Ways to act in another maze, over seeds.
pub fn mazes_transferred(title: &str, transfers: &[Transfer]) -> String {
    let Some(first) = transfers.first() else { return String::new() };
    let rows = first.rows.iter().enumerate().map(|(i, row)| {
        let of = |value: &dyn Fn(&mazeway_learner::report::TransferRow) -> Option<f64>| {
            let values: Vec<f64> = transfers.iter().filter_map(|transfer| value(transfer.rows.get(i)?)).collect();
            eval::mean_interval(&values).map_or_else(|| "–".to_owned(), |value| interval(value, 3))
        };
        [row.name.clone(), of(&|row| row.agreement), of(&|row| row.expected_value_difference)]
    });
    let table = table(["acting on", "#agreement there", "#EVD there"], rows);
    format!("{title}, {} seeds\n{table}\n", transfers.len())
}

/// Ways to drive in denser traffic.
pub fn highway_transferred(style: &str, transfer: &Transfer) -> String {
    let names = EVENTS.map(|(name, _)| format!("#{name}"));
    let rows = transfer.rows.iter().filter_map(|row| {
        let [speed, collisions, left, right] = metrics(row.metrics.as_ref()?);
        Some([row.name.clone(), speed, collisions, left, right])
    });
    let table = table([style, &names[0], &names[1], &names[2], &names[3]], rows);
    format!("{}, learned with the default density\n{table}\n", transfer.target)
}

#[cfg(test)]
mod tests {
    use super::correlation;

    #[test]
    fn correlations() {
        assert!((correlation(&[1.0, 2.0, 3.0], &[2.0, 4.0, 6.0]).expect("a number") - 1.0).abs() < 1e-12);
        assert!((correlation(&[1.0, 2.0, 3.0], &[3.0, 2.0, 1.0]).expect("a number") + 1.0).abs() < 1e-12);
        assert_eq!(correlation(&[1.0, 1.0], &[0.0, 2.0]), None);
    }
}
