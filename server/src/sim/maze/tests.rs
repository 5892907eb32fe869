use proptest::prelude::*;
use serde_json::json;

use super::*;
use crate::sim::rng::{Purpose, stream};

fn made(options: Value) -> Result<Configured<Maze>, OptionError> {
    configure(options.as_object().expect("an object"))
}

fn reference() -> Value {
    serde_json::from_str(include_str!("../../../../tests/data/maze_model.json")).expect("valid JSON")
}

#[test]
fn model_equals_the_reference() {
    let reference = reference();
    let model = made(json!({})).unwrap().model();
    let rows = reference["transition"].as_array().unwrap();
    assert_eq!(model.next_states.len(), rows.len());
    assert_eq!((model.n_states, model.n_actions), (57, 4));
    let mut entry = 0;
    for (row, bounds) in model.row_offsets.windows(2).enumerate() {
        assert!((model.probabilities[bounds[0]..bounds[1]].iter().sum::<f64>() - 1.0).abs() < 1e-12);
        for at in bounds[0]..bounds[1] {
            let expected: Vec<f64> = rows[entry].as_array().unwrap().iter().map(|x| x.as_f64().unwrap()).collect();
            assert_eq!([row / 4, row % 4, model.next_states[at] as usize].map(|x| x as f64), expected[..3]);
            assert!((model.probabilities[at] - expected[3]).abs() < 1e-12, "entry {entry}");
            entry += 1;
        }
    }
    let (rows, columns, cells) = model.grid.unwrap();
    assert_eq!((rows, columns), (9, 9));
    for (cell, place) in cells.iter().zip(reference["cells"].as_array().unwrap()) {
        assert_eq!(
            [u64::from(cell / 9), u64::from(cell % 9)],
            [place[0].as_u64().unwrap(), place[1].as_u64().unwrap()]
        );
    }
    let (style, rewards) = &model.rewards[0];
    assert_eq!(style, "optimal");
    let rewarded: Vec<usize> = (0..57).filter(|s| rewards[s * 4] == 1.0).collect();
    assert_eq!(rewarded, [0, 8, 28, 56]);
    assert_eq!(rewards.iter().sum::<f64>(), 16.0);
}

#[test]
fn optimal_actions_equal_the_reference() {
    let maze = made(json!({})).unwrap().prototype;
    for (mask, actions) in maze.tables.optimal().iter().zip(reference()["optimal_actions"].as_array().unwrap()) {
        let expected = actions.as_array().unwrap().iter().fold(0, |mask, action| mask | 1 << action.as_u64().unwrap());
        assert_eq!(*mask, expected);
    }
}

#[test]
fn steps_follow_the_model() {
    let configured = made(json!({"slip": 0.4, "layout": ["..", ".#", "..", ".."]})).unwrap();
    let model = configured.model();
    let mut maze = configured.prototype.clone();
    let mut rng = stream(3, Purpose::Dynamics);
    maze.reset(&mut rng);
    let n = model.n_states as usize;
    let mut counts = vec![0.0; n * 4 * n];
    let mut rows = vec![0.0; n * 4];
    for step in 0..400_000u32 {
        let (state, action) = (maze.tabular_state() as usize, step % 4);
        let reward = maze.step(action, &mut rng).reward;
        let row = state * 4 + action as usize;
        counts[row * n + maze.tabular_state() as usize] += 1.0;
        rows[row] += 1.0;
        assert_eq!(reward, model.rewards[0].1[maze.tabular_state() as usize * 4]);
    }
    for row in 0..n * 4 {
        let mut expected = vec![0.0; n];
        for at in model.row_offsets[row]..model.row_offsets[row + 1] {
            expected[model.next_states[at] as usize] = model.probabilities[at];
        }
        for next in 0..n {
            let (p, seen) = (expected[next], counts[row * n + next] / rows[row]);
            let bound = 5.0 * (p * (1.0 - p) / rows[row]).sqrt();
            assert!((seen - p).abs() <= bound, "row {row}, next {next}: {seen} instead of {p} ± {bound}");
        }
    }
}

#[test]
fn a_trajectory_has_its_golden_values() {
    let mut maze = made(json!({})).unwrap().prototype;
    let mut rng = stream(0, Purpose::Dynamics);
    maze.reset(&mut rng);
    let states: Vec<u32> = (0..16)
        .map(|step| {
            maze.step(step % 4, &mut rng);
            maze.tabular_state()
        })
        .collect();
    assert_eq!(states, [40, 39, 34, 34, 26, 34, 34, 26, 20, 26, 27, 26, 20, 26, 27, 26]);
}

#[test]
fn slip_bounds_hold() {
    for (slip, stays) in [(0.0, true), (1.0, false)] {
        let mut maze = made(json!({"slip": slip})).unwrap().prototype;
        let mut rng = stream(1, Purpose::Dynamics);
        maze.state = 0;
        let moved = (0..1000).any(|_| {
            maze.step(0, &mut rng);
            maze.state != 0
        });
        assert_eq!(moved, !stays, "slip {slip}");
    }
}

