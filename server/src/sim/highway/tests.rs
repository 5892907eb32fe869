use proptest::prelude::*;
use serde_json::json;

use super::{road::LENGTH_M, *};
use crate::sim::{
    TabularModel,
    rng::{Purpose, below, stream, uniform},
};

fn made(options: Value) -> Result<Configured<Highway>, OptionError> {
    configure(options.as_object().expect("an object"))
}

fn highway() -> Highway {
    made(json!({})).expect("defaults").prototype
}

/// Means a step of collisions, overtakes from the left and from the right, and speed.
fn means(name: &str, episodes: u64, steps: u32) -> [f64; 4] {
    let mut totals = [0.0; 4];
    for seed in 0..episodes {
        let mut highway = highway();
        let mut driver = highway.driver(name).expect("a driver");
        let (mut rng, mut controller) = (stream(seed, Purpose::Dynamics), stream(seed, Purpose::Controller));
        highway.reset(&mut rng);
        for _ in 0..steps {
            let action = driver.act(&highway, &mut controller);
            highway.step(action, &mut rng);
            for (column, total) in totals.iter_mut().enumerate() {
                *total += highway.info_value(column);
            }
        }
    }
    totals.map(|total| total / (episodes * u64::from(steps)) as f64)
}

#[test]
fn experts_are_unmistakable() {
    let [aggressive, bad, legal] = STYLES.map(|style| means(style, 600, 200));
    assert!(bad[COLLISIONS] >= 10.0 * aggressive[COLLISIONS], "{bad:?} {aggressive:?}");
    assert!(aggressive[COLLISIONS] <= 0.02, "{aggressive:?}");
    assert!(aggressive[OVERTAKES_RIGHT] >= 0.05, "{aggressive:?}");
    assert!(legal[OVERTAKES_RIGHT] < 0.002, "{legal:?}");
    assert!(legal[COLLISIONS] <= 0.005, "{legal:?}");
    assert!(aggressive[SPEED] > legal[SPEED] + 2.0, "{aggressive:?} {legal:?}");
}

/// Acts by the action that a driver took most often in each of the 36 states.
fn clone_of(name: &str) -> ([u32; 36], f64) {
    let mut counts = [[0u32; 12]; 36];
    for seed in 0..200 {
        let mut highway = highway();
        let mut driver = highway.driver(name).expect("a driver");
        let (mut rng, mut controller) = (stream(seed, Purpose::Dynamics), stream(seed, Purpose::Controller));
        highway.reset(&mut rng);
        for _ in 0..200 {
            let action = driver.act(&highway, &mut controller);
            counts[highway.tabular_state() as usize][action as usize] += 1;
            highway.step(action, &mut rng);
        }
    }
    let best = |row: &[u32; 12]| (0..12).max_by_key(|&action| row[action]).expect("actions") as u32;
    let agreed: u32 = counts.iter().map(|row| row[best(row) as usize]).sum();
    (counts.each_ref().map(best), f64::from(agreed) / f64::from(counts.iter().flatten().sum::<u32>()))
}

#[test]
fn styles_survive_the_36_states() {
    for (name, agreement, collisions, overtakes_right) in [
        ("aggressive", 0.97, 0.0..0.05, 0.08..0.15),
        ("bad", 0.83, 0.1..1.0, 0.0..1.0),
        ("legal", 0.97, 0.0..0.005, 0.0..0.004),
    ] {
        let (policy, agreed) = clone_of(name);
        assert!(agreed > agreement, "{name} agrees in {agreed}");
        let mut totals = [0.0; 4];
        for seed in 1000..1200 {
            let (mut highway, mut rng) = (highway(), stream(seed, Purpose::Dynamics));
            highway.reset(&mut rng);
            for _ in 0..200 {
                highway.step(policy[highway.tabular_state() as usize], &mut rng);
                for (column, total) in totals.iter_mut().enumerate() {
                    *total += highway.info_value(column) / 40_000.0;
                }
            }
        }
        assert!(collisions.contains(&totals[COLLISIONS]), "{name}: {totals:?}");
        assert!(overtakes_right.contains(&totals[OVERTAKES_RIGHT]), "{name}: {totals:?}");
    }
}

