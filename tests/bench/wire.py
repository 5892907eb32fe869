"""What a remote step costs beside its peers, in one run on one machine.

    python3 tests/bench/wire.py [--rounds N] [--json] [--chart FILE.svg] [--binary SERVER] [--skip PREFIX,...]

Makes a virtual environment of its own (kept in the cache directory, `--venv`), installs the peers from PyPI in pinned
versions and the Python client from `clients/python` with its native module, builds the environment server in release mode
(or takes `--binary`), and measures the time of one step, there and back, and steps a second of batches: in mode `pinned`
everything on one core (`taskset`), in mode `idle` on all of them. The cases of a mode are timed in one process, in turns,
round by round: what disturbs the machine disturbs them all. Medians over the rounds, with the lowest and the highest beside
them.

Peers: a bare TCP ping-pong in Python (the floor); Gymnasium's own wrappers around an environment that does nothing; bare
echoes by grpcio; dm_env_rpc's, OpenEnv's and remote-gym's own servers and clients around a toy; EnvPool's FrozenLake and highway-fast,
Gymnasium's vector environments and highway-env in process. Rust's own figures, the floor of blocking sockets in Rust, the
roll-outs and the memory of the server are those of `cargo run --release -p mazeway-bench-wire`, run after the others.

`--json` prints one object: `round_trip_microseconds` and `steps_per_second`, both by mode and case, each figure
with `median`, `low` and `high`; `rust`, the object of the Rust benchmark; `targets`, a list of `what`, `target`, `measured`,
`met`; `failures`, the cases that did not run and why; `rounds`, `cores`, `cpu`.

FrozenLake (16 states) is compared with the maze (57 states), highway-fast (continuous kinematics, 3 lanes, fewer vehicles
and simulation steps than highway-v0) with our highway (12 vehicles, one decision a second): by what a user gets a second,
not by what is simulated. docs/PERFORMANCE.md says what each does.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

from wire_targets import report, targets

REPOSITORY = Path(__file__).resolve().parents[2]
PEERS = Path(__file__).with_name("wire_peers.py")
PACKAGES = [
    "dm-env-rpc==1.1.7",
    "envpool==1.2.5",
    "grpcio==1.85.3",
    "gymnasium==1.4.0",
    "highway-env==1.12.1",
    "matplotlib==3.11.2",
    "numpy==2.4.6",
    "openenv-core==0.3.0",
]
# Wants an older protobuf than the others: it gets a virtual environment of its own, with the last dm_env_rpc that runs on it.
APART = {"remote-gym": ["dm-env-rpc==1.1.6", "remote-gym==0.7.3"]}
ROUND_TRIPS = [
    "tcp",
    "gymnasium",
    "gymnasium.make",
    "native",
    "native unwrapped",
    "native unix",
    "grpcio",
    "grpcio unwrapped",
    "grpcio tonic echo bidi",
    "grpcio echo bidi",
    "grpcio echo unary",
    "dm_env_rpc",
    "openenv websocket",
    "openenv http",
    "remote-gym",
]
BATCHES = [
    "maze native 64",
    "maze native 1024",
    "maze native 16384",
    "maze grpcio 1024",
    "highway native 1024",
    "highway kinematics native 1024",
    "highway grpcio 1024",
    "envpool frozenlake 1024",
    "envpool highway-fast 16",
    "envpool highway-fast 1024",
    "dm_env_rpc 1024",
    "gymnasium one",
    "gymnasium sync 64",
    "gymnasium async 64",
    "highway-env one",
]


def log(message):
    print(message, file=sys.stderr, flush=True)


def environment(directory, packages):
    """Python of a virtual environment with these packages, kept from run to run."""
    python = directory / "bin" / "python"
    stamp = directory / "packages"
    if not stamp.is_file() or stamp.read_text() != "\n".join(packages):
        log(f"installing {', '.join(packages)} into {directory}")
        venv.create(directory, with_pip=True, clear=True)
        subprocess.run([python, "-m", "pip", "install", "-q", *packages], check=True)
        stamp.write_text("\n".join(packages))
    return str(python)


def prepare(directory):
    """Python of an environment that holds the peers and the client as it is now."""
    python = environment(directory, PACKAGES)
    log("building the Python client")
    client = str(REPOSITORY / "clients" / "python")
    pip = [python, "-m", "pip", "install", "-q", "--no-deps", "--force-reinstall", client]
    subprocess.run(pip, check=True, stdout=sys.stderr)
    return python


def build_server():
    log("building the server and the Rust benchmark")
    command = ["cargo", "build", "--release", "-q", "--bin", "server", "--bin", "wire"]
    subprocess.run(command, cwd=REPOSITORY, check=True)
    return str(Path(os.environ.get("CARGO_TARGET_DIR", REPOSITORY / "target")) / "release" / "server")


class Servers:
    """Everything that answers, started for one mode."""

    def __init__(self, python, apart, binary, pin):
        self.processes, self.ports = [], {}
        self.place = tempfile.TemporaryDirectory()
        self.ports["mazeway"] = int(self._start([*pin, binary, "--listen", "127.0.0.1:0"]).rpartition(":")[2])
        self.ports["mazeway unix"] = f"{self.place.name}/socket"
        self._start([*pin, binary, "--listen", f"unix:{self.ports['mazeway unix']}"])
        for name in ("tcp", "grpc", "dm_env_rpc", "openenv"):
            self.ports[name] = int(self._start([*pin, python, str(PEERS), "serve", name]))
        echo = Path(binary).resolve().with_name("wire")
        if echo.is_file():
            command = [*pin, str(echo), "--serve-peers"]
            self.ports["tonic"] = self._start(command, cwd=self.place.name).split()[-2]
        for name, own in apart.items():
            self.ports[f"{name} python"] = own
            try:
                self.ports[name] = int(self._start([*pin, own, str(PEERS), "serve", name]))
            except RuntimeError as error:
                log(error)  # the case that asks for it will say so

    def _start(self, command, cwd=None):
        pipe = subprocess.PIPE
        process = subprocess.Popen(
            command, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, text=True, cwd=cwd
        )
        self.processes.append(process)
        line = process.stdout.readline()
        if not line:
            raise RuntimeError(f"{command}: no word of where it listens")
        return line.strip()

    def stop(self):
        for process in self.processes:
            process.stdin.close()
            process.terminate()
        for process in self.processes:
            process.wait(30)
        self.place.cleanup()


def run(python, apart, binary, cases, rounds, secs, pin):
    servers = Servers(python, apart, binary, pin)
    try:
        job = {"cases": cases, "ports": servers.ports, "rounds": rounds, "secs": secs}
        command = [*pin, python, str(PEERS), "measure"]
        done = subprocess.run(command, input=json.dumps(job), capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(done.stderr)
        return json.loads(done.stdout.splitlines()[-1])
    finally:
        servers.stop()


def rust_figures(binary, modes, rounds):
    """What the Rust benchmark measures that has a target, as its own object; empty where it is not there."""
    if not (REPOSITORY / "tests" / "bench" / "wire" / "Cargo.toml").is_file():
        return {}
    log("measuring the Rust client, roll-outs and memory")
    command = ["cargo", "run", "-q", "--release", "-p", "mazeway-bench-wire", "--", "--json", "-"]
    command += ["--parts", "round_trips,rollouts,memory", "--modes", modes]
    command += ["--rounds", str(rounds), "--server", binary]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    if done.returncode:
        log(f"the Rust benchmark failed: {done.stderr.strip()[-300:]}")
        return {}
    return json.loads(done.stdout)


def summary(times):
    return {"median": statistics.median(times), "low": min(times), "high": max(times)}


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=9, help="times that each case is measured")
    parser.add_argument("--secs", type=float, default=0.1, help="length of one measurement")
    parser.add_argument(
        "--binary",
        help="the environment server, the Rust benchmark beside it; built in release mode if not given",
    )
    parser.add_argument("--venv", type=Path, default=Path.home() / ".cache" / "mazeway-bench" / "wire")
    parser.add_argument("--python", help="an interpreter that has the peers and the client already")
    parser.add_argument("--modes", default="pinned,idle", help="which modes, of these")
    parser.add_argument("--skip", default="", help="cases to leave out, by the beginnings of their names")
    parser.add_argument("--no-rust", action="store_true", help="leave the Rust benchmark out")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--chart", type=Path, help="draw the round trips and batches into this SVG or PNG")
    arguments = parser.parse_args()
    python = arguments.python or prepare(arguments.venv)
    apart, failures = {}, {}
    for name, packages in APART.items():
        try:
            apart[name] = environment(arguments.venv.with_name(name), packages)
        except subprocess.CalledProcessError as error:
            failures[name] = str(error)
    binary = arguments.binary or build_server()
    skipped = tuple(filter(None, arguments.skip.split(",")))

    def chosen(cases):
        return [name for name in cases if name not in failures and not (skipped and name.startswith(skipped))]

    trips, batches = {}, {}
    for mode, pin in (("pinned", ["taskset", "-c", "0"]), ("idle", [])):
        if mode not in arguments.modes.split(","):
            continue
        log(f"measuring, {mode}")
        cases = chosen(ROUND_TRIPS) + chosen(BATCHES)
        said = run(python, apart, binary, cases, arguments.rounds, arguments.secs, pin)
        failures |= said["failures"]
        times, sizes = said["microseconds"], said["sizes"]
        trips[mode] = {name: summary(times[name]) for name in ROUND_TRIPS if name in times}
        batches[mode] = {
            name: summary([sizes[name] / time * 1e6 for time in times[name]])
            for name in BATCHES
            if name in times
        }
    rust = (
        {}
        if arguments.no_rust
        else rust_figures(str(Path(binary).resolve()), arguments.modes, arguments.rounds)
    )
    result = {
        "round_trip_microseconds": trips,
        "steps_per_second": batches,
        "rust": rust,
        "targets": targets(trips, batches, rust),
        "failures": failures,
        "rounds": arguments.rounds,
        "cores": os.cpu_count(),
        "cpu": rust.get("cpu"),
    }
    if arguments.chart:
        code = "import json, sys; from wire_chart import draw; draw(json.load(sys.stdin), sys.argv[1])"
        command = [python, "-c", code, str(arguments.chart.resolve())]
        subprocess.run(command, input=json.dumps(result), text=True, check=True, cwd=PEERS.parent)
    if arguments.json:
        print(json.dumps(result, indent=2))
        return
    print("\n".join(report(result)))


if __name__ == "__main__":
    main()
