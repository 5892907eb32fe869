//! Demonstrations from rows: a row a step, under named columns, put together trajectory by trajectory.

use super::{
    columns::{Columns, Format, ReadOptions, Role},
    csv::CsvTable,
    error::{FileError, Place},
    json_lines::{self, JsonTable},
    names::Resolve,
    parquet::ParquetTable,
    table::Table,
    value::Value,
};
use crate::store::clip;
use sha2::{Digest as _, Sha256};
use std::{
    collections::{HashMap, HashSet},
    ops::ControlFlow,
    path::Path,
};

/// Steps of one trajectory at most, so that a file without ids cannot fill the memory.
const MOST_STEPS: usize = 16_000_000;

/// One demonstration of a file.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Demonstration {
    /// What the file calls it.
    pub name: String,
    /// Environment, where the file says so.
    pub env: Option<String>,
    /// Style, where the file says so.
    pub style: Option<String>,
    /// Source, where the file says so.
    pub source: Option<String>,
    /// Seed, where the file says so.
    pub seed: Option<u64>,
    /// State before each step, shape (steps,).
    pub states: Vec<u32>,
    /// Actions, shape (steps,); empty where only states were seen.
    pub actions: Vec<u32>,
    /// Rewards, shape (steps,) or empty.
    pub rewards: Vec<f64>,
    /// State after the last step, where known; always known without actions.
    pub final_state: Option<u32>,
    /// The episode came to an end of its own.
    pub terminated: bool,
    /// The episode was cut off.
    pub truncated: bool,
    /// Line or row of each step, shape (steps,).
    pub places: Vec<u64>,
}

/// Reads a file and calls `visit` with every demonstration; returns the names of the columns that it did not understand.
///
/// # Errors
/// The first thing in the file that is wrong, or what `visit` breaks with.
pub fn read(
    file: &Path,
    options: &ReadOptions,
    states: &mut dyn Resolve,
    actions: &mut dyn Resolve,
    visit: &mut dyn FnMut(Demonstration) -> ControlFlow<Option<FileError>>,
) -> Result<Vec<String>, FileError> {
    let format = options.format.or_else(|| Format::of(file)).ok_or_else(|| {
        let hint = "name the file .csv, .tsv, .jsonl or .parquet, or say which it is with --format";
        FileError::new(file, Place::File, "expected a file of a known format, got another extension", hint)
    })?;
    let mut names = Resolvers { states, actions };
    match format {
        Format::Csv => {
            let tab = file.extension().is_some_and(|e| e.eq_ignore_ascii_case("tsv"));
            let delimiter = options.delimiter.unwrap_or(if tab { b'\t' } else { b',' });
            rows(CsvTable::open(file, delimiter)?, options, &mut names, visit)
        }
        Format::Parquet => rows(ParquetTable::open(file)?, options, &mut names, visit),
        Format::JsonLines => match JsonTable::open(file, options)? {
            Some(table) => rows(table, options, &mut names, visit),
            None => json_lines::trajectories(file, options, &mut names, visit).map(|()| Vec::new()),
        },
    }
}

/// What states and actions are called.
pub(super) struct Resolvers<'a> {
    pub(super) states: &'a mut dyn Resolve,
    pub(super) actions: &'a mut dyn Resolve,
}

/// Ids of trajectories that were read, by their hashes: 16 bytes each, whatever their length.
#[derive(Default)]
pub(super) struct Seen(HashSet<u128>);

impl Seen {
    /// True where the name is new.
    pub(super) fn insert(&mut self, name: &str) -> bool {
        let hash = Sha256::digest(name.as_bytes());
        self.0.insert(u128::from_le_bytes(std::array::from_fn(|i| hash[i])))
    }
}

/// A trajectory whose rows are still coming.
#[derive(Default)]
struct Open {
    demonstration: Demonstration,
    step: Option<u64>,
    next: Option<u32>,
    /// A row without an action came after rows with one: it is the last.
    ended: bool,
    rows: usize,
    last_place: u64,
}

