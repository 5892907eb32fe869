"""The same seed gives the same numbers here as in Rust, in process and over the wire, for ever."""

import json

import gymnasium
import numpy as np
import pytest
from conftest import DATA

GOLDEN = json.loads((DATA / "golden_trajectories.json").read_text())


@pytest.mark.parametrize("golden", GOLDEN, ids=lambda g: f"{g['env_id']}-{g['seed']}")
def test_a_single_environment_repeats_it(server, golden):
    env = gymnasium.make(
        f"mazeway/{golden['env_id']}", address=server, max_episode_steps=-1, **golden["options"]
    )
    observation, _ = env.reset(seed=golden["seed"])
    observations, rewards = [observation], []
    for action in golden["actions"]:
        observation, reward, terminated, truncated, _ = env.step(action)
        assert (terminated, truncated) == (False, False)
        observations.append(observation)
        rewards.append(reward)
    assert observations == golden["observations"]
    assert rewards == golden["rewards"]
    env.close()


@pytest.mark.parametrize("golden", GOLDEN, ids=lambda g: f"{g['env_id']}-{g['seed']}")
@pytest.mark.parametrize(("num_envs", "index"), [(1, 0), (5, 3), (300, 299)])
def test_any_place_in_a_batch_repeats_it(server, golden, num_envs, index):
    env = gymnasium.make_vec(
        f"mazeway/{golden['env_id']}", num_envs=num_envs, address=server, **golden["options"]
    )
    seeds = [(golden["seed"] - index + i) % 2**64 for i in range(num_envs)]
    observation, _ = env.reset(seed=seeds)
    observations, rewards = [observation[index]], []
    for action in golden["actions"]:
        observation, reward, *_ = env.step(np.full(num_envs, action))
        observations.append(observation[index])
        rewards.append(reward[index])
    assert observations == golden["observations"]
    assert rewards == golden["rewards"]
    env.close()
