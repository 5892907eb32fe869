"""The two clients are one to their users: the same numbers, types and errors, call by call."""

import socket
import subprocess
import sys
import threading
import time

import gymnasium
import numpy as np
import pytest
from conftest import start_server
from test_env import ENVIRONMENTS, OPTIONS, drive
from test_vector import MODES, assert_same

import mazeway
from mazeway import _transport, _wire
from mazeway._access import Access

CLIENTS = ["native", "grpc"]


@pytest.fixture(autouse=True)
def which_client(monkeypatch):
    """Here each call says which client it means."""
    if not _transport.has_native():
        pytest.skip("the native client is not built")
    monkeypatch.delenv(_transport.CLIENT_VARIABLE, raising=False)


@pytest.mark.parametrize(("name", "options"), OPTIONS)
def test_same_drives(server, name, options):
    said = []
    for client in CLIENTS:
        env = gymnasium.make(name, address=server, client=client, max_episode_steps=40, **options)
        actions = np.random.default_rng(5).integers(env.action_space.n, size=200)
        said.append((env.observation_space, env.action_space, drive(env, actions, seed=9)))
        env.close()
    assert said[0][:2] == said[1][:2]
    for one, other in zip(said[0][2], said[1][2], strict=True):
        assert_same(one, other)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(("name", "options"), OPTIONS)
def test_same_batches(server, name, options, mode):
    envs = [
        mazeway.MazewayVectorEnv(
            name, 5, server, autoreset_mode=mode, max_episode_steps=7, client=client, **options
        )
        for client in CLIENTS
    ]
    assert_same(*(env.reset(seed=3) for env in envs))
    rng = np.random.default_rng(1)
    for step in range(30):
        actions = rng.integers(envs[0].single_action_space.n, size=5)
        one, other = (env.step(actions) for env in envs)
        assert_same(one, other, f"step {step}")
        over = one[2] | one[3]
        if mode == "DISABLED" and over.any():
            assert_same(*(env.reset(options={"reset_mask": over.copy()}) for env in envs))
    assert_same(*(env.reset(seed=[4, None, 2**64 - 1, None, 0]) for env in envs))
    for env in envs:
        env.close()


def test_same_pictures(server):
    for name in ENVIRONMENTS:
        for mode in ("ansi", "rgb_array"):
            frames = []
            for client in CLIENTS:
                env = mazeway.MazewayEnv(name, server, render_mode=mode, client=client)
                env.reset(seed=2)
                env.step(1)
                frames.append(env.render())
                env.close()
            np.testing.assert_array_equal(*frames)


def outcome(call):
    """Type and words of what a call raises."""
    with pytest.raises(mazeway.MazewayError) as caught:
        call()
    error = caught.value
    return type(error), str(error), error.hint, getattr(error, "field", None)


WRONG = {
    "no such environment": lambda a, c: mazeway.MazewayEnv("Nowhere-v0", a, client=c).reset(),
    "no such option": lambda a, c: mazeway.MazewayEnv("Maze-v0", a, client=c, slipp=1).reset(),
    "option out of range": lambda a, c: mazeway.MazewayEnv("Maze-v0", a, client=c, slip=2.0).reset(),
    "option that is no number": lambda a, c: mazeway.MazewayEnv("Maze-v0", a, client=c, slip=np.nan).reset(),
    "too many": lambda a, c: mazeway.MazewayVectorEnv("Maze-v0", 2**31, a, client=c),
    "no server": lambda _, c: mazeway.MazewayEnv("Maze-v0", "127.0.0.1:1", client=c).reset(),
    "no such learner method": lambda a, c: mazeway.Learner(a, client=c).count(),
    "no such policy": lambda a, c: mazeway.Client(a, client=c).rollout("Maze-v0", policy=np.ones((57, 4))),
    "no such driver": lambda a, c: mazeway.Client(a, client=c).rollout("Maze-v0", driver="drunk"),
    "no such model": lambda a, c: mazeway.Client(a, client=c).model("Nowhere-v0"),
}


@pytest.mark.parametrize("name", WRONG)
def test_same_errors(server, name):
    native, grpc = (outcome(lambda client=client: WRONG[name](server, client)) for client in CLIENTS)
    assert native == grpc


