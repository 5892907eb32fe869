use super::*;
use crate::sim::{Driver, Outcome, Rng, Space, maze, rng};
use proptest::prelude::*;

/// A chain of states that ends at random: what no maze does. Observes its state, counts its steps in the info.
#[derive(Debug, Clone, PartialEq)]
struct Chain {
    state: u32,
    steps: i32,
}

const STATES: u32 = 11;

impl Simulator for Chain {
    type Stored = Self;
    const STEP_NANOS: usize = 1_000;

    fn stored(&self) -> Self {
        self.clone()
    }

    fn load<'a>(_scratch: &'a mut Self, stored: &'a mut Self) -> &'a mut Self {
        stored
    }

    fn save(_scratch: &Self, _stored: &mut Self) {}

    fn reset(&mut self, rng: &mut Rng) {
        *self = Self { state: rng::below(rng, STATES), steps: 0 };
    }

    fn step(&mut self, action: u32, rng: &mut Rng) -> Outcome {
        self.state = (self.state + action + rng::below(rng, 2)) % STATES;
        self.steps += 1;
        Outcome { reward: f64::from(self.state) / 4.0, terminated: rng::below(rng, 5) == 0 }
    }

    fn tabular_state(&self) -> u32 {
        self.state
    }

    fn write_observation(&self, out: &mut [u8]) {
        out.copy_from_slice(&(self.state as i32).to_le_bytes());
    }

    fn write_info(&self, _column: usize, out: &mut [u8]) {
        out.copy_from_slice(&self.steps.to_le_bytes());
    }

    fn info_value(&self, _column: usize) -> f64 {
        f64::from(self.steps)
    }

    fn write_action_mask(&self, out: &mut [u8]) {
        out.fill(1);
        out[self.state as usize % out.len()] = 0;
    }

    fn render_text(&self) -> String {
        self.state.to_string()
    }

    fn render_svg(&self) -> String {
        "<svg xmlns='http://www.w3.org/2000/svg' width='1' height='1'/>".into()
    }

    fn driver(&self, _name: &str) -> Option<Box<dyn Driver<Self>>> {
        None
    }
}

fn chain() -> Configured<Chain> {
    let steps = InfoColumn {
        name: "steps",
        dtype: DType::Int32,
        shape: Vec::new(),
        unit: "1",
        description: "steps since the reset",
        summed: false,
    };
    let spec = EnvSpec {
        env_id: "Chain-v0",
        description: "a chain",
        observation_space: Space::Discrete { n: STATES },
        n_actions: 3,
        n_states: STATES,
        info_columns: vec![steps],
        max_episode_steps: 0,
        options: Vec::new(),
        drivers: Vec::new(),
        styles: Vec::new(),
        render_fps: 1,
    };
    Configured { spec: Arc::new(spec), prototype: Chain { state: 0, steps: 0 } }
}

fn options(num_envs: usize, autoreset: Autoreset, max_episode_steps: u32) -> BatchOptions {
    BatchOptions { num_envs, autoreset, max_episode_steps, action_masks: true }
}

fn batch(num_envs: usize, autoreset: Autoreset, max_episode_steps: u32) -> SimBatch<Chain> {
    SimBatch::new(chain(), options(num_envs, autoreset, max_episode_steps))
}

fn pack(actions: &[i32]) -> Vec<u8> {
    actions.iter().flat_map(|action| action.to_le_bytes()).collect()
}

/// Row `index` of every part of a reply but the final ones.
fn row(buffers: &StepBuffers, index: usize) -> Vec<Vec<u8>> {
    let layout = buffers.layout();
    let parts = [&layout.observations, &layout.rewards, &layout.terminated, &layout.truncated];
    parts.into_iter().chain(&layout.infos).map(|range| slice(buffers.bytes(), range, layout.num_envs, index)).collect()
}

fn final_row(buffers: &StepBuffers, index: usize) -> Vec<Vec<u8>> {
    let layout = buffers.layout();
    let parts = std::iter::once(&layout.final_observations).chain(&layout.final_infos);
    parts.map(|range| slice(&buffers.bytes, range, layout.num_envs, index)).collect()
}

fn slice(bytes: &[u8], range: &std::ops::Range<usize>, num_envs: usize, index: usize) -> Vec<u8> {
    let len = range.len() / num_envs;
    bytes[range.start + index * len..][..len].to_vec()
}

