//! What is done to a store, drawn by proptest, and the model that says what the store holds then.

use mazeway_learner::store::{Arrays, Collection, Filter, Model, Recording, Rows, pack_f64, pack_u32};
use mazeway_proto::{env::ModelHeader, learner as pb};
use proptest::{collection::vec, prelude::*};
use std::collections::BTreeMap;
use uuid::Uuid;

use super::disk::Fault;

/// Trajectories that a history knows.
const TRAJECTORIES: u8 = 40;
/// Models and fits that a history knows.
const OTHERS: u8 = 3;

/// A trajectory by its number; another variant of a number has the same id and another content.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Spec {
    number: u8,
    variant: bool,
    size: Size,
}

/// How many steps a trajectory has: on a page with others, on a few pages, on many.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Size {
    Small,
    Medium,
    Large,
}

/// One thing that is done to a store.
#[derive(Debug, Clone)]
pub enum Step {
    /// Requests of several clients at the same time, each of several trajectories.
    Record(Vec<Vec<Spec>>),
    /// Deletes what a filter selects.
    Delete(Selection),
    /// Counts, exports and scans everything, and what a filter selects.
    Read(Selection),
    /// Stores a model.
    PutModel(u8),
    /// Stores a fit, unless it is there.
    PutFit(u8),
    /// Deletes a fit.
    DeleteFit(u8),
    /// Gives free room back.
    Vacuum,
    /// Writes the log back.
    Checkpoint,
    /// Closes the store in peace and opens it again.
    Reopen,
    /// The disk begins to fail.
    Break(Fault),
    /// The disk has so many bytes left.
    Fill(u16),
    /// The disk works again.
    Mend,
}

/// Which trajectories are meant.
#[derive(Debug, Clone, Copy)]
pub enum Selection {
    /// One style of three.
    Style(u8),
    /// One id.
    Id(u8),
    /// Those of many steps.
    Long,
}

impl Selection {
    /// The store's filter.
    pub fn filter(self) -> Filter {
        match self {
            Self::Style(style) => Filter { style: style_of(style), ..Filter::default() },
            Self::Id(number) => Filter { ids: vec![id(number)], ..Filter::default() },
            Self::Long => Filter { min_steps: 100, ..Filter::default() },
        }
    }

    /// What the filter means, said a second time.
    pub fn selects(self, recording: &Recording) -> bool {
        match self {
            Self::Style(style) => recording.collection().style == style_of(style),
            Self::Id(number) => recording.id() == id(number),
            Self::Long => recording.steps() >= 100,
        }
    }
}

fn id(number: u8) -> Uuid {
    Uuid::from_u128(u128::from(number).wrapping_mul(0x9e37_79b9_7f4a_7c15_f39c_c060_5ced_c835))
}

fn style_of(number: u8) -> String {
    format!("style {}", number % 3)
}

impl Spec {
    /// The trajectory itself.
    ///
    /// # Panics
    /// It is none.
    pub fn recording(self) -> Recording {
        let steps = match self.size {
            Size::Small => 1 + u32::from(self.number % 7),
            Size::Medium => 300,
            Size::Large => 1500,
        };
        let cell = |step: u32| step.wrapping_mul(2_654_435_761).wrapping_add(u32::from(self.number) * 40_503) >> 7;
        let collection = Collection {
            env_id: "Test-v0".into(),
            model_id: String::new(),
            style: style_of(self.number),
            source: if self.variant { "another".into() } else { "test".into() },
            n_states: 1000,
            n_actions: 5,
        };
        let arrays = Arrays {
            states: pack_u32(&(0..steps).map(|step| cell(step) % 1000).collect::<Vec<_>>()),
            actions: pack_u32(&(0..steps).map(|step| cell(step + 1) % 5).collect::<Vec<_>>()),
            rewards: pack_f64(&(0..steps).map(|step| f64::from(cell(step + 2)) / 3.0).collect::<Vec<_>>()),
            final_state: self.number.is_multiple_of(2).then_some(7),
            terminated: self.number.is_multiple_of(3),
            truncated: self.number.is_multiple_of(5),
        };
        let seed = (!self.number.is_multiple_of(4)).then_some(u64::MAX - u64::from(self.number));
        Recording::new(id(self.number), collection, seed, arrays).expect("a recording")
    }
}

