"""Watching sessions."""

import threading
import time

import gymnasium
import numpy as np
import pytest
from conftest import start_server

import mazeway


def test_a_wrapped_environment_is_seen_as_it_is_stepped(server):
    env = gymnasium.make("mazeway/Maze-v0", address=server, render_mode="rgb_array")
    frames = mazeway.watch(env, max_fps=60, timeout=20)
    env.reset(seed=3)
    frame = next(frames)
    assert (frame.step, frame.episode_step, frame.skipped, frame.episode_ended) == (0, 0, 0, False)
    np.testing.assert_array_equal(frame.content, env.render())
    for step in range(1, 4):
        env.step(step % 4)
        frame = next(frames)
        assert (frame.step, frame.episode_step, frame.skipped) == (step, step, 0)
        np.testing.assert_array_equal(frame.content, env.render())
    env.close()
    assert next(frames, None) is None


def test_text_and_png_of_a_batch(server):
    envs = gymnasium.make_vec("mazeway/Maze-v0", num_envs=3, address=server, render_mode="ansi")
    envs.reset(seed=3)
    text = next(mazeway.watch(envs, 2, mode="ansi"))
    assert text.content == envs.render()[2]
    # The id is all that a stranger needs.
    png = next(mazeway.watch(envs.unwrapped.session_id, 2, mode="png", max_width=100, address=server))
    assert png.content[:4] == b"\x89PNG"
    assert int.from_bytes(png.content[16:20], "big") == 100
    small = next(mazeway.watch(envs, max_width=100))
    assert small.content.shape[1:] == (100, 3)
    assert "content" not in repr(small)
    envs.close()


def test_another_thread_watches_while_this_one_steps(server):
    env = mazeway.MazewayEnv("Highway-v0", server)
    env.reset(seed=1)
    seen = []
    viewer = threading.Thread(target=lambda: seen.extend(mazeway.watch(env, max_fps=60, max_width=64)))
    viewer.start()
    deadline = time.monotonic() + 30
    while len(seen) < 5 and time.monotonic() < deadline:
        *_, terminated, truncated, _ = env.step(0)
        if terminated or truncated:
            env.reset()
    env.close()
    viewer.join(timeout=30)
    assert not viewer.is_alive()
    assert len(seen) >= 5
    assert [frame.step for frame in seen] == sorted({frame.step for frame in seen})
    assert sum(frame.skipped for frame in seen) >= seen[-1].step - seen[0].step - len(seen)


def test_nothing_to_see_within_the_timeout(server):
    env = mazeway.MazewayEnv("Maze-v0", server)
    frames = mazeway.watch(env, timeout=0.3)
    with pytest.raises(mazeway.DeadlineExceededError, match=r"within 0\.3 s"):
        next(frames)
    env.close()


def test_a_session_at_rest_is_waited_for(server, monkeypatch):
    monkeypatch.setattr("mazeway.watching._SILENCE_SECS", 0.3)
    env = mazeway.MazewayEnv("Maze-v0", server)
    frames = mazeway.watch(env, mode="ansi", max_fps=60)
    for act in (lambda: env.reset(seed=1), lambda: env.step(0)):
        timer = threading.Timer(1.5, act)  # by then it was asked for several times
        timer.start()
        next(frames)
        timer.join()
    env.close()
    assert next(frames, None) is None


def test_a_server_without_a_sign_of_life_ends_the_watch(tmp_path, monkeypatch):
    process = start_server(tmp_path)
    env = mazeway.MazewayEnv("Maze-v0", process.address)
    env.reset(seed=1)
    monkeypatch.setattr("mazeway.watching._SILENCE_SECS", 0.5)
    frames = mazeway.watch(env)
    next(frames)
    process.pause()
    began = time.monotonic()
    with pytest.raises(mazeway.DeadlineExceededError, match=r"within 0\.5 s"):
        next(frames)
    assert time.monotonic() - began < 10
    process.stop()


def test_a_frozen_server_is_found_out_by_its_pings(tmp_path):
    process = start_server(tmp_path)
    env = mazeway.MazewayEnv("Maze-v0", process.address)
    env.reset(seed=1)
    frames = mazeway.watch(env, timeout=100)
    next(frames)
    process.pause()
    began = time.monotonic()
    with pytest.raises(mazeway.ServerUnreachableError):
        next(frames)
    # A ping after ten seconds, and as long for its answer.
    assert 10 < time.monotonic() - began < 40
    process.stop()


def test_a_server_that_dies_ends_the_watch(tmp_path):
    process = start_server(tmp_path)
    env = mazeway.MazewayEnv("Maze-v0", process.address)
    env.reset(seed=1)
    frames = mazeway.watch(env)
    next(frames)
    process.stop()
    with pytest.raises(mazeway.ServerUnreachableError):
        next(frames)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"mode": "jpeg"}, mazeway.InvalidArgumentError, "mode: expected one of"),
        ({"index": -1}, mazeway.InvalidArgumentError, "index: expected at least 0"),
        ({"index": 1}, mazeway.InvalidArgumentError, "index: expected an index below 1"),
        ({"max_width": -1}, mazeway.InvalidArgumentError, "max_width: expected at least 0"),
        ({"mode": "ansi", "max_width": 9}, mazeway.InvalidArgumentError, "max_width: expected none"),
        ({"max_fps": -1.0}, mazeway.InvalidArgumentError, "max_fps: expected at least 0.01"),
        ({"what": "f" * 32}, mazeway.NotFoundError, "no such session"),
        ({"what": "nonsense"}, mazeway.NotFoundError, "no such session"),
    ],
)
def test_wrong_watches(server, arguments, error, message):
    env = mazeway.MazewayEnv("Maze-v0", server)
    with pytest.raises(error) as caught:
        next(mazeway.watch(**{"what": env, "address": server, "timeout": 20, **arguments}))
    assert message in f"{getattr(caught.value, 'field', '')}: {caught.value}"
    env.close()


def test_what_is_no_session_is_refused():
    with pytest.raises(mazeway.InvalidArgumentError, match="environment of Mazeway"):
        mazeway.watch(gymnasium.make("FrozenLake-v1"))
