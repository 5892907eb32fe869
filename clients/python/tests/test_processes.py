"""Forks, pickles, threads, and servers that stop, hang, return and forget."""

import contextlib
import copy
import multiprocessing
import pickle
import signal
import threading
import time
import weakref

import gymnasium
import numpy as np
import pytest
from conftest import start_server

import mazeway
from mazeway import _transport, _wire

# A fork beside running threads is what these tests are about; Python 3.12 and later warn of it.
pytestmark = pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")

CONTEXTS = multiprocessing.get_all_start_methods()


def make(address, **options):
    return gymnasium.make("mazeway/Maze-v0", address=address, max_episode_steps=7, **options)


class Maker:
    """A picklable environment function, for processes that are spawned."""

    def __init__(self, address):
        self.address = address

    def __call__(self):
        return make(self.address)


def positions(env, steps=12):
    observations = [env.reset(seed=17)[0]]
    observations += [env.step(np.array([0, 1, 2, 3]))[0] for _ in range(steps)]
    return np.array(observations).tolist()


@pytest.mark.parametrize("context", CONTEXTS)
def test_async_vector_env(server, context):
    expected = gymnasium.vector.SyncVectorEnv([Maker(server)] * 4)
    reference = positions(expected)
    # The live environment of this process must neither suffer nor be shared.
    live = make(server)
    trace = [live.reset(seed=1), live.step(0)]
    env = gymnasium.vector.AsyncVectorEnv([Maker(server)] * 4, context=context)
    try:
        assert positions(env) == reference
        trace.append(live.step(1))
    finally:
        env.close(terminate=True)
    trace.append(live.step(2))
    again = make(server)
    assert repr(trace) == repr([again.reset(seed=1), *(again.step(a) for a in (0, 1, 2))])
    for other in (expected, live, again):
        other.close()


def _in_child(env, connection):
    try:
        env.unwrapped.step(0)
    except mazeway.ResetNeededError as error:
        connection.send(str(error))
    connection.send([env.reset(seed=3)[0], *(env.step(a)[0] for a in (0, 1, 2))])
    env.close()


@pytest.mark.skipif("fork" not in CONTEXTS, reason="this platform has no fork")
@pytest.mark.parametrize("attempt", range(5))
def test_a_forked_environment_begins_a_session_of_its_own(server, attempt):
    env = make(server)
    reference = [env.reset(seed=3)[0], *(env.step(a)[0] for a in (0, 1, 2))]
    env.reset(seed=4)
    before = env.step(0)
    ours, theirs = multiprocessing.Pipe()
    child = multiprocessing.get_context("fork").Process(target=_in_child, args=(env, theirs))
    child.start()
    assert ours.poll(60)
    assert "reset" in ours.recv()
    assert ours.poll(60)
    assert ours.recv() == reference
    child.join(60)
    assert child.exitcode == 0
    # The parent's episode went on untouched.
    after = env.step(1)
    env.reset(seed=4)
    assert repr([before, after]) == repr([env.step(0), env.step(1)])
    env.close()


@pytest.mark.skipif("fork" not in CONTEXTS, reason="this platform has no fork")
def test_clients_work_on_both_sides_of_a_fork(server):
    client = mazeway.Client(server)
    names = [e.env_id for e in client.list_environments()]
    ours, theirs = multiprocessing.Pipe()

    def child():
        theirs.send([e.env_id for e in client.list_environments()])

    process = multiprocessing.get_context("fork").Process(target=child)
    process.start()
    assert ours.poll(60)
    assert ours.recv() == names
    process.join(60)
    assert [e.env_id for e in client.list_environments()] == names
    client.close()


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_begins_anew(server, copied):
    env = make(server)
    env.reset(seed=3)
    env.step(0)
    twin = copied(env)
    assert twin.observation_space == env.observation_space
    with pytest.raises(gymnasium.error.ResetNeeded):
        twin.unwrapped.step(0)
    assert repr(twin.reset(seed=9)) == repr(env.reset(seed=9))
    assert repr([twin.step(a) for a in (0, 1, 2)]) == repr([env.step(a) for a in (0, 1, 2)])
    twin.close()
    env.step(1)
    env.close()


def test_a_copys_unseeded_reset_follows_np_random(server):
    env = mazeway.MazewayEnv("Maze-v0", server)
    env.reset(seed=3)
    drives = []
    for _ in range(2):
        twin = pickle.loads(pickle.dumps(env))
        drives.append([twin.reset() for _ in range(10)])
        twin.close()
    assert repr(drives[0]) == repr(drives[1])
    env.close()


def test_errors_survive_pickling():
    error = mazeway.InvalidArgumentError("slip: expected at most 1", field="slip", hint="lower it")
    twin = pickle.loads(pickle.dumps(error))
    assert type(twin) is mazeway.InvalidArgumentError
    assert (str(twin), twin.field, twin.hint) == (str(error), "slip", "lower it")


def test_a_forgotten_environment_is_freed(server):
    env = mazeway.MazewayEnv("Maze-v0", server)
    env.reset(seed=1)
    gone = weakref.ref(env)
    del env
    assert gone() is None


