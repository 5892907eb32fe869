"""The peers of wire.py: servers that answer a step with what a tiny environment says, and loops that time a step.

Run by wire.py, in its virtual environment: `python wire_peers.py serve NAME` prints the port and serves until its input
ends; `python wire_peers.py measure` reads what to measure as JSON and prints the times; `python wire_peers.py apart NAME`
times for another process a peer whose requirements clash with the others'. Every server steps the same toy, a walk over 16
numbers, so that what is timed is the way there and back.
"""

import json
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time

# What goes to this machine needs no proxy.
os.environ["NO_PROXY"] = os.environ["no_proxy"] = "127.0.0.1,localhost"

#: Numbers of the toy's states and actions, as in FrozenLake.
N_STATES, N_ACTIONS = 16, 4

#: Servers that would end with their last reference.
KEPT = []


class Toy:
    """A step that costs next to nothing."""

    def __init__(self):
        self.state = 0

    def reset(self):
        self.state = 0
        return self.state

    def step(self, action):
        self.state = (self.state + action) % N_STATES
        return self.state


# Servers


def serve_tcp(listener):
    """Answers every message with one of the same size."""
    while True:
        connection, _ = listener.accept()
        if connection.family != socket.AF_UNIX:
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        while message := connection.recv(4096):
            connection.sendall(message)


def serve_grpc():
    """A bare bidirectional and a bare unary echo of bytes by grpcio."""
    from concurrent import futures

    import grpc

    def echo(requests, _context):
        yield from requests

    handlers = grpc.method_handlers_generic_handler(
        "Echo",
        {
            "Stream": grpc.stream_stream_rpc_method_handler(echo),
            "Once": grpc.unary_unary_rpc_method_handler(lambda request, _context: request),
        },
    )
    server = grpc.server(futures.ThreadPoolExecutor(4))
    server.add_generic_rpc_handlers((handlers,))
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    KEPT.append(server)
    return port


def serve_dm_env_rpc():
    """The protocol's own Python: one agent, its action and its observation as tensors."""
    from concurrent import futures

    import grpc
    from dm_env_rpc.v1 import dm_env_rpc_pb2 as pb
    from dm_env_rpc.v1 import dm_env_rpc_pb2_grpc, tensor_utils

    def spec(name, n):
        tensor = pb.TensorSpec(name=name, dtype=pb.DataType.INT32)
        tensor.min.int32s.array[:] = [0]
        tensor.max.int32s.array[:] = [n - 1]
        return tensor

    class Service(dm_env_rpc_pb2_grpc.EnvironmentServicer):
        def Process(self, requests, _context):
            toy = Toy()
            for request in requests:
                response = pb.EnvironmentResponse()
                kind = request.WhichOneof("payload")
                if kind == "create_world":
                    response.create_world.world_name = "toy"
                elif kind == "join_world":
                    response.join_world.specs.actions[1].CopyFrom(spec("action", N_ACTIONS))
                    response.join_world.specs.observations[1].CopyFrom(spec("observation", N_STATES))
                elif kind == "step":
                    actions = (
                        tensor_utils.unpack_tensor(request.step.actions[1]) if request.step.actions else 0
                    )
                    observation = (
                        toy.step(actions) if getattr(actions, "ndim", 0) == 0 else actions % N_STATES
                    )
                    packed = tensor_utils.pack_tensor(observation, dtype=pb.DataType.INT32)
                    response.step.observations[1].CopyFrom(packed)
                    response.step.state = pb.EnvironmentStateType.RUNNING
                else:
                    getattr(response, kind).SetInParent()
                yield response

    server = grpc.server(futures.ThreadPoolExecutor(4))
    dm_env_rpc_pb2_grpc.add_EnvironmentServicer_to_server(Service(), server)
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    KEPT.append(server)
    return port


def serve_openenv():
    """OpenEnv's own server, HTTP and WebSocket."""
    import uvicorn
    from openenv.core.env_server.http_server import create_fastapi_app
    from openenv.core.env_server.interfaces import Environment
    from openenv.core.env_server.types import Action, Observation, State

    class Move(Action):
        move: int

    class Seen(Observation):
        state: int = 0

    class ToyEnvironment(Environment):
        SUPPORTS_CONCURRENT_SESSIONS = True

        def __init__(self):
            super().__init__()
            self._toy = Toy()

        def reset(self, **_):
            return Seen(state=self._toy.reset(), reward=0.0, done=False)

        def step(self, action, **_):
            return Seen(state=self._toy.step(action.move), reward=0.0, done=False)

        @property
        def state(self):
            return State()

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    app = create_fastapi_app(ToyEnvironment, Move, Seen, max_concurrent_envs=8)
    config = uvicorn.Config(app, host="127.0.0.1", port=port, log_level="error")
    threading.Thread(target=uvicorn.Server(config).run, daemon=True).start()
    for _ in range(200):
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return port
        time.sleep(0.05)
    raise RuntimeError("OpenEnv's server does not listen")


