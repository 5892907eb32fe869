//! Reports for the tests: the maze with the reference numbers, the highway and another process with plausible ones.

use super::{DriverMetrics, Drivers, Evaluation, GridLayout, Interval, Report, Source};
use crate::irl::{BasisKind, FitOptions, Stopped, TraceEntry};
use serde_json::Value;

fn reference(text: &str) -> Value {
    serde_json::from_str(text).expect("reference data are JSON")
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().expect("an array").iter().map(|x| x.as_f64().expect("a number")).collect()
}

fn index(value: &Value) -> usize {
    value.as_u64().expect("an index") as usize
}

fn trace(n: u32, scale: f64) -> Vec<TraceEntry> {
    (1..=n)
        .map(|iteration| {
            let k = f64::from(iteration);
            TraceEntry {
                iteration,
                objective: -0.41 - scale * (-0.22 * k).exp() - 0.02 * scale / k,
                change: scale * (-0.31 * k).exp() * (1.2 + (k * 1.7).sin()),
                elapsed_secs: 0.004 * k,
            }
        })
        .collect()
}

/// Greedy policy on `q`, ties split evenly.
fn greedy(q: &[f64], n_actions: usize) -> Vec<f64> {
    q.chunks(n_actions)
        .flat_map(|row| {
            let best = row.iter().copied().fold(f64::MIN, f64::max);
            let ties = row.iter().filter(|&&x| best - x < 1e-9).count() as f64;
            row.iter().map(move |&x| if best - x < 1e-9 { 1.0 / ties } else { 0.0 }).collect::<Vec<_>>()
        })
        .collect()
}

/// A report without a layout and with little in it.
pub(crate) fn plain(n_states: usize, n_actions: usize) -> Report {
    let pairs = n_states * n_actions;
    let reward: Vec<f64> = (0..pairs).map(|i| ((i * 37) % 101) as f64 / 101.0).collect();
    Report {
        env_id: "Custom-v0".into(),
        style: "mine".into(),
        method: "em".into(),
        options: FitOptions::default(),
        seed: 7,
        model_id: "5b0c".repeat(16),
        fit_id: "6d0d2a0e-0c55-4c1c-9d3c-3f1b4b1a5a10".into(),
        n_states: n_states as u32,
        n_actions: n_actions as u32,
        state_labels: vec![],
        action_labels: vec![],
        trajectories: 12,
        steps: 240,
        horizon: 20,
        sources: vec![Source { name: "import".into(), trajectories: 12 }],
        state_visits: (0..n_states).map(|s| if s % 5 == 4 { 0.0 } else { ((s * 13) % 29) as f64 }).collect(),
        states_covered: n_states as u32 / 2,
        weights: Vec::new(),
        weight_names: Vec::new(),
        uncertainty: None,
        hyperparameters: Vec::new(),
        policy: (0..pairs).map(|_| 1.0 / n_actions as f64).collect(),
        greedy_policy: greedy(&reward, n_actions),
        reward,
        state_values: (0..n_states).map(|s| (s % 17) as f64 / 3.0).collect(),
        trace: trace(14, 2.0),
        stopped: Stopped::Converged,
        iterations: 14,
        fit_secs: 0.031,
        total_secs: 0.4,
        warnings: vec![],
        agreement: 0.81,
        agreement_held_out: None,
        log_likelihood_per_step: -0.72,
        log_likelihood_per_step_held_out: None,
        drivers: None,
        evaluation: None,
        expected_value_difference: None,
        true_reward: None,
        optimal_policy: None,
        validation: None,
        transfer: None,
        grid: None,
        frame_png: None,
        features: Vec::new(),
        commands: vec!["learner fit --env Custom-v0 --method em --seed 7".into()],
    }
}

/// `Maze-v0` with the reference weights of `em` and the reference optimum.
pub(crate) fn maze() -> Report {
    let model = reference(include_str!("../../../tests/data/maze_model.json"));
    let fits = reference(include_str!("../../../tests/data/maze_fits.json"));
    let demonstrations = reference(include_str!("../../../tests/data/maze_demonstrations.json"));
    let (s, a) = (57, 4);
    let mut report = plain(s, a);
    let cells = model["cells"].as_array().expect("cells");
    let mut true_reward = vec![0.0; s];
    for state in model["rewarded_states"].as_array().expect("states") {
        true_reward[index(state)] = 1.0;
    }
    let mut optimal = vec![0.0; s * a];
    for (state, best) in model["optimal_actions"].as_array().expect("actions").iter().enumerate() {
        let best = best.as_array().expect("actions");
        for action in best {
            optimal[state * a + index(action)] = 1.0 / best.len() as f64;
        }
    }
    let mut visits = vec![0.0; s];
    for state in
        demonstrations["states"].as_array().expect("rows").iter().flat_map(|row| row.as_array().expect("a row"))
    {
        visits[index(state)] += 1.0;
    }
    let weights = numbers(&fits["cases"][0]["weights"]);
    let reward: Vec<f64> = weights.iter().flat_map(|&w| [w; 4]).collect();

    // The learned policy, planned here by plain value iteration on the reference transitions.
    let mut values = vec![0.0; s];
    let mut q = vec![0.0; s * a];
    for _ in 0..400 {
        q.copy_from_slice(&reward);
        for row in model["transition"].as_array().expect("rows") {
            let row = numbers(row);
            q[row[0] as usize * a + row[1] as usize] += 0.9 * row[3] * values[row[2] as usize];
        }
        values = q.chunks(a).map(|row| row.iter().copied().fold(f64::MIN, f64::max)).collect();
    }
    report.env_id = "Maze-v0".into();
    report.style = "optimal".into();
    report.state_labels = cells.iter().map(|cell| format!("row {}, column {}", cell[0], cell[1])).collect();
    report.action_labels = ["north", "south", "east", "west"].map(str::to_owned).to_vec();
    report.trajectories = 20;
    report.horizon = 50;
    report.steps = 1000;
    report.states_covered = visits.iter().filter(|&&n| n > 0.0).count() as u32;
    report.state_visits = visits;
    report.greedy_policy = greedy(&q, a);
    report.policy = report.greedy_policy.clone();
    report.reward = reward;
    report.state_values = values;
    report.agreement = 44.0 / 57.0;
    report.expected_value_difference = Some(0.3127);
    report.true_reward = Some(true_reward);
    report.optimal_policy = Some(optimal);
    report.sources = vec![Source { name: "driver:optimal".into(), trajectories: 20 }];
    report.grid = Some(GridLayout {
        rows: 9,
        columns: 9,
        cells: cells.iter().map(|cell| (index(&cell[0]) * 9 + index(&cell[1])) as u32).collect(),
    });
    report.commands = vec!["learner fit --env Maze-v0 --method em --trajectories 20 --seed 7".into()];
    report
}

