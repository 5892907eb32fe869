//! Methods compared on the same demonstrations: means over seeds, and differences to one of them seed by seed.
//!
//! A [`Cell`] is one fit. Cells of one seed saw the same demonstrations, those of fewer trajectories a part of them, so that
//! differences between methods are taken seed by seed: what a lucky seed gives to all of them cancels. Deliberately absent: how
//! the cells came about, and how they are shown.

use super::{Interval, mean_interval};
use serde::{Deserialize, Serialize};

/// One fit of a comparison.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Cell {
    /// Method, as it is named in the tables.
    pub method: String,
    /// Number of demonstrations L.
    pub trajectories: u32,
    /// Seed of the demonstrations.
    pub seed: u32,
    /// What came of it.
    pub outcome: Outcome,
}

/// What came of one fit.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Outcome {
    /// It is there.
    Fitted(Score),
    /// The method refused to fit, and said why.
    Refused(String),
}

/// What a fit is worth.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Score {
    /// Share of the states whose greedy action is optimal, ties split; where the true reward is not known, the share of the
    /// expert's steps that the fit did not see whose action the greedy policy takes.
    pub agreement: f64,
    /// Expected value difference; `None` where the true reward is not known.
    pub evd: Option<f64>,
    /// Mean log π(a|s), in nats, of the expert's steps that the fit did not see.
    pub log_likelihood: f64,
    /// Seconds of the fit on one core.
    pub fit_secs: f64,
}

/// One method at one number of demonstrations, over all seeds.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Row {
    /// Method.
    pub method: String,
    /// Number of demonstrations L.
    pub trajectories: u32,
    /// Seeds with a fit.
    pub seeds: u32,
    /// Mean of [`Score::agreement`]; `None` where the method refused every time.
    pub agreement: Option<Interval>,
    /// Mean of [`Score::evd`]; `None` where the true reward is not known or the method refused.
    pub evd: Option<Interval>,
    /// Median of [`Score::fit_secs`].
    pub fit_secs: Option<f64>,
    /// Mean of [`Score::log_likelihood`], where there is no expected value difference to judge by.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub log_likelihood: Option<Interval>,
    /// Why the method refused, where it did.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub refused: Option<String>,
}

/// A difference of means over paired seeds.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Difference {
    /// Mean of the method's number minus the baseline's.
    pub mean: f64,
    /// Lower end of its 95 % interval.
    pub low: f64,
    /// Upper end.
    pub high: f64,
    /// How the method compares.
    pub verdict: Verdict,
}

/// How a method compares with the baseline.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Verdict {
    /// The interval of the difference lies on the good side of zero.
    Better,
    /// It contains zero.
    Open,
    /// It lies on the bad side.
    Worse,
}

/// A method beside the baseline at one number of demonstrations.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Pair {
    /// Method.
    pub method: String,
    /// Number of demonstrations L.
    pub trajectories: u32,
    /// Seeds on which both have a fit.
    pub seeds: u32,
    /// Higher is better.
    pub agreement: Option<Difference>,
    /// Lower is better; `None` where the true reward is not known.
    pub evd: Option<Difference>,
    /// Higher is better; of the steps that the fits did not see.
    pub log_likelihood: Option<Difference>,
}

/// All methods at all numbers of demonstrations.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Comparison {
    /// The method that the others are held against.
    pub baseline: String,
    /// Methods in the order asked for, by rising numbers of demonstrations.
    pub rows: Vec<Row>,
    /// The same without the baseline.
    pub pairs: Vec<Pair>,
}

/// Differences below this are rounding, however sure they are.
const ROUNDING: f64 = 1e-9;

impl Difference {
    fn new(differences: &[f64], higher_is_better: bool) -> Option<Self> {
        let Interval { mean, low, high } = mean_interval(differences)?;
        let verdict = match (low > ROUNDING, high < -ROUNDING) {
            (true, _) if higher_is_better => Verdict::Better,
            (_, true) if !higher_is_better => Verdict::Better,
            (false, false) => Verdict::Open,
            _ => Verdict::Worse,
        };
        Some(Self { mean, low, high, verdict })
    }
}

