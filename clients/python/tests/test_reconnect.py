"""Connections that break and servers that come back."""

import concurrent.futures
import contextlib
import signal
import threading
import time

import gymnasium
import numpy as np
import pytest
from conftest import Proxy, start_learner, start_server

import mazeway


def broken(proxy):
    """Cuts the connections, and lets both ends notice."""
    proxy.cut()
    time.sleep(0.2)


def test_an_episode_goes_on_over_another_connection(server, proxy):
    env = mazeway.MazewayEnv("Highway-v0", proxy.address)
    reference = mazeway.MazewayEnv("Highway-v0", server)
    assert repr(env.reset(seed=4)) == repr(reference.reset(seed=4))
    session_id = env.session_id
    for step in range(30):
        if step % 10 == 5:
            broken(proxy)
        assert repr(env.step(step % 12)) == repr(reference.step(step % 12)), step
    broken(proxy)
    assert repr(env.reset()) == repr(reference.reset())  # the generators went on as well
    assert env.session_id == session_id
    broken(proxy)
    env.close()
    reference.close()


def test_a_batch_goes_on_over_another_connection(server, proxy):
    envs = gymnasium.make_vec("mazeway/Maze-v0", num_envs=5, address=proxy.address)
    reference = gymnasium.make_vec("mazeway/Maze-v0", num_envs=5, address=server)
    envs.reset(seed=4)
    reference.reset(seed=4)
    for step in range(12):
        if step % 4 == 2:
            broken(proxy)
        actions = np.full(5, step % 4)
        assert repr(envs.step(actions)) == repr(reference.step(actions)), step
    envs.close()
    reference.close()


def test_a_step_whose_answer_is_lost_is_not_made_twice(server, proxy):
    env = mazeway.MazewayEnv("Maze-v0", proxy.address)
    reference = mazeway.MazewayEnv("Maze-v0", server)
    env.reset(seed=4)
    session_id = env.session_id
    frames = mazeway.watch(session_id, mode="ansi", max_fps=60, address=server, timeout=20)
    assert next(frames).step == 0
    proxy.mute.set()
    threading.Timer(0.5, proxy.cut).start()
    with pytest.raises(mazeway.EpisodeLostError, match=r"reset\(\)") as caught:
        env.step(1)
    assert isinstance(caught.value, ConnectionError)
    assert next(frames).step == 1  # the server made it
    proxy.mute.clear()
    with pytest.raises(mazeway.ResetNeededError):
        env.step(1)
    assert repr(env.reset(seed=9)) == repr(reference.reset(seed=9))
    assert repr(env.step(2)) == repr(reference.step(2))
    assert env.session_id == session_id
    assert next(frames).step == 1  # the reset
    env.close()
    reference.close()


def test_calls_that_only_read_are_made_again(server, proxy, learner_address):
    client = mazeway.Client(proxy.address)
    first = [e.env_id for e in client.list_environments()]
    proxy.cut()
    assert [e.env_id for e in client.list_environments()] == first
    client.close()
    way = Proxy(learner_address)
    learner = mazeway.Learner(way.address)
    models = learner.models()
    way.cut()
    assert learner.models() == models
    learner.close()
    way.close()


def test_a_restarted_server_has_lost_the_episode_and_serves_the_next(tmp_path):
    process = start_server(tmp_path)
    env = mazeway.MazewayEnv("Maze-v0", process.address)
    env.reset(seed=1)
    env.step(0)
    process.stop()
    again = []
    # It is waited for.
    timer = threading.Timer(1.0, lambda: again.append(start_server(tmp_path, listen=process.address)))
    timer.start()
    with pytest.raises(mazeway.EpisodeLostError, match=r"reset\(\)"):
        env.step(0)
    timer.join()
    try:
        reference = mazeway.MazewayEnv("Maze-v0", again[0].address)
        assert repr(env.reset(seed=5)) == repr(reference.reset(seed=5))
        assert repr(env.step(3)) == repr(reference.step(3))
        env.close()
        reference.close()
    finally:
        again[0].stop()


def test_a_recorder_goes_on_with_a_restarted_learner(server, tmp_path):
    process = start_learner(tmp_path)
    address = process.address
    env = gymnasium.make("mazeway/Maze-v0", address=server, max_episode_steps=3)
    env = mazeway.Recorder(env, style="restarted", address=address)
    episodes = 12
    for episode in range(episodes):
        env.reset(seed=episode)
        if episode % 4 == 2:
            # In the middle of an episode, and without a chance to tidy up.
            process.stop(signal.SIGKILL)
            process = start_learner(tmp_path, listen=address)
        for _ in range(3):
            env.step(1)
    env.close()
    assert env.pending == []
    learner = mazeway.Learner(address)
    recorded = learner.trajectories("Maze-v0", "restarted")
    assert len(recorded) == episodes
    assert len({trajectory.trajectory_id for trajectory in recorded}) == episodes
    learner.close()
    process.stop()


