use super::*;
use crate::{
    batch::{Autoreset, Batch, BatchOptions, Seeds, SimBatch},
    sim::{
        highway, maze,
        rng::{Purpose, stream},
    },
};
use proptest::prelude::*;
use std::sync::atomic::{AtomicU32, Ordering};

fn maze() -> Configured<maze::Maze> {
    maze::configure(&serde_json::Map::new()).unwrap()
}

fn uniform_policy() -> Controller {
    Controller::Policy(TabularPolicy::new(&[0.25; 57 * 4], 57, 4).unwrap())
}

fn plan(controller: Controller) -> RolloutPlan {
    RolloutPlan {
        controller,
        seed: 40,
        episodes: 23,
        steps: 17,
        burn_in_steps: 0,
        totals_only: false,
        compact: false,
        chunk_episodes: 8,
    }
}

/// A whole roll-out, unpacked.
#[derive(Debug, Clone, Default, PartialEq)]
struct All {
    lengths: Vec<u32>,
    states: Vec<u32>,
    actions: Vec<u32>,
    rewards: Vec<f64>,
    final_states: Vec<u32>,
    terminated: Vec<bool>,
    returns: Vec<f64>,
    totals: Vec<Vec<f64>>,
}

impl All {
    fn of<S: Simulator>(configured: &Configured<S>, plan: &RolloutPlan) -> (Self, Vec<StepFormat>) {
        let (mut all, mut formats) = (Self::default(), Vec::new());
        plan.check(&configured.spec).unwrap();
        roll_out(configured, plan, &|| false, &mut |chunk| {
            assert!(chunk.lengths.len() <= plan.chunk_episodes as usize);
            assert_eq!(chunk.first_episode as usize, all.lengths.len());
            let steps = chunk.steps;
            all.lengths.extend(chunk.lengths);
            all.states.extend((0..steps.len()).map(|at| steps.state(at)));
            all.actions.extend((0..steps.len()).map(|at| steps.action(at)));
            all.rewards.extend((0..steps.len()).map(|at| steps.reward(at)));
            all.final_states.extend(chunk.final_states);
            all.terminated.extend(chunk.terminated);
            all.returns.extend(chunk.returns);
            all.totals.resize(chunk.totals.len(), Vec::new());
            all.totals.iter_mut().zip(chunk.totals).for_each(|(all, more)| all.extend(more));
            formats.push(steps.format);
            true
        });
        (all, formats)
    }
}

fn run(plan: &RolloutPlan) -> All {
    All::of(&maze(), plan).0
}

#[test]
fn threads_and_chunks_change_nothing() {
    for controller in [uniform_policy(), Controller::Driver("random".into()), Controller::Driver("optimal".into())] {
        let reference = run(&plan(controller.clone()));
        assert_eq!(reference.lengths, [17; 23]);
        for threads in [1, 2, 5] {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            assert_eq!(pool.install(|| run(&plan(controller.clone()))), reference);
        }
        for chunk_episodes in [1, 5, 100] {
            assert_eq!(run(&RolloutPlan { chunk_episodes, ..plan(controller.clone()) }), reference);
            assert_eq!(run(&RolloutPlan { chunk_episodes, compact: true, ..plan(controller.clone()) }), reference);
        }
    }
}

/// A highway whose episodes end at random lengths, driven over many groups.
fn crashes(compact: bool) -> RolloutPlan {
    RolloutPlan { compact, episodes: 90, steps: 300, chunk_episodes: 40, ..plan(Controller::Driver("bad".into())) }
}

#[test]
fn compact_steps_are_the_same_steps() {
    let options = serde_json::json!({"terminate_on_collision": true, "style": "legal"});
    let highway = highway::configure(options.as_object().unwrap()).unwrap();
    let (whole, formats) = All::of(&highway, &crashes(false));
    let widths = StepFormat { states: Width::Four, actions: Width::Four, rewards: RewardFormat::Values };
    assert_eq!(formats, [widths; 3]);
    assert!(whole.lengths.iter().any(|&length| length < 300) && whole.rewards.iter().any(|&reward| reward < 0.0));
    for threads in [1, 3] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let (compact, formats) = pool.install(|| All::of(&highway, &crashes(true)));
        let widths = StepFormat { states: Width::One, actions: Width::One, rewards: RewardFormat::Ranks };
        assert_eq!(formats, [widths; 3]);
        assert_eq!(compact, whole);
    }
}

