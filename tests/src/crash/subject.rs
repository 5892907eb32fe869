//! A store at work on a disk that may fail, step by step, and what it may hold if the power is cut at any moment of that.

use super::{
    check::{Bench, Tally, check_disk, describe, expect, read, recordings},
    disk::Fault,
    history::{Contents, Selection, Spec, Step, fit, fit_ids, model},
    vfs::with_disk,
};
use bytes::Bytes;
use mazeway_learner::store::{Filter, Put, Recording, Store, StoreError};
use proptest::{prelude::*, test_runner::TestCaseError};
use std::{ops::ControlFlow, path::Path, rc::Rc};
use uuid::Uuid;

/// What a store may hold if the power is cut from a moment on.
pub(super) struct Segment {
    pub(super) from: usize,
    /// What is allowed.
    pub(super) allowed: Vec<Rc<Contents>>,
}

/// A store at work, and what is known of it.
pub(super) struct Subject<'a> {
    bench: &'a Bench,
    store: Option<Store>,
    /// What it shows.
    visible: Rc<Contents>,
    /// What it may show after a cut now: more than what it shows where a request has failed halfway.
    allowed: Vec<Rc<Contents>>,
    segments: Vec<Segment>,
    tally: Tally,
}

/// How a step went, as far as the model is concerned.
enum Outcome {
    /// As it should: the store holds this, and held one of those meanwhile.
    Done { after: Rc<Contents>, during: Vec<Rc<Contents>> },
    /// The disk failed: the store holds one of `after`, and held one of those or of `during` meanwhile.
    Failed { after: Vec<Rc<Contents>>, during: Vec<Rc<Contents>> },
}

impl<'a> Subject<'a> {
    /// Opens the store on the disk that is mounted, which holds this, and may fail at first.
    pub(super) fn open(bench: &'a Bench, contents: Rc<Contents>, fault: Option<Fault>) -> Result<Self, TestCaseError> {
        let allowed = vec![Rc::clone(&contents)];
        Ok(Self {
            bench,
            store: Some(open_on(&bench.at_work, fault)?),
            visible: contents,
            segments: vec![Segment { from: 0, allowed: allowed.clone() }],
            allowed,
            tally: Tally::default(),
        })
    }

    /// Closes the store, and tells what had to be there when.
    pub(super) fn close(self) -> (Vec<Segment>, Tally) {
        (self.segments, self.tally)
    }

    /// Does one thing.
    pub(super) fn step(&mut self, step: &Step) -> Result<(), TestCaseError> {
        let from = with_disk(&self.bench.at_work, |disk| disk.now());
        self.tally.steps += 1;
        let same = |subject: &Self| Outcome::Done { after: Rc::clone(&subject.visible), during: Vec::new() };
        let outcome = match step {
            Step::Record(requests) => self.record(requests)?,
            Step::Delete(selection) => {
                let deleted = self.bench.runtime.block_on(self.store().delete_trajectories(selection.filter()));
                let mut after = Contents::clone(&self.visible);
                after.recordings.retain(|recording| !selection.selects(recording));
                let expected = (self.visible.recordings.len() - after.recordings.len()) as u64;
                self.outcome(deleted, |deleted| deleted == expected, after)?
            }
            Step::Read(selection) => {
                self.compare(*selection)?;
                same(self)
            }
            Step::PutModel(number) => {
                let model = model(*number);
                let mut after = Contents::clone(&self.visible);
                let new = after.models.insert(model.model_id().to_owned(), model.clone()).is_none();
                let put = self.bench.runtime.block_on(self.store().put_model(model, false));
                self.outcome(put, |put| put == if new { Put::Stored } else { Put::Known }, after)?
            }
            Step::PutFit(number) => {
                let fit = fit(*number);
                let mut after = Contents::clone(&self.visible);
                let ids = fit_ids(*number);
                if after.fits.insert(fit.fit_id.clone(), (fit.clone(), ids.clone())).is_some() {
                    same(self)
                } else {
                    let mut list = self.store().id_list();
                    for id in ids {
                        expect(list.push(id))?;
                    }
                    let put = self.bench.runtime.block_on(self.store().put_fit(fit, list));
                    self.outcome(put, |_| true, after)?
                }
            }
            Step::DeleteFit(number) => {
                let id = fit(*number).fit_id;
                let mut after = Contents::clone(&self.visible);
                let there = after.fits.remove(&id).is_some();
                let deleted = self.bench.runtime.block_on(self.store().delete_fit(id));
                self.outcome(deleted, |deleted| deleted == there, after)?
            }
            Step::Vacuum => {
                let vacuumed = self.bench.runtime.block_on(self.store().vacuum());
                self.outcome(vacuumed, |()| true, Contents::clone(&self.visible))?
            }
            Step::Checkpoint => {
                let checkpointed = self.bench.runtime.block_on(self.store().checkpoint());
                self.outcome(checkpointed, |()| true, Contents::clone(&self.visible))?
            }
            Step::Reopen => {
                drop(self.store.take());
                self.store = Some(reopen(&self.bench.at_work)?);
                same(self)
            }
            Step::Break(fault) => {
                with_disk(&self.bench.at_work, |disk| disk.set_fault(Some(*fault)));
                same(self)
            }
            Step::Fill(free) => {
                with_disk(&self.bench.at_work, |disk| disk.set_free(Some(usize::from(*free))));
                same(self)
            }
            Step::Mend => {
                self.mend();
                same(self)
            }
        };
        self.settle(from, outcome)
    }