#[test]
fn random_driver_reaches_all_states() {
    let (mut highway, mut rng, mut controller) =
        (highway(), stream(1, Purpose::Dynamics), stream(1, Purpose::Controller));
    let mut driver = highway.driver("random").unwrap();
    let mut visits = [0u32; 36];
    highway.reset(&mut rng);
    for _ in 0..100_000 {
        visits[highway.tabular_state() as usize] += 1;
        let action = driver.act(&highway, &mut controller);
        highway.step(action, &mut rng);
    }
    assert!(visits.iter().all(|&n| n > 50), "{visits:?}");
    assert!(highway.driver("reckless").is_none());
}

/// The invariants of a road that every step must keep.
fn check(highway: &Highway) {
    let road = &highway.road;
    let vehicles: Vec<_> = road.vehicles().collect();
    assert_eq!(vehicles.len(), road.n_vehicles());
    assert!(vehicles.windows(2).all(|pair| pair[0].x_m >= pair[1].x_m), "not front to back: {vehicles:?}");
    for lane in 0..LANES {
        let mut bodies: Vec<f64> = vehicles.iter().filter(|v| v.lane == lane).map(|v| v.x_m).collect();
        if lane == road.host_lane {
            bodies.push(0.0);
        }
        bodies.sort_by(f64::total_cmp);
        assert!(bodies.windows(2).all(|pair| pair[1] - pair[0] >= LENGTH_M), "overlap in lane {lane}: {bodies:?}");
    }
    for vehicle in &vehicles {
        assert!(vehicle.lane < LANES && (0.0..=27.6).contains(&vehicle.speed_mps), "{vehicle:?}");
        assert!(vehicle.x_m.abs() < MAX_DISTANCE_M);
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn nothing_ever_overlaps(seed: u64, density in 0.0..=8.0f64, persistence in 1..10u32) {
        let mut highway = made(json!({"density": density})).unwrap().prototype;
        let (mut rng, mut controller) = (stream(seed, Purpose::Dynamics), stream(seed, Purpose::Controller));
        highway.reset(&mut rng);
        check(&highway);
        let mut action = 0;
        for _ in 0..500 {
            if below(&mut controller, persistence) == 0 {
                action = below(&mut controller, N_ACTIONS);
            }
            let before = (highway.road.host_lane, highway.road.view());
            let mut mask = [0; 12];
            highway.write_action_mask(&mut mask);
            highway.step(action, &mut rng);
            check(&highway);
            let wanted = target_lane(before.0, action as usize / LEVELS).unwrap_or(before.0);
            prop_assert_eq!(highway.road.host_lane, if mask[action as usize] == 1 { wanted } else { before.0 });
            let level = if highway.events.collisions > 0 { 0 } else { action as usize % LEVELS };
            prop_assert_eq!(highway.road.host_level, level);
        }
    }

    #[test]
    fn states_say_what_the_road_shows(seed: u64) {
        let (mut highway, mut rng) = (highway(), stream(seed, Purpose::Dynamics));
        highway.reset(&mut rng);
        for step in 0..100 {
            highway.step(step * 5 % 12, &mut rng);
            let road = &highway.road;
            let nobody = |lane: usize, from_m: f64, to_m: f64| {
                !road.vehicles().any(|v| v.lane == lane && v.x_m > from_m && v.x_m <= to_m)
            };
            let free = |lane: usize| nobody(lane, -7.0, 45.0);
            let lane = road.host_lane;
            let adjacent = [lane.wrapping_sub(1), lane + 1].into_iter().any(|lane| lane < LANES && free(lane));
            let traffic = if nobody(lane, 0.0, 45.0) { 0 } else if adjacent { 1 } else { 2 };
            prop_assert_eq!(highway.tabular_state() as usize, (lane * 4 + road.host_level) * 3 + traffic);
        }
    }
}

/// Steps until `wanted` shows in the events.
fn until(highway: &mut Highway, action: u32, wanted: impl Fn(&Events) -> bool) -> Outcome {
    let mut rng = stream(11, Purpose::Dynamics);
    highway.reset(&mut rng);
    for _ in 0..10_000 {
        let outcome = highway.step(action, &mut rng);
        if wanted(&highway.events) {
            return outcome;
        }
    }
    panic!("never happened")
}

#[test]
fn a_collision_slows_the_host_and_clears_the_road() {
    for (terminate, style, reward) in [(true, "aggressive", -5.0), (false, "bad", 1.0), (false, "legal", -5.0)] {
        let options = json!({"terminate_on_collision": terminate, "style": style});
        let mut highway = made(options).unwrap().prototype;
        let outcome = until(&mut highway, 3, |events| events.collisions > 0 && events.overtakes_right == 0);
        assert_eq!(outcome, Outcome { reward, terminated: terminate });
        assert_eq!((highway.road.host_level, highway.info_value(SPEED)), (0, 20.0));
        assert!(highway.road.view().ahead_m[highway.road.host_lane] > 2.0);
        assert_eq!(highway.info_value(COLLISIONS), 1.0);
    }
}

#[test]
fn overtaking_from_the_right_costs_the_legal_driver() {
    let mut highway = made(json!({"style": "legal"})).unwrap().prototype;
    let outcome = until(&mut highway, 11, |events| *events == Events { overtakes_right: 1, ..Events::default() });
    assert_eq!(outcome.reward, 1.0 - 5.0);
    assert!(highway.road.host_lane < 2);
}

#[test]
fn passing_counts_on_the_side_it_happens() {
    // In the left lane there is nobody to the left, in the right lane nobody to the right.
    for (action, impossible) in [(7, OVERTAKES_RIGHT), (11, OVERTAKES_LEFT)] {
        let (mut highway, mut rng) = (highway(), stream(2, Purpose::Dynamics));
        highway.reset(&mut rng);
        let mut passed = [0.0; 4];
        for step in 0..2000 {
            highway.step(action, &mut rng);
            if step > 50 {
                assert_eq!(highway.info_value(impossible), 0.0);
            }
            for (column, passed) in passed.iter_mut().enumerate() {
                *passed += highway.info_value(column);
            }
        }
        assert!(passed[OVERTAKES_LEFT + OVERTAKES_RIGHT - impossible] > 100.0, "{passed:?}");
    }
}

#[test]
fn a_trajectory_has_its_golden_values() {
    let (mut highway, mut rng) = (highway(), stream(0, Purpose::Dynamics));
    highway.reset(&mut rng);
    let states: Vec<u32> = (0..20)
        .map(|step| {
            highway.step(step * 7 % 12, &mut rng);
            highway.tabular_state()
        })
        .collect();
    assert_eq!(states, [24, 33, 30, 16, 24, 22, 30, 27, 24, 33, 18, 28, 24, 35, 32, 17, 26, 23, 32, 29]);
    let bits: Vec<u64> = highway.road.vehicles().take(3).map(|vehicle| vehicle.x_m.to_bits()).collect();
    assert_eq!(bits, [0x406e_f8fc_b1e1_4c48, 0x4068_e78e_b068_1048, 0x4064_6798_e1bf_35d6]);
}

#[test]
fn kinematics_lie_in_their_space_and_begin_with_the_host() {
    for density in [0.0, 4.0, 8.0] {
        let configured = made(json!({"observation": "kinematics", "density": density})).unwrap();
        let Space::Box { shape, low, high } = configured.spec.observation_space.clone() else {
            panic!("not a box");
        };
        let rows = (density * 3.0) as usize + 1;
        assert_eq!(shape, [rows as u32, 3]);
        let mut highway = configured.prototype.clone();
        let mut rng = stream(6, Purpose::Dynamics);
        highway.reset(&mut rng);
        let mut bytes = vec![0; configured.spec.observation_space.packed_len()];
        for step in 0..300 {
            highway.step(step % 12, &mut rng);
            highway.write_observation(&mut bytes);
            let values: Vec<f32> = bytes.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
            assert!(values.iter().zip(low.iter().zip(&high)).all(|(x, (low, high))| low <= x && x <= high));
            assert_eq!(values[..3], [0.0, highway.road.host_lane as f32, highway.road.host_speed_mps() as f32]);
            let near: Vec<f32> = values.chunks_exact(3).skip(1).map(|row| row[0].abs()).collect();
            assert!(near.windows(2).all(|pair| pair[0] <= pair[1]));
        }
    }
}

#[test]
fn infos_are_packed_as_their_columns_say() {
    let configured = made(json!({})).unwrap();
    let mut highway = configured.prototype.clone();
    let mut rng = stream(4, Purpose::Dynamics);
    highway.reset(&mut rng);
    for step in 0..200 {
        highway.step(step % 12, &mut rng);
        for (index, column) in configured.spec.info_columns.iter().enumerate() {
            let mut bytes = [0; 4];
            assert_eq!(column.packed_len(), 4);
            highway.write_info(index, &mut bytes);
            let read = match column.dtype {
                DType::Float32 => f64::from(f32::from_le_bytes(bytes)),
                _ => f64::from(i32::from_le_bytes(bytes)),
            };
            assert!((read - highway.info_value(index)).abs() < 1e-4, "{}", column.name);
        }
    }
}

#[test]
fn wrong_options_are_named() {
    for (options, field, part) in [
        (json!({"lanes": 3}), "lanes", "style, density"),
        (json!({"style": "polite"}), "style", "aggressive, bad, legal"),
        (json!({"style": 1}), "style", "got 1"),
        (json!({"density": 9}), "density", "from 0 to 8"),
        (json!({"density": "full"}), "density", "got \"full\""),
        (json!({"observation": "pixels"}), "observation", "discrete, kinematics"),
        (json!({"terminate_on_collision": 1}), "terminate_on_collision", "true or false"),
    ] {
        let error = made(options).unwrap_err();
        assert_eq!(error.field, field);
        assert!(error.message.contains(part), "{error}");
    }
}

fn model_of(threads: usize) -> TabularModel {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    pool.install(|| made(json!({})).unwrap().model())
}

#[test]
fn model_is_estimated_from_many_visits_whatever_the_threads() {
    let model = model_of(1);
    assert_eq!(model, model_of(3));
    let visits = model.visit_counts.unwrap();
    assert_eq!(visits.len(), 36 * 12);
    assert!(visits.iter().sum::<u64>() >= 2_000_000);
    assert!(*visits.iter().min().unwrap() >= 200, "{:?}", visits.iter().min());
    for row in model.row_offsets.windows(2) {
        let (next, p) = (&model.next_states[row[0]..row[1]], &model.probabilities[row[0]..row[1]]);
        assert!((p.iter().sum::<f64>() - 1.0).abs() < 1e-12);
        assert!(next.windows(2).all(|pair| pair[0] < pair[1]));
    }
    assert!((model.initial_distribution.iter().sum::<f64>() - 1.0).abs() < 1e-12);
    assert_eq!(model.rewards.iter().map(|(style, _)| style.as_str()).collect::<Vec<_>>(), STYLES);
    // Fastest in a clear lane: the aggressive driver's reward is near 1, the bad one's near 0.
    let row = (2 * 4 + 3) * 3 * 12 + 3;
    assert!(model.rewards[0].1[row] > 0.9 && model.rewards[1].1[row] < 0.02);
    assert_eq!(
        (model.state_labels[13].as_str(), model.action_labels[6].as_str()),
        ("lane 1, 20 m/s, passable", "left, 30 m/s")
    );
}

#[test]
fn model_rows_agree_with_fresh_steps() {
    let model = made(json!({})).unwrap().model();
    let (mut highway, mut rng, mut controller) =
        (highway(), stream(99, Purpose::Dynamics), stream(99, Purpose::Controller));
    let (mut log_model, mut log_uniform) = (0.0, 0.0);
    for step in 0..50_000 {
        if step % 200 == 0 {
            highway.reset(&mut rng);
        }
        let (state, action) = (highway.tabular_state(), (uniform(&mut controller) * 12.0) as u32);
        highway.step(action, &mut rng);
        let row = (state * 12 + action) as usize;
        let entries = model.row_offsets[row]..model.row_offsets[row + 1];
        let at = model.next_states[entries.clone()].iter().position(|&next| next == highway.tabular_state());
        let p = at.map_or(1e-4, |at| model.probabilities[entries.start + at]);
        log_model += p.ln();
        log_uniform += (1.0 / 36.0f64).ln();
    }
    assert!(log_model / 50_000.0 > -1.0 && log_model > log_uniform, "{}", log_model / 50_000.0);
}

#[test]
fn pictures_show_the_host_and_every_vehicle_near_by() {
    let (mut highway, mut rng) = (highway(), stream(3, Purpose::Dynamics));
    highway.reset(&mut rng);
    for _ in 0..20 {
        highway.step(3, &mut rng);
    }
    let text = highway.render_text();
    assert_eq!(text.lines().count(), 4);
    assert_eq!(text.matches('@').count(), 1);
    let in_window = highway.road.vehicles().filter(|v| (-100.0..250.0).contains(&v.x_m)).count();
    assert_eq!(text.lines().take(3).map(|line| line.matches('o').count()).sum::<usize>(), in_window);
    let svg = highway.render_svg();
    assert!(svg.starts_with("<svg") && svg.ends_with("</svg>\n"));
    assert!(svg.contains("35 m/s") || svg.contains("20 m/s"));
    let shown = highway.road.vehicles().filter(|v| v.x_m > -50.0 && v.x_m < 130.0).count();
    // A windscreen each, the host's among them.
    assert_eq!(svg.matches("<path").count(), shown + 1);
}