class Stays(gymnasium.Env):
    """An environment of this process."""

    observation_space = action_space = gymnasium.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        return 0, {}

    def step(self, action):
        return 0, 0.0, False, False, {}


def late(process, *calls):
    """Every call of a process that stands still ends in time, by an error."""
    for call in calls:
        process.pause()
        began = time.monotonic()
        with pytest.raises(mazeway.DeadlineExceededError, match="within 1 s"):
            call()
        assert time.monotonic() - began < 10
        process.resume()  # before its silence breaks the connection


def test_no_call_outlives_its_timeout(tmp_path):
    process = start_server(tmp_path)
    client = mazeway.Client(process.address, timeout=1)
    client.list_environments()
    env = mazeway.MazewayEnv("Maze-v0", process.address, timeout=1)
    env.reset(seed=1)
    drawn = mazeway.MazewayEnv("Maze-v0", process.address, render_mode="ansi", timeout=1)
    drawn.reset(seed=1)
    envs = mazeway.MazewayVectorEnv("Maze-v0", 2, process.address, timeout=1)
    envs.reset(seed=1)
    closed = mazeway.MazewayVectorEnv("Maze-v0", 2, process.address, timeout=1)
    closed.reset(seed=1)
    late(
        process,
        client.list_environments,
        lambda: client.model("Maze-v0"),
        lambda: client.rollout("Maze-v0"),
        drawn.render,
        lambda: env.step(0),
        lambda: env.reset(seed=1),
        lambda: mazeway.MazewayEnv("Maze-v0", process.address, timeout=1).reset(),
        lambda: envs.step([0, 0]),
        lambda: envs.reset(seed=1),
        lambda: mazeway.MazewayVectorEnv("Maze-v0", 2, process.address, timeout=1),
        lambda: next(mazeway.watch("f" * 32, address=process.address, timeout=1)),
    )
    process.pause()
    began = time.monotonic()
    closed.close()  # a courtesy, of which nobody hears
    client.close()
    assert time.monotonic() - began < 10
    process.resume()
    env.reset(seed=1)
    env.step(0)
    env.close()
    envs.reset(seed=1)
    envs.step([0, 0])
    envs.close()
    process.stop()


def test_no_call_of_the_learner_outlives_its_timeout(tmp_path):
    process = start_learner(tmp_path)
    learner = mazeway.Learner(process.address, timeout=1)
    learner.models()
    recorder = mazeway.Recorder(Stays(), "late", process.address, "Stays-v0", timeout=1)
    recorder.reset()
    recorder.step(0)
    late(
        process,
        learner.models,
        learner.fits,
        lambda: list(learner.fit_trajectories("f" * 32)),
        lambda: learner.count(style="late"),
        lambda: learner.trajectories(style="late"),
        lambda: learner.delete_trajectories(style="late"),
        lambda: learner.put_model("Stays-v0", np.ones((2, 2, 2)) / 2),
        lambda: learner.record([demonstration("late")]),
        lambda: learner.fit("Stays-v0", "late", timeout_secs=1),
        recorder.reset,
    )
    recorder.close()
    assert recorder.pending == []
    assert learner.count(style="late", source="python") >= 1
    learner.close()
    process.stop()


def demonstration(style):
    return mazeway.Trajectory("Stays-v0", style, 2, 2, np.array([0, 1]), np.array([1, 0]))


@contextlib.contextmanager
def absent(process, start, directory):
    """A server that is killed now and comes back in a while."""
    process.stop()
    again = []
    timer = threading.Timer(1.5, lambda: again.append(start(directory, listen=process.address)))
    timer.start()
    try:
        yield
    finally:
        timer.join()
        again[0].stop()


def test_a_server_that_comes_back_is_waited_for(tmp_path):
    process = start_server(tmp_path)
    client = mazeway.Client(process.address)
    models = client.model("Maze-v0").model_id
    new, old = (mazeway.MazewayEnv("Maze-v0", process.address) for _ in range(2))
    batch = mazeway.MazewayVectorEnv("Maze-v0", 3, process.address)
    assert new.session_id  # its first episode is still to begin
    old.reset(seed=1)
    old.step(0)
    calls = (
        lambda: client.model("Maze-v0").model_id,
        lambda: new.reset()[0],
        lambda: old.reset()[0],
        lambda: batch.reset()[0],
    )
    with absent(process, start_server, tmp_path), concurrent.futures.ThreadPoolExecutor(len(calls)) as pool:
        model, *observations = [answer.result() for answer in [pool.submit(call) for call in calls]]
        assert model == models
        assert [np.shape(observation) for observation in observations] == [(), (), (3,)]
        for env in (new, old, batch, client):
            env.close()