@pytest.mark.parametrize(
    "actions",
    [[0, 1], [[0], [1], [2]], [0.5, 1.0, 2.0], [0, 1, 4], [0, 1, -1], [0, 1, 2**32], [0, 1, 2**64 - 1]],
)
def test_same_refusals_of_actions(server, actions):
    said = []
    for client in CLIENTS:
        env = mazeway.MazewayVectorEnv("Maze-v0", 3, server, client=client)
        env.reset(seed=1)
        said.append((outcome(lambda env=env: env.step(np.array(actions))), env.step(np.array([0, 1, 2]))))
        env.close()
    assert said[0][0] == said[1][0]
    assert_same(said[0][1], said[1][1])


@pytest.mark.parametrize(
    "action",
    [-1, 4, 1.5, "north", None, True, np.int64(2), np.array(3), np.array([1]), np.array([0, 1])],
    ids=repr,
)
def test_same_reading_of_an_action(server, action):
    said = []
    for client in CLIENTS:
        env = mazeway.MazewayEnv("Maze-v0", server, client=client)
        env.reset(seed=1)
        try:
            said.append(repr(env.step(action)))
        except mazeway.InvalidArgumentError as error:
            said.append((str(error), error.field))
        env.close()
    assert said[0] == said[1]


@pytest.mark.parametrize("client", CLIENTS)
@pytest.mark.parametrize("ahead", [1, 3, 64])
def test_sending_ahead_gives_what_steps_give(server, client, ahead):
    env, reference = (
        mazeway.MazewayVectorEnv("Highway-v0", 7, server, client=client, max_episode_steps=9)
        for _ in range(2)
    )
    env.reset(seed=5)
    reference.reset(seed=5)
    actions = np.random.default_rng(2).integers(12, size=(100, 7))
    expected = [reference.step(a) for a in actions]
    said = []
    for rank, action in enumerate(actions):
        env.send(action)
        if rank >= ahead:
            said.append(env.recv())
    said += [env.recv() for _ in range(min(ahead, len(actions)))]
    for one, other in zip(said, expected, strict=True):
        assert_same(one, other)
    env.step_async(actions[0])
    assert_same(env.step_wait(), reference.step(actions[0]))
    env.close()
    reference.close()


@pytest.mark.parametrize("client", CLIENTS)
def test_wrong_sends(server, client):
    env = mazeway.MazewayVectorEnv("Maze-v0", 2, server, client=client)
    with pytest.raises(mazeway.ResetNeededError, match="reset"):
        env.send(np.array([0, 0]))
    env.reset(seed=1)
    with pytest.raises(mazeway.WrongStateError, match=r"send\(\)"):
        env.recv()
    env.send(np.array([0, 1]))
    with pytest.raises(mazeway.InvalidArgumentError, match="shape"):
        env.send(np.array([0]))
    for call in (lambda: env.step(np.array([0, 0])), env.reset):
        with pytest.raises(mazeway.WrongStateError, match=r"recv\(\)"):
            call()
    env.recv()
    env.send(np.array([0, 9]))
    env.send(np.array([0, 1]))
    with pytest.raises(mazeway.InvalidArgumentError, match="9"):
        env.recv()  # the stream, and what else was sent on it, is over; the session is not
    env.step(np.array([0, 1]))
    for _ in range(1024):
        env.send(np.array([0, 1]))
    with pytest.raises(mazeway.WrongStateError, match="at most 1024"):
        env.send(np.array([0, 1]))
    for _ in range(1024):
        env.recv()
    env.close()


def test_which_client_is_chosen(server, monkeypatch):
    assert _transport.choose("auto") == "native"
    mazeway.Client("https://localhost:1", client="native").close()
    with pytest.raises(
        mazeway.InvalidArgumentError, match="client: expected one of 'auto', 'native', 'grpc'"
    ) as caught:
        gymnasium.make("mazeway/Maze-v0", address=server, client="carrier pigeon")
    assert caught.value.field == "client"
    monkeypatch.setenv(_transport.CLIENT_VARIABLE, "grpc")
    assert _transport.choose("auto") == "grpc"
    assert _transport.choose("native") == "native"
    monkeypatch.setenv(_transport.CLIENT_VARIABLE, "pigeon")
    with pytest.raises(mazeway.InvalidArgumentError, match="MAZEWAY_CLIENT"):
        mazeway.Learner()
    monkeypatch.delenv(_transport.CLIENT_VARIABLE)
    monkeypatch.setattr(_transport, "has_native", lambda: False)
    assert _transport.choose("auto") == "grpc"
    with pytest.raises(mazeway.UnsupportedError, match="client='grpc'"):
        mazeway.Learner(client="native")


