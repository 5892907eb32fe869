//! Does a history to a store, cuts the power at random moments, and compares what is left with what was promised.

use super::{
    disk::{Disk, Fault, Image, below},
    history::{Contents, Step, extra, fault, steps},
    subject::{Segment, Subject},
    vfs::{self, mount, unmount, with_disk},
};
use crate::memory;
use mazeway_learner::store::{self, FILE_NAME, Filter, Recording, Store, StoreError, StoreOptions};
use mazeway_proto::learner as pb;
use proptest::{
    prelude::*,
    test_runner::{Config, RngAlgorithm, TestCaseError, TestRng, TestRunner},
};
use rand_pcg::Pcg64Mcg;
use std::{
    path::{Path, PathBuf},
    rc::Rc,
};
use tempfile::TempDir;
use tokio::runtime::Runtime;

/// Cuts of the power in one generation of a history.
const CUTS: usize = 24;
/// Pages after which a log is written back: few, so that it happens often.
const CHECKPOINT_PAGES: u32 = 12;
/// Events of a generation that are its beginning, from where one cut in four is taken: a store is made and opened there.
const BEGINNING: usize = 48;
/// After one cut in so many a page is damaged as well.
const DAMAGE_ONE_IN: usize = 16;
/// Bytes that are damaged.
const SECTOR: usize = 512;

/// What was tried and found.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Tally {
    /// Things done to stores.
    pub steps: u64,
    /// Steps that the disk made fail.
    pub failed_steps: u64,
    /// Cuts of the power, each at another moment or with another luck, opened and compared.
    pub cuts: u64,
    /// Trajectories that had been acknowledged before a cut and were looked for after it.
    pub acknowledged: u64,
    /// Cuts in the middle of a request.
    pub cuts_within: u64,
    /// Of these, how many left the request there as a whole.
    pub kept_within: u64,
    /// Stores that were damaged after a cut, and checked and repaired.
    pub damaged: u64,
}

impl std::ops::AddAssign for Tally {
    fn add_assign(&mut self, other: Self) {
        self.steps += other.steps;
        self.failed_steps += other.failed_steps;
        self.cuts += other.cuts;
        self.acknowledged += other.acknowledged;
        self.cuts_within += other.cuts_within;
        self.kept_within += other.kept_within;
        self.damaged += other.damaged;
    }
}

/// Draws histories from a seed until the power was cut so many times. `old` is a store of the first release, with which some
/// begin. A disk that `lies` answers to a sync without doing it.
///
/// # Errors
/// Something that was acknowledged is not there, something is there in part, or a store does not open.
pub fn run(seed: u64, cuts: u64, old: &[u8], lies: bool) -> Result<Tally, String> {
    let mut bytes = [0; 32];
    bytes[..8].copy_from_slice(&seed.to_le_bytes());
    // Each history has one generation at least.
    let cases = (cuts / CUTS as u64 + 1) as u32;
    let config =
        Config { cases, failure_persistence: None, max_shrink_iters: if lies { 0 } else { 300 }, ..Config::default() };
    let mut runner = TestRunner::new_with_rng(config, TestRng::from_seed(RngAlgorithm::ChaCha, &bytes));
    let bench = Bench::new(lies);
    let tally = std::cell::Cell::new(Tally::default());
    // Half of them open on a disk that fails: a store of the first release is migrated on it.
    let histories = (any::<u64>(), any::<u8>(), prop::option::of(fault()), prop::collection::vec(steps(), 1..4));
    let outcome = runner.run(&histories, |(luck, start, fault, generations)| {
        let mut sum = tally.get();
        if sum.cuts < cuts {
            let old = [(FILE_NAME.to_owned(), old.to_vec())];
            let base = if start.is_multiple_of(8) { Image::from(old) } else { Image::new() };
            sum += bench.history(base, fault, &generations, luck)?;
            tally.set(sum);
        }
        Ok(())
    });
    outcome.map(|()| tally.get()).map_err(|error| format!("seed {seed}: {error}"))
}

/// Where stores are opened: directories that exist, whose files lie on disks of ours.
pub(super) struct Bench {
    pub(super) runtime: Runtime,
    _root: TempDir,
    pub(super) at_work: PathBuf,
    after: PathBuf,
    lies: bool,
}

impl Bench {
    fn new(lies: bool) -> Self {
        let root = tempfile::tempdir().expect("a directory");
        let [at_work, after] = ["work", "after"].map(|name| root.path().join(name));
        for directory in [&at_work, &after] {
            std::fs::create_dir(directory).expect("a directory");
        }
        let runtime = tokio::runtime::Builder::new_current_thread().build().expect("a runtime");
        Self { runtime, _root: root, at_work, after, lies }
    }

