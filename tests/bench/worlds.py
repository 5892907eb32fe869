"""Round trips of a step through DeepMind's dm_env_rpc client: this server beside a server written with DeepMind's package.

    python -m venv bench && bench/bin/pip install -r tests/dm_env_rpc/requirements.txt
    cargo build --release -p mazeway-server
    bench/bin/python tests/bench/worlds.py            # one table
    bench/bin/python tests/bench/worlds.py --json     # one JSON object

The peer is what the package's own example is: a `grpc.server` whose servicer packs and unpacks with the package's
`SpecManager`. It serves a counter, the least work that an environment can have, so that its figures are those of the
protocol; ours serves the maze. Client and observations are the same: one INT32 and one DOUBLE, or as many as a batch has.
Both servers are processes of their own; rounds alternate between them.
"""

import argparse
import itertools
import json
import statistics
import subprocess
import sys
import time
from concurrent import futures
from pathlib import Path

import grpc
import numpy as np
from dm_env_rpc.v1 import (
    connection as dm_env_rpc_connection,
)
from dm_env_rpc.v1 import (
    dm_env_adaptor,
    dm_env_rpc_pb2,
    dm_env_rpc_pb2_grpc,
    spec_manager,
    tensor_utils,
)

SERVER = Path(__file__).parents[2] / "target/release/server"
SEEN = ["observation", "reward"]


def counter_specs(num_envs):
    """Specs of the peer's environment, of the shapes that the maze has."""
    shape = [num_envs] if num_envs else []
    spec = dm_env_rpc_pb2.TensorSpec
    specs = dm_env_rpc_pb2.ActionObservationSpecs()
    specs.actions[1].CopyFrom(spec(name="action", dtype=dm_env_rpc_pb2.INT32, shape=shape))
    specs.observations[1].CopyFrom(spec(name="observation", dtype=dm_env_rpc_pb2.INT32, shape=shape))
    specs.observations[2].CopyFrom(spec(name="reward", dtype=dm_env_rpc_pb2.DOUBLE, shape=shape))
    return specs


class Peer(dm_env_rpc_pb2_grpc.EnvironmentServicer):
    """A counter over dm_env_rpc, as the package's example serves its game."""

    def Process(self, requests, context):
        """Answers in order."""
        specs, actions, observations, state = None, None, None, None
        for request in requests:
            response = dm_env_rpc_pb2.EnvironmentResponse()
            kind = request.WhichOneof("payload")
            if kind == "create_world":
                packed = request.create_world.settings.get("num_envs")
                num_envs = int(tensor_utils.unpack_tensor(packed)) if packed else 0
                specs = counter_specs(num_envs)
                actions = spec_manager.SpecManager(specs.actions)
                observations = spec_manager.SpecManager(specs.observations)
                state = np.zeros(specs.observations[1].shape, np.int32)
                response.create_world.world_name = "counter"
            elif kind == "join_world":
                response.join_world.specs.CopyFrom(specs)
            elif kind == "reset":
                response.reset.specs.CopyFrom(specs)
            elif kind == "step":
                action = actions.unpack(request.step.actions).get("action", 0)
                state = (state + action) % 57
                packed = observations.pack({"observation": state, "reward": state.astype(np.float64)})
                for uid in request.step.requested_observations:
                    response.step.observations[uid].CopyFrom(packed[uid])
                response.step.state = dm_env_rpc_pb2.RUNNING
            else:
                getattr(response, kind).SetInParent()
            yield response


def serve():
    """The peer as a process: says where it listens and serves until it is killed."""
    server = grpc.server(futures.ThreadPoolExecutor(max_workers=4))
    dm_env_rpc_pb2_grpc.add_EnvironmentServicer_to_server(Peer(), server)
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    print(f"listening on 127.0.0.1:{port}", flush=True)
    server.wait_for_termination()


def start(command):
    """A server and where it listens."""
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    return process, process.stdout.readline().split()[-1]


def raw(address, num_envs, settings):
    """A function that takes one step with messages made beforehand: the protocol and gRPC alone."""
    connection = dm_env_rpc_connection.create_secure_channel_and_connect(address)
    name = dm_env_adaptor.create_world(connection, settings)
    specs = connection.send(dm_env_rpc_pb2.JoinWorldRequest(world_name=name)).specs
    uids = {spec.name: uid for uid, spec in specs.observations.items()}
    action = tensor_utils.pack_tensor(np.ones([num_envs] if num_envs else [], np.int32))
    request = dm_env_rpc_pb2.StepRequest(
        actions={1: action}, requested_observations=[uids[name] for name in SEEN]
    )
    return lambda: connection.send(request)


def adaptor(address, num_envs, settings):
    """A function that takes one step as users do: tensors to and from numpy."""
    connection = dm_env_rpc_connection.create_secure_channel_and_connect(address)
    env, _ = dm_env_adaptor.create_and_join_world(connection, settings, {}, requested_observations=SEEN)
    env.reset()
    action = {"action": np.ones([num_envs] if num_envs else [], np.int32)}
    return lambda: env.step(action)


def round_trip(step, secs):
    """Median seconds of one step."""
    times, until = [], time.perf_counter() + secs
    while (began := time.perf_counter()) < until:
        step()
        times.append(time.perf_counter() - began)
    return statistics.median(times)


def main():
    """Measures and prints."""
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--server", type=Path, default=SERVER, help="the program to measure")
    arguments.add_argument("--rounds", type=int, default=7, help="rounds of each measurement")
    arguments.add_argument("--secs", type=float, default=0.5, help="length of a round")
    arguments.add_argument("--json", action="store_true", help="print one JSON object")
    arguments.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    given = arguments.parse_args()
    if given.serve:
        serve()
        return
    ours = start([given.server, "--listen", "127.0.0.1:0"])
    peer = start([sys.executable, __file__, "--serve"])
    servers = {"mazeway": ours[1], "dm_env_rpc": peer[1]}
    figures = {}
    try:
        for (name, make), num_envs in itertools.product({"send": raw, "dm_env": adaptor}.items(), [0, 1024]):
            settings = {"env_id": "Maze-v0"} | ({"num_envs": num_envs} if num_envs else {})
            steps = {server: make(address, num_envs, settings) for server, address in servers.items()}
            for step in steps.values():
                round_trip(step, given.secs / 2)
            rounds = {server: [] for server in servers}
            for _ in range(given.rounds):
                for server, step in steps.items():
                    rounds[server].append(1e6 * round_trip(step, given.secs))
            case = f"{name}, {num_envs} environments" if num_envs else f"{name}, one environment"
            figures[case] = {
                server: {"median_us": statistics.median(all_), "low_us": min(all_), "high_us": max(all_)}
                for server, all_ in rounds.items()
            }
            figures[case]["ratio"] = (
                figures[case]["dm_env_rpc"]["median_us"] / figures[case]["mazeway"]["median_us"]
            )
    finally:
        for process, _ in (ours, peer):
            process.kill()
            process.wait()
    if given.json:
        print(json.dumps(figures))
        return
    print(f"{'a step, µs (lowest to highest round)':38}{'mazeway':>24}{'dm_env_rpc server':>24}{'ratio':>8}")
    for case, figure in figures.items():
        cells = [
            f"{of['median_us']:.0f} ({of['low_us']:.0f} to {of['high_us']:.0f})"
            for of in (figure["mazeway"], figure["dm_env_rpc"])
        ]
        print(f"{case:38}{cells[0]:>24}{cells[1]:>24}{figure['ratio']:>7.1f}×")


if __name__ == "__main__":
    main()