#[test]
fn wrong_options_are_named() {
    for (options, field, part) in [
        (json!({"size": 3}), "size", "layout, rewards, slip"),
        (json!({"slip": "much"}), "slip", "got \"much\""),
        (json!({"slip": -0.1}), "slip", "got -0.1"),
        (json!({"layout": 3}), "layout", "got 3"),
        (json!({"layout": []}), "layout", "got none"),
        (json!({"layout": ""}), "layout", "got none"),
        (json!({"layout": ["..", "."]}), "layout", "in row 1"),
        (json!({"layout": [".x"]}), "layout", "got 'x'"),
        (json!({"layout": ["é."]}), "layout", "got 'é'"),
        (json!({"layout": ["##"]}), "layout", "walls only"),
        (json!({"layout": [".", 1]}), "layout", "list of strings"),
        (json!({"layout": vec![".".repeat(257); 257]}), "layout", "65536"),
        (json!({"layout": ["#.#"], "rewards": null}), "", ""),
        (json!({"layout": ["#####", "#.###", "#####"]}), "rewards", "none of"),
        (json!({"rewards": [[1, 1]]}), "rewards", "row 1, column 1"),
        (json!({"rewards": [[0, 99]]}), "rewards", "column 99"),
        (json!({"rewards": [[0]]}), "rewards", "[row, column]"),
        (json!({"rewards": [[0, -1]]}), "rewards", "[row, column]"),
        (json!({"rewards": [[0, 0, 1e9]]}), "rewards", "got 1000000000"),
        (json!({"rewards": [0, 1]}), "rewards", "57 numbers"),
        (json!({"rewards": 1}), "rewards", "a list"),
    ] {
        match made(options.clone()) {
            Ok(_) => assert!(field.is_empty(), "{options} was accepted"),
            Err(error) => {
                assert_eq!(error.field, field, "{options}: {error}");
                assert!(error.message.contains(part), "{options}: {error}");
            }
        }
    }
}

#[test]
fn options_change_the_maze() {
    let configured = made(json!({"layout": "..#\n#..\n", "rewards": [[0, 0], [1, 2, -0.5]], "slip": 0})).unwrap();
    assert_eq!(configured.spec.n_states, 4);
    let mut maze = configured.prototype;
    let mut rng = stream(1, Purpose::Dynamics);
    maze.state = 1;
    assert_eq!(maze.render_text(), "$@#\n#.-\n");
    let mut mask = [9; 4];
    maze.write_action_mask(&mut mask);
    assert_eq!(mask, [0, 1, 0, 1]);
    assert_eq!(maze.step(1, &mut rng).reward, 0.0);
    assert_eq!(maze.step(2, &mut rng), Outcome { reward: -0.5, terminated: false });
    assert_eq!((maze.info_value(0), maze.info_value(1)), (1.0, 2.0));
    let mut bytes = [0; 4];
    maze.write_observation(&mut bytes);
    assert_eq!(i32::from_le_bytes(bytes), 3);
    let numbers = made(json!({"layout": "..#\n#..", "rewards": [1.0, 0.0, 0.0, -0.5], "slip": 0})).unwrap();
    assert_eq!(
        numbers.model(),
        made(json!({"layout": ["..#", "#.."], "rewards": [[0.0, 0], [1, 2, -0.5]], "slip": 0.0})).unwrap().model()
    );
}

#[test]
fn optimal_driver_earns_more_than_random() {
    let configured = made(json!({})).unwrap();
    let earned = |name: &str| {
        let mut maze = configured.prototype.clone();
        let (mut rng, mut controller) = (stream(5, Purpose::Dynamics), stream(5, Purpose::Controller));
        let mut driver = maze.driver(name).unwrap();
        maze.reset(&mut rng);
        (0..5000)
            .map(|_| {
                let action = driver.act(&maze, &mut controller);
                maze.step(action, &mut rng).reward
            })
            .sum::<f64>()
    };
    assert!(earned("optimal") > 5.0 * earned("random"));
    assert!(configured.prototype.driver("reckless").is_none());
}

proptest! {
    #[test]
    fn every_layout_makes_a_proper_model(grid in proptest::collection::vec("[.#]{5}", 1..6), slip in 0.0..=1.0f64) {
        let any_free = grid.iter().any(|row| row.contains('.'));
        let configured = made(json!({"layout": grid, "rewards": [], "slip": slip}));
        prop_assert_eq!(configured.is_ok(), any_free);
        if let Ok(configured) = configured {
            let model = configured.model();
            for row in model.row_offsets.windows(2) {
                let (next, p) = (&model.next_states[row[0]..row[1]], &model.probabilities[row[0]..row[1]]);
                prop_assert!((p.iter().sum::<f64>() - 1.0).abs() < 1e-12);
                prop_assert!(next.windows(2).all(|pair| pair[0] < pair[1]));
            }
            let mut maze = configured.prototype;
            let mut rng = stream(9, Purpose::Dynamics);
            maze.reset(&mut rng);
            for step in 0..50 {
                maze.step(step % 4, &mut rng);
                prop_assert!(maze.tabular_state() < model.n_states);
            }
        }
    }
}

#[test]
fn the_last_state_of_the_largest_maze_is_kept() {
    let mut maze = made(json!({"layout": vec![".".repeat(256); 256]})).unwrap().prototype;
    maze.state = maze.tables.layout.n_states() - 1;
    assert_eq!(maze.state, 65_535);
    let (mut stored, mut scratch) = (maze.stored(), maze.clone());
    scratch.state = 0;
    assert_eq!(Maze::load(&mut scratch, &mut stored).state, maze.state);
}