fn rows<T: Table>(
    mut table: T,
    options: &ReadOptions,
    names: &mut Resolvers<'_>,
    visit: &mut dyn FnMut(Demonstration) -> ControlFlow<Option<FileError>>,
) -> Result<Vec<String>, FileError> {
    let (columns, ignored) = Columns::new(&table, options)?;
    let (mut row, mut seen) = (Vec::new(), Seen::default());
    // In the order of their first rows; one at most where they may not alternate.
    let (mut open, mut ranks) = (Vec::<Open>::new(), HashMap::<String, usize>::new());
    let mut emit = |open: Open, table: &T| -> Result<ControlFlow<()>, FileError> {
        match visit(close(open, table)?) {
            ControlFlow::Continue(()) => Ok(ControlFlow::Continue(())),
            ControlFlow::Break(None) => Ok(ControlFlow::Break(())),
            ControlFlow::Break(Some(error)) => Err(error),
        }
    };
    while table.next(&mut row)? {
        let at = columns.of(Role::Trajectory);
        let name = columns.cell(&row, Role::Trajectory).label().ok_or_else(|| {
            table.error(at, "expected the id of a trajectory, got nothing", "give every row the id of its trajectory")
        })?;
        let rank = if options.interleaved {
            ranks.get(&name).copied()
        } else {
            open.first().filter(|open| open.demonstration.name == name).map(|_| 0)
        };
        let rank = match rank {
            Some(rank) => rank,
            None if options.interleaved => {
                ranks.insert(name.clone(), open.len());
                open.push(begin(name, &table, &columns, &row)?);
                open.len() - 1
            }
            None => {
                if let Some(done) = open.pop()
                    && emit(done, &table)?.is_break()
                {
                    return Ok(ignored);
                }
                if !seen.insert(&name) {
                    let message =
                        format!("expected the rows of trajectory '{}' together, got more of them", clip(&name));
                    let hint = "sort the rows by trajectory and step, or add --interleaved to hold them all in memory";
                    return Err(table.error(at, message, hint));
                }
                open.push(begin(name, &table, &columns, &row)?);
                0
            }
        };
        append(&mut open[rank], &table, &columns, &row, names)?;
    }
    for done in open {
        if emit(done, &table)?.is_break() {
            break;
        }
    }
    Ok(ignored)
}

/// The labels of a trajectory, from its first row.
fn begin<T: Table>(name: String, table: &T, columns: &Columns, row: &[Value]) -> Result<Open, FileError> {
    let label = |role| columns.cell(row, role).label();
    let seed = columns.cell(row, Role::Seed);
    if !seed.is_null() && seed.whole().is_none() {
        let message = format!("expected a seed that is a whole number, got {}", seed.shown());
        return Err(table.error(columns.of(Role::Seed), message, "leave it empty where there is none"));
    }
    Ok(Open {
        demonstration: Demonstration {
            name,
            env: label(Role::Env),
            style: label(Role::Style),
            source: label(Role::Source),
            seed: seed.whole(),
            ..Demonstration::default()
        },
        ..Open::default()
    })
}