def test_a_learner_that_comes_back_is_waited_for(tmp_path):
    process = start_learner(tmp_path)
    learner = mazeway.Learner(process.address)
    model = mazeway.Model.from_dense("Stays-v0", np.ones((2, 2, 2)) / 2)
    learner.put_model(model)
    first, second = demonstration("absent"), demonstration("absent")
    assert learner.record([first]) == 1
    calls = (
        lambda: learner.put_model(model),
        lambda: [t.trajectory_id for t in learner.trajectories(env_id="Stays-v0", source="python")],
        lambda: learner.record([first, second]),
    )
    with absent(process, start_learner, tmp_path), concurrent.futures.ThreadPoolExecutor(len(calls)) as pool:
        answers = [answer.result() for answer in [pool.submit(call) for call in calls]]
        assert answers[0] == model.model_id
        assert first.trajectory_id in answers[1]
        assert answers[2] == 1
        assert learner.count(style="absent") == 2
        learner.close()


def test_what_is_not_repeated_can_be_called_again_at_once(tmp_path):
    process = start_learner(tmp_path)
    learner = mazeway.Learner(process.address)

    def attempts(times):
        """One call after the other, as a caller's own loop makes them: whether each was answered."""
        for _ in range(times):
            try:
                learner.delete_trajectories(style="none")
            except mazeway.ServerUnreachableError:
                yield False
            else:
                yield True
            time.sleep(0.3)

    assert any(attempts(1))
    process.stop()
    assert not any(attempts(3))
    process = start_learner(tmp_path, listen=process.address)
    assert any(attempts(6))
    learner.close()
    process.stop()


def test_a_server_that_was_never_there_is_not_waited_for():
    client, learner = mazeway.Client("127.0.0.1:1"), mazeway.Learner("127.0.0.1:1")
    for call in (
        lambda: client.model("Maze-v0"),
        lambda: learner.record([demonstration("nowhere")]),
        learner.trajectories,
    ):
        began = time.monotonic()
        with pytest.raises(mazeway.ServerUnreachableError, match="hint: start one with"):
            call()
        assert time.monotonic() - began < 5


def test_a_batch_is_lost_with_its_server_and_begins_anew(tmp_path):
    process = start_server(tmp_path)
    envs = gymnasium.make_vec("mazeway/Maze-v0", num_envs=3, address=process.address)

    def step():
        envs.step([0, 1, 2])

    def step_ahead():
        envs.unwrapped.send([0, 1, 2])
        envs.unwrapped.recv()

    for ask in (step, step_ahead):
        envs.reset(seed=1)
        envs.step([0, 1, 2])
        process.stop()
        process = start_server(tmp_path, listen=process.address)
        time.sleep(0.2)  # both ends notice
        with pytest.raises(mazeway.EpisodeLostError, match=r"call reset\(\)") as caught:
            ask()
        if ask is step:  # what is sent ahead may go down with its stream
            assert isinstance(caught.value, mazeway.SessionLostError)
            assert "the server was restarted or the lease has run out" in str(caught.value)
            # No lease outlives its server.
            assert "lease_secs" not in str(caught.value)
        with pytest.raises(mazeway.ResetNeededError):
            ask()
    reference = gymnasium.make_vec("mazeway/Maze-v0", num_envs=3, address=process.address)
    assert repr(envs.reset(seed=5)) == repr(reference.reset(seed=5))
    assert repr(envs.step([3, 3, 3])) == repr(reference.step([3, 3, 3]))
    envs.close()
    reference.close()
    process.stop()


def test_streams_that_have_said_all_end_as_they_should(tmp_path):
    process = start_learner(tmp_path, "--metrics-listen", "127.0.0.1:0")
    for _ in range(3):
        recorder = mazeway.Recorder(Stays(), "said", process.address, "Stays-v0")
        recorder.reset()
        recorder.step(0)
        recorder.close()
    with mazeway.Learner(process.address) as learner:
        assert learner.record([demonstration("said")]) == 1
        assert learner.count(style="said") == 4
    deadline = time.monotonic() + 10
    while time.monotonic() < deadline and process.calls().get(("RecordTrajectories", "OK"), 0) < 4:
        time.sleep(0.05)
    recorded = {
        code: calls for (method, code), calls in process.calls().items() if method == "RecordTrajectories"
    }
    assert recorded == {"OK": 4}
    process.stop()