fn ended(buffers: &StepBuffers, index: usize) -> bool {
    buffers.terminated()[index] == 1 || buffers.truncated()[index] == 1
}

fn modes() -> impl Strategy<Value = Autoreset> {
    prop_oneof![Just(Autoreset::NextStep), Just(Autoreset::SameStep), Just(Autoreset::Disabled)]
}

proptest! {
    #[test]
    fn a_batch_is_as_many_singles(
        mode in modes(),
        num_envs in 1_usize..6,
        max_episode_steps in 0_u32..8,
        seed in prop_oneof![any::<u64>(), Just(u64::MAX), Just(u64::MAX - 2)],
        actions in prop::collection::vec(prop::collection::vec(0_i32..3, 6), 1..40),
    ) {
        let mut whole = batch(num_envs, mode, max_episode_steps);
        let mut singles: Vec<_> = (0..num_envs).map(|_| batch(1, mode, max_episode_steps)).collect();
        whole.reset(Seeds::From(seed), None).unwrap();
        for (i, single) in singles.iter_mut().enumerate() {
            single.reset(Seeds::From(seed.wrapping_add(i as u64)), None).unwrap();
            prop_assert_eq!(row(whole.buffers(), i), row(single.buffers(), 0));
        }
        for actions in actions {
            if mode == Autoreset::Disabled {
                let mask: Vec<u8> = (0..num_envs).map(|i| u8::from(ended(whole.buffers(), i))).collect();
                whole.reset(Seeds::Continue, Some(&mask)).unwrap();
                for single in singles.iter_mut().zip(&mask).filter(|(_, flag)| **flag == 1).map(|(single, _)| single) {
                    single.reset(Seeds::Continue, None).unwrap();
                }
            }
            whole.step(&pack(&actions[..num_envs])).unwrap();
            let mut any_final = false;
            for (i, single) in singles.iter_mut().enumerate() {
                single.step(&pack(&actions[i..=i])).unwrap();
                prop_assert_eq!(row(whole.buffers(), i), row(single.buffers(), 0));
                prop_assert_eq!(whole.tabular_state(i), single.tabular_state(0));
                any_final |= single.buffers().has_final();
                // Rows of environments that did not end are zero in both.
                prop_assert_eq!(final_row(whole.buffers(), i), final_row(single.buffers(), 0));
            }
            prop_assert_eq!(whole.buffers().has_final(), any_final);
        }
    }

    #[test]
    fn a_seeded_reset_forgets_the_past(
        seed in any::<u64>(), before in 0_usize..20, actions in prop::collection::vec(0_i32..3, 1..20),
    ) {
        let (mut old, mut new) = (batch(1, Autoreset::NextStep, 6), batch(1, Autoreset::NextStep, 6));
        old.reset(Seeds::From(!seed), None).unwrap();
        for _ in 0..before {
            old.step(&pack(&[1])).unwrap();
        }
        old.reset(Seeds::From(seed), None).unwrap();
        new.reset(Seeds::Each(&seed.to_le_bytes()), None).unwrap();
        for action in actions {
            prop_assert_eq!(old.buffers(), new.buffers());
            old.step(&pack(&[action])).unwrap();
            new.step(&pack(&[action])).unwrap();
        }
    }

    #[test]
    fn the_autoreset_modes_tell_one_story(seed in any::<u64>(), actions in prop::collection::vec(0_i32..3, 1..60)) {
        let [mut disabled, mut same, mut next] =
            [Autoreset::Disabled, Autoreset::SameStep, Autoreset::NextStep].map(|mode| batch(1, mode, 4));
        for batch in [&mut disabled, &mut same, &mut next] {
            batch.reset(Seeds::From(seed), None).unwrap();
        }
        for action in actions {
            let action = pack(&[action]);
            for batch in [&mut disabled, &mut same, &mut next] {
                batch.step(&action).unwrap();
            }
            // Without autoreset and with the one of the next step, a step shows the end of the episode.
            prop_assert_eq!(row(disabled.buffers(), 0), row(next.buffers(), 0));
            let (shown, resetting) = (disabled.buffers().clone(), same.buffers().clone());
            prop_assert_eq!(shown.rewards(), resetting.rewards());
            prop_assert_eq!([shown.terminated(), shown.truncated()], [resetting.terminated(), resetting.truncated()]);
            if ended(&shown, 0) {
                prop_assert_eq!(shown.observations(), resetting.final_observations());
                prop_assert_eq!(shown.info(0), resetting.final_info(0));
                // The action of the resetting step is ignored, even one that there is not.
                next.step(&pack(&[-7])).unwrap();
                disabled.reset(Seeds::Continue, Some(&[1])).unwrap();
                prop_assert_eq!(row(disabled.buffers(), 0), row(next.buffers(), 0));
                prop_assert_eq!(next.buffers().observations(), resetting.observations());
                prop_assert_eq!((next.buffers().reward(0), ended(next.buffers(), 0)), (0.0, false));
            } else {
                prop_assert!(!resetting.has_final());
                prop_assert_eq!(row(&shown, 0), row(&resetting, 0));
            }
        }
    }

    #[test]
    fn a_refused_call_changes_nothing(seed in any::<u64>(), steps in 0_usize..10) {
        let (mut tried, mut spared) = (batch(3, Autoreset::SameStep, 5), batch(3, Autoreset::SameStep, 5));
        for batch in [&mut tried, &mut spared] {
            batch.reset(Seeds::From(seed), None).unwrap();
            for _ in 0..steps {
                batch.step(&pack(&[0, 1, 2])).unwrap();
            }
        }
        tried.step(&pack(&[0, 1, 3])).unwrap_err();
        tried.step(&pack(&[0, 1])).unwrap_err();
        tried.reset(Seeds::Each(&[0; 23]), None).unwrap_err();
        tried.reset(Seeds::From(1), Some(&[1, 1])).unwrap_err();
        tried.reset(Seeds::From(1), Some(&[1, 1, 2])).unwrap_err();
        for _ in 0..5 {
            prop_assert_eq!(tried.buffers(), spared.buffers());
            tried.step(&pack(&[2, 1, 0])).unwrap();
            spared.step(&pack(&[2, 1, 0])).unwrap();
        }
    }
}

