"""Recording and learning, end to end against a real learner."""

import datetime
import hashlib
import pickle
import signal
import uuid

import gymnasium
import numpy as np
import pytest
from conftest import start_learner

import mazeway
from mazeway import Trajectory


@pytest.fixture
def learner(learner_address):
    with mazeway.Learner(learner_address) as learner:
        yield learner


@pytest.fixture
def style():
    """A style that no other test uses."""
    return f"test-{uuid.uuid4()}"


def trajectory(style, steps=4, **changes):
    values = {
        "env_id": "Toy-v0",
        "style": style,
        "n_states": 5,
        "n_actions": 2,
        "states": np.arange(steps) % 5,
        "actions": np.arange(steps) % 2,
        "rewards": np.arange(steps) / 4,
        "final_state": 3,
        "terminated": True,
    }
    return Trajectory(**{**values, **changes})


def optimal_policy(model, reward, discount=0.9):
    """Greedy policy by value iteration, shape (n_states,)."""
    transition, values = model.to_dense(), np.zeros(model.n_states)
    for _ in range(1000):
        action_values = reward + discount * transition @ values
        values = action_values.max(axis=1)
    return action_values.argmax(axis=1), action_values


def drive(env, policy, episodes, seed=0):
    for episode in range(episodes):
        observation, _ = env.reset(seed=seed + episode)
        over = False
        while not over:
            observation, _, terminated, truncated, _ = env.step(int(policy[observation]))
            over = terminated or truncated


def test_trajectories_come_back_as_they_went(learner, style):
    sent = [
        trajectory(style),
        trajectory(style, steps=1, rewards=None, final_state=None, terminated=False, truncated=True),
        trajectory(style, seed=7, source="driver:careful"),
    ]
    assert learner.record(sent) == 3
    assert learner.record(sent) == 0, "a repeated id is stored once"
    back = learner.trajectories(style=style)
    assert len(back) == learner.count(style=style) == 3
    for one, other in zip(sent, back, strict=True):
        for name in vars(one):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
    assert [t.seed for t in learner.trajectories(style=style, source="driver:careful")] == [7]
    assert learner.count(style=style, min_steps=2) == 2
    now = datetime.datetime.now(datetime.timezone.utc)
    assert learner.count(style=style, recorded_from=now + datetime.timedelta(hours=1)) == 0
    assert learner.count(style=style, recorded_until=now + datetime.timedelta(hours=1)) == 3
    assert learner.delete_trajectories(style=style, source="python") == 2
    assert learner.count(style=style) == 1


def test_many_trajectories_go_in_bounded_requests(learner, style):
    assert learner.record(trajectory(style, steps=3) for _ in range(1234)) == 1234
    assert learner.count(style=style) == 1234


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"states": np.array([], int), "actions": np.array([], int)}, "at least one step"),
        ({"actions": np.zeros(3, int)}, "as many as states"),
        ({"states": np.array([0, 1, 2, 5])}, "states: expected 0 to 4, got 5"),
        ({"actions": np.array([0, 1, -1, 0])}, "actions: expected 0 to 1, got -1"),
    ],
)
def test_wrong_trajectories(style, changes, message):
    with pytest.raises(mazeway.InvalidArgumentError, match=message):
        trajectory(style, **changes)


def test_the_learner_refuses_and_names_the_field(learner, style):
    with pytest.raises(mazeway.InvalidArgumentError, match="trajectory_id"):
        learner.record([trajectory(style, trajectory_id="seven")])
    sent = trajectory(style)
    learner.record([sent])
    other = trajectory(style, steps=3, trajectory_id=sent.trajectory_id)
    with pytest.raises(mazeway.AlreadyExistsError):
        learner.record([other])
    with pytest.raises(mazeway.InvalidArgumentError, match="filter"):
        learner.delete_trajectories()
    with pytest.raises(mazeway.InvalidArgumentError, match="unknown condition"):
        learner.trajectories(colour="red")
    with pytest.raises(mazeway.InvalidArgumentError, match="time zone"):
        learner.count(recorded_from=datetime.datetime(2026, 1, 1))


def test_models_are_stored_once(learner):
    name = f"Toy-{uuid.uuid4()}"
    # Another model each time: one content is stored under one name.
    dense = np.random.default_rng().dirichlet(np.ones(5), size=(5, 3))
    model = mazeway.Model.from_dense(name, dense, rewards={"true": np.eye(5, 3)})
    model_id = learner.put_model(model)
    assert model_id == model.model_id, "the learner computes the same id"
    assert learner.put_model(name, dense) == model_id
    assert learner.put_model(name, model.csr, 3) == model_id
    (summary,) = learner.models(name)
    assert (summary.n_states, summary.n_actions, summary.n_transitions) == (5, 3, 75)
    assert summary.styles == ["true"]


