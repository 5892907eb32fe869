//! What states and actions are called, and what a cell means by it.
//!
//! A label wins over an index. Where the labels themselves look like numbers, an index could mean either, and only labels are
//! taken.

use super::value::Value;
use crate::store::clip;
use std::collections::HashMap;

/// Most states or actions that may be made up from a file.
const MOST_NAMES: usize = 4_000_000;
/// Bytes of a label at most.
const MOST_LABEL_BYTES: usize = 1_000;

/// Turns a cell into an index.
pub trait Resolve {
    /// The index that a cell stands for.
    ///
    /// # Errors
    /// What was expected and what came.
    fn resolve(&mut self, cell: &Value) -> Result<u32, String>;
}

/// A known set of states or actions.
#[derive(Debug, Clone)]
pub struct Names {
    noun: &'static str,
    size: u32,
    labels: Vec<String>,
    by_label: HashMap<String, u32>,
    labels_only: bool,
}

impl Names {
    /// `size` of them, known by their indices alone.
    pub fn numbered(noun: &'static str, size: u32) -> Self {
        Self { noun, size, labels: Vec::new(), by_label: HashMap::new(), labels_only: false }
    }

    /// One a label.
    ///
    /// # Errors
    /// A label that is empty or there twice: its index, and why.
    pub fn labelled(noun: &'static str, labels: Vec<String>) -> Result<Self, (usize, String)> {
        let mut by_label = HashMap::with_capacity(labels.len());
        for (i, label) in labels.iter().enumerate() {
            if label.is_empty() {
                return Err((i, format!("expected a label for every {noun}, got an empty one")));
            }
            if label.len() > MOST_LABEL_BYTES {
                return Err((i, format!("expected labels of at most {MOST_LABEL_BYTES} bytes, got {}", label.len())));
            }
            if by_label.insert(label.clone(), i as u32).is_some() {
                return Err((i, format!("expected each {noun} once, got '{}' again", clip(label))));
            }
        }
        let labels_only = labels.iter().enumerate().any(|(i, label)| label.parse().is_ok_and(|n: usize| n != i));
        Ok(Self { noun, size: labels.len() as u32, labels, by_label, labels_only })
    }

    /// From a model: labels where it has them.
    pub fn of_model(noun: &'static str, size: u32, labels: &[String]) -> Self {
        if labels.len() == size as usize && !labels.is_empty() {
            Self::labelled(noun, labels.to_vec()).unwrap_or_else(|_| Self::numbered(noun, size))
        } else {
            Self::numbered(noun, size)
        }
    }

    /// How many there are.
    pub fn len(&self) -> u32 {
        self.size
    }

    /// True where there are none.
    pub fn is_empty(&self) -> bool {
        self.size == 0
    }

    /// The labels; empty where there are none.
    pub fn labels(&self) -> &[String] {
        &self.labels
    }

    /// How one is written: its label, or its index.
    pub fn name(&self, index: u32) -> String {
        self.labels.get(index as usize).cloned().unwrap_or_else(|| index.to_string())
    }

    fn find(&self, cell: &Value) -> Option<u32> {
        if let Value::Text(text) = cell
            && let Some(&index) = self.by_label.get(text.as_str())
        {
            return Some(index);
        }
        if !self.by_label.is_empty()
            && let Some(&index) = cell.label().and_then(|label| self.by_label.get(&label))
        {
            return Some(index);
        }
        let index = cell.whole().filter(|&index| !self.labels_only && index < u64::from(self.size))?;
        Some(index as u32)
    }

    /// What a cell should have been.
    fn expected(&self) -> String {
        let (noun, last) = (self.noun, self.size.saturating_sub(1));
        match self.labels.first() {
            None => format!("expected {} {noun} from 0 to {last}", article(noun)),
            Some(first) => format!("expected one of the {} {noun}s, such as '{}'", self.size, clip(first)),
        }
    }
}

fn article(noun: &str) -> &'static str {
    if noun.starts_with('a') { "an" } else { "a" }
}

impl Resolve for &Names {
    fn resolve(&mut self, cell: &Value) -> Result<u32, String> {
        self.find(cell).ok_or_else(|| format!("{}, got {}", self.expected(), cell.shown()))
    }
}

/// States or actions as they turn up in a file that comes without a list of them.
#[derive(Debug, Clone)]
pub struct Collector {
    noun: &'static str,
    ranks: HashMap<String, u32>,
}

impl Collector {
    /// Nothing yet.
    pub fn new(noun: &'static str) -> Self {
        Self { noun, ranks: HashMap::new() }
    }

