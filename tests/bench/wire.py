"""What a remote step costs beside its peers, in one run on one machine.

    python3 tests/bench/wire.py [--rounds N] [--json] [--chart FILE.svg] [--binary SERVER] [--skip PREFIX,...]

Makes a virtual environment of its own (kept in the cache directory, `--venv`), installs the peers from PyPI in pinned
versions and the Python client from `clients/python` with its native module, builds the environment server in release mode
(or takes `--binary`), and measures: the time of one step, there and back, pinned to one core (`taskset`) and on all of them;
and steps a second of batches. The cases of a mode are timed in one process, in turns, round by round: what disturbs the
machine disturbs them all. Medians over the rounds, with the lowest and the highest beside them.

Peers: a bare TCP ping-pong in Python (the floor); Gymnasium's own wrappers around an environment that does nothing; bare
echoes by grpcio; dm_env_rpc's and OpenEnv's own servers and clients around a toy; EnvPool's FrozenLake and highway-fast,
Gymnasium's vector environments and highway-env in process. Rust's own figures, and the floor of blocking sockets in Rust,
are those of `cargo run --release -p mazeway-bench-wire -- --parts round_trips`, run in between.

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
ROUND_TRIPS = [
    "tcp",
    "gymnasium",
    "gymnasium.make",
    "native",
    "native unwrapped",
    "native unix",
    "grpcio",
    "grpcio unwrapped",
    "grpcio echo bidi",
    "grpcio echo unary",
    "dm_env_rpc",
    "openenv websocket",
    "openenv http",
]
BATCHES = [
    "maze native 64",
    "maze native 1024",
    "maze native 16384",
    "maze grpcio 1024",
    "highway native 1024",
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
LABELS = {
    "tcp": "TCP ping-pong, Python sockets",
    "gymnasium": "an empty Gymnasium environment, in process",
    "gymnasium.make": "the same in gymnasium.make's wrappers",
    "native": "mazeway, native, gymnasium.make",
    "native unwrapped": "mazeway, native, without wrappers",
    "native unix": "mazeway, native, Unix socket",
    "grpcio": "mazeway, grpcio, gymnasium.make",
    "grpcio unwrapped": "mazeway, grpcio, without wrappers",
    "grpcio echo bidi": "grpcio bidi echo, bare",
    "grpcio echo unary": "grpcio unary echo, bare",
    "dm_env_rpc": "dm_env_rpc's own server and client",
    "openenv websocket": "OpenEnv, WebSocket",
    "openenv http": "OpenEnv, HTTP",
    "maze native 64": "mazeway maze, native, 64",
    "maze native 1024": "mazeway maze, native, 1,024",
    "maze native 16384": "mazeway maze, native, 16,384",
    "maze grpcio 1024": "mazeway maze, grpcio, 1,024",
    "highway native 1024": "mazeway highway, native, 1,024",
    "highway grpcio 1024": "mazeway highway, grpcio, 1,024",
    "envpool frozenlake 1024": "EnvPool FrozenLake, in process, 1,024",
    "envpool highway-fast 16": "EnvPool highway-fast, in process, 16",
    "envpool highway-fast 1024": "EnvPool highway-fast, in process, 1,024",
    "dm_env_rpc 1024": "dm_env_rpc's own, 1,024 as a tensor",
    "gymnasium one": "Gymnasium FrozenLake, in process, one",
    "gymnasium sync 64": "Gymnasium SyncVectorEnv FrozenLake, 64",
    "gymnasium async 64": "Gymnasium AsyncVectorEnv FrozenLake, 64",
    "highway-env one": "highway-env highway-fast-v0, in process",
}


def log(message):
    print(message, file=sys.stderr, flush=True)


def prepare(directory):
    """Python of an environment that holds the peers and the client as it is now."""
    python = directory / "bin" / "python"
    stamp = directory / "packages"
    if not stamp.is_file() or stamp.read_text() != "\n".join(PACKAGES):
        log(f"installing the peers into {directory}")
        venv.create(directory, with_pip=True, clear=True)
        subprocess.run([python, "-m", "pip", "install", "-q", *PACKAGES], check=True)
        stamp.write_text("\n".join(PACKAGES))
    log("building the Python client")
    client = str(REPOSITORY / "clients" / "python")
    pip = [python, "-m", "pip", "install", "-q", "--no-deps", "--force-reinstall", client]
    subprocess.run(pip, check=True, stdout=sys.stderr)
    return str(python)


def build_server():
    log("building the server")
    subprocess.run(["cargo", "build", "--release", "-q", "--bin", "server"], cwd=REPOSITORY, check=True)
    return str(Path(os.environ.get("CARGO_TARGET_DIR", REPOSITORY / "target")) / "release" / "server")


class Servers:
    """Everything that answers, started for one mode."""

    def __init__(self, python, binary, pin):
        self.processes, self.ports = [], {}
        self.place = tempfile.TemporaryDirectory()
        self.ports["mazeway"] = int(self._start([*pin, binary, "--listen", "127.0.0.1:0"]).rpartition(":")[2])
        self.ports["mazeway unix"] = f"{self.place.name}/socket"
        self._start([*pin, binary, "--listen", f"unix:{self.ports['mazeway unix']}"])
        for name in ("tcp", "grpc", "dm_env_rpc", "openenv"):
            self.ports[name] = int(self._start([*pin, python, str(PEERS), "serve", name]))

    def _start(self, command):
        pipe = subprocess.PIPE
        process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, text=True)
        self.processes.append(process)
        line = process.stdout.readline()
        if not line:
            raise RuntimeError(f"{command}: no word of where it listens")
        return line.split()[-1]

    def stop(self):
        for process in self.processes:
            process.stdin.close()
            process.terminate()
        for process in self.processes:
            process.wait(30)
        self.place.cleanup()


def run(python, binary, cases, rounds, secs, pin):
    servers = Servers(python, binary, pin)
    try:
        job = {"cases": cases, "ports": servers.ports, "rounds": rounds, "secs": secs}
        command = [*pin, python, str(PEERS), "measure"]
        done = subprocess.run(command, input=json.dumps(job), capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(done.stderr)
        return json.loads(done.stdout.splitlines()[-1])
    finally:
        servers.stop()


def rust_figures(binary, rounds):
    """Round trips by mode and name, as the Rust benchmark measures them; none where it is not there."""
    if not (REPOSITORY / "tests" / "bench" / "wire" / "Cargo.toml").is_file():
        return {}
    log("measuring round trips of the Rust client")
    command = ["cargo", "run", "-q", "--release", "-p", "mazeway-bench-wire", "--", "--json", "-"]
    command += ["--parts", "round_trips", "--rounds", str(rounds), "--server", binary]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    if done.returncode:
        log(f"the Rust benchmark failed: {done.stderr.strip()[-300:]}")
        return {}
    figures = {}
    for row in json.loads(done.stdout)["round_trips"]:
        figures.setdefault(row["mode"], {})[row["name"]] = {k: row[k] for k in ("median", "low", "high")}
    return figures


def summary(times):
    return {"median": statistics.median(times), "low": min(times), "high": max(times)}


def table(title, unit, rows, digits):
    """Lines of a table: label, median, lowest and highest."""
    width = max(len(label) for label, _ in rows)
    lines = [f"{title:<{width}}  {unit:>12}  (lowest - highest)"]
    for label, row in rows:
        median, low, high = (f"{row[key]:,.{digits}f}" for key in ("median", "low", "high"))
        lines.append(f"{label:<{width}}  {median:>12}  ({low} - {high})")
    return lines


def ratios(modes, batches, rust):
    """The targets, each a ratio within one run, with what it should be."""
    found = []

    def add(what, value, wanted, better):
        met = value >= wanted if better == "at least" else value <= wanted
        found.append({"what": what, "value": value, "target": f"{better} {wanted:g}", "met": met})

    for mode, rows in modes.items():
        at = {name: row["median"] for name, row in rows.items()}
        wrappers = at["gymnasium.make"] - at["gymnasium"]
        add(
            f"{mode}: native step less wrappers, to TCP",
            (at["native"] - wrappers) / at["tcp"],
            2.5,
            "at most",
        )
        if "dm_env_rpc" in at:
            add(f"{mode}: dm_env_rpc to native", at["dm_env_rpc"] / at["native"], 15, "at least")
        others = [at[name] for name in ("openenv websocket", "openenv http") if name in at]
        if others:
            add(f"{mode}: OpenEnv's best to native", min(others) / at["native"], 8, "at least")
        plain = at["grpcio unwrapped"] / at["grpcio echo bidi"]
        add(f"{mode}: grpcio client to a bare grpcio echo", plain, 1.15, "at most")
    at = {name: row["median"] for name, row in batches.items()}
    add("maze, 1,024: million steps a second", at["maze native 1024"] / 1e6, 10, "at least")
    add("highway, 1,024: million steps a second", at["highway native 1024"] / 1e6, 1, "at least")
    if "envpool frozenlake 1024" in at:
        value = at["maze native 1024"] / at["envpool frozenlake 1024"]
        add("maze to EnvPool's FrozenLake", value, 10, "at least")
    fast = [at[name] for name in at if name.startswith("envpool highway-fast")]
    if fast:
        add("highway to EnvPool's best highway-fast", at["highway native 1024"] / max(fast), 40, "at least")
    return found


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=9, help="times that each case is measured")
    parser.add_argument("--secs", type=float, default=0.1, help="length of one measurement")
    parser.add_argument("--binary", help="the environment server; built in release mode if not given")
    parser.add_argument("--venv", type=Path, default=Path.home() / ".cache" / "mazeway-bench" / "wire")
    parser.add_argument("--python", help="an interpreter that has the peers and the client already")
    parser.add_argument("--skip", default="", help="cases to leave out, by the beginnings of their names")
    parser.add_argument("--no-rust", action="store_true", help="leave the Rust benchmark out")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--chart", type=Path, help="draw the round trips and batches into this SVG or PNG")
    arguments = parser.parse_args()
    python = arguments.python or prepare(arguments.venv)
    binary = arguments.binary or build_server()
    skipped = tuple(filter(None, arguments.skip.split(",")))

    def chosen(cases):
        return [name for name in cases if not skipped or not name.startswith(skipped)]

    modes, failures = {}, {}
    for mode, pin in (("pinned", ["taskset", "-c", "0"]), ("idle", [])):
        log(f"measuring round trips, {mode}")
        said = run(python, binary, chosen(ROUND_TRIPS), arguments.rounds, arguments.secs, pin)
        modes[mode] = {name: summary(times) for name, times in said["microseconds"].items()}
        failures |= said["failures"]
    log("measuring batches")
    said = run(python, binary, chosen(BATCHES), arguments.rounds, arguments.secs, [])
    failures |= said["failures"]
    batches = {}
    for name, times in said["microseconds"].items():
        batches[name] = summary([said["sizes"][name] / time * 1e6 for time in times])
    rust = {} if arguments.no_rust else rust_figures(str(Path(binary).resolve()), arguments.rounds)
    result = {
        "round_trip_microseconds": modes,
        "steps_per_second": batches,
        "rust": rust,
        "ratios": ratios(modes, batches, rust),
        "failures": failures,
        "rounds": arguments.rounds,
        "cores": os.cpu_count(),
    }
    if arguments.chart:
        code = "import json, sys; from wire_chart import draw; draw(json.load(sys.stdin), sys.argv[1])"
        command = [python, "-c", code, str(arguments.chart.resolve())]
        subprocess.run(command, input=json.dumps(result), text=True, check=True, cwd=PEERS.parent)
    if arguments.json:
        print(json.dumps(result, indent=2))
        return
    lines = []
    for mode, rows in modes.items():
        labelled = [(LABELS[name], row) for name, row in rows.items()]
        labelled += [(f"Rust: {name}", row) for name, row in rust.get(mode, {}).items()]
        lines += [*table(f"one step, {mode}", "microseconds", labelled, 1), ""]
    million = [
        (LABELS[name], {key: value / 1e6 for key, value in row.items()}) for name, row in batches.items()
    ]
    lines += [*table("batches", "million/s", million, 4), ""]
    for ratio in result["ratios"]:
        word = "met" if ratio["met"] else "NOT met"
        lines.append(f"{ratio['what']:<60} {ratio['value']:8.2f}   {ratio['target']}: {word}")
    lines += [f"not measured: {LABELS[name]}: {why}" for name, why in failures.items()]
    print("\n".join(lines))


if __name__ == "__main__":
    main()