    fn store(&self) -> &Store {
        self.store.as_ref().expect("a store")
    }

    fn mend(&self) {
        mend(&self.bench.at_work);
    }

    /// Requests that share their commits as they come.
    fn record(&mut self, requests: &[Vec<Spec>]) -> Result<Outcome, TestCaseError> {
        let requests =
            requests.iter().map(|r| r.iter().map(|spec| spec.recording()).collect::<Vec<_>>()).collect::<Vec<_>>();
        let answers = self.bench.runtime.block_on(async {
            let mut pending = Vec::new();
            for request in &requests {
                pending.push(self.store().queue_recordings(request.clone()).await);
            }
            let mut answers = Vec::new();
            for pending in pending {
                answers.push(match pending {
                    Ok(pending) => pending.committed().await,
                    Err(error) => Err(error),
                });
            }
            answers
        });
        let disk_failed =
            |answer: &Result<u32, StoreError>| !matches!(answer, Ok(_) | Err(StoreError::TrajectoryExists { .. }));
        if !answers.iter().any(disk_failed) {
            let mut contents = Contents::clone(&self.visible);
            let mut during = Vec::new();
            for (request, answer) in requests.iter().zip(&answers) {
                let before = contents.recordings.len();
                let recorded = contents.record(request);
                let stored = contents.recordings.len() - before;
                match answer {
                    Ok(n) => prop_assert!(recorded && *n as usize == stored, "expected {stored} stored, got {n}"),
                    Err(error) => prop_assert!(!recorded, "{}", error),
                }
                during.push(Rc::new(contents.clone()));
            }
            return Ok(Outcome::Done { after: Rc::new(contents), during });
        }
        // They are taken up in their order, each commit with one or more: once the first k have been, every set of these that
        // has those which were acknowledged.
        let after = self.possible(&requests, &answers)?;
        let mut during = Vec::new();
        for k in 1..requests.len() {
            during.extend(self.possible(&requests[..k], &answers[..k])?);
        }
        Ok(Outcome::Failed { after, during })
    }

    /// What the store may hold after requests of which some have failed with the disk.
    fn possible(
        &self,
        requests: &[Vec<Recording>],
        answers: &[Result<u32, StoreError>],
    ) -> Result<Vec<Rc<Contents>>, TestCaseError> {
        let mut possible = Vec::new();
        for set in 0_u32..1 << requests.len() {
            let mut contents = Contents::clone(&self.visible);
            let mut consistent = true;
            for (i, (request, answer)) in requests.iter().zip(answers).enumerate() {
                let chosen = set >> i & 1 == 1;
                match answer {
                    Ok(_) => consistent &= chosen && contents.record(request),
                    Err(error) if chosen => consistent &= check_disk(error).is_ok() && contents.record(request),
                    Err(StoreError::TrajectoryExists { .. }) => {}
                    Err(error) => check_disk(error)?,
                }
            }
            if consistent {
                possible.push(Rc::new(contents));
            }
        }
        Ok(possible)
    }

    /// Of a step that is done as a whole or not at all.
    fn outcome<T: std::fmt::Debug>(
        &self,
        result: Result<T, StoreError>,
        as_expected: impl FnOnce(T) -> bool,
        after: Contents,
    ) -> Result<Outcome, TestCaseError> {
        let after = Rc::new(after);
        match result {
            Ok(value) => {
                let text = format!("{value:?}");
                prop_assert!(as_expected(value), "got {}", text);
                Ok(Outcome::Done { after, during: Vec::new() })
            }
            Err(error) => {
                check_disk(&error)?;
                Ok(Outcome::Failed { after: vec![Rc::clone(&self.visible), after], during: Vec::new() })
            }
        }
    }