/// `Highway-v0`, aggressive, with numbers of the right size.
pub(crate) fn highway() -> Report {
    let (s, a) = (36, 12);
    let mut report = plain(s, a);
    let mut reward = vec![0.0; s * a];
    let mut visits = vec![0.0; s];
    for lane in 0..3 {
        for speed in 0..4 {
            for traffic in 0..3 {
                let state = (lane * 4 + speed) * 3 + traffic;
                let seen = [[230.0, 74.0, 31.0], [61.0, 96.0, 42.0], [18.0, 7.0, 4.0]][traffic][2 - lane];
                visits[state] = f64::floor(
                    seen * [0.06, 0.2, 0.35, 1.0][speed] * if traffic == 2 && speed == 3 { 0.2 } else { 1.0 },
                );
                let best = match traffic {
                    0 => 3,
                    1 if lane < 2 => 4 + 3,
                    1 => 8 + 3,
                    _ => 0,
                };
                if visits[state] > 0.0 {
                    reward[state * a + best] = 0.4 + 0.9 * (visits[state] / 230.0).sqrt();
                    reward[state * a + (best + 11) % 12] = 0.05;
                }
            }
        }
    }
    let round = |x: f64| (x * 1e4).round() / 1e4;
    let interval = |mean: f64, half: f64| Interval { mean, low: round(mean - half), high: round(mean + half) };
    let metrics = |speed: f64, collisions: f64, left: f64, right: f64| DriverMetrics {
        speed_mps: interval(speed, 0.11),
        collisions: interval(collisions, 0.0008 + 0.1 * collisions),
        overtakes_left: interval(left, 0.006),
        overtakes_right: interval(right, 0.0009 + 0.05 * right),
    };
    report.env_id = "Highway-v0".into();
    report.style = "aggressive".into();
    report.method = "em-tied".into();
    report.options.basis = BasisKind::StateAction;
    report.trajectories = 200;
    report.horizon = 5;
    report.steps = 1000;
    report.state_labels = (0..s)
        .map(|i| {
            let traffic = ["clear", "passable", "boxed in"][i % 3];
            format!("lane {}, {} m/s, {traffic}", i / 12, [20, 25, 30, 35][i / 3 % 4])
        })
        .collect();
    report.action_labels =
        (0..a).map(|i| format!("{}, {} m/s", ["keep", "left", "right"][i / 4], [20, 25, 30, 35][i % 4])).collect();
    report.states_covered = visits.iter().filter(|&&n| n > 0.0).count() as u32;
    report.state_visits = visits;
    report.greedy_policy = greedy(&reward, a);
    report.policy = report.greedy_policy.iter().map(|p| 0.9 * p + 0.1 / 12.0).collect();
    report.state_values = reward.chunks(a).map(|row| 2.0 + 3.1 * row.iter().copied().fold(0.0, f64::max)).collect();
    report.reward = reward;
    report.trace = trace(46, 1.4);
    report.iterations = 46;
    report.fit_secs = 0.18;
    report.total_secs = 6.42;
    report.agreement = 0.991;
    report.agreement_held_out = Some(0.978);
    report.log_likelihood_per_step = -0.231;
    report.log_likelihood_per_step_held_out = Some(-0.262);
    report.drivers = Some(Drivers {
        expert: Some(metrics(33.92, 0.0068, 0.149, 0.112)),
        learned: metrics(33.41, 0.031, 0.131, 0.104),
        random: metrics(26.74, 0.061, 0.058, 0.047),
    });
    report.evaluation = Some(Evaluation { episodes: 50, steps: 200, seed: 7 });
    report.warnings = vec!["5 of 36 states were never visited: their reward is what the penalty leaves".into()];
    report.sources = vec![Source { name: "driver:aggressive".into(), trajectories: 200 }];
    report.frame_png = Some(super::pictures::png(FRAME).expect("the frame is drawn"));
    report.commands =
        vec!["learner fit --style aggressive --method em-tied --seed 7".into(), "learner show 6d0d2a0e".into()];
    report
}

const FRAME: &str = r##"<svg xmlns="http://www.w3.org/2000/svg" width="600" height="120" viewBox="0 0 600 120">
<rect width="600" height="120" fill="#4a525e"/><path d="M0 40H600M0 80H600" stroke="#fff" stroke-dasharray="14 12"/>
<rect x="200" y="50" width="44" height="20" rx="4" fill="#ffb000"/><rect x="420" y="10" width="44" height="20" rx="4" fill="#d6dbe3"/>
<text x="8" y="112" font-family="sans-serif" font-size="12" fill="#fff">35 m/s</text></svg>"##;
