"""One environment: Gymnasium's own checker, spaces, seeds, limits, pictures and wrong calls."""

import gymnasium
import numpy as np
import pytest
from conftest import start_server
from gymnasium.utils.env_checker import check_env

import mazeway

ENVIRONMENTS = ["mazeway/Maze-v0", "mazeway/Highway-v0"]
OPTIONS = [
    ("mazeway/Maze-v0", {}),
    ("mazeway/Maze-v0", {"slip": 0.0, "action_masks": True}),
    ("mazeway/Highway-v0", {}),
    ("mazeway/Highway-v0", {"observation": "kinematics", "action_masks": True}),
    ("mazeway/Highway-v0", {"style": "bad", "terminate_on_collision": True}),
]


def drive(env, actions, seed=None):
    """Everything that an environment says along a sequence of actions."""
    said = [env.reset(seed=seed)]
    for action in actions:
        said.append(env.step(action))
        if said[-1][2] or said[-1][3]:
            said.append(env.reset())
    return said


def same(one, other):
    return repr(one) == repr(other)


@pytest.mark.parametrize(("name", "options"), OPTIONS)
def test_gymnasiums_checker_finds_nothing(server, name, options):
    # Warnings are errors in this suite, so this is "no warning" as well.
    env = gymnasium.make(name, address=server, **options)
    check_env(env.unwrapped)
    env.close()


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_spaces_and_types_are_gymnasiums(server, name):
    env = gymnasium.make(name, address=server)
    observation, info = env.reset(seed=1)
    assert type(observation) is np.int64
    assert observation in env.observation_space
    assert info
    assert all(type(value) in (int, float) for value in info.values())
    observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
    assert type(observation) is np.int64
    assert type(reward) is float
    assert (type(terminated), type(truncated)) == (bool, bool)
    env.close()


def test_maze_spaces_and_infos(server):
    env = gymnasium.make("mazeway/Maze-v0", address=server)
    assert env.observation_space == gymnasium.spaces.Discrete(57)
    assert env.action_space == gymnasium.spaces.Discrete(4)
    _, info = env.reset(seed=3)
    assert {"row", "col"} <= info.keys()
    assert 0 <= info["row"] < 9
    env.close()


def test_highway_spaces_and_infos(server):
    env = gymnasium.make("mazeway/Highway-v0", address=server)
    assert env.observation_space == gymnasium.spaces.Discrete(36)
    assert env.action_space == gymnasium.spaces.Discrete(12)
    _, info = env.reset(seed=3)
    assert {"collisions", "overtakes_left", "overtakes_right", "speed_mps"} <= info.keys()
    assert info["speed_mps"] in (20.0, 25.0, 30.0, 35.0)
    env.close()


def test_kinematics_are_a_box(server):
    env = gymnasium.make("mazeway/Highway-v0", address=server, observation="kinematics")
    assert isinstance(env.observation_space, gymnasium.spaces.Box)
    observation, _ = env.reset(seed=3)
    assert observation.dtype == np.float32
    assert observation.flags.writeable
    assert observation in env.observation_space
    env.close()


def test_action_masks_go_into_sample(server):
    env = gymnasium.make("mazeway/Maze-v0", address=server, action_masks=True)
    _, info = env.reset(seed=5)
    for _ in range(50):
        mask = info["action_mask"]
        assert mask.shape == (4,)
        assert mask[env.action_space.sample(mask)] == 1
        *_, info = env.step(env.action_space.sample(mask))
    env.close()


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_same_seed_same_drive(server, name):
    one, other = (gymnasium.make(name, address=server) for _ in range(2))
    actions = np.random.default_rng(7).integers(one.action_space.n, size=300)
    first = drive(one, actions, seed=11)
    assert same(first, drive(other, actions, seed=11))
    assert same(first, drive(one, actions, seed=11)), "a seeded reset begins anew"
    assert not same(first, drive(one, actions, seed=12))
    one.close()
    other.close()


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_unseeded_resets_follow_np_random(server, name):
    drives = []
    for seed in (5, 5, 6):
        env = gymnasium.make(name, address=server)
        env.unwrapped.np_random = np.random.default_rng(seed)
        drives.append([env.reset() for _ in range(20)])
        env.close()
    assert same(drives[0], drives[1])
    assert not same(drives[0], drives[2])
    assert len({repr(said) for said in drives[0]}) > 1, "later resets go on, not back"


def test_unseeded_environments_differ(server):
    drives = set()
    for _ in range(3):
        env = gymnasium.make("mazeway/Maze-v0", address=server)
        drives.add(repr([env.reset() for _ in range(20)]))
        env.close()
    assert len(drives) == 3


def episode_length(env):
    env.reset(seed=0)
    for step in range(1, 10_000):
        _, _, terminated, truncated, _ = env.step(0)
        assert not terminated
        if truncated:
            return step
    return None


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_default_limit_is_the_servers(server, name):
    env = gymnasium.make(name, address=server)
    listed = {e.env_id: e.max_episode_steps for e in mazeway.Client(server).list_environments()}
    assert env.spec.max_episode_steps == listed[name.removeprefix("mazeway/")]
    assert episode_length(env) == env.spec.max_episode_steps
    env.close()


@pytest.mark.parametrize("limit", [1, 7, 350])
def test_limit_of_make_is_honoured(server, limit):
    env = gymnasium.make("mazeway/Maze-v0", address=server, max_episode_steps=limit)
    assert episode_length(env) == limit
    env.close()