def test_a_large_model_goes_in_parts(learner):
    states, actions = 3000, 4
    rng = np.random.default_rng(1)
    following = np.sort(rng.permuted(np.tile(np.arange(states), (states * actions, 1))[:, :20]), axis=1)
    data = np.full(following.size, 1 / 20)
    indptr = np.arange(0, following.size + 1, 20)
    model = mazeway.Model.from_csr("Large-v0", (data, following.ravel(), indptr), actions)
    assert len(list(model.parts())) > 2
    assert learner.put_model(model) == model.model_id


def test_maze_end_to_end(server, learner, learner_address, style):
    """Records an expert through the wrapper, fits, and acts nearly as well as the expert."""
    model = mazeway.Client(server).model("Maze-v0")
    (reward,) = model.rewards.values()
    expert, action_values = optimal_policy(model, reward)
    env = gymnasium.make("mazeway/Maze-v0", address=server, max_episode_steps=50)
    env = mazeway.Recorder(env, style=style, address=learner_address)
    drive(env, expert, episodes=60)
    env.close()

    recorded = learner.trajectories("mazeway/Maze-v0", style)
    assert len(recorded) == 60
    assert {(t.env_id, t.model_id, len(t)) for t in recorded} == {("Maze-v0", model.model_id, 50)}
    assert all(t.truncated and not t.terminated for t in recorded)
    for t in recorded:
        np.testing.assert_array_equal(expert[t.states], t.actions)

    seen = []
    fit = learner.fit("mazeway/Maze-v0", style, discount=0.9, progress=seen.append)
    assert fit.policy.shape == fit.greedy_policy.shape == fit.reward.shape == (57, 4)
    assert fit.state_values.shape == fit.state_visits.shape == (57,)
    assert fit.weights.ndim == 1
    np.testing.assert_allclose(fit.policy.sum(axis=1), 1, atol=1e-6)
    assert fit.state_visits.sum() == pytest.approx(3000)
    assert fit.states_covered == np.count_nonzero(fit.state_visits)
    assert seen
    assert [p.iteration for p in seen] == sorted(p.iteration for p in seen)
    assert fit.stopped in ("converged", "stalled", "max-iterations")

    actions = fit.act(np.arange(57))
    chosen = np.take_along_axis(action_values, actions[:, None], axis=1)[:, 0]
    optimal = np.isclose(chosen, action_values.max(axis=1), atol=1e-6)
    assert optimal.mean() > 0.8, "as SPEC's accuracy for tens of demonstrations"

    shown = learner.show(fit.fit_id[:8])
    assert shown.fit_id == fit.fit_id
    np.testing.assert_array_equal(shown.policy, fit.policy)
    assert fit.fit_id in [f.fit_id for f in learner.fits("Maze-v0", style)]
    assert style in repr(fit)
    learner.delete_fit(fit.fit_id)
    with pytest.raises(mazeway.NotFoundError):
        learner.show(fit.fit_id)


@pytest.mark.parametrize("name", ["FrozenLake-v1", "CliffWalking-v1"])
def test_toy_text_end_to_end(learner, learner_address, style, name):
    """Gymnasium's own environments bring their model as the table P."""
    if name not in gymnasium.registry:
        name = "CliffWalking-v0"  # as Gymnasium 1.0 has it
    env = gymnasium.make(name, max_episode_steps=100)
    model = mazeway.Model.from_gymnasium(env)
    expert, _ = optimal_policy(model, model.rewards["true"], discount=0.99)
    env = mazeway.Recorder(env, style=style, address=learner_address)
    drive(env, expert, episodes=30)
    env.close()
    recorded = learner.trajectories(name, style)
    assert len(recorded) == 30
    assert {t.model_id for t in recorded} == {model.model_id}
    assert any(t.terminated for t in recorded)
    fit = learner.fit(name, style, method="em-tied", discount=0.99, basis="state")
    visited = np.flatnonzero(fit.state_visits)
    assert (fit.act(visited) == expert[visited]).mean() > 0.7
    assert fit.agreement > 0.7


