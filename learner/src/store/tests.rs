//! Laws of the store: what goes in comes out, in order, and filters agree with a model in memory.

use super::*;
use proptest::prelude::*;
use std::collections::BTreeSet;
use uuid::Uuid;

fn runtime() -> tokio::runtime::Runtime {
    tokio::runtime::Builder::new_current_thread().build().unwrap()
}

fn label() -> impl Strategy<Value = String> {
    prop::sample::select(vec!["a", "b", "c", "Maze-v0", "ü", "%_'\"\0"]).prop_map(str::to_owned)
}

fn model_label() -> impl Strategy<Value = String> {
    prop::sample::select(vec![String::new(), "0".repeat(64), "f".repeat(64)])
}

prop_compose! {
    fn recording()(
        id in any::<u128>(),
        (env_id, style, source, model_id) in (label(), label(), label(), model_label()),
        (n_states, n_actions) in (1_u32..2_000_000_000, 1_u32..20),
        seed in prop_oneof![Just(None), (0_u64..5).prop_map(Some), any::<u64>().prop_map(Some)],
        steps in prop::collection::vec((any::<u32>(), any::<u32>(), -1e9..1e9_f64), 1..40),
        (with_rewards, terminated, truncated) in any::<(bool, bool, bool)>(),
        last in any::<Option<u32>>(),
    ) -> Recording {
        let states = steps.iter().map(|s| s.0 % n_states).collect::<Vec<_>>();
        let actions = steps.iter().map(|s| s.1 % n_actions).collect::<Vec<_>>();
        let rewards = if with_rewards { steps.iter().map(|s| s.2).collect() } else { Vec::new() };
        let arrays = Arrays {
            states: pack_u32(&states),
            actions: pack_u32(&actions),
            rewards: pack_f64(&rewards),
            final_state: last.map(|s| s % n_states),
            terminated,
            truncated,
        };
        let collection = Collection { env_id, model_id, style, source, n_states, n_actions };
        Recording::new(Uuid::from_u128(id), collection, seed, arrays).unwrap()
    }
}

prop_compose! {
    fn filter()(
        (env_id, style, source) in (prop::option::of(label()), prop::option::of(label()), prop::option::of(label())),
        model_id in prop::option::of(model_label()),
        min_seed in prop::option::of(prop_oneof![0_u64..5, any::<u64>()]),
        max_seed in prop::option::of(prop_oneof![0_u64..6, any::<u64>()]),
        min_steps in prop_oneof![Just(0_u32), 0_u32..40],
    ) -> Filter {
        Filter {
            env_id: env_id.unwrap_or_default(),
            style: style.unwrap_or_default(),
            source: source.unwrap_or_default(),
            model_id: model_id.unwrap_or_default(),
            min_seed,
            max_seed,
            min_steps,
            ..Filter::default()
        }
    }
}

/// What the filter means, said a second time.
fn passes(filter: &Filter, r: &Recording) -> bool {
    let c = r.collection();
    let label = |wanted: &str, is: &str| wanted.is_empty() || wanted == is;
    label(&filter.env_id, &c.env_id)
        && label(&filter.style, &c.style)
        && label(&filter.source, &c.source)
        && label(&filter.model_id, &c.model_id)
        && r.seed().is_none_or(|seed| filter.min_seed.is_none_or(|min| seed >= min))
        && r.seed().is_none_or(|seed| filter.max_seed.is_none_or(|max| seed < max))
        && r.steps() >= filter.min_steps
        && (filter.ids.is_empty() || filter.ids.contains(&r.id()))
}