REMOTE_GYM_TOY = """
import gymnasium
import numpy

class Remote(gymnasium.Env):
    observation_space = gymnasium.spaces.Discrete(16)
    action_space = gymnasium.spaces.Discrete(4)
    reward_range = (numpy.float32(0), numpy.float32(1))
    render_mode = None

    def reset(self, **_):
        self.state = 0
        return 0, {}

    def step(self, action):
        self.state = (self.state + int(action)) % 16
        return self.state, 0.0, False, False, {}

def create_environment(**_):
    return Remote()
"""


def serve_remote_gym():
    """remote-gym's own server, the environment in a thread, which is the quicker of its two ways."""
    from remote_gym import create_remote_environment_server

    place = tempfile.TemporaryDirectory()
    os.chdir(place.name)
    with open("toy.py", "w") as file:
        file.write(REMOTE_GYM_TOY)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    default = {"entrypoint": "toy.py", "entrypoint_kwargs": {}}
    KEPT.append((place, create_remote_environment_server(default, "127.0.0.1", port, use_thread=True)))
    return port


def serve(name):
    if name == "tcp":
        listener = socket.create_server(("127.0.0.1", 0))
        threading.Thread(target=serve_tcp, args=(listener,), daemon=True).start()
        where = listener.getsockname()[1]
    else:
        servers = {"grpc": serve_grpc, "dm_env_rpc": serve_dm_env_rpc, "openenv": serve_openenv}
        where = (servers | {"remote-gym": serve_remote_gym})[name]()
    print(where, flush=True)
    sys.stdin.read()
    os._exit(0)  # a peer's children and threads may not want to end


# Steps: each maker returns a callable that steps once, and how many steps one call is.


def step_tcp(ports):
    connection = socket.create_connection(("127.0.0.1", ports["tcp"]))
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def step():
        connection.sendall(b"x" * 32)
        connection.recv(4096)

    return step, 1


def step_grpc(ports, streaming):
    from queue import SimpleQueue

    import grpc

    channel = grpc.insecure_channel(f"127.0.0.1:{ports['grpc']}")
    if not streaming:
        once = channel.unary_unary("/Echo/Once")
        return lambda: once(b"x" * 32), 1
    requests = SimpleQueue()
    answers = channel.stream_stream("/Echo/Stream")(iter(requests.get, None))
    return step_stream(requests, answers), 1


def step_tonic(ports):
    """grpcio's client of a bare stream that tonic serves: the Rust benchmark's echo."""
    from queue import SimpleQueue

    import grpc

    requests = SimpleQueue()
    stream = grpc.insecure_channel(ports["tonic"]).stream_stream("/bench.Echo/Bidi")
    return step_stream(requests, stream(iter(requests.get, None), metadata=(("reply-bytes", "32"),))), 1


def step_stream(requests, answers):
    def step():
        requests.put(b"x" * 32)
        next(answers)

    return step


def step_dm_env_rpc(port, num_envs=1, world=None):
    import grpc
    import numpy as np
    from dm_env_rpc.v1 import connection as dm_connection
    from dm_env_rpc.v1 import dm_env_rpc_pb2 as pb
    from dm_env_rpc.v1 import tensor_utils

    link = dm_connection.Connection(grpc.insecure_channel(f"127.0.0.1:{port}"))
    created = link.send(pb.CreateWorldRequest(settings=world or {}))
    joined = link.send(pb.JoinWorldRequest(world_name=created.world_name))
    action_id = next(iter(joined.specs.actions))
    observation_ids = list(joined.specs.observations)
    action = 1 if num_envs == 1 else np.ones(num_envs, np.int32)

    def step():
        request = pb.StepRequest(requested_observations=observation_ids)
        request.actions[action_id].CopyFrom(tensor_utils.pack_tensor(action, dtype=pb.DataType.INT32))
        answer = link.send(request)
        return tensor_utils.unpack_tensor(answer.observations[observation_ids[0]])

    step()
    return step, num_envs


