//! Rounds, medians, the report and its tables.

use crate::Mode;
use clap::ValueEnum as _;
use serde_json::{Value, json};
use std::{
    fmt::Write as _,
    time::{Duration, Instant},
};

/// Time of a figure in a round.
pub const SLICE: Duration = Duration::from_millis(60);

/// Median and quartiles of the rounds.
#[derive(Debug, Clone, Copy)]
pub struct Spread {
    median: f64,
    low: f64,
    high: f64,
}

impl Spread {
    fn of(mut values: Vec<f64>) -> Self {
        values.sort_by(f64::total_cmp);
        let at = |share: f64| values[((values.len() - 1) as f64 * share).round() as usize];
        Self { median: at(0.5), low: at(0.25), high: at(0.75) }
    }

    pub fn median(self) -> f64 {
        self.median
    }

    /// The same as a rate of `units` in each of these times, µs.
    pub fn rate(self, units: u32) -> Self {
        let rate = |us: f64| f64::from(units) * 1e6 / us;
        Self { median: rate(self.median), low: rate(self.high), high: rate(self.low) }
    }

    fn write(self, record: &mut Value) {
        (record["median"], record["low"], record["high"]) = (self.median.into(), self.low.into(), self.high.into());
    }
}

/// Something that is done a number of times.
pub struct Subject<'a> {
    pub name: &'static str,
    run: Box<dyn FnMut(u64) + 'a>,
}

impl<'a> Subject<'a> {
    pub fn new(name: &'static str, run: impl FnMut(u64) + 'a) -> Self {
        Self { name, run: Box::new(run) }
    }

    fn timed(&mut self, times: u64) -> Duration {
        let begun = Instant::now();
        (self.run)(times);
        begun.elapsed()
    }
}

/// µs that each subject takes for one time, measured in turn.
pub fn in_rounds(subjects: &mut [Subject], rounds: usize, slice: Duration) -> Vec<Spread> {
    let times: Vec<u64> = subjects
        .iter_mut()
        .map(|subject| {
            // Doubled until it is long enough to tell how many times fit.
            let mut times = 1;
            loop {
                let took = subject.timed(times);
                if took * 4 > slice {
                    let fit = slice.as_secs_f64() / took.as_secs_f64() * times as f64;
                    return (fit as u64).max(1);
                }
                times *= 2;
            }
        })
        .collect();
    let mut us = vec![Vec::new(); subjects.len()];
    for _ in 0..rounds {
        for ((subject, us), &times) in subjects.iter_mut().zip(&mut us).zip(&times) {
            us.push(subject.timed(times).as_secs_f64() * 1e6 / times as f64);
        }
    }
    us.into_iter().map(Spread::of).collect()
}

/// All figures, as the object that `--json` writes.
pub struct Report(Value);

const LISTS: [&str; 8] = ["round_trips", "pipelined", "batches", "rollouts", "ratios", "memory", "scale", "watching"];

/// What is promised of one figure over another.
const LIMITS: [(&str, &str, Option<f64>); 6] = [
    ("env_step_tcp", "tonic_bidi_tcp", Some(1.25)),
    ("env_step_tcp", "raw_tcp", Some(2.2)),
    ("env_step_unix", "tonic_bidi_unix", Some(1.25)),
    ("env_step_unix", "raw_unix", None),
    ("env_step_tcp_multi_thread", "env_step_tcp", None),
    ("tonic_bidi_tcp_multi_thread", "tonic_bidi_tcp", None),
];

impl Report {
    pub fn new(rounds: usize) -> Self {
        let info = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
        let cpu = info.lines().find_map(|line| line.strip_prefix("model name")?.split_once(": ")).map(|(_, name)| name);
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let mut object = json!({"benchmark": "wire", "cores": cores, "cpu": cpu, "rounds": rounds});
        for list in LISTS {
            object[list] = json!([]);
        }
        Self(object)
    }

    pub fn push(&mut self, list: &str, mut record: Value, spread: Spread) {
        spread.write(&mut record);
        self.push_plain(list, record);
    }

    pub fn push_plain(&mut self, list: &str, record: Value) {
        self.0[list].as_array_mut().expect("a list").push(record);
    }

    /// Takes the figures of another report in.
    pub fn merge(&mut self, json: &str) {
        let mut other: Value = serde_json::from_str(json).expect("the object that another process printed");
        for list in LISTS {
            let records = other[list].as_array_mut().map(std::mem::take).unwrap_or_default();
            for record in records {
                self.push_plain(list, record);
            }
        }
    }

    fn list(&self, list: &str) -> impl Iterator<Item = &Value> {
        self.0[list].as_array().into_iter().flatten()
    }

    fn median(&self, list: &str, fields: &[(&str, &Value)]) -> Option<f64> {
        self.list(list).find(|record| fields.iter().all(|(key, value)| record[*key] == **value))?["median"].as_f64()
    }

