//! A step never allocates, nor does anything else that is done every step.

use mazeway_server::sim::{
    Configured, Simulator, highway, maze,
    rng::{Purpose, stream},
};
use serde_json::{Map, json};

fn allocations<S: Simulator>(configured: &Configured<S>, driver: &str) -> u64 {
    let (mut simulator, mut rng) = (configured.prototype.clone(), stream(1, Purpose::Dynamics));
    let mut controller = stream(1, Purpose::Controller);
    let mut driver = simulator.driver(driver).expect("a driver");
    let mut observation = vec![0; configured.spec.observation_space.packed_len()];
    let mut mask = vec![0; configured.spec.n_actions as usize];
    let mut infos: Vec<Vec<u8>> =
        configured.spec.info_columns.iter().map(|column| vec![0; column.packed_len()]).collect();
    let mut reward = 0.0;
    let measured = allocation_counter::measure(|| {
        for step in 0..2_000 {
            if step % 100 == 0 {
                simulator.reset(&mut rng);
            }
            let action = driver.act(&simulator, &mut controller);
            reward += simulator.step(action, &mut rng).reward;
            simulator.write_observation(&mut observation);
            simulator.write_action_mask(&mut mask);
            for (column, info) in infos.iter_mut().enumerate() {
                simulator.write_info(column, info);
            }
        }
    });
    assert!(reward.is_finite() && mask.contains(&1));
    measured.count_total
}

#[test]
fn counting_works() {
    assert_eq!(allocation_counter::measure(|| drop(std::hint::black_box(vec![1u8; 100]))).count_total, 1);
}

#[test]
fn maze_steps_do_not_allocate() {
    let configured = maze::configure(&Map::new()).expect("defaults");
    for driver in ["random", "optimal"] {
        assert_eq!(allocations(&configured, driver), 0, "{driver}");
    }
}

#[test]
fn highway_steps_do_not_allocate() {
    for observation in ["discrete", "kinematics"] {
        let options = json!({"observation": observation, "density": 8});
        let configured = highway::configure(options.as_object().expect("an object")).expect("valid options");
        for driver in ["random", "aggressive", "bad", "legal"] {
            assert_eq!(allocations(&configured, driver), 0, "{observation} {driver}");
        }
    }
}