def python(code, *arguments):
    """Runs a program to its end; returns what it printed."""
    command = [sys.executable, "-W", "error", "-c", code, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_native_client_needs_no_grpcio(server):
    code = """
import sys, gymnasium, mazeway
env = gymnasium.make("mazeway/Maze-v0", address=sys.argv[1], client="native")
env.reset(seed=1); env.step(0); env.close()
print("grpc" in sys.modules)
"""
    assert python(code, server) == "False\n"


@pytest.mark.parametrize("client", CLIENTS)
def test_a_program_ends_while_its_server_is_away(client):
    code = """
import sys, mazeway
client = mazeway.Client("127.0.0.1:1", client=sys.argv[1])
for _ in range(2):
    try: client.model("Maze-v0")
    except mazeway.ServerUnreachableError: pass
"""
    for _ in range(5):
        assert python(code, client) == ""


@pytest.mark.parametrize("client", CLIENTS)
def test_a_program_ends_with_environments_open(server, client):
    code = """
import sys, gymnasium, mazeway
envs = [gymnasium.make("mazeway/Maze-v0", address=sys.argv[1], client=sys.argv[2]) for _ in range(3)]
for env in envs: env.reset(seed=1); env.step(0)
batch = gymnasium.make_vec("mazeway/Maze-v0", num_envs=3, address=sys.argv[1], client=sys.argv[2])
batch.reset(seed=1); batch.send(batch.action_space.sample())
print("over")
"""
    assert python(code, server, client) == "over\n"


@pytest.mark.parametrize("client", CLIENTS)
def test_others_work_while_one_waits(tmp_path, client):
    process = start_server(tmp_path)
    try:
        env = mazeway.MazewayEnv("Maze-v0", process.address, client=client)
        env.reset(seed=1)
        process.pause()
        waiting = threading.Thread(target=env.step, args=(0,))
        waiting.start()
        count = sum(1 for _ in range(100_000))  # would never end if the interpreter were held
        assert waiting.is_alive()
        assert count == 100_000
        process.resume()
        waiting.join(60)
        assert not waiting.is_alive()
        env.close()
    finally:
        process.resume()
        process.stop()


def test_a_silent_client_goes_on(tmp_path):
    """Longer than the server's keep-alive interval and its ping's timeout of 10 seconds together."""
    process = start_server(tmp_path, "--keepalive-secs", "0.5")
    try:
        envs = [mazeway.MazewayEnv("Maze-v0", process.address, client=client) for client in CLIENTS]
        batch = mazeway.MazewayVectorEnv("Maze-v0", 2, process.address, client="native")
        client = mazeway.Client(process.address, client="native")
        client.list_environments()
        batch.reset(seed=1)
        for env in envs:
            env.reset(seed=1)
            env.step(0)
        time.sleep(13)
        assert repr(envs[0].step(1)) == repr(envs[1].step(1))
        batch.step(np.array([0, 1]))
        client.list_environments()
        for env in (*envs, batch):
            env.close()
    finally:
        process.stop()


def test_what_waits_to_be_sent_is_bounded():
    with socket.create_server(("127.0.0.1", 0)) as listener:  # takes connections and never says a word
        address = f"127.0.0.1:{listener.getsockname()[1]}"
        transport = _transport.connect(address, _wire.ENVIRONMENT_SERVICE, Access("native"))
        exchange = transport.exchange("Interact", timeout=1)
        request = _wire.env.InteractRequest()
        request.close.session_id = "0" * 200
        with pytest.raises(mazeway.LimitReachedError, match="at most 4096 requests"):
            for _ in range(20_000):
                exchange.send(request)
        exchange.cancel()
        transport.close()