def test_behaviour_cloning_is_the_counts(learner, style):
    model_id = learner.put_model("Toy-v0", np.full((5, 2, 5), 0.2))
    learner.record(trajectory(style, model_id=model_id, steps=10) for _ in range(3))
    fit = learner.fit("Toy-v0", style, method="bc")
    assert fit.act(0) in (0, 1)
    assert fit.options["discount"] == 0.9
    assert fit.method == "bc"
    html = fit._repr_html_()
    assert html.startswith("<table>")
    assert fit.fit_id in html


def test_act_draws_as_told(learner, style):
    model_id = learner.put_model("Toy-v0", np.full((5, 2, 5), 0.2))
    demonstration = trajectory(
        style, model_id=model_id, states=np.zeros(4, int), actions=np.array([0, 0, 0, 1])
    )
    learner.record([demonstration])
    fit = learner.fit("Toy-v0", style, method="bc")
    np.testing.assert_allclose(fit.policy[0], [0.75, 0.25])
    used = list(learner.fit_trajectories(fit.fit_id[:8]))
    assert len(used) == fit.trajectories == sum(fit.sources.values())
    assert fit.trajectories_digest == hashlib.sha256(b"".join(uuid.UUID(i).bytes for i in used)).digest()
    assert [t.trajectory_id for t in learner.trajectories(fit_id=fit.fit_id)] == used
    with pytest.raises(mazeway.NotFoundError):
        list(learner.fit_trajectories(str(uuid.UUID(int=0))))
    draws = fit.act(np.zeros(20_000, int), rng=np.random.default_rng(1), stochastic=True)
    assert np.mean(draws) == pytest.approx(0.25, abs=0.02)
    assert fit.act(np.zeros((2, 3), int)).tolist() == [[0, 0, 0], [0, 0, 0]]
    again = fit.act(np.zeros(20_000, int), rng=np.random.default_rng(1), stochastic=True)
    np.testing.assert_array_equal(draws, again)
    for wrong in (5, -1, 0.5):
        with pytest.raises(mazeway.InvalidArgumentError, match="expected integers from 0 to 4"):
            fit.act(wrong)
    with pytest.raises(mazeway.InvalidArgumentError, match="rng"):
        fit.act(0, stochastic=True)


def test_wrong_fits(learner, style):
    with pytest.raises(mazeway.MazewayError, match="selects 0") as caught:
        learner.fit("Toy-v0", style)
    assert isinstance(caught.value, (mazeway.WrongStateError, mazeway.NotFoundError))
    for options, message in (
        ({"gamma": 0.9}, "gamma: unknown option, expected one of discount"),
        ({"basis": "wavelet"}, "basis: expected one of 'state', 'state-action', 'features', got 'wavelet'"),
        ({"discount": "high"}, "discount"),
        ({"horizon": -3}, "horizon"),
    ):
        with pytest.raises(mazeway.InvalidArgumentError, match=message):
            learner.fit("Toy-v0", style, **options)
    learner.record([trajectory(style, model_id=learner.put_model("Toy-v0", np.full((5, 2, 5), 0.2)))])
    with pytest.raises(mazeway.InvalidArgumentError, match="method"):
        learner.fit("Toy-v0", style, method="guess")
    with pytest.raises(mazeway.InvalidArgumentError, match="discount"):
        learner.fit("Toy-v0", style, discount=1.5)


def test_no_learner_is_one_line_with_a_hint():
    with pytest.raises(mazeway.ServerUnreachableError) as caught:
        mazeway.Learner("127.0.0.1:1").fits()
    assert "\n" not in str(caught.value)
    assert "hint: start one with: cargo run --release --bin learner -- serve" in str(caught.value)


def record_lake(address, style, **arguments):
    env = gymnasium.make("FrozenLake-v1", max_episode_steps=20)
    return mazeway.Recorder(env, style=style, address=address, **arguments)


def test_states_alone(style):
    alone = trajectory(style, actions=None)
    without_end = trajectory(style, actions=None, final_state=None)
    assert (len(alone), len(without_end)) == (4, 3)
    for sent in (alone, without_end):
        read = Trajectory.from_wire(sent.to_wire())
        assert read.actions is None
        assert (read.states.tolist(), read.final_state) == (sent.states.tolist(), sent.final_state)
    with pytest.raises(mazeway.InvalidArgumentError, match="at least two"):
        trajectory(style, steps=1, actions=None, final_state=None)


