"""The same environments over a Unix socket."""

import signal

import gymnasium
import numpy as np
import pytest
from conftest import start_server

import mazeway


@pytest.fixture
def socket(tmp_path_factory):
    # A path of at most 107 bytes: the operating system takes no longer one.
    directory = tmp_path_factory.mktemp("unix")
    process = start_server(directory, listen=f"unix:{directory}/env.sock")
    yield process
    process.stop()


def trace(address, **options):
    env = gymnasium.make("mazeway/Highway-v0", address=address, max_episode_steps=9, **options)
    try:
        out = [env.reset(seed=3)]
        for step in range(40):
            out.append(env.step(step % 12))
            if out[-1][2] or out[-1][3]:
                out.append(env.reset())
        return repr(out)
    finally:
        env.close()


def test_trajectories_are_those_over_tcp(server, socket):
    assert socket.address.startswith("unix:/")
    assert trace(socket.address) == trace(server)
    # The scheme with slashes means the same.
    assert trace(socket.address.replace("unix:", "unix://")) == trace(server)


def test_batches_and_pictures(server, socket):
    frames = []
    for address in (server, socket.address):
        envs = gymnasium.make_vec("mazeway/Maze-v0", num_envs=5, address=address)
        observations, _ = envs.reset(seed=1)
        steps = [envs.step(np.full(5, action)) for action in (0, 1, 2, 3)]
        frames.append(repr((observations, steps)))
        envs.close()
    assert frames[0] == frames[1]
    env = gymnasium.make("mazeway/Maze-v0", address=socket.address, render_mode="rgb_array")
    env.reset(seed=1)
    assert env.render().shape[2] == 3
    env.close()


def test_the_socket_goes_with_its_server(socket):
    env = gymnasium.make("mazeway/Maze-v0", address=socket.address)
    env.reset(seed=1)
    socket.stop(signal.SIGTERM)
    with pytest.raises(mazeway.MazewayError):
        for _ in range(100):
            env.step(0)
    env.close()
    with pytest.raises(mazeway.MazewayError, match=r"env\.sock"):
        gymnasium.make("mazeway/Maze-v0", address=socket.address).reset(seed=1)
