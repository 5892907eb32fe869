"""Connections that break and servers that come back."""

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


def test_no_call_outlives_its_timeout(tmp_path):
    process = start_server(tmp_path)
    client = mazeway.Client(process.address, timeout=1)
    client.list_environments()
    env = mazeway.MazewayEnv("Maze-v0", process.address, timeout=1)
    env.reset(seed=1)
    process.pause()
    for call in (client.list_environments, lambda: env.step(0), lambda: env.reset(seed=1)):
        began = time.monotonic()
        with pytest.raises(mazeway.DeadlineExceededError, match="within 1 s"):
            call()
        assert time.monotonic() - began < 10
    process.resume()
    env.reset(seed=1)
    env.step(0)
    env.close()
    process.stop()
