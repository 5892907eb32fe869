//! What the columns of demonstrations are called, and how a file of them is read.

use super::{
    error::{FileError, Place},
    table::Table,
    value::Value,
};
use crate::store::clip;
use std::path::Path;

/// Formats of demonstrations.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// A line of fields a step, under a header.
    Csv,
    /// A JSON object a line: a trajectory, or a step.
    JsonLines,
    /// A row a step.
    Parquet,
}

impl Format {
    /// By the file's extension.
    pub fn of(file: &Path) -> Option<Self> {
        match file.extension()?.to_str()?.to_ascii_lowercase().as_str() {
            "csv" | "tsv" | "txt" => Some(Self::Csv),
            "jsonl" | "ndjson" => Some(Self::JsonLines),
            "parquet" | "pq" => Some(Self::Parquet),
            _ => None,
        }
    }
}

/// How to read a file.
#[derive(Debug, Clone, Default)]
pub struct ReadOptions {
    /// Format; by the extension where `None`.
    pub format: Option<Format>,
    /// Columns that have other names than ours: ours and theirs.
    pub columns: Vec<(String, String)>,
    /// Between the fields of a CSV file; a comma, or a tab in files named `.tsv`, where `None`.
    pub delimiter: Option<u8>,
    /// Rows of several trajectories may alternate: all of them are held until the end.
    pub interleaved: bool,
}

/// What a column tells.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Role {
    Trajectory,
    Step,
    State,
    Action,
    NextState,
    Reward,
    Style,
    Source,
    Env,
    Seed,
    Terminated,
    Truncated,
    States,
    Actions,
    Rewards,
    FinalState,
    /// What `learner export` writes and nobody needs in order to read it.
    Known,
}

/// Names of columns, ours first.
const NAMES: [(Role, &[&str]); 17] = [
    (Role::Trajectory, &["trajectory", "trajectory_id", "id", "episode"]),
    (Role::Step, &["step", "t"]),
    (Role::State, &["state", "s"]),
    (Role::Action, &["action", "a"]),
    (Role::NextState, &["next_state"]),
    (Role::Reward, &["reward", "r"]),
    (Role::Style, &["style"]),
    (Role::Source, &["source"]),
    (Role::Env, &["env", "environment"]),
    (Role::Seed, &["seed"]),
    (Role::Terminated, &["terminated"]),
    (Role::Truncated, &["truncated"]),
    (Role::States, &["states"]),
    (Role::Actions, &["actions"]),
    (Role::Rewards, &["rewards"]),
    (Role::FinalState, &["final_state"]),
    (Role::Known, &["model", "n_states", "n_actions"]),
];

impl ReadOptions {
    /// What a column of this name tells; a name that is given away to another column tells nothing.
    pub(super) fn role(&self, name: &str) -> Option<Role> {
        let own = |name: &str| NAMES.iter().find(|(_, names)| names.contains(&name)).map(|(role, _)| *role);
        if let Some((ours, _)) = self.columns.iter().find(|(_, theirs)| theirs == name) {
            return own(ours);
        }
        let role = own(name)?;
        let taken = self.columns.iter().any(|(ours, _)| own(ours) == Some(role));
        (!taken).then_some(role)
    }

    /// Whether `name` is one of our columns.
    pub fn is_column(name: &str) -> bool {
        NAMES.iter().any(|(role, names)| *role != Role::Known && names.contains(&name))
    }
}

/// Ranks of the columns.
pub(super) struct Columns([Option<usize>; NAMES.len()]);

impl Columns {
    pub(super) fn new<T: Table>(table: &T, options: &ReadOptions) -> Result<(Self, Vec<String>), FileError> {
        let (mut ranks, mut ignored) = ([None; NAMES.len()], Vec::new());
        let wrong = |message: String, hint: String| {
            let place = if matches!(table.place(None), Place::Row(_)) { Place::File } else { table.place(None) };
            FileError::new(table.file(), place, message, hint)
        };
        for (ours, theirs) in &options.columns {
            if !table.columns().contains(theirs) {
                let hint = format!("it has the columns {}", clip(&table.columns().join(", ")));
                return Err(wrong(format!("expected a column '{theirs}' for {ours}, got none"), hint));
            }
        }
        for (rank, name) in table.columns().iter().enumerate() {
            match options.role(name) {
                // Of two names of one thing, the first of our list.
                Some(role) => {
                    let slot = &mut ranks[role as usize];
                    let prior = |at: usize| NAMES[role as usize].1.iter().position(|n| *n == table.columns()[at]);
                    match slot {
                        Some(other) if prior(*other) <= prior(rank) => {}
                        _ => *slot = Some(rank),
                    }
                }
                None => ignored.push(name.clone()),
            }
        }
        for role in [Role::Trajectory, Role::State] {
            if ranks[role as usize].is_none() {
                let name = NAMES[role as usize].1[0];
                let got = clip(&table.columns().join(", "));
                let hint = format!("rename a column, or say which it is: --column {name}=NAME");
                return Err(wrong(format!("expected a column '{name}', got {got}"), hint));
            }
        }
        Ok((Self(ranks), ignored))
    }

    pub(super) fn of(&self, role: Role) -> Option<usize> {
        self.0[role as usize]
    }

    pub(super) fn cell<'a>(&self, row: &'a [Value], role: Role) -> &'a Value {
        self.of(role).and_then(|rank| row.get(rank)).unwrap_or(&Value::Null)
    }
}