    pub(super) fn open(directory: &Path) -> Result<Store, StoreError> {
        with_disk(directory, forget_a_beginning);
        let options = StoreOptions {
            checkpoint_pages: Some(CHECKPOINT_PAGES),
            vfs: Some(vfs::NAME.into()),
            ..StoreOptions::default()
        };
        Store::open_with(directory, options)
    }

    /// Generations of a store: each begins with what a cut has left of the one before.
    fn history(
        &self,
        base: Image,
        mut fault: Option<Fault>,
        generations: &[Vec<Step>],
        luck: u64,
    ) -> Result<Tally, TestCaseError> {
        let mut rng = Pcg64Mcg::new(u128::from(luck));
        let mut tally = Tally::default();
        let hashed = base.is_empty();
        let mut image = base;
        let mut contents = Rc::new(self.pristine(&image)?);
        for steps in generations {
            let (disk, segments, done) = self.generation(&image, contents, fault.take(), steps)?;
            tally += done;
            let mut survivors = None;
            for _ in 0..CUTS {
                let events = if below(&mut rng, 4) == 0 { disk.now().min(BEGINNING) } else { disk.now() };
                let moment = below(&mut rng, events + 1);
                image = disk.cut(moment, &mut rng);
                let segment = &segments[segments.partition_point(|segment| segment.from <= moment) - 1];
                let found = self.survivors(&image, &segment.allowed, &mut rng)?;
                tally.cuts += 1;
                tally.acknowledged += segment.allowed[0].recordings.len() as u64;
                if segment.allowed.len() > 1 {
                    tally.cuts_within += 1;
                    tally.kept_within += u64::from(found != segment.allowed[0]);
                }
                if !self.lies && below(&mut rng, DAMAGE_ONE_IN) == 0 {
                    let directory = memory();
                    damage(directory.path(), &image, &found, hashed, &mut rng)?;
                    tally.damaged += 1;
                }
                survivors = Some(found);
            }
            contents = survivors.expect("a cut");
        }
        Ok(tally)
    }

    /// What an image holds that no power was cut on.
    fn pristine(&self, image: &Image) -> Result<Contents, TestCaseError> {
        mount(&self.after, Disk::new(image));
        let contents = read(&expect(Self::open(&self.after))?)?;
        unmount(&self.after);
        Ok(contents)
    }

    /// Does the steps, and tells what the disk has seen and what had to be there when.
    fn generation(
        &self,
        image: &Image,
        contents: Rc<Contents>,
        fault: Option<Fault>,
        steps: &[Step],
    ) -> Result<(Disk, Vec<Segment>, Tally), TestCaseError> {
        let mut disk = Disk::new(image);
        if self.lies {
            disk.lie();
        }
        mount(&self.at_work, disk);
        let mut subject = Subject::open(self, contents, fault)?;
        for step in steps {
            subject.step(step)?;
        }
        let (segments, tally) = subject.close();
        Ok((unmount(&self.at_work), segments, tally))
    }

    /// Opens what a cut has left: it must open, hold one of the allowed contents, and go on.
    fn survivors(
        &self,
        image: &Image,
        allowed: &[Rc<Contents>],
        rng: &mut Pcg64Mcg,
    ) -> Result<Rc<Contents>, TestCaseError> {
        mount(&self.after, Disk::new(image));
        let store = expect(Self::open(&self.after))?;
        let contents = read(&store)?;
        let Some(found) = allowed.iter().find(|allowed| ***allowed == contents).cloned() else {
            return Err(TestCaseError::fail(format!(
                "after a cut the store holds {}, allowed were {}",
                describe(&contents),
                allowed.iter().map(|allowed| describe(allowed)).collect::<Vec<_>>().join(" or ")
            )));
        };
        let dice = rng.next_u32();
        let mut after = vec![Rc::clone(&found)];
        if dice.is_multiple_of(8) {
            let integrity = expect(store.check_structure())?;
            prop_assert!(integrity.is_empty(), "{:?}", integrity);
        }
        if dice.is_multiple_of(4) {
            let more = extra();
            let mut contents = Contents::clone(&found);
            contents.record(std::slice::from_ref(&more));
            prop_assert_eq!(expect(self.runtime.block_on(store.record(vec![more])))?, 1);
            prop_assert_eq!(&read(&store)?, &contents);
            after.push(Rc::new(contents));
        }
        drop(store);
        let disk = unmount(&self.after);
        // Cut again while it recovers, goes on or closes.
        if dice.is_multiple_of(5) {
            mount(&self.after, Disk::new(&disk.cut(below(rng, disk.now() + 1), rng)));
            let contents = read(&expect(Self::open(&self.after))?)?;
            unmount(&self.after);
            prop_assert!(after.iter().any(|after| **after == contents), "{}", describe(&contents));
        }
        Ok(found)
    }
}