def step_openenv_websocket(ports):
    from openenv.core.generic_client import GenericEnvClient

    client = GenericEnvClient(base_url=f"http://127.0.0.1:{ports['openenv']}").sync()
    client.connect()
    client.reset()
    return lambda: client.step({"move": 1}), 1


def step_openenv_http(ports):
    import requests

    session = requests.Session()
    url = f"http://127.0.0.1:{ports['openenv']}"
    session.post(f"{url}/reset", json={}).raise_for_status()
    return lambda: session.post(f"{url}/step", json={"action": {"move": 1}}).json(), 1


def step_remote_gym(port):
    from remote_gym import RemoteEnvironment

    env = RemoteEnvironment("127.0.0.1", port)
    env.reset()
    return lambda: env.step(1), 1


class Apart:
    """A step that another interpreter takes, and times."""

    def __init__(self, python, name, port):
        pipe = subprocess.PIPE
        command = [python, __file__, "apart", name, str(port)]
        self._process = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True)

    def timed(self, calls):
        print(calls, file=self._process.stdin, flush=True)
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError(f"{self._process.args[3]}: its process ended")
        return float(line)


def time_apart(name, port):
    """Steps as often as each line of the input says, and prints how long one took."""
    step, _ = APART[name](port)
    for line in sys.stdin:
        print(timed(step, int(line)), flush=True)


def step_mazeway(ports, client, wrapped=True, address=None):
    import gymnasium
    import mazeway

    address = address or f"127.0.0.1:{ports['mazeway']}"
    if wrapped:
        env = gymnasium.make("mazeway/Maze-v0", address=address, client=client, max_episode_steps=10**9)
    else:
        env = mazeway.MazewayEnv("Maze-v0", address, client=client)
    env.reset(seed=1)
    return lambda: env.step(1), 1


def step_local(wrapped):
    """A Gymnasium environment in this process that does nothing: what is left is Gymnasium's own."""
    import gymnasium

    class Local(gymnasium.Env):
        observation_space = gymnasium.spaces.Discrete(N_STATES)
        action_space = gymnasium.spaces.Discrete(N_ACTIONS)

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            return 0, {}

        def step(self, action):
            return 0, 0.0, False, False, {}

    gymnasium.register("Local-v0", Local, max_episode_steps=10**9)
    env = gymnasium.make("Local-v0") if wrapped else Local()
    env.reset(seed=1)
    return lambda: env.step(1), 1


def batch_mazeway(ports, name, num_envs, client, **options):
    import gymnasium
    import mazeway  # noqa: F401 - registers its environments
    import numpy as np

    env = gymnasium.make_vec(
        f"mazeway/{name}",
        num_envs=num_envs,
        address=f"127.0.0.1:{ports['mazeway']}",
        client=client,
        **options,
    )
    env.reset(seed=1)
    actions = np.random.default_rng(0).integers(env.single_action_space.n, size=(64, num_envs))
    rank = iter(range(10**9))
    return lambda: env.step(actions[next(rank) % 64]), num_envs


def batch_envpool(name, num_envs):
    import envpool
    import numpy as np

    env = envpool.make_gymnasium(name, num_envs=num_envs)
    env.reset()
    n = env.action_space.n
    actions = np.random.default_rng(0).integers(n, size=(64, num_envs)).astype(np.int32)
    rank = iter(range(10**9))
    return lambda: env.step(actions[next(rank) % 64]), num_envs


def batch_gymnasium(kind, num_envs):
    import gymnasium
    import numpy as np

    if kind == "one":
        env = gymnasium.make("FrozenLake-v1")
        env.reset(seed=1)

        def step():
            _, _, terminated, truncated, _ = env.step(1)
            if terminated or truncated:
                env.reset()

        return step, 1
    env = gymnasium.make_vec("FrozenLake-v1", num_envs=num_envs, vectorization_mode=kind)
    env.reset(seed=1)
    actions = np.random.default_rng(0).integers(4, size=num_envs)
    return lambda: env.step(actions), num_envs


def step_highway_env():
    import gymnasium
    import highway_env  # noqa: F401 - registers its environments

    env = gymnasium.make("highway-fast-v0")
    env.reset(seed=1)

    def step():
        _, _, terminated, truncated, _ = env.step(1)
        if terminated or truncated:
            env.reset()

    return step, 1