fn append<T: Table>(
    open: &mut Open,
    table: &T,
    columns: &Columns,
    row: &[Value],
    names: &mut Resolvers<'_>,
) -> Result<(), FileError> {
    let id = clip(&open.demonstration.name);
    let cell = |role| columns.cell(row, role);
    let wrong = |role, message: String, hint: &str| Err(table.error(columns.of(role), message, hint));
    if open.ended {
        let message = format!("expected no row of trajectory '{id}' after the one without an action, got one");
        return wrong(
            Role::Trajectory,
            message,
            "leave the action out in the last row alone: it is the state where all ends",
        );
    }
    let done = &mut open.demonstration;
    if done.terminated || done.truncated {
        let message = format!("expected no row of trajectory '{id}' after the one that ended it, got one");
        return wrong(Role::Trajectory, message, "terminated and truncated are true in the last row alone");
    }
    if open.rows > 0 {
        let labels = [(Role::Env, &done.env), (Role::Style, &done.style), (Role::Source, &done.source)];
        for (role, known) in labels {
            let label = cell(role).label();
            if label.is_some() && label != *known {
                let message = format!(
                    "expected '{}' as in the rows before of trajectory '{id}', got {}",
                    clip(known.as_deref().unwrap_or_default()),
                    cell(role).shown()
                );
                return wrong(role, message, "a trajectory has one environment, one style and one source");
            }
        }
    }
    if columns.of(Role::Step).is_some() {
        let step = cell(Role::Step);
        let expected = open.step.map(|before| before + 1);
        match step.whole() {
            Some(step) if expected.is_none_or(|expected| step == expected) => open.step = Some(step),
            _ => {
                let expected = expected.map_or("a whole number".to_owned(), |step| step.to_string());
                let message = format!("expected step {expected} of trajectory '{id}', got {}", step.shown());
                return wrong(Role::Step, message, "the steps of a trajectory rise by one from row to row");
            }
        }
    }
    let resolved = |index: Result<u32, String>, role| {
        let hint = "states and actions are those of the model: its labels, or indices from 0 on";
        index.map_err(|message| table.error(columns.of(role), message, hint))
    };
    let state = resolved(names.states.resolve(cell(Role::State)), Role::State)?;
    if open.next.is_some_and(|next| next != state) {
        let message = format!(
            "expected the state that the row before of trajectory '{id}' leads to, got {}",
            cell(Role::State).shown()
        );
        return wrong(Role::State, message, "next_state is the state of the row that follows");
    }
    open.next = match cell(Role::NextState) {
        Value::Null => None,
        next => Some(resolved(names.states.resolve(next), Role::NextState)?),
    };
    let action = match cell(Role::Action) {
        Value::Null => None,
        action => Some(resolved(names.actions.resolve(action), Role::Action)?),
    };
    let place = match table.place(None) {
        Place::Line(line) | Place::Row(line) => line,
        _ => 0,
    };
    open.rows += 1;
    open.last_place = place;
    if action.is_none() && !done.actions.is_empty() {
        open.ended = true;
        done.final_state = Some(state);
        return Ok(());
    }
    if action.is_some() && done.actions.len() != done.states.len() {
        let message = format!("expected no action, as in the rows before of trajectory '{id}', got one");
        return wrong(Role::Action, message, "give the action of every step but the last, or of none");
    }
    if done.states.len() >= MOST_STEPS {
        let message = format!("expected at most {MOST_STEPS} steps of trajectory '{id}', got one more");
        return wrong(Role::Trajectory, message, "cut it into several trajectories");
    }
    for (role, flag) in [(Role::Terminated, &mut done.terminated), (Role::Truncated, &mut done.truncated)] {
        let value = cell(role);
        *flag = match value.truth() {
            Some(truth) => truth,
            None if value.is_null() => false,
            None => {
                let message = format!("expected true or false, got {}", value.shown());
                return wrong(role, message, "leave it empty where it is not known");
            }
        };
    }
    match cell(Role::Reward) {
        Value::Null => {}
        reward => match reward.number() {
            Some(number) if done.rewards.len() == done.states.len() => done.rewards.push(number),
            Some(_) => {
                let message = format!("expected no reward, as in a row before of trajectory '{id}', got one");
                return wrong(Role::Reward, message, "give the reward of every step, or of none");
            }
            None => {
                let message = format!("expected a finite number, got {}", reward.shown());
                return wrong(Role::Reward, message, "leave it empty where it is not known");
            }
        },
    }
    done.states.push(state);
    done.actions.extend(action);
    done.places.push(place);
    Ok(())
}

/// A trajectory whose rows are all there.
fn close<T: Table>(open: Open, table: &T) -> Result<Demonstration, FileError> {
    let Open { mut demonstration, next, ended, last_place, .. } = open;
    if !ended {
        demonstration.final_state = next;
    }
    let place = match table.place(None) {
        Place::Row(_) => Place::Row(last_place),
        _ => Place::Line(last_place),
    };
    let file = table.file();
    finish(demonstration).map_err(|(message, hint)| FileError::new(file, place, message, hint))
}

/// Checks what only the whole shows.
pub(super) fn finish(mut d: Demonstration) -> Result<Demonstration, (String, &'static str)> {
    let id = clip(&d.name);
    if d.actions.is_empty() && d.final_state.is_none() {
        // Of states alone, the last is where all ends.
        d.final_state = d.states.pop();
        d.places.truncate(d.states.len());
        d.rewards.truncate(d.states.len());
    }
    if d.states.is_empty() {
        let message = format!("expected at least one step of trajectory '{id}', got a state without an action");
        return Err((message, "a trajectory without actions has two states at least"));
    }
    if !d.rewards.is_empty() && d.rewards.len() != d.states.len() {
        let message = format!(
            "expected a reward for each of the {} steps of trajectory '{id}' or for none, got {}",
            d.states.len(),
            d.rewards.len()
        );
        return Err((message, "give the reward of every step, or of none"));
    }
    if !d.actions.is_empty() && d.actions.len() != d.states.len() {
        let message = format!(
            "expected an action for each of the {} steps of trajectory '{id}' or for none, got {}",
            d.states.len(),
            d.actions.len()
        );
        return Err((message, "give the action of every step, or of none; final_state is the state after the last"));
    }
    Ok(d)
}

impl Demonstration {
    /// The same labels, no steps.
    #[must_use]
    pub fn clone_labels(&self) -> Self {
        Self {
            name: self.name.clone(),
            env: self.env.clone(),
            style: self.style.clone(),
            source: self.source.clone(),
            seed: self.seed,
            ..Self::default()
        }
    }
}