fn read_all(store: &Store, filter: &Filter) -> Vec<Recording> {
    let mut all = Vec::new();
    let mut cursor = store.cursor(filter).unwrap();
    loop {
        let page = store.next_page(&mut cursor).unwrap();
        if page.is_empty() {
            return all;
        }
        all.extend(page);
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn everything_comes_out_as_it_went_in(
        recordings in prop::collection::vec(recording(), 1..30),
        filters in prop::collection::vec(filter(), 1..6),
        chosen in prop::collection::vec(any::<prop::sample::Index>(), 1..6),
        cut in any::<prop::sample::Index>(),
    ) {
        let directory = tempfile::tempdir().unwrap();
        let store = Store::open(directory.path()).unwrap();
        let runtime = runtime();
        let ids = recordings.iter().map(Recording::id).collect::<BTreeSet<_>>();
        prop_assume!(ids.len() == recordings.len());
        let (first, second) = recordings.split_at(cut.index(recordings.len()));
        for part in [first, second, first, second] {
            let known = read_all(&store, &Filter::default()).len();
            let stored = runtime.block_on(store.record(part.to_vec())).unwrap();
            prop_assert_eq!(known + stored as usize, read_all(&store, &Filter::default()).len());
        }
        drop(store);

        let store = Store::open(directory.path()).unwrap();
        prop_assert_eq!(&read_all(&store, &Filter::default()), &recordings);
        let mut filters = filters;
        filters.push(Filter {
            ids: chosen.iter().map(|i| recordings[i.index(recordings.len())].id()).collect(),
            ..filters[0].clone()
        });
        for filter in &filters {
            let expected = recordings.iter().filter(|r| passes(filter, r)).cloned().collect::<Vec<_>>();
            prop_assert_eq!(store.count(filter).unwrap(), expected.len() as u64, "{:?}", filter);
            prop_assert_eq!(&read_all(&store, filter), &expected, "{:?}", filter);
            // Lists in pages of two are the same list.
            let (mut listed, mut after) = (Vec::new(), 0);
            loop {
                let page = store.summaries(filter, after, 2).unwrap();
                let Some(last) = page.last() else { break };
                after = last.seq;
                listed.extend(page);
            }
            let listed = listed.into_iter().map(|s| (s.id, s.collection, s.seed, s.steps)).collect::<Vec<_>>();
            let as_listed = |r: &Recording| (r.id(), r.collection().clone(), r.seed(), r.steps());
            prop_assert_eq!(listed, expected.iter().map(as_listed).collect::<Vec<_>>());
        }
        let filter = &filters[0];
        let kept = recordings.iter().filter(|r| !passes(filter, r)).cloned().collect::<Vec<_>>();
        let deleted = runtime.block_on(store.delete_trajectories(filter.clone())).unwrap();
        prop_assert_eq!(deleted as usize, recordings.len() - kept.len());
        prop_assert_eq!(read_all(&store, &Filter::default()), kept);
    }
}

fn simple(id: u128, states: &[u32]) -> Recording {
    let collection = Collection {
        env_id: "e".into(),
        style: "s".into(),
        source: "test".into(),
        n_states: 100,
        n_actions: 1,
        ..Collection::default()
    };
    let arrays = Arrays { states: pack_u32(states), actions: pack_u32(&vec![0; states.len()]), ..Arrays::default() };
    Recording::new(Uuid::from_u128(id), collection, None, arrays).unwrap()
}

#[test]
fn an_id_with_another_content_is_refused_and_nothing_of_its_request_is_stored() {
    let directory = tempfile::tempdir().unwrap();
    let store = Store::open(directory.path()).unwrap();
    let runtime = runtime();
    runtime.block_on(store.record(vec![simple(1, &[1])])).unwrap();
    let error = runtime.block_on(store.record(vec![simple(2, &[2]), simple(1, &[9]), simple(3, &[3])])).unwrap_err();
    assert!(matches!(error, StoreError::TrajectoryExists { index: 1, .. }), "{error}");
    assert_eq!(read_all(&store, &Filter::default()), [simple(1, &[1])]);
    // The collection that the failed request would have made is made by the next one.
    assert_eq!(runtime.block_on(store.record(vec![simple(2, &[2])])).unwrap(), 1);
    assert_eq!(read_all(&store, &Filter::default()), [simple(1, &[1]), simple(2, &[2])]);
}

#[test]
fn requests_that_share_a_commit_fail_alone() {
    let directory = tempfile::tempdir().unwrap();
    let store = Store::open(directory.path()).unwrap();
    runtime().block_on(async {
        store.record(vec![simple(0, &[0])]).await.unwrap();
        let requests = (0..200_u128).map(|i| {
            let store = store.clone();
            // Every tenth uses an id that has another content.
            tokio::spawn(async move { store.record(vec![simple(if i % 10 == 9 { 0 } else { i + 1 }, &[7])]).await })
        });
        for (i, request) in requests.collect::<Vec<_>>().into_iter().enumerate() {
            match request.await.unwrap() {
                Ok(stored) => assert_eq!((stored, i % 10 == 9), (1, false)),
                Err(error) => {
                    assert!(matches!(error, StoreError::TrajectoryExists { .. }), "{error}");
                    assert_eq!(i % 10, 9);
                }
            }
        }
    });
    assert_eq!(store.count(&Filter::default()).unwrap(), 181);
}

#[test]
fn pages_are_bounded_and_a_slow_reader_sees_no_later_recordings() {
    let directory = tempfile::tempdir().unwrap();
    let store = Store::open(directory.path()).unwrap();
    let long = vec![1; 100_000];
    let recordings = (1..=10).map(|id| simple(id, &long)).collect::<Vec<_>>();
    runtime().block_on(store.record(recordings.clone())).unwrap();
    for filter in
        [Filter::default(), Filter { ids: recordings.iter().map(Recording::id).collect(), ..Filter::default() }]
    {
        let mut cursor = store.cursor(&filter).unwrap();
        let first = store.next_page(&mut cursor).unwrap();
        assert_eq!(first, recordings[..1], "two trajectories of 800 kB exceed a page");
        runtime().block_on(store.record(vec![simple(99, &[1])])).unwrap();
        runtime()
            .block_on(store.delete_trajectories(Filter { ids: vec![Uuid::from_u128(2)], ..Filter::default() }))
            .unwrap();
        let mut rest = Vec::new();
        while let page @ [_, ..] = store.next_page(&mut cursor).unwrap().as_slice() {
            rest.extend(page.iter().map(|r| r.id().as_u128()));
        }
        assert_eq!(rest, (3..=10).collect::<Vec<_>>());
        runtime()
            .block_on(store.delete_trajectories(Filter { ids: vec![Uuid::from_u128(99)], ..Filter::default() }))
            .unwrap();
        // Back again, now behind the others.
        runtime().block_on(store.delete_trajectories(Filter::default())).unwrap();
        runtime().block_on(store.record(recordings.clone())).unwrap();
    }
}

#[test]
fn a_full_disk_is_said_and_loses_nothing_that_was_acknowledged() {
    let directory = tempfile::tempdir().unwrap();
    let store = Store::open(directory.path()).unwrap();
    let runtime = runtime();
    // SQLite's own limit on the database's size stands in for the disk's: the same error takes the same way.
    let limit = |pages: i64| {
        let job = move |connection: &Connection| connection.pragma_update(None, "max_page_count", pages);
        runtime.block_on(store.write(job)).unwrap();
    };
    limit(60);
    let mut acknowledged = Vec::new();
    let error = (1..).find_map(|id| match runtime.block_on(store.record(vec![simple(id, &[5; 2000])])) {
        Ok(_) => {
            acknowledged.push(simple(id, &[5; 2000]));
            None
        }
        Err(error) => Some(error),
    });
    assert!(matches!(error, Some(StoreError::DiskFull { .. })), "{error:?}");
    assert!(!acknowledged.is_empty());
    assert_eq!(read_all(&store, &Filter::default()), acknowledged);
    limit(1_000_000);
    acknowledged.push(simple(1 << 100, &[6; 2000]));
    assert_eq!(runtime.block_on(store.record(acknowledged.clone())).unwrap(), 1);
    assert_eq!(read_all(&store, &Filter::default()), acknowledged);
}

#[test]
fn two_stores_on_one_directory_write_and_read_together() {
    let directory = tempfile::tempdir().unwrap();
    let stores = [Store::open(directory.path()).unwrap(), Store::open(directory.path()).unwrap()];
    std::thread::scope(|scope| {
        for (i, store) in stores.iter().enumerate() {
            scope.spawn(move || {
                for id in 0..100 {
                    // Half of the ids are common to both.
                    let id = if id % 2 == 0 { id } else { id + 1000 * (i as u128 + 1) };
                    runtime().block_on(store.record(vec![simple(id, &[3])])).unwrap();
                }
            });
        }
    });
    for store in &stores {
        assert_eq!(store.count(&Filter::default()).unwrap(), 150);
    }
}

/// A fit of this many trajectories, and their ids.
fn fitted(store: &Store, ids: impl Iterator<Item = u128>) -> (pb::Fit, IdList) {
    let fit = pb::Fit { fit_id: Uuid::new_v4().to_string(), env_id: "e".into(), ..pb::Fit::default() };
    let mut list = store.id_list();
    ids.for_each(|id| list.push(Uuid::from_u128(id)).unwrap());
    (fit, list)
}

#[test]
fn a_fit_tells_what_it_was_made_of_page_by_page() {
    let directory = tempfile::tempdir().unwrap();
    let store = Store::open(directory.path()).unwrap();
    let runtime = runtime();
    let recordings = (0..1300_u32).map(|i| simple(u128::from(i) + 1, &[i % 100, 3])).collect::<Vec<_>>();
    runtime.block_on(store.record(recordings.clone())).unwrap();
    // Every second one, so that a page of ids is two of rows; and a fit of nothing beside it.
    let chosen = (1..=1300_u128).step_by(2);
    let mut stored = Vec::new();
    for ids in [chosen.clone().collect::<Vec<_>>(), Vec::new()] {
        let (fit, list) = fitted(&store, ids.iter().copied());
        let fit = runtime.block_on(store.put_fit(fit, list)).unwrap();
        assert_eq!((fit.trajectories, store.fit(&fit.fit_id).unwrap()), (ids.len() as u64, Some(fit.clone())));
        stored.push(fit.fit_id);
    }
    let all = store.fit_trajectories(&stored[0][..8], 0, 10_000).unwrap().unwrap();
    assert_eq!(all, (chosen.clone().map(Uuid::from_u128).collect(), 650));
    for (after, limit) in [(0, 3), (510, 5), (512, 1), (600, 100), (650, 4), (u64::MAX, 4)] {
        let (ids, total) = store.fit_trajectories(&stored[0], after, limit).unwrap().unwrap();
        let expected = all.0.iter().skip(after.min(650) as usize).take(limit).copied().collect::<Vec<_>>();
        assert_eq!((ids, total), (expected, 650));
    }
    assert_eq!(store.fit_trajectories(&stored[1], 0, 10).unwrap(), Some((Vec::new(), 0)));
    assert_eq!(store.fit_trajectories("none", 0, 10).unwrap(), None);

    // Of what is left of them, those that a filter selects too.
    runtime.block_on(store.delete_trajectories(Filter { ids: vec![Uuid::from_u128(5)], ..Filter::default() })).unwrap();
    let read = |prefix: &str, filter: &Filter| {
        let (mut cursor, mut all) = (store.fit_cursor(prefix, filter).unwrap().unwrap(), Vec::new());
        while let page @ [_, ..] = store.next_page(&mut cursor).unwrap().as_slice() {
            all.extend(page.iter().cloned());
        }
        all
    };
    let left = recordings.iter().step_by(2).filter(|r| r.id() != Uuid::from_u128(5)).cloned().collect::<Vec<_>>();
    assert_eq!(read(&stored[0], &Filter::default()), left);
    assert_eq!(read(&stored[0], &Filter { style: "other".into(), ..Filter::default() }), []);
    assert_eq!(read(&stored[1], &Filter::default()), []);
    assert!(store.fit_cursor("none", &Filter::default()).unwrap().is_none());

    // The ids go with the fit, and wrong ones are found.
    assert!(runtime.block_on(store.delete_fit(stored.remove(1))).unwrap());
    let found = verify(directory.path()).unwrap();
    assert!(found.is_sound() && found.fits.sound == 1, "{found:?}");
    let spoil = |sql: &'static str| {
        runtime.block_on(store.write(move |connection: &Connection| connection.execute(sql, []))).unwrap();
        let found = verify(directory.path()).unwrap();
        (found.fits.damaged, found.damage.first().map(|damage| damage.message.clone()).unwrap_or_default())
    };
    let (damaged, message) = spoil("UPDATE fit_trajectories SET ids = CAST(ids || 'x' AS BLOB) WHERE page = 1");
    assert!(damaged == 1 && message.contains("the digests differ"), "{message}");
    assert_eq!(spoil("DELETE FROM fit_trajectories").0, 1);
}