#[test]
fn rewards_too_many_for_ranks_and_states_too_many_for_a_byte_stay_whole() {
    let rewards: Vec<f64> = (0..300).map(|state| f64::from(state) / 7.0).collect();
    let options = serde_json::json!({"layout": [".".repeat(300)], "rewards": rewards, "slip": 0.0});
    let maze = maze::configure(options.as_object().unwrap()).unwrap();
    // Ten steps from anywhere: the first chunks have few rewards, a later one has too many.
    let plan = |compact, chunk_episodes| RolloutPlan {
        compact,
        chunk_episodes,
        episodes: 300,
        steps: 10,
        ..plan(Controller::Driver("random".into()))
    };
    let (whole, _) = All::of(&maze, &plan(false, 300));
    let (compact, formats) = All::of(&maze, &plan(true, 20));
    assert_eq!(compact, whole);
    assert!(formats.iter().all(|format| format.states == Width::Two && format.actions == Width::One));
    assert_eq!(formats[0].rewards, RewardFormat::Ranks);
    let (compact, formats) = All::of(&maze, &plan(true, 300));
    assert_eq!((compact, formats[0].rewards), (whole, RewardFormat::Values));
}

#[test]
fn episode_i_is_seeded_with_seed_plus_i() {
    let all = run(&plan(uniform_policy()));
    let later = run(&RolloutPlan { seed: 45, episodes: 1, ..plan(uniform_policy()) });
    assert_eq!(later.states, all.states[5 * 17..6 * 17]);
    assert_eq!(later.actions, all.actions[5 * 17..6 * 17]);
}

#[test]
fn a_session_that_repeats_the_actions_sees_the_same_episode() {
    let all = run(&plan(Controller::Driver("random".into())));
    let options =
        BatchOptions { num_envs: 23, autoreset: Autoreset::Disabled, max_episode_steps: 0, action_masks: false };
    let mut batch = SimBatch::new(maze(), options);
    batch.reset(Seeds::From(40), None).unwrap();
    for step in 0..17 {
        let at = |episode: usize| episode * 17 + step;
        for episode in 0..23 {
            assert_eq!(batch.tabular_state(episode), Ok(all.states[at(episode)]));
        }
        let actions: Vec<u8> = (0..23).flat_map(|episode| (all.actions[at(episode)] as i32).to_le_bytes()).collect();
        let buffers = batch.step(&actions).unwrap();
        for episode in 0..23 {
            assert_eq!(buffers.reward(episode), all.rewards[at(episode)]);
        }
    }
    for episode in 0..23 {
        assert_eq!(batch.tabular_state(episode), Ok(all.final_states[episode]));
    }
}

#[test]
fn burn_in_is_the_head_of_a_longer_episode() {
    let whole = run(&plan(uniform_policy()));
    let tail = run(&RolloutPlan { burn_in_steps: 5, steps: 12, ..plan(uniform_policy()) });
    for episode in 0..23 {
        assert_eq!(tail.states[episode * 12..][..12], whole.states[episode * 17 + 5..][..12]);
    }
    assert_eq!(tail.final_states, whole.final_states);
}

#[test]
fn an_episode_that_ends_in_burn_in_begins_anew() {
    let options = serde_json::json!({"terminate_on_collision": true, "density": 8});
    let highway = highway::configure(options.as_object().unwrap()).unwrap();
    // Always as fast as possible in one lane: it hits before long.
    let row = |action: usize| f64::from(u8::from(action % 12 == 3));
    let policy = TabularPolicy::new(&(0..36 * 12).map(row).collect::<Vec<_>>(), 36, 12).unwrap();
    let plan = RolloutPlan { burn_in_steps: 100, episodes: 20, ..plan(Controller::Policy(policy)) };
    let mut chunks = Vec::new();
    roll_out(&highway, &plan, &|| false, &mut |chunk| {
        chunks.push(chunk);
        true
    });
    let states: Vec<_> =
        chunks.iter().flat_map(|chunk| (0..chunk.steps.len()).map(|at| chunk.steps.state(at))).collect();
    let lengths: Vec<_> = chunks.iter().flat_map(|chunk| chunk.lengths.clone()).collect();
    let terminated: Vec<_> = chunks.iter().flat_map(|chunk| chunk.terminated.clone()).collect();
    assert!(terminated.iter().any(|&flag| flag));
    // A batch that resets in the step of a collision goes the same way.
    let options =
        BatchOptions { num_envs: 1, autoreset: Autoreset::SameStep, max_episode_steps: 0, action_masks: false };
    let (mut at, mut restarts) = (0, 0);
    for episode in 0..20 {
        let mut batch = SimBatch::new(highway.clone(), options);
        batch.reset(Seeds::From(40 + episode as u64), None).unwrap();
        for _ in 0..100 {
            restarts += u32::from(batch.step(&3_i32.to_le_bytes()).unwrap().terminated()[0]);
        }
        for step in 0..lengths[episode] {
            assert_eq!(batch.tabular_state(0), Ok(states[at]));
            let ended = batch.step(&3_i32.to_le_bytes()).unwrap().terminated()[0] == 1;
            assert_eq!(ended, terminated[episode] && step + 1 == lengths[episode]);
            at += 1;
        }
        assert!(terminated[episode] || lengths[episode] == 17);
    }
    assert!(restarts > 20, "{restarts} restarts");
}

