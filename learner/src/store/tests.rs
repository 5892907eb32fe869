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