#[test]
fn fits_of_long_lists_are_read_a_page_at_a_time() {
    let directory = tempfile::tempdir().unwrap();
    let store = Store::open(directory.path()).unwrap();
    let runtime = runtime();
    // A page of two such trajectories is more than a reader holds at a time.
    let recordings = (1..=5).map(|id| simple(id, &vec![1; 100_000])).collect::<Vec<_>>();
    runtime.block_on(store.record(recordings.clone())).unwrap();
    let (fit, list) = fitted(&store, (1..=4).chain([99]));
    let fit = runtime.block_on(store.put_fit(fit, list)).unwrap();
    let mut cursor = store.fit_cursor(&fit.fit_id, &Filter::default()).unwrap().unwrap();
    for recording in &recordings[..4] {
        assert_eq!(store.next_page(&mut cursor).unwrap(), std::slice::from_ref(recording));
    }
    assert!(store.next_page(&mut cursor).unwrap().is_empty() && cursor.is_done());
}

#[test]
fn a_count_sees_every_trajectory_once_and_in_order_whatever_is_asked() {
    let directory = tempfile::tempdir().unwrap();
    let store = Store::open(directory.path()).unwrap();
    let runtime = runtime();
    // One style in three holds a tenth, and is read along its index.
    let recordings = (0..300_u32).map(|i| {
        let (id, mut collection, _, arrays) = simple(u128::from(i) + 1, &[i % 100; 5]).into_parts();
        collection.style = if i % 10 == 0 {
            "seldom"
        } else if i % 2 == 0 {
            "often"
        } else {
            "s"
        }
        .into();
        collection.n_states = if i % 3 == 0 { 100 } else { 70_000 };
        Recording::new(id, collection, None, arrays).unwrap()
    });
    let recordings = recordings.collect::<Vec<_>>();
    runtime.block_on(store.record(recordings.clone())).unwrap();
    for filter in [
        Filter::default(),
        Filter { style: "seldom".into(), ..Filter::default() },
        Filter { style: "often".into(), ..Filter::default() },
        Filter { ids: (5..90).rev().map(Uuid::from_u128).collect(), ..Filter::default() },
        Filter { ids: vec![Uuid::from_u128(11)], style: "often".into(), ..Filter::default() },
    ] {
        let mut seen = Vec::new();
        let outcome = store.for_each(&filter, |stored| {
            seen.push(stored.recording());
            assert_eq!(stored.states().to_vec(), unpack_u32(&seen[seen.len() - 1].arrays().states).collect::<Vec<_>>());
            ControlFlow::<()>::Continue(())
        });
        assert_eq!(outcome.unwrap(), ControlFlow::Continue(()));
        assert_eq!(seen, recordings.iter().filter(|r| passes(&filter, r)).cloned().collect::<Vec<_>>(), "{filter:?}");
        let first = store.for_each(&filter, |stored| ControlFlow::Break(stored.id())).unwrap();
        assert_eq!(first, seen.first().map_or(ControlFlow::Continue(()), |first| ControlFlow::Break(first.id())));
    }
}