    /// Compares what was measured with what is promised.
    pub fn add_ratios(&mut self) {
        let mut ratios = Vec::new();
        let mut push = |mode: &Value, name: String, value: f64, limit: Option<f64>| {
            let met = limit.map(|limit| value <= limit);
            ratios.push(json!({"mode": mode, "name": name, "value": value, "limit": limit, "met": met}));
        };
        for mode in Mode::value_variants() {
            let mode = json!(mode_name(*mode));
            for (of, over, limit) in LIMITS {
                let median = |name: &str| self.median("round_trips", &[("mode", &mode), ("name", &json!(name))]);
                if let (Some(of_us), Some(over_us)) = (median(of), median(over)) {
                    push(&mode, format!("{of} / {over}"), of_us / over_us, limit);
                }
            }
            for record in self.list("batches").filter(|r| r["mode"] == mode && r["name"] == "tonic_bidi_echo") {
                let (env, num_envs, ours) = (&record["env"], &record["num_envs"], json!("vector_env_step"));
                let same = [("mode", &mode), ("env", env), ("num_envs", num_envs), ("name", &ours)];
                if let (Some(ours), Some(echo)) = (self.median("batches", &same), record["median"].as_f64()) {
                    let env = env.as_str().unwrap_or_default();
                    push(&mode, format!("{env} x {num_envs}: echo / vector_env_step"), echo / ours, None);
                }
            }
            for record in self.list("watching").filter(|r| r["mode"] == mode && r["name"] == "unwatched") {
                let (env, watched) = (&record["env"], json!("watched"));
                let watched = self.median("watching", &[("mode", &mode), ("env", env), ("name", &watched)]);
                if let (Some(watched), Some(unwatched)) = (watched, record["median"].as_f64()) {
                    let name = format!("{}: watched / unwatched", env.as_str().unwrap_or_default());
                    push(&mode, name, watched / unwatched, None);
                }
            }
        }
        self.0["ratios"] = ratios.into();
    }

    pub fn to_json(&self) -> String {
        self.0.to_string()
    }

    pub fn tables(&self) -> String {
        let mut out = format!("{}, {} cores\n", self.0["cpu"].as_str().unwrap_or("unknown processor"), self.0["cores"]);
        let text = |value: &Value| value.as_str().map_or_else(|| value.to_string(), str::to_owned);
        let mut table = |list: &str, title: &str, columns: &[&str]| {
            if self.list(list).next().is_none() {
                return;
            }
            let _ = writeln!(out, "\n{title}\n\n| {} |\n|{}", columns.join(" | "), "---|".repeat(columns.len()));
            for record in self.list(list) {
                let cells = columns.iter().map(|column| match &record[*column] {
                    Value::Number(number) => readable(number.as_f64().unwrap_or(f64::NAN)),
                    Value::Null => "–".into(),
                    Value::Bool(flag) => if *flag { "yes" } else { "no" }.into(),
                    other => text(other),
                });
                let _ = writeln!(out, "| {} |", cells.collect::<Vec<_>>().join(" | "));
            }
        };
        table("round_trips", "Round trip of one step, µs", &["mode", "name", "median", "low", "high"]);
        table("pipelined", "Steps a second, sent ahead", &["mode", "name", "in_flight", "median", "low", "high"]);
        let batch = ["mode", "env", "num_envs", "name", "median", "low", "high"];
        table("batches", "Steps a second of a batch", &batch);
        let rollout = ["mode", "env", "controller", "median", "low", "high", "promised", "met"];
        table("rollouts", "Steps a second of a roll-out", &rollout);
        table("ratios", "Ratios", &["mode", "name", "value", "limit", "met"]);
        table("memory", "Memory of the server, bytes", &["name", "env", "count", "bytes", "limit", "met"]);
        let watching = ["mode", "env", "name", "median", "low", "high", "pictures"];
        table("watching", "Round trip of one step with and without viewers, µs", &watching);
        table("scale", "Steps a second of many sessions together", &["sessions", "name", "median", "low", "high"]);
        out
    }
}

pub fn mode_name(mode: Mode) -> String {
    mode.to_possible_value().expect("a name").get_name().to_owned()
}

/// Three digits or all those before the point, in groups.
fn readable(number: f64) -> String {
    if number.abs() < 100.0 {
        let digits = if number.fract() == 0.0 { 0 } else { 2 };
        return format!("{number:.digits$}");
    }
    let plain = format!("{number:.0}");
    let mut out = String::new();
    for (rank, digit) in plain.chars().enumerate() {
        if rank > 0 && (plain.len() - rank).is_multiple_of(3) {
            out.push(',');
        }
        out.push(digit);
    }
    out
}