#[test]
fn the_time_limit_truncates_and_zero_never_does() {
    let maze = maze::configure(&serde_json::Map::new()).unwrap();
    let mut limited = SimBatch::new(maze.clone(), options(1, Autoreset::Disabled, 3));
    let mut unlimited = SimBatch::new(maze, options(1, Autoreset::Disabled, 0));
    limited.reset(Seeds::From(0), None).unwrap();
    unlimited.reset(Seeds::From(0), None).unwrap();
    let flags: Vec<_> = (0..3).map(|_| limited.step(&pack(&[0])).unwrap().truncated()[0]).collect();
    assert_eq!(flags, [0, 0, 1]);
    assert_eq!(limited.step(&pack(&[0])), Err(BatchError::EpisodeEnded { index: 0 }));
    assert!((0..1000).all(|_| unlimited.step(&pack(&[0])).unwrap().truncated() == [0]));
}

#[test]
fn an_ended_episode_is_stepped_only_after_its_reset() {
    let mut batch = batch(2, Autoreset::Disabled, 2);
    batch.reset(Seeds::From(3), None).unwrap();
    while !ended(batch.buffers(), 0) {
        batch.step(&pack(&[0, 0])).unwrap();
    }
    let refused = batch.step(&pack(&[0, 0])).unwrap_err();
    assert_eq!(refused, BatchError::EpisodeEnded { index: 0 });
    let other = batch.buffers().observations()[4..].to_vec();
    let mask = [1, u8::from(ended(batch.buffers(), 1))];
    batch.reset(Seeds::Continue, Some(&mask)).unwrap();
    if mask[1] == 0 {
        assert_eq!(batch.buffers().observations()[4..], other, "a masked environment repeats its observation");
    }
    batch.step(&pack(&[0, 0])).unwrap();
}

#[test]
fn nothing_but_a_whole_reset_comes_first() {
    let mut batch = batch(2, Autoreset::NextStep, 0);
    assert_eq!(batch.step(&pack(&[0, 0])), Err(BatchError::NeverReset));
    assert_eq!(batch.render_text(0), Err(BatchError::NeverReset));
    assert_eq!(batch.reset(Seeds::From(0), Some(&[1, 0])), Err(BatchError::MaskLeavesUnborn { index: 1 }));
    assert_eq!(batch.step(&pack(&[0, 0])), Err(BatchError::NeverReset));
    batch.reset(Seeds::Continue, Some(&[1, 1])).unwrap();
    batch.step(&pack(&[0, 0])).unwrap();
    assert_eq!(batch.render_text(2), Err(BatchError::IndexOutOfRange { index: 2, num_envs: 2 }));
}