def test_limit_on_the_server(server):
    env = mazeway.MazewayEnv("Maze-v0", server, max_episode_steps=9)
    assert episode_length(env) == 9
    with pytest.raises(mazeway.WrongStateError):
        env.step(0)  # an ended episode
    env.reset()
    assert env.step(0)[3] is False
    env.close()
    unlimited = mazeway.MazewayEnv("Maze-v0", server)
    unlimited.reset(seed=0)
    assert not any(unlimited.step(0)[3] for _ in range(500))
    unlimited.close()


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_renders(server, name):
    env = gymnasium.make(name, address=server, render_mode="rgb_array")
    env.reset(seed=1)
    frame = env.render()
    assert frame.dtype == np.uint8
    assert frame.ndim == 3
    assert frame.shape[2] == 3
    assert len(np.unique(frame.reshape(-1, 3), axis=0)) > 3, "more than a blank"
    for _ in range(5):
        env.step(env.action_space.n - 1)
    assert not np.array_equal(frame, env.render())
    assert env.unwrapped.metadata["render_fps"] > 0
    env.close()

    env = gymnasium.make(name, address=server, render_mode="ansi")
    env.reset(seed=1)
    text = env.render()
    assert text.count("\n") >= 3
    env.close()


def test_render_without_a_mode_warns(server):
    env = gymnasium.make("mazeway/Maze-v0", address=server)
    env.reset(seed=1)
    with pytest.warns(UserWarning, match="without a render mode"):
        assert env.unwrapped.render() is None
    env.close()


def test_close_twice_and_use_after(server):
    env = gymnasium.make("mazeway/Maze-v0", address=server)
    env.reset(seed=1)
    env.close()
    env.close()
    with pytest.raises(mazeway.ResetNeededError, match="closed"):
        env.unwrapped.reset()
    with pytest.raises(mazeway.ResetNeededError, match="closed"):
        env.unwrapped.step(0)


def test_step_before_reset(server):
    env = mazeway.MazewayEnv("Maze-v0", server)
    with pytest.raises(mazeway.ResetNeededError, match="before the first reset"):
        env.step(0)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(0)
    env.close()


@pytest.mark.parametrize("action", [-1, 4, 2**40, 1.5, "north", None, np.array([0, 1])])
def test_wrong_action_harms_nothing(server, action):
    env = gymnasium.make("mazeway/Maze-v0", address=server)
    env.reset(seed=2)
    reference = [env.step(a) for a in (0, 1, 2, 3)]
    env.reset(seed=2)
    said = [env.step(0), env.step(1)]
    with pytest.raises(mazeway.InvalidArgumentError, match="from 0 to 3") as caught:
        env.step(action)
    assert caught.value.field == "actions"
    said += [env.step(2), env.step(3)]
    assert same(said, reference)
    env.close()


def test_unknown_environment(server):
    env = mazeway.MazewayEnv("Labyrinth-v0", server)
    with pytest.raises(mazeway.NotFoundError, match="Labyrinth-v0"):
        env.reset()


@pytest.mark.parametrize(
    ("options", "field"),
    [({"slipp": 0.1}, "slipp"), ({"slip": 2.0}, "slip"), ({"slip": "much"}, "slip")],
)
def test_wrong_option_is_named(server, options, field):
    with pytest.raises(mazeway.InvalidArgumentError, match=field) as caught:
        gymnasium.make("mazeway/Maze-v0", address=server, **options)
    assert field in caught.value.field


def test_option_of_no_wire_type(server):
    with pytest.raises(mazeway.InvalidArgumentError, match=r"options\.slip: expected .* got set"):
        gymnasium.make("mazeway/Maze-v0", address=server, slip={0.1})


@pytest.mark.parametrize("seed", [-1, 2**64, 1.5])
def test_wrong_seed(server, seed):
    env = mazeway.MazewayEnv("Maze-v0", server)
    with pytest.raises(mazeway.InvalidArgumentError, match=r"seed: expected an integer from 0"):
        env.reset(seed=seed)
    env.reset(seed=2**64 - 1)
    env.close()


def test_options_at_reset_are_refused(server):
    env = mazeway.MazewayEnv("Maze-v0", server)
    with pytest.raises(mazeway.InvalidArgumentError, match=r"gymnasium\.make"):
        env.reset(options={"slip": 0.1})
    env.close()


def test_wrong_render_mode(server):
    with pytest.raises(mazeway.InvalidArgumentError, match="render_mode"):
        mazeway.MazewayEnv("Maze-v0", server, render_mode="hologram")


def test_no_server_is_one_line_with_a_hint():
    with pytest.raises(mazeway.ServerUnreachableError) as caught:
        gymnasium.make("mazeway/Maze-v0", address="127.0.0.1:1")
    message = str(caught.value)
    assert "\n" not in message
    assert "127.0.0.1:1" in message
    assert "hint: start one with: cargo run --release --bin server" in message
    assert isinstance(caught.value, ConnectionError)


@pytest.mark.parametrize("address", ["", "127.0.0.1", ":50051", "host:port", "host:70000", 50051])
def test_wrong_address(address):
    with pytest.raises(mazeway.InvalidArgumentError, match=r"host:port|a string"):
        mazeway.MazewayEnv("Maze-v0", address).reset()


def test_too_many_sessions_is_a_limit(tmp_path):
    process = start_server(tmp_path, "--max-sessions", "2")
    try:
        kept = [mazeway.MazewayEnv("Maze-v0", process.address) for _ in range(2)]
        for env in kept:
            env.reset(seed=1)
        third = mazeway.MazewayEnv("Maze-v0", process.address)
        with pytest.raises(mazeway.LimitReachedError):
            third.reset(seed=1)
        kept.pop().close()
        third.reset(seed=1)
        del third  # a forgotten environment frees its session too
        mazeway.MazewayEnv("Maze-v0", process.address).reset(seed=1)
    finally:
        process.stop()
