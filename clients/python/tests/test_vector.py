"""Batches: the same, number for number, as Gymnasium's SyncVectorEnv of single environments."""

import gymnasium
import numpy as np
import pytest

import mazeway
from mazeway.vector import AutoresetMode

MODES = ["NEXT_STEP", "SAME_STEP", "DISABLED"]
OPTIONS = [
    ("mazeway/Maze-v0", {"max_episode_steps": 7}),
    ("mazeway/Maze-v0", {"max_episode_steps": 5, "action_masks": True}),
    ("mazeway/Highway-v0", {"max_episode_steps": 9, "style": "bad", "terminate_on_collision": True}),
    ("mazeway/Highway-v0", {"max_episode_steps": 6, "observation": "kinematics"}),
]


def assert_same(ours, theirs, path=""):
    """Equal in keys, types, dtypes, shapes and values."""
    assert type(ours) is type(theirs), path
    if isinstance(ours, dict):
        assert ours.keys() == theirs.keys(), path
        for key in ours:
            assert_same(ours[key], theirs[key], f"{path}/{key}")
    elif isinstance(ours, tuple):
        assert len(ours) == len(theirs), path
        for i, pair in enumerate(zip(ours, theirs, strict=True)):
            assert_same(*pair, f"{path}/{i}")
    elif isinstance(ours, np.ndarray):
        assert (ours.dtype, ours.shape) == (theirs.dtype, theirs.shape), path
        if ours.dtype == object:
            for i, pair in enumerate(zip(ours, theirs, strict=True)):
                assert_same(*pair, f"{path}/{i}")
        else:
            np.testing.assert_array_equal(ours, theirs, err_msg=path)
    else:
        assert ours == theirs, path


@pytest.fixture
def pair(server):
    """Makes our vector environment and Gymnasium's of as many single ones."""
    if not hasattr(gymnasium.vector, "AutoresetMode"):
        pytest.skip("Gymnasium 1.0 has no autoreset modes to compare with")
    made = []

    def make(name, num_envs, mode, **options):
        mode = AutoresetMode[mode]
        ours = gymnasium.make_vec(name, num_envs=num_envs, address=server, autoreset_mode=mode, **options)
        theirs = gymnasium.vector.SyncVectorEnv(
            [lambda: gymnasium.make(name, address=server, **options)] * num_envs,
            autoreset_mode=mode,
        )
        made.extend([ours, theirs])
        return ours, theirs

    yield make
    for env in made:
        env.close()


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(("name", "options"), OPTIONS)
def test_same_as_sync_vector_env(pair, name, options, mode):
    ours, theirs = pair(name, 6, mode, **options)
    assert isinstance(ours, mazeway.MazewayVectorEnv)
    assert ours.metadata["autoreset_mode"] is AutoresetMode[mode]
    for attribute in (
        "num_envs",
        "action_space",
        "observation_space",
        "single_action_space",
        "single_observation_space",
    ):
        assert getattr(ours, attribute) == getattr(theirs, attribute), attribute
    assert_same(ours.reset(seed=17), theirs.reset(seed=17), "reset")
    rng = np.random.default_rng(3)
    ended = 0
    for step in range(40):
        actions = rng.integers(ours.single_action_space.n, size=6)
        one, other = ours.step(actions), theirs.step(actions)
        assert_same(one, other, f"step {step}")
        assert one[0] in ours.observation_space
        over = one[2] | one[3]
        ended += over.sum()
        if mode == "DISABLED" and over.any():
            assert_same(
                ours.reset(options={"reset_mask": over.copy()}),
                theirs.reset(options={"reset_mask": over.copy()}),
                f"reset after step {step}",
            )
    assert ended >= 12, "the modes were put to the test"


@pytest.mark.parametrize("mode", ["NEXT_STEP", "SAME_STEP"])
def test_steps_sent_ahead_are_those_made_in_turn(pair, mode):
    ours, theirs = pair("mazeway/Maze-v0", 4, mode, max_episode_steps=6)
    assert_same(ours.reset(seed=3), theirs.reset(seed=3), "reset")
    actions = [(np.arange(4) + step) % 4 for step in range(25)]
    for action in actions:
        ours.send(action)
    for step, action in enumerate(actions):
        assert_same(ours.recv(), theirs.step(action), f"step {step}")


def test_episodes_that_end_apart(pair):
    """After masked resets at different times the environments end at different steps."""
    ours, theirs = pair("mazeway/Maze-v0", 4, "SAME_STEP", max_episode_steps=8)
    assert_same(ours.reset(seed=1), theirs.reset(seed=1))
    for step in range(30):
        if step in (3, 5):
            mask = np.array([step == 3, False, True, step == 5])
            assert_same(ours.reset(options={"reset_mask": mask}), theirs.reset(options={"reset_mask": mask}))
        actions = np.array([0, 1, 2, 3])
        assert_same(ours.step(actions), theirs.step(actions), f"step {step}")


@pytest.mark.parametrize("seed", [[5, 5, 9, 2**63], [5, None, 9, None], [None, None, None, 4]], ids=str)
def test_a_seed_each(pair, seed):
    ours, theirs = pair("mazeway/Maze-v0", 4, "NEXT_STEP", max_episode_steps=5)
    ours.reset(seed=100)
    theirs.reset(seed=100)
    assert_same(ours.reset(seed=seed), theirs.reset(seed=seed))
    for step in range(12):
        actions = np.array([3, 2, 1, 0])
        assert_same(ours.step(actions), theirs.step(actions), f"step {step}")
    assert_same(ours.reset(), theirs.reset())