/// A store as a cut has left it, on a real disk, with a damaged page: what is wrong is found, the rest is taken over, and
/// nothing is there that was not stored. Models and fits of the first release are not `hashed`.
fn damage(
    directory: &Path,
    image: &Image,
    found: &Contents,
    hashed: bool,
    rng: &mut Pcg64Mcg,
) -> Result<(), TestCaseError> {
    if !image.contains_key(FILE_NAME) {
        return Ok(());
    }
    for (name, content) in image {
        let mut content = content.clone();
        if name == FILE_NAME && !content.is_empty() {
            let sector = below(rng, content.len().div_ceil(SECTOR)) * SECTOR;
            let end = content.len().min(sector + SECTOR);
            rng.fill_bytes(&mut content[sector..end]);
        }
        std::fs::write(directory.join(name), content).expect("a file");
    }
    let beyond = |error: &StoreError| {
        matches!(
            error,
            StoreError::Corrupt { .. }
                | StoreError::Database { .. }
                | StoreError::Foreign { .. }
                | StoreError::NewerSchema { .. }
        )
    };
    let verified = match store::verify(directory) {
        Ok(verified) => verified,
        Err(error) => {
            prop_assert!(beyond(&error), "{error}");
            return Ok(());
        }
    };
    if !verified.is_sound() {
        match store::repair(directory) {
            Ok(_) => {}
            Err(error) => {
                prop_assert!(beyond(&error), "{error}");
                return Ok(());
            }
        }
    }
    let left = read(&expect(Store::open(directory))?)?;
    let mut originals = found.recordings.iter();
    prop_assert!(left.recordings.iter().all(|left| originals.any(|original| original == left)), "{}", describe(&left));
    prop_assert_eq!(verified.trajectories.sound, left.recordings.len() as u64);
    if hashed {
        prop_assert!(left.models.iter().all(|(id, model)| found.models.get(id) == Some(model)), "{}", describe(&left));
        prop_assert!(left.fits.iter().all(|(id, fit)| found.fits.get(id) == Some(fit)), "{}", describe(&left));
        prop_assert!(!verified.is_sound() || left == *found, "{}", describe(&left));
    }
    Ok(())
}

/// What opening a store does to a real directory, whose files SQLite's file system does not show it: a database that was begun
/// and taken back is forgotten.
fn forget_a_beginning(disk: &mut Disk) {
    let journal = format!("{FILE_NAME}-journal");
    if disk.find(FILE_NAME).is_some_and(|file| disk.len(file) == 0) && disk.find(&journal).is_some() {
        disk.delete(FILE_NAME);
    }
}

/// An error may be the disk's alone.
pub(super) fn check_disk(error: &StoreError) -> Result<(), TestCaseError> {
    match error {
        StoreError::DiskFull { .. } | StoreError::Database { .. } => Ok(()),
        other => Err(TestCaseError::fail(format!("expected an error of the disk, got: {other}"))),
    }
}

pub(super) fn expect<T>(result: Result<T, StoreError>) -> Result<T, TestCaseError> {
    result.map_err(|error| TestCaseError::fail(error.to_string()))
}

/// Everything that a filter selects.
pub(super) fn recordings(store: &Store, filter: &Filter) -> Result<Vec<Recording>, StoreError> {
    let mut all = Vec::new();
    let mut cursor = store.cursor(filter)?;
    loop {
        let page = store.next_page(&mut cursor)?;
        if page.is_empty() {
            return Ok(all);
        }
        all.extend(page);
    }
}

/// Everything that a store shows.
pub(super) fn read(store: &Store) -> Result<Contents, TestCaseError> {
    let mut contents = Contents { recordings: expect(recordings(store, &Filter::default()))?, ..Contents::default() };
    for info in expect(store.models(""))? {
        let id = info.header.model_id;
        let model = expect(store.model(&id))?.ok_or_else(|| TestCaseError::fail("a model that is listed"))?;
        contents.models.insert(id, model);
    }
    for info in expect(store.fits("", "", i64::MAX, u32::MAX))? {
        let fit = expect(store.fit(&info.fit_id))?.ok_or_else(|| TestCaseError::fail("a fit that is listed"))?;
        let (ids, total) = expect(store.fit_trajectories(&info.fit_id, 0, usize::MAX))?
            .ok_or_else(|| TestCaseError::fail("the trajectories of a fit that is listed"))?;
        prop_assert_eq!((fit.trajectories, total), (ids.len() as u64, ids.len() as u64));
        let plain = pb::Fit { created_at: None, trajectories: 0, trajectories_digest: Default::default(), ..fit };
        contents.fits.insert(info.fit_id, (plain, ids));
    }
    Ok(contents)
}

pub(super) fn describe(contents: &Contents) -> String {
    let ids = contents.recordings.iter().map(|r| (r.id().to_string()[..4].to_owned(), r.steps())).collect::<Vec<_>>();
    format!("{ids:?} with {} models and {} fits", contents.models.len(), contents.fits.len())
}