    /// Takes down what may be there from the beginning of a step on, and from its end on.
    fn settle(&mut self, from: usize, outcome: Outcome) -> Result<(), TestCaseError> {
        let to = with_disk(&self.bench.at_work, |disk| disk.now());
        let mut allowed = self.allowed.clone();
        match outcome {
            Outcome::Done { after, during } => {
                during.into_iter().chain([Rc::clone(&after)]).for_each(|contents| add(&mut allowed, contents));
                self.within(from, to, allowed);
                // Nothing of the step is waited for where it has changed nothing: what was uncertain remains so.
                if after != self.visible {
                    self.allowed = vec![Rc::clone(&after)];
                }
                self.visible = after;
            }
            Outcome::Failed { after, during } => {
                self.tally.failed_steps += 1;
                for contents in &after {
                    add(&mut allowed, Rc::clone(contents));
                }
                self.allowed.clone_from(&allowed);
                for contents in during {
                    add(&mut allowed, contents);
                }
                self.within(from, to, allowed);
                self.visible = self.look(&after)?;
            }
        }
        self.segments.push(Segment { from: to, allowed: self.allowed.clone() });
        Ok(())
    }

    /// While a step is at work: after its first event and before its last.
    fn within(&mut self, from: usize, to: usize, allowed: Vec<Rc<Contents>>) {
        if to > from {
            self.segments.push(Segment { from: from + 1, allowed });
        }
    }

    /// What the store shows after a failure, looked at while the disk works.
    fn look(&self, possible: &[Rc<Contents>]) -> Result<Rc<Contents>, TestCaseError> {
        let fault = with_disk(&self.bench.at_work, |disk| disk.set_fault(None));
        let contents = read(self.store())?;
        with_disk(&self.bench.at_work, |disk| disk.set_fault(fault));
        possible.iter().find(|possible| ***possible == contents).cloned().ok_or_else(|| {
            let possible = possible.iter().map(|possible| describe(possible)).collect::<Vec<_>>();
            TestCaseError::fail(format!(
                "after a failure the store holds {}, possible were {}",
                describe(&contents),
                possible.join(" or ")
            ))
        })
    }

    /// Reads as a service does. A broken disk may be said; wrong contents may not.
    fn compare(&self, selection: Selection) -> Result<(), TestCaseError> {
        let visible = &self.visible.recordings;
        for (filter, expected) in [
            (Filter::default(), visible.clone()),
            (selection.filter(), visible.iter().filter(|r| selection.selects(r)).cloned().collect()),
        ] {
            match self.store().count(&filter) {
                Ok(count) => prop_assert_eq!(count, expected.len() as u64),
                Err(error) => check_disk(&error)?,
            }
            match recordings(self.store(), &filter) {
                Ok(found) => prop_assert!(found == expected, "read {} for {}", found.len(), expected.len()),
                Err(error) => check_disk(&error)?,
            }
            // As a fit reads: without the rewards.
            let mut scanned = Vec::new();
            let all = self.store().for_each(&filter, |stored| {
                scanned.push(arrays(&stored.recording()));
                ControlFlow::<()>::Continue(())
            });
            match all {
                Ok(_) => {
                    let expected = expected.iter().map(arrays).collect::<Vec<_>>();
                    prop_assert!(scanned == expected, "scanned {} for {}", scanned.len(), expected.len());
                }
                Err(error) => check_disk(&error)?,
            }
        }
        Ok(())
    }
}

/// What a fit reads of a trajectory.
fn arrays(recording: &Recording) -> (Uuid, Bytes, Bytes) {
    let arrays = recording.arrays();
    (recording.id(), arrays.states.clone(), arrays.actions.clone())
}

/// Opens a store on a disk that may fail, which it may say; then the disk is mended.
fn reopen(directory: &Path) -> Result<Store, TestCaseError> {
    Bench::open(directory).or_else(|error| {
        check_disk(&error)?;
        mend(directory);
        expect(Bench::open(directory))
    })
}

/// As [`reopen`], on a disk that fails so and works again afterwards.
fn open_on(directory: &Path, fault: Option<Fault>) -> Result<Store, TestCaseError> {
    with_disk(directory, |disk| disk.set_fault(fault));
    let store = reopen(directory)?;
    mend(directory);
    Ok(store)
}

fn mend(directory: &Path) {
    with_disk(directory, |disk| {
        disk.set_fault(None);
        disk.set_free(None);
    });
}

fn add(set: &mut Vec<Rc<Contents>>, contents: Rc<Contents>) {
    if !set.contains(&contents) {
        set.push(contents);
    }
}