    /// All that turned up, and the index of each rank: numbers keep their value, labels are sorted.
    ///
    /// # Errors
    /// Nothing turned up; numbers too large to be indices.
    pub fn finish(self) -> Result<(Names, Vec<u32>), String> {
        let noun = self.noun;
        if self.ranks.is_empty() {
            return Err(format!("expected at least one {noun}, got none"));
        }
        let numbers: Option<Vec<(u64, u32)>> =
            self.ranks.iter().map(|(label, &rank)| label.parse().ok().map(|number| (number, rank))).collect();
        let mut index = vec![0; self.ranks.len()];
        if let Some(numbers) = numbers {
            let largest = numbers.iter().map(|(number, _)| *number).max().unwrap_or(0);
            if largest >= MOST_NAMES as u64 {
                return Err(format!("expected indices of {noun}s below {MOST_NAMES}, got {largest}"));
            }
            for (number, rank) in numbers {
                index[rank as usize] = number as u32;
            }
            return Ok((Names::numbered(noun, largest as u32 + 1), index));
        }
        let mut labels: Vec<(String, u32)> = self.ranks.into_iter().collect();
        labels.sort_unstable();
        for (i, (_, rank)) in labels.iter().enumerate() {
            index[*rank as usize] = i as u32;
        }
        let labels = labels.into_iter().map(|(label, _)| label).collect();
        Ok((Names::labelled(noun, labels).map_err(|(_, message)| message)?, index))
    }
}

impl Resolve for Collector {
    fn resolve(&mut self, cell: &Value) -> Result<u32, String> {
        let noun = self.noun;
        let label = match cell {
            Value::Text(_) | Value::Integer(0..) => cell.label(),
            Value::Number(_) => cell.whole().map(|n| n.to_string()),
            Value::Null | Value::Integer(_) | Value::Truth(_) => None,
        };
        // "3.0" and "3" are one state.
        let label = label.map(|label| cell.whole().map_or(label, |n| n.to_string()));
        let wrong = || format!("expected {} {noun}: a label or an index, got {}", article(noun), cell.shown());
        let label = label.filter(|label| label.len() <= MOST_LABEL_BYTES).ok_or_else(wrong)?;
        let next = self.ranks.len();
        if let Some(&rank) = self.ranks.get(&label) {
            return Ok(rank);
        }
        if next >= MOST_NAMES {
            return Err(format!("expected at most {MOST_NAMES} {noun}s, got one more"));
        }
        self.ranks.insert(label, next as u32);
        Ok(next as u32)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn labels_win_over_indices() {
        let labels = |labels: &[&str]| Names::labelled("state", labels.iter().map(|l| (*l).to_owned()).collect());
        let named = labels(&["slow", "fast"]).expect("names");
        assert_eq!((&named).resolve(&Value::text("fast")), Ok(1));
        assert_eq!((&named).resolve(&Value::text("1")), Ok(1));
        assert_eq!((&named).resolve(&Value::Number(1.0)), Ok(1));
        let said = (&named).resolve(&Value::text("2")).expect_err("no such state");
        assert_eq!(said, "expected one of the 2 states, such as 'slow', got '2'");
        // Labels that are other numbers than their indices: 1 is the first of them, and 0 is none.
        let shifted = labels(&["1", "2"]).expect("names");
        assert_eq!((&shifted).resolve(&Value::Integer(1)), Ok(0));
        assert!((&shifted).resolve(&Value::Integer(0)).is_err());
        let mut numbered = &Names::numbered("action", 3);
        assert_eq!(numbered.resolve(&Value::text("2.0")), Ok(2));
        assert_eq!(numbered.resolve(&Value::text("3")), Err("expected an action from 0 to 2, got '3'".into()));
        assert_eq!(numbered.resolve(&Value::Null), Err("expected an action from 0 to 2, got nothing".into()));
        assert_eq!(labels(&["a", "a"]).expect_err("twice").0, 1);
    }

    #[test]
    fn what_turns_up_is_numbered_alike_whatever_its_order() {
        let collected = |cells: &[&str]| {
            let mut collector = Collector::new("state");
            let ranks: Vec<u32> = cells.iter().map(|c| collector.resolve(&Value::text(c)).expect("a cell")).collect();
            let (names, index) = collector.finish().expect("names");
            (names.labels().to_vec(), names.len(), ranks.into_iter().map(|r| index[r as usize]).collect::<Vec<_>>())
        };
        assert_eq!(collected(&["b", "a", "b"]), (vec!["a".into(), "b".into()], 2, vec![1, 0, 1]));
        assert_eq!(collected(&["7", "0", "7.0"]), (vec![], 8, vec![7, 0, 7]));
        assert!(Collector::new("state").finish().is_err());
        let mut huge = Collector::new("state");
        huge.resolve(&Value::text("4000000")).expect("a cell");
        assert!(huge.finish().is_err());
    }
}