#[test]
fn a_repair_keeps_what_each_caller_has_recorded() {
    let directory = tempfile::tempdir().unwrap();
    let one = simple(1, &[1, 2, 3]);
    let bytes = one.packed_bytes() as u64;
    let record = |store: &Store, recording: Recording| {
        let allowance = Allowance { caller: "anna".into(), max_bytes: Some(2 * bytes) };
        runtime()
            .block_on(async { store.queue_recordings_of(Some(allowance), vec![recording]).await?.committed().await })
    };
    let store = Store::open(directory.path()).unwrap();
    record(&store, one.clone()).unwrap();
    record(&store, simple(2, &[4, 5, 6])).unwrap();
    let path = store.path().to_owned();
    drop(store);
    // One of the two is damaged: the caller has recorded it all the same.
    let mut file = std::fs::read(&path).unwrap();
    let hash = one.content_hash();
    let at = file.windows(32).rposition(|window| *window == hash).unwrap();
    file[at] ^= 1;
    std::fs::write(&path, file).unwrap();
    let repaired = repair(directory.path()).unwrap();
    assert_eq!(repaired.found.trajectories, Tally { sound: 1, damaged: 1 });
    let store = Store::open(directory.path()).unwrap();
    let refused = record(&store, simple(3, &[7, 8, 9]));
    assert!(matches!(refused, Err(StoreError::AllowanceSpent { .. })), "{refused:?}");
}

