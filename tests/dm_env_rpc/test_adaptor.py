"""Environments through DeepMind's dm_env adaptor, as its users use it."""

import json
from pathlib import Path

import dm_env
import numpy as np
import pytest
from absl.testing import absltest
from conftest import connect
from dm_env import test_utils
from dm_env_rpc.v1 import dm_env_adaptor, error
from dm_env_rpc.v1.extensions import properties

GOLDEN = json.loads((Path(__file__).parents[1] / "data/golden_trajectories.json").read_text())
ENVIRONMENTS = ["Maze-v0", "Highway-v0"]


def make(connection, join_settings=None, **settings):
    """An environment and the name of its world."""
    return dm_env_adaptor.create_and_join_world(connection, settings, join_settings or {})


@pytest.mark.parametrize("golden", GOLDEN, ids=lambda g: f"{g['env_id']}-{g['seed']}")
def test_a_seed_gives_the_same_numbers_as_ever(connection, golden):
    options = {f"options.{name}": value for name, value in golden["options"].items()}
    seed = np.uint64(golden["seed"])
    env, _ = make(connection, env_id=golden["env_id"], seed=seed, max_episode_steps=0, **options)
    observations, rewards = [env.reset().observation["observation"]], []
    for action in golden["actions"]:
        step = env.step({"action": action})
        assert step.mid()
        observations.append(step.observation["observation"])
        rewards.append(step.reward)
    assert observations == golden["observations"]
    assert rewards == golden["rewards"]


@pytest.mark.parametrize("env_id", ENVIRONMENTS)
def test_time_limits_interrupt_and_the_next_step_begins_anew(connection, env_id):
    env, _ = make(connection, env_id=env_id, seed=1, max_episode_steps=3)
    assert env.reset().step_type is dm_env.StepType.FIRST
    steps = [env.step({"action": 0}) for _ in range(4)]
    assert [step.step_type for step in steps] == [dm_env.StepType.MID] * 2 + [
        dm_env.StepType.LAST,
        dm_env.StepType.FIRST,
    ]
    assert steps[2].discount == 1.0 and steps[2].observation["truncated"]
    assert not steps[2].observation["terminated"]
    assert (steps[3].reward, steps[3].discount) == (None, None)


def test_an_end_of_its_own_has_discount_0(connection):
    settings = {"options.terminate_on_collision": True, "options.density": 8, "options.style": "bad"}
    env, _ = make(connection, env_id="Highway-v0", seed=2, max_episode_steps=0, **settings)
    step = env.reset()
    while not step.last():
        step = env.step({"action": 3})
    assert step.discount == 0.0 and step.observation["terminated"] and not step.observation["truncated"]
    assert step.observation["info"]["collisions"] == 1
    assert env.step({"action": 3}).first()


@pytest.mark.parametrize("env_id", ENVIRONMENTS)
def test_what_the_specs_say_is_what_comes(connection, env_id):
    env, _ = make(connection, env_id=env_id, seed=1)
    spec, actions = env.observation_spec(), env.action_spec()["action"]
    assert actions.num_values == {"Maze-v0": 4, "Highway-v0": 12}[env_id]
    assert spec["observation"].num_values == {"Maze-v0": 57, "Highway-v0": 36}[env_id]
    step = env.reset()
    for action in range(actions.num_values):
        for name in ["observation", "terminated", "truncated"]:
            spec[name].validate(step.observation[name])
        for name, value in step.observation["info"].items():
            spec["info"][name].validate(value)
        step = env.step({"action": action})
        env.reward_spec().validate(step.reward)
    assert step.observation["info"]["action_mask"].shape == (actions.num_values,)


def test_a_batch_is_a_tensor_whose_environments_begin_anew_by_themselves(connection):
    env, _ = make(connection, env_id="Maze-v0", num_envs=5, seed=10, max_episode_steps=4)
    first = env.reset().observation["observation"]
    assert first.shape == (5,)
    for index in range(5):
        alone, _ = make(connect(), env_id="Maze-v0", seed=10 + index)
        assert alone.reset().observation["observation"] == first[index]
    steps = [env.step({"action": np.full(5, 2, np.int32)}) for _ in range(6)]
    assert all(step.mid() for step in steps)
    assert [step.observation["truncated"].all() for step in steps] == [False] * 3 + [True, False, False]
    assert steps[4].reward.tolist() == [0.0] * 5


def test_properties_tell_the_options_and_change_the_next_sequence(connection):
    outside = properties.PropertiesExtension(connection)
    assert set(outside.specs()) == {"environments"}
    assert "environments.Maze-v0.options.slip" in outside.specs("environments.Maze-v0.options")
    assert outside["environments.Maze-v0.options.slip"] == 0.3
    assert outside["environments.Highway-v0.n_actions"] == 12
    for key in ["world.seed", "environments.Maze-v9", "environments.Maze-v0.options.slip.x"]:
        with pytest.raises(KeyError):
            outside.read(key)
    with pytest.raises(PermissionError):
        outside.write("environments.Maze-v0.options.slip", 0.1)

    env, name = make(connection, env_id="Maze-v0")
    assert set(outside.specs()) == {"environments", "world"}
    assert outside["world.name"] == name and outside["world.env_id"] == "Maze-v0"
    with pytest.raises(error.DmEnvRpcError, match="no seed"):
        outside.read("world.seed")
    for key in ["world.name", "world.lease_secs", "world.options"]:
        with pytest.raises(PermissionError):
            outside.write(key, 1)
    for key, value in [("world.seed", -1), ("world.options.slip", 1.5), ("world.max_episode_steps", "ten")]:
        with pytest.raises(ValueError):
            outside.write(key, value)
    with pytest.raises(error.DmEnvRpcError, match="would change the specs"):
        outside.write("world.options.layout", "...")
    outside["world.seed"], outside["world.options.slip"], outside["world.max_episode_steps"] = 7, 0.0, 3
    assert (outside["world.seed"], outside["world.options.slip"]) == (7, 0.0)
    reference, _ = make(
        connect(), **{"env_id": "Maze-v0", "seed": 7, "options.slip": 0, "max_episode_steps": 3}
    )
    for action in [0, 1, 2, 3, 0]:
        step, wanted = env.step({"action": action}), reference.step({"action": action})
        assert (step.step_type, step.observation["observation"]) == (
            wanted.step_type,
            wanted.observation["observation"],
        )
    assert all(spec.description for spec in outside.specs("world.options").values())


def test_errors_tell_code_and_field_and_nothing_is_lost(connection):
    env, _ = make(connection, env_id="Maze-v0", seed=1)
    env.reset()
    with pytest.raises(error.DmEnvRpcError, match=r"actions\[1\]: expected an action from 0 to 3"):
        env.step({"action": 4})
    assert env.step({"action": 3}).mid()


class _AdaptorTest(test_utils.EnvironmentTestMixin):
    """dm_env's own tests of an environment."""

    env_id: str

    def setUp(self):
        self._connection = connect()
        super().setUp()

    def tearDown(self):
        super().tearDown()
        self._connection.close()

    def make_object_under_test(self):
        return make(self._connection, env_id=self.env_id, seed=1, max_episode_steps=20)[0]

    def make_action_sequence(self):
        spec = self.environment.action_spec()["action"]
        for action in range(50):
            yield {"action": action % spec.num_values}


class TestMazeIsADmEnv(_AdaptorTest, absltest.TestCase):
    env_id = "Maze-v0"


class TestHighwayIsADmEnv(_AdaptorTest, absltest.TestCase):
    env_id = "Highway-v0"
