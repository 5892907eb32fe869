"""How long a Python client over grpcio takes to see that a server is back, by version of grpcio.

    python3 tests/bench/reconnect.py [--versions 1.60.0,1.85.3] [--binary SERVER]

Each version gets a virtual environment of its own, with `clients/python` without its native module. The server is killed
and started again 1.5 s later, for two clients: bare grpcio, which calls every 0.3 s, and ours, which is asked once and
waits by itself. Prints the seconds from the kill to the answer; bare grpcio is given up after 30. The bare client has
our channel's options for the pauses between attempts to connect (0.1 to 1 s), so they are not what it waits for.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import threading
import time
import venv
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[2]
AWAY_SECS = 1.5
PATIENCE_SECS = 30.0


def bare(address):
    """A call by grpcio alone, again every 0.3 s until it is answered."""
    import grpc

    options = [("grpc.initial_reconnect_backoff_ms", 100), ("grpc.max_reconnect_backoff_ms", 1000)]
    check = grpc.insecure_channel(address, options).unary_unary("/grpc.health.v1.Health/Check")

    def call():
        began = time.monotonic()
        while True:
            try:
                return check(b"", timeout=5)
            except grpc.RpcError:
                if time.monotonic() - began > PATIENCE_SECS:
                    return None
            time.sleep(0.3)

    return call


def ours(address):
    """A call by our client, which is waited for by itself."""
    import mazeway

    client = mazeway.Client(address, client="grpc")
    return lambda: client.model("Maze-v0")


def serve(binary, listen):
    """A server that listens, and where."""
    command = [binary, "--listen", listen]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    return process, process.stdout.readline().split()[-1].removeprefix("http://")


def measure(binary, make):
    """Seconds from the kill of the server to the answer of a server that is back; None for no answer."""
    process, address = serve(binary, "127.0.0.1:0")
    call = make(address)
    call()
    process.kill()
    process.wait()
    again = []
    timer = threading.Timer(AWAY_SECS, lambda: again.append(serve(binary, address)[0]))
    timer.start()
    began = time.monotonic()
    answer = call()
    took = time.monotonic() - began
    timer.join()
    again[0].kill()
    again[0].wait()
    return took if answer is not None else None


def main():
    """Measures every version."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--versions", default="1.60.0,1.68.1,1.76.0,1.85.3", help="of grpcio")
    parser.add_argument("--binary", help="the server; built in release mode where none is named")
    parser.add_argument("--within", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    binary = arguments.binary
    if binary is None:
        subprocess.run(
            ["cargo", "build", "--release", "--locked", "--bin", "server"], cwd=REPOSITORY, check=True
        )
        binary = REPOSITORY / "target/release/server"
    if arguments.within:
        took = {name: measure(binary, make) for name, make in (("bare", bare), ("ours", ours))}
        said = [f"{name} {'never' if secs is None else f'{secs:.1f} s'}" for name, secs in took.items()]
        print(f"grpcio {arguments.versions}: {', '.join(said)}", flush=True)
        return
    for version in arguments.versions.split(","):
        with tempfile.TemporaryDirectory() as directory:
            venv.create(directory, with_pip=True)
            python = Path(directory) / "bin/python"
            subprocess.run(
                [
                    python,
                    "-m",
                    "pip",
                    "install",
                    "--quiet",
                    REPOSITORY / "clients/python",
                    f"grpcio=={version}",
                ],
                env=os.environ | {"MAZEWAY_PURE": "1"},
                check=True,
            )
            subprocess.run(
                [python, __file__, "--within", "--versions", version, "--binary", binary], check=True
            )


if __name__ == "__main__":
    sys.exit(main())