#[test]
fn totals_alone_are_the_same_totals() {
    let (whole, totals) =
        (run(&plan(uniform_policy())), run(&RolloutPlan { totals_only: true, ..plan(uniform_policy()) }));
    assert!(totals.states.is_empty() && totals.actions.is_empty() && totals.rewards.is_empty());
    assert_eq!(
        (totals.returns, totals.lengths, totals.final_states),
        (whole.returns, whole.lengths, whole.final_states)
    );
}

#[test]
fn it_stops_when_nobody_listens() {
    let mut chunks = 0;
    roll_out(&maze(), &plan(uniform_policy()), &|| false, &mut |_| {
        chunks += 1;
        false
    });
    assert_eq!(chunks, 1);
    // A single endless episode asks now and then.
    let asked = AtomicU32::new(0);
    let endless = RolloutPlan { steps: u32::MAX, totals_only: true, episodes: 1, ..plan(uniform_policy()) };
    let cancelled = || asked.fetch_add(1, Ordering::Relaxed) > 2;
    roll_out(&maze(), &endless, &cancelled, &mut |_| panic!("it was cancelled"));
}

#[test]
fn wrong_plans_name_their_field() {
    let spec = maze().spec;
    let field = |plan: RolloutPlan| plan.check(&spec).unwrap_err().field();
    assert_eq!(field(RolloutPlan { episodes: 0, ..plan(uniform_policy()) }), "episodes");
    assert_eq!(field(RolloutPlan { steps: 0, ..plan(uniform_policy()) }), "steps");
    let unknown = plan(Controller::Driver("kamikaze".into())).check(&spec).unwrap_err();
    assert_eq!(unknown.field(), "driver");
    assert_eq!(unknown.to_string(), "expected a driver among optimal, random, got \"kamikaze\"");
    let small = TabularPolicy::new(&[1.0], 1, 1).unwrap();
    assert_eq!(field(plan(Controller::Policy(small))), "policy.probabilities");
    let policy = |values: &[f64]| TabularPolicy::new(values, 2, 2).unwrap_err().field();
    assert_eq!(policy(&[1.0, 0.0, 0.5]), "policy.probabilities");
    assert_eq!(policy(&[1.0, 0.0, 1.5, -0.5]), "policy.probabilities[1][1]");
    assert_eq!(policy(&[f64::NAN, 0.0, 0.5, 0.5]), "policy.probabilities[0][0]");
    assert_eq!(policy(&[1.0, 0.0, 0.5, 0.49]), "policy.probabilities[1]");
}

proptest! {
    #[test]
    fn drawn_actions_have_positive_probability(
        weights in prop::collection::vec(prop_oneof![Just(0.0), 0.01..1.0_f64], 1..8), seed in any::<u64>(),
    ) {
        let total: f64 = weights.iter().sum();
        prop_assume!(total > 0.0);
        let row: Vec<f64> = weights.iter().map(|weight| weight / total).collect();
        let policy = TabularPolicy::new(&row, 1, row.len() as u32).unwrap();
        let mut rng = stream(seed, Purpose::Controller);
        for _ in 0..200 {
            prop_assert!(row[policy.draw(0, &mut rng) as usize] > 0.0);
        }
    }
}

#[test]
fn actions_are_drawn_as_often_as_they_are_probable() {
    let row = [0.1, 0.0, 0.6, 0.3];
    let policy = TabularPolicy::new(&row, 1, 4).unwrap();
    let mut rng = stream(1, Purpose::Controller);
    let mut counts = [0_u32; 4];
    for _ in 0..100_000 {
        counts[policy.draw(0, &mut rng) as usize] += 1;
    }
    for (count, probability) in counts.into_iter().zip(row) {
        // Four standard deviations are below 0.0063.
        assert!((f64::from(count) / 1e5 - probability).abs() < 0.0063, "{counts:?}");
    }
}