#[test]
fn unseeded_environments_differ_and_go_on() {
    let observe = || {
        let mut batch = batch(64, Autoreset::NextStep, 0);
        let first = batch.reset(Seeds::Continue, None).unwrap().observations().to_vec();
        (first, batch.reset(Seeds::Continue, None).unwrap().observations().to_vec())
    };
    let ((first, second), (other, _)) = (observe(), observe());
    assert_ne!(first, other, "the operating system seeds");
    assert_ne!(first, second, "the generator goes on");
}

#[test]
fn errors_name_their_field() {
    let mut batch = batch(3, Autoreset::NextStep, 0);
    batch.reset(Seeds::From(0), None).unwrap();
    let field = |error: BatchError| error.field().unwrap();
    assert_eq!(field(batch.step(&pack(&[0, 3, 0])).unwrap_err()), "actions[1]");
    assert_eq!(field(batch.step(&pack(&[0, 0, -1])).unwrap_err()), "actions[2]");
    let wrong_length = batch.step(&pack(&[0])).unwrap_err();
    assert_eq!(wrong_length.to_string(), "expected 12 bytes of int32 actions for 3 environments, got 4");
    assert_eq!(field(batch.reset(Seeds::Each(&[]), None).unwrap_err()), "seeds");
    assert_eq!(field(batch.reset(Seeds::Continue, Some(&[1])).unwrap_err()), "reset_mask");
    assert_eq!(field(batch.reset(Seeds::Continue, Some(&[1, 0, 9])).unwrap_err()), "reset_mask[2]");
}

#[test]
fn the_layout_is_known_beforehand_and_steps_keep_the_block() {
    let mut batch = batch(5, Autoreset::SameStep, 1);
    assert_eq!(Layout::of(batch.spec(), batch.options()), *batch.buffers().layout());
    let place = batch.buffers().bytes.as_ptr();
    batch.reset(Seeds::From(0), None).unwrap();
    let present = batch.buffers().bytes().len();
    assert_eq!(present, 5 * (4 + 8 + 1 + 1 + 4 + 3));
    batch.step(&pack(&[0; 5])).unwrap();
    assert_eq!(batch.buffers().bytes().len(), present + 5 * (4 + 4 + 3));
    assert_eq!(batch.buffers().bytes.as_ptr(), place);
}

#[test]
fn the_action_mask_is_the_last_column() {
    let mut batch = batch(1, Autoreset::NextStep, 0);
    batch.reset(Seeds::From(0), None).unwrap();
    assert_eq!(batch.info_columns().last().map(|column| column.name), Some(ACTION_MASK));
    let blocked = batch.tabular_state(0).unwrap() as usize % 3;
    assert_eq!(batch.buffers().info(1).iter().position(|&flag| flag == 0), Some(blocked));
}

#[test]
fn cores_change_nothing() {
    // Large enough for several blocks; chains end at random, so that every mode has its resets.
    const ENVS: usize = 1_000;
    assert!(ENVS > 8 * parallel::block_envs::<Chain>());
    for autoreset in [Autoreset::NextStep, Autoreset::SameStep, Autoreset::Disabled] {
        let replies = || {
            let mut batch = batch(ENVS, autoreset, 7);
            let mut replies = vec![batch.reset(Seeds::From(3), None).unwrap().clone()];
            for step in 0..20 {
                if autoreset == Autoreset::Disabled {
                    let over: Vec<u8> = (0..ENVS).map(|i| u8::from(ended(&replies[replies.len() - 1], i))).collect();
                    replies.push(batch.reset(Seeds::Continue, Some(&over)).unwrap().clone());
                }
                let actions: Vec<i32> = (0..ENVS as i32).map(|i| (i + step) % 3).collect();
                replies.push(batch.step(&pack(&actions)).unwrap().clone());
            }
            replies
        };
        let on = |threads| rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(replies);
        let alone = on(1);
        assert_eq!(alone[20].has_final(), autoreset == Autoreset::SameStep);
        for threads in [2, 3, 7] {
            assert!(on(threads) == alone, "{autoreset:?} on {threads} threads");
        }
        // Outside of any pool.
        assert!(replies() == alone, "{autoreset:?} on all cores");
    }
}
