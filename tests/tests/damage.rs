//! Damaged files: what is wrong is found and named, what is sound is taken over, and nothing wrong is taken for right.

use mazeway_client::packed::pack;
use mazeway_learner::store::{self, Arrays, Collection, FILE_NAME, Filter, Kind, Recording, Store, StoreError};
use mazeway_tests::memory;
use rand_core::Rng as _;
use rand_pcg::Pcg64Mcg;
use std::{fs, path::Path};
use uuid::Uuid;

/// Trajectories of the store that is damaged.
const TRAJECTORIES: u32 = 300;
/// Times that it is damaged, unless `MAZEWAY_DAMAGES` says how often.
const TRIALS: u64 = 300;

fn recording(number: u32) -> Recording {
    let steps = if number.is_multiple_of(25) { 900 } else { 4 + number % 30 };
    let collection = Collection {
        env_id: "Test-v0".into(),
        style: format!("style {}", number % 4),
        source: "test".into(),
        n_states: 1000,
        n_actions: 7,
        ..Collection::default()
    };
    let cell = |step: u32| step.wrapping_mul(2_654_435_761).wrapping_add(number * 40_503) >> 9;
    let arrays = Arrays {
        states: pack((0..steps).map(|step| cell(step) % 1000)),
        actions: pack((0..steps).map(|step| cell(step) % 7)),
        rewards: pack((0..steps).map(|step| f64::from(cell(step)))),
        final_state: Some(5),
        ..Arrays::default()
    };
    Recording::new(Uuid::from_u128(u128::from(number) << 64 | 7), collection, Some(u64::from(number)), arrays)
        .expect("a recording")
}

fn all(directory: &Path) -> Result<Vec<Recording>, StoreError> {
    let store = Store::open(directory)?;
    let mut cursor = store.cursor(&Filter::default())?;
    let mut all = Vec::new();
    while !cursor.is_done() {
        all.extend(store.next_page(&mut cursor)?);
    }
    Ok(all)
}

/// A store of trajectories, and its bytes.
fn store(directory: &Path) -> (Vec<Recording>, Vec<u8>) {
    let runtime = tokio::runtime::Builder::new_current_thread().build().expect("a runtime");
    let recordings = (0..TRAJECTORIES).map(recording).collect::<Vec<_>>();
    let store = Store::open(directory).expect("a store");
    for request in recordings.chunks(50) {
        runtime.block_on(store.record(request.to_vec())).expect("stored");
    }
    drop(store);
    (recordings, fs::read(directory.join(FILE_NAME)).expect("a database"))
}