impl Comparison {
    /// Puts the cells together. `methods` and `trajectories` say in which order; cells of others are left out.
    pub fn new(cells: &[Cell], methods: &[&str], trajectories: &[u32], baseline: &str) -> Self {
        let at = |method: &str, l: u32| -> Vec<&Cell> {
            let mut found: Vec<_> = cells.iter().filter(|c| c.method == method && c.trajectories == l).collect();
            found.sort_by_key(|cell| cell.seed);
            found
        };
        let grid = || methods.iter().flat_map(|&method| trajectories.iter().map(move |&l| (method, l)));
        Self {
            baseline: baseline.to_owned(),
            rows: grid().map(|(method, l)| row(method, l, &at(method, l))).collect(),
            pairs: grid()
                .filter(|&(method, _)| method != baseline)
                .map(|(method, l)| pair(method, l, &at(method, l), &at(baseline, l)))
                .collect(),
        }
    }

    /// The row of a method at a number of demonstrations.
    pub fn row(&self, method: &str, trajectories: u32) -> Option<&Row> {
        self.rows.iter().find(|row| row.method == method && row.trajectories == trajectories)
    }

    /// The pair of a method at a number of demonstrations.
    pub fn pair(&self, method: &str, trajectories: u32) -> Option<&Pair> {
        self.pairs.iter().find(|pair| pair.method == method && pair.trajectories == trajectories)
    }

    /// Where a method has a significantly higher agreement or lower expected value difference than the baseline, at `least` or
    /// more demonstrations.
    pub fn beaten(&self, least: u32) -> impl Iterator<Item = &Pair> {
        let better = |difference: Option<Difference>| difference.is_some_and(|d| d.verdict == Verdict::Better);
        self.pairs.iter().filter(move |pair| pair.trajectories >= least && (better(pair.agreement) || better(pair.evd)))
    }

    /// One line that says whether any method beats the baseline at `least` or more demonstrations.
    pub fn verdict(&self, least: u32) -> String {
        let baseline = &self.baseline;
        let compared = self.pairs.iter().filter(|pair| pair.trajectories >= least && pair.agreement.is_some()).count();
        if compared == 0 {
            return format!("nothing was compared with {baseline} at {least} or more demonstrations");
        }
        let known = self.rows.iter().any(|row| row.evd.is_some());
        let measures =
            if known { "a significantly higher agreement or lower EVD" } else { "a significantly higher agreement" };
        let tell = |name: &str, difference: Option<Difference>| {
            difference
                .filter(|d| d.verdict == Verdict::Better)
                .map(|d| format!("{name} {:+.3} [{:+.3}, {:+.3}]", d.mean, d.low, d.high))
        };
        let beaten: Vec<String> = self
            .beaten(least)
            .map(|pair| {
                let by: Vec<_> =
                    [tell("agreement", pair.agreement), tell("EVD", pair.evd)].into_iter().flatten().collect();
                format!("{} at L = {} ({})", pair.method, pair.trajectories, by.join(", "))
            })
            .collect();
        if beaten.is_empty() {
            format!("no method has {measures} than {baseline} at any L of {least} or more ({compared} pairs compared)")
        } else {
            format!(
                "{} of {compared} pairs at L of {least} or more have {measures} than {baseline}: {}",
                beaten.len(),
                beaten.join("; ")
            )
        }
    }
}

fn score(cell: &Cell) -> Option<&Score> {
    match &cell.outcome {
        Outcome::Fitted(score) => Some(score),
        Outcome::Refused(_) => None,
    }
}

fn row(method: &str, trajectories: u32, cells: &[&Cell]) -> Row {
    let scores: Vec<&Score> = cells.iter().filter_map(|cell| score(cell)).collect();
    let mean =
        |of: fn(&Score) -> Option<f64>| mean_interval(&scores.iter().filter_map(|score| of(score)).collect::<Vec<_>>());
    let evd = mean(|score| score.evd);
    Row {
        method: method.to_owned(),
        trajectories,
        seeds: scores.len() as u32,
        agreement: mean(|score| Some(score.agreement)),
        evd,
        fit_secs: median(scores.iter().map(|score| score.fit_secs).collect()),
        log_likelihood: if evd.is_none() { mean(|score| Some(score.log_likelihood)) } else { None },
        refused: cells.iter().find_map(|cell| match &cell.outcome {
            Outcome::Refused(reason) => Some(reason.clone()),
            Outcome::Fitted(_) => None,
        }),
    }
}