def test_recorder_stores_before_the_next_reset(learner, learner_address, style):
    env = record_lake(learner_address, style)
    env.reset(seed=1)
    assert learner.count(style=style) == 0
    observations, actions, rewards, over = [], [], [], False
    env.action_space.seed(1)
    observation, _ = env.reset(seed=1)
    while not over:
        action = env.action_space.sample()
        observations.append(observation)
        actions.append(action)
        observation, reward, terminated, truncated, _ = env.step(action)
        rewards.append(reward)
        over = terminated or truncated
    env.reset(seed=2)
    assert env.pending == []
    (stored,) = learner.trajectories(style=style)
    assert (stored.states.tolist(), stored.actions.tolist()) == (observations, actions)
    assert (stored.rewards.tolist(), stored.final_state) == (rewards, observation)
    assert (stored.terminated, stored.truncated) == (terminated, truncated)
    assert (stored.env_id, stored.source) == ("FrozenLake-v1", "python")
    # A part of an episode counts too, be it ended by reset or by close.
    env.step(0)
    env.reset(seed=3)
    assert learner.count(style=style) == 2
    env.step(0)
    env.step(0)
    env.close()
    last = learner.trajectories(style=style)[-1]
    assert (len(last), last.terminated, last.truncated) == (2, False, False)
    env.close()
    assert learner.count(style=style) == 3


def test_recorder_flush(learner, learner_address, style):
    env = record_lake(learner_address, style)
    env.reset(seed=1)
    while not any(env.step(1)[2:4]):
        pass
    env.flush()
    assert learner.count(style=style) == 1
    env.close()


def test_recorder_changes_nothing(server, learner_address, style):
    plain = gymnasium.make("mazeway/Maze-v0", address=server, max_episode_steps=10)
    wrapped = mazeway.Recorder(
        gymnasium.make("mazeway/Maze-v0", address=server, max_episode_steps=10),
        style=style,
        address=learner_address,
    )
    for seed in (4, None):
        assert repr(plain.reset(seed=seed)) == repr(wrapped.reset(seed=seed))
        for i in range(10):
            assert repr(plain.step(i % 4)) == repr(wrapped.step(i % 4))
    assert isinstance(wrapped.unwrapped, mazeway.MazewayEnv)
    plain.close()
    wrapped.close()


def test_recorder_names(learner, learner_address, style):
    env = record_lake(learner_address, style, env_id="Lake", model_id=None, source="keyboard")
    env.reset(seed=1)
    env.step(0)
    env.close()
    (stored,) = learner.trajectories("Lake", style)
    assert (stored.model_id, stored.source) == ("", "keyboard")


def test_recorder_refuses_what_is_not_discrete(learner_address):
    with pytest.raises(mazeway.InvalidArgumentError, match="Discrete observation space"):
        mazeway.Recorder(gymnasium.make("CartPole-v1"), style="x", address=learner_address)
    with pytest.raises(mazeway.InvalidArgumentError, match="style"):
        mazeway.Recorder(gymnasium.make("FrozenLake-v1"), style="", address=learner_address)


def test_recorder_sends_again_after_a_failure(tmp_path, style):
    """The learner is killed with an episode unacknowledged: nothing is lost, nothing is twice."""
    process = start_learner(tmp_path)
    env = record_lake(process.address, style, timeout=3.0)
    env.reset(seed=1)
    while not any(env.step(1)[2:4]):
        pass
    env.flush()
    process.stop(signal.SIGKILL)
    env.reset(seed=2)  # nothing is pending: the learner is not needed
    while not any(env.step(1)[2:4]):
        pass
    with pytest.raises(mazeway.ServerUnreachableError, match="start one with"):
        env.reset(seed=3)
    ids = [t.trajectory_id for t in env.pending]
    assert len(ids) == 1
    process = start_learner(tmp_path, listen=process.address)
    try:
        env.flush()
        assert env.pending == []
        with mazeway.Learner(process.address) as learner:
            stored = learner.trajectories(style=style)
            assert len(stored) == 2
            assert stored[1].trajectory_id == ids[0]
        env.close()
    finally:
        process.stop()


def test_recorder_waits_for_a_learner_that_comes_back(tmp_path, style):
    process = start_learner(tmp_path)
    env = record_lake(process.address, style)
    env.reset(seed=1)
    env.step(0)
    process.stop(signal.SIGKILL)
    process = start_learner(tmp_path, listen=process.address)
    try:
        env.reset(seed=2)
        with mazeway.Learner(process.address) as learner:
            assert learner.count(style=style) == 1
        env.close()
    finally:
        process.stop()


def test_recorder_can_be_pickled(learner, learner_address, style):
    env = record_lake(learner_address, style)
    env.reset(seed=1)
    env.step(0)
    twin = pickle.loads(pickle.dumps(env))
    twin.close()
    env.close()
    assert learner.count(style=style) == 2