CASES = {
    "tcp": lambda p: step_tcp(p),
    "gymnasium": lambda _: step_local(wrapped=False),
    "gymnasium.make": lambda _: step_local(wrapped=True),
    "native": lambda p: step_mazeway(p, "native"),
    "native unwrapped": lambda p: step_mazeway(p, "native", wrapped=False),
    "native unix": lambda p: step_mazeway(p, "native", address=f"unix:{p['mazeway unix']}"),
    "grpcio": lambda p: step_mazeway(p, "grpc"),
    "grpcio unwrapped": lambda p: step_mazeway(p, "grpc", wrapped=False),
    "grpcio echo bidi": lambda p: step_grpc(p, streaming=True),
    "grpcio tonic echo bidi": lambda p: step_tonic(p),
    "grpcio echo unary": lambda p: step_grpc(p, streaming=False),
    "dm_env_rpc": lambda p: step_dm_env_rpc(p["dm_env_rpc"]),
    "openenv websocket": lambda p: step_openenv_websocket(p),
    "openenv http": lambda p: step_openenv_http(p),
    "remote-gym": lambda p: (Apart(p["remote-gym python"], "remote-gym", p["remote-gym"]), 1),
    "maze native 64": lambda p: batch_mazeway(p, "Maze-v0", 64, "native"),
    "maze native 1024": lambda p: batch_mazeway(p, "Maze-v0", 1024, "native"),
    "maze native 16384": lambda p: batch_mazeway(p, "Maze-v0", 16384, "native"),
    "maze grpcio 1024": lambda p: batch_mazeway(p, "Maze-v0", 1024, "grpc"),
    "highway native 1024": lambda p: batch_mazeway(p, "Highway-v0", 1024, "native"),
    # As many vehicles as highway-fast has, and an observation of the same kind.
    "highway kinematics native 1024": lambda p: batch_mazeway(
        p, "Highway-v0", 1024, "native", density=20 / 3, observation="kinematics"
    ),
    "highway grpcio 1024": lambda p: batch_mazeway(p, "Highway-v0", 1024, "grpc"),
    "envpool frozenlake 1024": lambda _: batch_envpool("FrozenLake-v1", 1024),
    "envpool highway-fast 16": lambda _: batch_envpool("highway-fast-v0", 16),
    "envpool highway-fast 1024": lambda _: batch_envpool("highway-fast-v0", 1024),
    "dm_env_rpc 1024": lambda p: step_dm_env_rpc(p["dm_env_rpc"], 1024),
    "gymnasium one": lambda _: batch_gymnasium("one", 1),
    "gymnasium sync 64": lambda _: batch_gymnasium("sync", 64),
    # It forks, which a process with gRPC's threads should not.
    "gymnasium async 64": lambda _: (Apart(sys.executable, "gymnasium async 64", 0), 64),
    "highway-env one": lambda _: step_highway_env(),
}


#: What `time_apart` times.
APART = {
    "remote-gym": step_remote_gym,
    "gymnasium async 64": lambda _: batch_gymnasium("async", 64),
}


def timed(step, calls):
    """Seconds of one call."""
    if isinstance(step, Apart):
        return step.timed(calls)
    begun = time.perf_counter()
    for _ in range(calls):
        step()
    return (time.perf_counter() - begun) / calls


def measure(job):
    """Microseconds of one call of each case, one number a round; the cases take turns."""
    steps, times, failures = {}, {}, {}
    for name in job["cases"]:
        try:
            step, size = CASES[name](job["ports"])
            timed(step, 3)
            # As many calls as fit into a round's share of time.
            calls = max(1, int(job["secs"] / max(timed(step, 2), 1e-7)))
            calls = max(1, int(job["secs"] / max(timed(step, max(2, calls // 10)), 1e-7)))
        except Exception as error:  # noqa: BLE001 - a peer that does not run is said so
            failures[name] = " ".join(f"{type(error).__name__}: {error}".split())[:300]
            continue
        steps[name] = step, calls, size
    for _ in range(job["rounds"]):
        for name, (step, calls, _) in steps.items():
            times.setdefault(name, []).append(timed(step, calls) * 1e6)
    sizes = {name: size for name, (_, _, size) in steps.items()}
    return {"microseconds": times, "sizes": sizes, "failures": failures}


if __name__ == "__main__":
    if sys.argv[1] == "serve":
        serve(sys.argv[2])
    elif sys.argv[1] == "apart":
        time_apart(sys.argv[2], int(sys.argv[3]))
        os._exit(0)
    else:
        print(json.dumps(measure(json.loads(sys.stdin.read()))), flush=True)
        os._exit(0)  # peers' threads may not want to end