fn pair(method: &str, trajectories: u32, cells: &[&Cell], baseline: &[&Cell]) -> Pair {
    let both: Vec<(&Score, &Score)> = cells
        .iter()
        .filter_map(|cell| {
            let other = baseline.iter().find(|other| other.seed == cell.seed)?;
            Some((score(cell)?, score(other)?))
        })
        .collect();
    let differences = |of: fn(&Score) -> Option<f64>| -> Vec<f64> {
        both.iter().filter_map(|(method, baseline)| Some(of(method)? - of(baseline)?)).collect()
    };
    Pair {
        method: method.to_owned(),
        trajectories,
        seeds: both.len() as u32,
        agreement: Difference::new(&differences(|score| Some(score.agreement)), true),
        evd: Difference::new(&differences(|score| score.evd), false),
        log_likelihood: Difference::new(&differences(|score| Some(score.log_likelihood)), true),
    }
}

fn median(mut values: Vec<f64>) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    let middle = values.len() / 2;
    match values.len() {
        0 => None,
        n if n % 2 == 1 => Some(values[middle]),
        _ => Some(f64::midpoint(values[middle - 1], values[middle])),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cell(method: &str, seed: u32, agreement: f64, evd: f64) -> Cell {
        let score = Score { agreement, evd: Some(evd), log_likelihood: -1.0, fit_secs: f64::from(seed) };
        Cell { method: method.to_owned(), trajectories: 5, seed, outcome: Outcome::Fitted(score) }
    }

    /// Seeds differ by much, the methods on each seed by little.
    fn cells(gain: f64) -> Vec<Cell> {
        let noise = [0.001, -0.001, 0.002, -0.002];
        (0..4)
            .flat_map(|seed| {
                let luck = 0.2 * f64::from(seed);
                let wobble = noise[seed as usize];
                [cell("a", seed, luck, 1.0 - luck), cell("b", seed, luck + gain + wobble, 1.0 - luck - gain + wobble)]
            })
            .collect()
    }

    #[test]
    fn pairs_see_what_means_over_seeds_hide() {
        let comparison = Comparison::new(&cells(0.05), &["a", "b"], &[5], "a");
        let [a, b] = ["a", "b"].map(|method| comparison.row(method, 5).expect("a row").agreement.expect("a mean"));
        assert!(a.high > b.mean, "over seeds alone nothing is seen");
        let pair = comparison.pair("b", 5).expect("a pair");
        assert_eq!(pair.agreement.expect("a difference").verdict, Verdict::Better);
        assert_eq!(pair.evd.expect("a difference").verdict, Verdict::Better);
        assert_eq!(comparison.beaten(5).count(), 1);
        assert_eq!(comparison.beaten(6).count(), 0);
        assert!(comparison.verdict(5).starts_with("1 of 1 pairs"), "{}", comparison.verdict(5));
        let comparison = Comparison::new(&cells(-0.05), &["a", "b"], &[5], "a");
        let pair = comparison.pair("b", 5).expect("a pair");
        assert_eq!(pair.agreement.expect("a difference").verdict, Verdict::Worse);
        assert_eq!(pair.evd.expect("a difference").verdict, Verdict::Worse);
        let comparison = Comparison::new(&cells(0.0), &["a", "b"], &[5], "a");
        assert_eq!(comparison.pairs[0].agreement.expect("a difference").verdict, Verdict::Open);
        assert!(comparison.verdict(5).starts_with("no method has"), "{}", comparison.verdict(5));
    }

    #[test]
    fn a_refusal_is_told_and_counted_nowhere() {
        let mut cells = cells(0.0);
        cells[3].outcome = Outcome::Refused("too many states".to_owned());
        let comparison = Comparison::new(&cells, &["a", "b", "c"], &[5], "a");
        let b = comparison.row("b", 5).expect("a row");
        assert_eq!((b.seeds, b.refused.as_deref()), (3, Some("too many states")));
        assert_eq!(b.fit_secs, Some(2.0));
        assert_eq!(comparison.pair("b", 5).expect("a pair").seeds, 3);
        let c = comparison.row("c", 5).expect("a row");
        assert_eq!((c.seeds, c.agreement, c.fit_secs), (0, None, None));
    }

    #[test]
    fn the_order_of_the_cells_does_not_matter() {
        let forth = cells(0.01);
        let back: Vec<Cell> = forth.iter().rev().cloned().collect();
        let compare = |cells: &[Cell]| Comparison::new(cells, &["a", "b"], &[5], "a");
        assert_eq!(compare(&forth), compare(&back));
    }

    #[test]
    fn medians() {
        assert_eq!(median(vec![]), None);
        assert_eq!(median(vec![3.0, 1.0, 2.0]), Some(2.0));
        assert_eq!(median(vec![4.0, 1.0, 2.0, 3.0]), Some(2.5));
    }
}