/// A trajectory that no history has.
pub fn extra() -> Recording {
    Spec { number: TRAJECTORIES, variant: false, size: Size::Small }.recording()
}

/// A small model by its number.
///
/// # Panics
/// It is none.
pub fn model(number: u8) -> Model {
    let header = ModelHeader { env_id: "Test-v0".into(), n_states: 2, n_actions: 1, ..ModelHeader::default() };
    let p = f64::from(number % OTHERS + 1) / 8.0;
    let rows = Rows {
        row_lengths: pack_u32(&[2, 1]),
        next_states: pack_u32(&[0, 1, 1]),
        probabilities: pack_f64(&[p, 1.0 - p, 1.0]),
        ..Rows::default()
    };
    Model::new(header, rows).expect("a model")
}

/// A fit by its number, without the time at which it is stored.
pub fn fit(number: u8) -> pb::Fit {
    pb::Fit {
        fit_id: Uuid::from_u128(1000 + u128::from(number % OTHERS)).to_string(),
        request: Some(pb::FitRequest { method: "em".into(), ..pb::FitRequest::default() }),
        env_id: "Test-v0".into(),
        n_states: 200,
        weights: pack_f64(&(0..200).map(|i| f64::from(i * (u32::from(number) + 1))).collect::<Vec<_>>()),
        ..pb::Fit::default()
    }
}

/// Ids of the trajectories of a fit, by its number: none, a few, or more than a page of them.
pub fn fit_ids(number: u8) -> Vec<Uuid> {
    let n = [0, 7, 1100][usize::from(number % OTHERS)];
    (0..n).map(|i| Uuid::from_u128(u128::from(number % OTHERS) << 64 | i)).collect()
}

/// What a store holds.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Contents {
    /// Trajectories in the order of recording.
    pub recordings: Vec<Recording>,
    /// Models by id.
    pub models: BTreeMap<String, Model>,
    /// Fits by id, without their times and what the store says of their trajectories, and the ids of these.
    pub fits: BTreeMap<String, (pb::Fit, Vec<Uuid>)>,
}

impl Contents {
    /// Stores the trajectories of a request or none: whether they are stored.
    pub fn record(&mut self, request: &[Recording]) -> bool {
        let before = self.recordings.len();
        for recording in request {
            match self.recordings.iter().find(|stored| stored.id() == recording.id()) {
                None => self.recordings.push(recording.clone()),
                Some(stored) if stored == recording => {}
                Some(_) => {
                    self.recordings.truncate(before);
                    return false;
                }
            }
        }
        true
    }
}

fn spec() -> impl Strategy<Value = Spec> {
    let size = prop_oneof![20 => Just(Size::Small), 3 => Just(Size::Medium), 1 => Just(Size::Large)];
    let variant = prop_oneof![9 => Just(false), 1 => Just(true)];
    (0..TRAJECTORIES, variant, size).prop_map(|(number, variant, size)| Spec { number, variant, size })
}

fn selection() -> impl Strategy<Value = Selection> {
    prop_oneof![
        2 => any::<u8>().prop_map(Selection::Style),
        3 => (0..TRAJECTORIES).prop_map(Selection::Id),
        1 => Just(Selection::Long),
    ]
}

/// How a disk fails.
pub fn fault() -> impl Strategy<Value = Fault> {
    prop_oneof![(0_u32..40).prop_map(Fault::Read), (0_u32..40).prop_map(Fault::Write), (0_u32..6).prop_map(Fault::Sync),]
}

/// Things to do to a store.
pub fn steps() -> impl Strategy<Value = Vec<Step>> {
    let step = prop_oneof![
        12 => vec(vec(spec(), 1..5), 1..4).prop_map(Step::Record),
        3 => selection().prop_map(Step::Delete),
        3 => selection().prop_map(Step::Read),
        1 => (0..OTHERS).prop_map(Step::PutModel),
        2 => (0..OTHERS).prop_map(Step::PutFit),
        1 => (0..OTHERS).prop_map(Step::DeleteFit),
        1 => Just(Step::Vacuum),
        2 => Just(Step::Checkpoint),
        2 => Just(Step::Reopen),
        2 => fault().prop_map(Step::Break),
        1 => (0_u16..60_000).prop_map(Step::Fill),
        3 => Just(Step::Mend),
    ];
    vec(step, 1..24)
}