#[test]
fn what_lists_tell_of_a_fit_is_checked_and_made_anew() {
    let samples = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/data");
    let copied = |name: &str| {
        let directory = tempfile::tempdir().unwrap();
        std::fs::copy(samples.join(format!("store_{name}.sqlite3")), directory.path().join(FILE_NAME)).unwrap();
        directory
    };
    let fits = |directory: &Path| {
        let store = Store::open(directory).unwrap();
        let with_ids = |fit: FitInfo| (store.fit_trajectories(&fit.fit_id, 0, 1000).unwrap(), fit);
        store.fits("", "", i64::MAX, 10).unwrap().into_iter().map(with_ids).collect::<Vec<_>>()
    };
    for name in ["v1", "v2", "v2_hashed"] {
        let told = fits(copied(name).path());
        assert!(!told.is_empty(), "{name}");
        for damage in ["agreement = 0.125", "method = 'none'", "created_at = 1", "iterations = -1"] {
            let directory = copied(name);
            let file = Connection::open(directory.path().join(FILE_NAME)).unwrap();
            file.execute(&format!("UPDATE fits SET {damage}"), []).unwrap();
            drop(file);
            let found = verify(directory.path()).unwrap();
            assert!(!found.is_sound() && found.fits.damaged == 0, "{name}, {damage}: {found:?}");
            assert!(found.structure[0].contains(&told[0].1.fit_id), "{found:?}");
            let repaired = repair(directory.path()).unwrap();
            assert!(repaired.kept.is_some() && repaired.found.fits.sound == told.len() as u64, "{repaired:?}");
            assert_eq!(fits(directory.path()), told, "{name}, {damage}");
        }
    }
}