def test_environments_in_threads(server):
    reference = mazeway.MazewayEnv("Maze-v0", server)
    reference.reset(seed=5)
    expected = [reference.step(i % 4)[0] for i in range(60)]
    reference.close()
    results = {}

    def drive(name):
        env = mazeway.MazewayEnv("Maze-v0", server)
        env.reset(seed=5)
        results[name] = [env.step(i % 4)[0] for i in range(60)]
        env.close()

    threads = [threading.Thread(target=drive, args=(i,)) for i in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert results == dict.fromkeys(range(6), expected)


@pytest.fixture
def own_server(tmp_path):
    """A server that a test may harm."""
    process = start_server(tmp_path)
    yield process
    if process.popen.poll() is None:
        process.resume()
    process.stop()


def test_a_killed_server_is_an_error_and_a_new_one_serves(own_server, tmp_path):
    env = make(own_server.address)
    env.reset(seed=1)
    own_server.stop()
    with pytest.raises(mazeway.ServerUnreachableError, match="start one with"):
        env.step(0)
    with pytest.raises(mazeway.ResetNeededError):
        env.step(0)
    with pytest.raises(mazeway.ServerUnreachableError):
        env.reset()
    again = start_server(tmp_path, listen=own_server.address)
    try:
        first = env.reset(seed=8)
        env.step(0)
        fresh = make(again.address)
        assert repr(first) == repr(fresh.reset(seed=8))
        fresh.close()
        env.close()
    finally:
        again.stop()


def test_reset_takes_up_with_a_new_server_at_once(own_server, tmp_path):
    env = mazeway.MazewayEnv("Maze-v0", own_server.address)
    env.reset(seed=1)
    own_server.stop()
    again = start_server(tmp_path, listen=own_server.address)
    try:
        observation, _ = env.reset()
        assert observation in env.observation_space
        env.step(0)
        env.close()
    finally:
        again.stop()


def test_close_with_the_server_gone(own_server):
    env = make(own_server.address)
    env.reset(seed=1)
    own_server.stop()
    env.close()
    env.close()


@pytest.mark.parametrize("call", ["step", "reset", "render", "list"])
def test_a_hanging_server_is_a_timeout(own_server, call):
    env = mazeway.MazewayEnv("Maze-v0", own_server.address, timeout=2.0, render_mode="ansi")
    client = mazeway.Client(own_server.address, timeout=2.0)
    env.reset(seed=1)
    own_server.pause()
    calls = {
        "step": lambda: env.step(0),
        "reset": env.reset,
        "render": env.render,
        "list": client.list_environments,
    }
    with pytest.raises(mazeway.DeadlineExceededError, match=r"no answer from .* within 2 s") as caught:
        calls[call]()
    assert isinstance(caught.value, TimeoutError)
    own_server.resume()
    env.reset(seed=1)
    env.step(0)
    env.close()
    client.close()


def test_an_expired_lease_is_said_and_mended(own_server):
    env = make(own_server.address, lease_secs=2.0)
    env.reset(seed=1)
    time.sleep(5)
    with pytest.raises(mazeway.SessionLostError, match=r"reset\(\)"):
        env.step(0)
    env.reset(seed=1)
    env.step(0)
    time.sleep(5)
    env.reset()  # mends itself
    env.step(0)
    env.close()


@pytest.fixture
def interruptible():
    """Ctrl-C raises, also where a shell started the tests in the background and so had them ignore it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_an_interrupted_step_asks_for_a_reset(own_server, interruptible):
    env = mazeway.MazewayEnv("Maze-v0", own_server.address)
    env.reset(seed=1)
    own_server.pause()
    main = threading.main_thread().ident
    timer = threading.Timer(0.5, lambda: signal.pthread_kill(main, signal.SIGINT))
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        env.step(0)
    own_server.resume()
    with pytest.raises(mazeway.ResetNeededError):
        env.step(0)
    reference = mazeway.MazewayEnv("Maze-v0", own_server.address)
    assert repr(env.reset(seed=1)) == repr(reference.reset(seed=1))
    assert repr(env.step(2)) == repr(reference.step(2))
    env.close()
    reference.close()


def test_a_stream_that_the_server_still_holds_is_waited_for(server):
    reference = mazeway.MazewayEnv("Maze-v0", server)
    env = mazeway.MazewayEnv("Maze-v0", server, timeout=5)
    env._session.open()
    with held(env) as holder:
        timer = threading.Timer(0.3, holder.cancel)
        timer.start()
        assert repr(env.reset(seed=1)) == repr(reference.reset(seed=1))
        timer.join()
    assert repr(env.step(2)) == repr(reference.step(2))
    env.close()
    reference.close()


def test_a_session_that_stays_in_use_is_an_error(server):
    env = mazeway.MazewayEnv("Maze-v0", server, timeout=1)
    env._session.open()
    with held(env), pytest.raises(mazeway.SessionInUseError, match="in use by another"):
        env.reset(seed=1)
    env.reset(seed=1)
    env.close()


@contextlib.contextmanager
def held(env):
    """Another stream that has the session of `env`."""
    transport = _transport.connect(env.address, _wire.ENVIRONMENT_SERVICE)
    stream = transport.exchange("Interact", timeout=10)
    request = _wire.env.InteractRequest()
    request.reset.session_id = env._session._connection.session_id
    stream.send(request)
    stream.receive()
    try:
        yield stream
    finally:
        stream.cancel()
        transport.close()