def test_unseeded_reset_follows_np_random(server):
    said = []
    for seed in (1, 1, 2):
        env = gymnasium.make_vec("mazeway/Maze-v0", num_envs=16, address=server)
        env.np_random = np.random.default_rng(seed)
        said.append([env.reset()[0].tolist() for _ in range(5)])
        env.close()
    assert said[0] == said[1]
    assert said[0] != said[2]
    assert said[0][0] != said[0][1]


def test_any_batch_size_gives_the_same(server):
    drives = {}
    for num_envs in (1, 3, 64):
        env = gymnasium.make_vec("mazeway/Highway-v0", num_envs=num_envs, address=server)
        env.reset(seed=40)
        rng = np.random.default_rng(0)
        drives[num_envs] = [env.step(rng.integers(12, size=64)[:num_envs]) for _ in range(50)]
        env.close()
    for small, large in ((1, 3), (3, 64)):
        for one, other in zip(drives[small], drives[large], strict=True):
            for array, longer in zip(one[:4], other[:4], strict=True):
                np.testing.assert_array_equal(array, longer[:small])


def test_the_two_limits_are_one(server):
    env = gymnasium.make_vec("mazeway/Maze-v0", num_envs=2, address=server)
    env.reset(seed=1)
    lengths = [env.step(np.zeros(2, int))[3].all() for _ in range(100)]
    assert lengths == [False] * 99 + [True]
    env.close()
    env = gymnasium.make_vec("mazeway/Maze-v0", num_envs=2, address=server, max_episode_steps=-1)
    env.reset(seed=1)
    assert not any(env.step(np.zeros(2, int))[3].any() for _ in range(300))
    env.close()


def test_renders_each(server):
    env = gymnasium.make_vec("mazeway/Maze-v0", num_envs=3, address=server, render_mode="rgb_array")
    env.reset(seed=1)
    frames = env.render()
    assert len(frames) == 3
    assert all(frame.dtype == np.uint8 and frame.shape[2] == 3 for frame in frames)
    env.close()
    env.close()


def test_sync_mode_of_make_vec(server):
    env = gymnasium.make_vec("mazeway/Maze-v0", num_envs=2, vectorization_mode="sync", address=server)
    assert isinstance(env, gymnasium.vector.SyncVectorEnv)
    env.reset(seed=1)
    env.step(np.array([0, 1]))
    env.close()


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        ([0, 1], r"expected shape \(3,\), got \(2,\)"),
        ([[0], [1], [2]], r"expected shape \(3,\)"),
        ([0.5, 1.0, 2.0], "expected integers, got float64"),
        ([0, 1, 4], "4"),
        ([0, 1, -1], "-1"),
        ([0, 1, 2**32], "4294967296"),
    ],
)
def test_wrong_actions_harm_nothing(server, actions, message):
    env = gymnasium.make_vec("mazeway/Maze-v0", num_envs=3, address=server)
    reset = env.reset(seed=4)
    reference = [env.step(np.array([0, 1, 2])) for _ in range(3)]
    assert_same(env.reset(seed=4), reset)
    assert_same(env.step(np.array([0, 1, 2])), reference[0])
    with pytest.raises(mazeway.InvalidArgumentError, match=message) as caught:
        env.step(np.array(actions))
    assert "actions" in caught.value.field
    assert_same(env.step(np.array([0, 1, 2])), reference[1])
    env.close()


@pytest.mark.parametrize(
    ("mask", "message"),
    [
        ([True, False], "numpy array of bool, got list"),
        (np.array([1, 0]), "numpy array of bool, got int64"),
        (np.array([True]), r"shape \(2,\)"),
        (np.array([False, False]), "at least one True"),
    ],
)
def test_wrong_masks(server, mask, message):
    env = gymnasium.make_vec("mazeway/Maze-v0", num_envs=2, address=server)
    env.reset(seed=1)
    with pytest.raises(mazeway.InvalidArgumentError, match=message):
        env.reset(options={"reset_mask": mask})
    env.close()


def test_an_ended_episode_waits_for_its_reset(server):
    env = gymnasium.make_vec(
        "mazeway/Maze-v0",
        num_envs=2,
        address=server,
        autoreset_mode="Disabled",
        max_episode_steps=1,
    )
    env.reset(seed=1)
    env.step(np.array([0, 0]))
    with pytest.raises(mazeway.WrongStateError):
        env.step(np.array([0, 0]))
    env.reset()
    env.step(np.array([0, 0]))
    env.close()


def test_wrong_arguments(server):
    with pytest.raises(mazeway.InvalidArgumentError, match="autoreset_mode: expected one of"):
        mazeway.MazewayVectorEnv("Maze-v0", 2, server, autoreset_mode="Sometimes")
    with pytest.raises(mazeway.InvalidArgumentError, match="num_envs"):
        mazeway.MazewayVectorEnv("Maze-v0", 0, server)
    with pytest.raises(mazeway.LimitReachedError):
        mazeway.MazewayVectorEnv("Maze-v0", 2**31, server)


def test_gymnasiums_wrappers_work(server):
    env = gymnasium.make_vec("mazeway/Maze-v0", num_envs=4, address=server, max_episode_steps=5)
    env = gymnasium.wrappers.vector.RecordEpisodeStatistics(env)
    env.reset(seed=1)
    episodes = 0
    for _ in range(24):
        *_, infos = env.step(env.action_space.sample())
        episodes += int(infos.get("_episode", np.zeros(4)).sum())
        if "episode" in infos:
            assert set(infos["episode"]["l"][infos["_episode"]]) == {5}
    assert episodes == 16
    env.close()