#[test]
fn whatever_page_is_damaged_the_rest_is_taken_over_and_nothing_wrong_passes() {
    let directory = memory();
    let (recordings, sound) = store(directory.path());
    let (mut silent, mut repaired, mut beyond, mut kept) = (0, 0, 0_u64, 0);
    let trials = std::env::var("MAZEWAY_DAMAGES").map_or(TRIALS, |trials| trials.parse().expect("a number"));
    for trial in 0..trials {
        let mut rng = Pcg64Mcg::new(u128::from(trial));
        let mut bytes = sound.clone();
        let at = (rng.next_u64() % bytes.len() as u64) as usize;
        let what = rng.next_u32() % 4;
        match what {
            0 => bytes[at] ^= 1 << (rng.next_u32() % 8),
            1 => rng.fill_bytes(&mut bytes[at / 512 * 512..at / 512 * 512 + 512]),
            2 => bytes[at / 4096 * 4096..at / 4096 * 4096 + 4096].fill(0),
            _ => rng.fill_bytes(&mut bytes[at / 4096 * 4096..at / 4096 * 4096 + 4096]),
        }
        let place = directory.path().join(trial.to_string());
        fs::create_dir(&place).expect("a directory");
        fs::write(place.join(FILE_NAME), &bytes).expect("a file");
        let found = match store::verify(&place) {
            Ok(found) => found,
            // The very name of the format: another program's, as far as anybody can tell.
            Err(StoreError::Foreign { .. } | StoreError::NewerSchema { .. } | StoreError::Database { .. }) => {
                beyond += 1;
                continue;
            }
            Err(error) => panic!("trial {trial}: {error}"),
        };
        if found.is_sound() {
            // Nothing is wrong: then everything is there as it was.
            assert!(all(&place).is_ok_and(|read| read == recordings), "trial {trial}: wrong, and not found");
            silent += 1;
        } else {
            match store::repair(&place) {
                Ok(repair) => {
                    assert_eq!(fs::read(repair.kept.expect("the damaged file")).expect("it"), bytes);
                    let rest = all(&place).expect("a sound store");
                    let mut original = recordings.iter();
                    assert!(
                        rest.iter().all(|r| original.any(|o| o == r)),
                        "trial {trial}: something is there that was not stored"
                    );
                    // Every one that is not there is named, where anything that knows of it could be read.
                    let lost = recordings.len() - rest.len();
                    assert_eq!(found.trajectories.sound as usize, rest.len(), "trial {trial}: {found:?}");
                    kept += rest.len();
                    repaired += 1;
                    if what == 0 {
                        assert!(lost <= 60, "trial {trial}: one bit cost {lost} trajectories of {TRAJECTORIES}");
                    }
                }
                Err(StoreError::Corrupt { .. } | StoreError::Database { .. } | StoreError::Foreign { .. }) => {
                    beyond += 1;
                }
                Err(error) => panic!("trial {trial}: {error}"),
            }
        }
        fs::remove_dir_all(&place).expect("a directory");
    }
    println!(
        "{trials} damaged files: {silent} without effect, {repaired} repaired with {:.1} % of their trajectories, {beyond} beyond repair",
        100.0 * f64::from(kept as u32) / f64::from(repaired) / f64::from(TRAJECTORIES)
    );
    assert!(repaired > 100 && beyond * 10 < trials);
    assert!(kept * 100 > repaired as usize * TRAJECTORIES as usize * 85);
}

#[test]
fn a_flipped_bit_in_a_trajectory_is_named() {
    let directory = memory();
    let (recordings, mut bytes) = store(directory.path());
    let victim = &recordings[25];
    // A thousand states: two bytes each.
    let states =
        victim.arrays().states.as_chunks::<4>().0[100..110].iter().flat_map(|s| [s[0], s[1]]).collect::<Vec<_>>();
    let at = bytes.windows(20).position(|window| window == states).expect("its states");
    bytes[at] ^= 2;
    fs::write(directory.path().join(FILE_NAME), &bytes).expect("a file");
    let found = store::verify(directory.path()).expect("findings");
    assert!(found.structure.is_empty() && !found.is_sound());
    assert_eq!((found.trajectories.sound, found.trajectories.damaged), (u64::from(TRAJECTORIES) - 1, 1));
    assert_eq!((found.damage[0].kind, found.damage[0].name.as_str()), (Kind::Trajectory, &*victim.id().to_string()));
    let repair = store::repair(directory.path()).expect("a repair");
    assert_eq!(repair.found, found);
    assert_eq!(fs::read(repair.kept.expect("the damaged file")).expect("it"), bytes);
    let rest = recordings.iter().filter(|r| *r != victim).cloned().collect::<Vec<_>>();
    assert_eq!(all(directory.path()).expect("a store"), rest);
    assert!(store::verify(directory.path()).expect("findings").is_sound());
    // Once more there is nothing to do.
    assert_eq!(store::repair(directory.path()).expect("a repair").kept, None);
}

#[test]
fn a_store_in_use_is_not_repaired() {
    let directory = memory();
    let (_, bytes) = store(directory.path());
    let store = Store::open(directory.path()).expect("a store");
    assert!(matches!(store::repair(directory.path()), Err(StoreError::Busy { .. })));
    drop(store);
    assert_eq!(fs::read(directory.path().join(FILE_NAME)).expect("a database"), bytes);
    let none = store::verify(&directory.path().join("none"));
    assert!(matches!(none, Err(StoreError::Directory { .. })), "{none:?}");
}
