"""Real servers on free ports, and environments against them."""

import os
import re
import selectors
import signal
import subprocess
import time
from pathlib import Path

import pytest

from mazeway import _transport

REPOSITORY = Path(__file__).resolve().parents[3]
DATA = REPOSITORY / "tests" / "data"


def binary(name):
    """The program under test: MAZEWAY_BIN_DIR/name, else the workspace's debug build."""
    directory = Path(os.environ.get("MAZEWAY_BIN_DIR", REPOSITORY / "target" / "debug"))
    path = directory / name
    if not path.is_file():
        pytest.fail(f"{path} is missing: cargo build --bin {name}, or set MAZEWAY_BIN_DIR")
    return str(path)


class Process:
    """A program that prints "listening on ADDRESS"."""

    def __init__(self, *command, log):
        self.log = log
        with log.open("ab") as stderr:
            self.popen = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=stderr, bufsize=0)
        self.address = self._read_address()

    def _read_address(self):
        selector = selectors.DefaultSelector()
        selector.register(self.popen.stdout, selectors.EVENT_READ)
        seen = b""
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline:
            if selector.select(timeout=1):
                chunk = os.read(self.popen.stdout.fileno(), 4096)
                seen += chunk
                if found := re.search(rb"listening on (?:http://)?(unix:\S+|\S+:\d+)\s", seen):
                    selector.close()
                    return found[1].decode()
                if not chunk:
                    break
        self.stop()
        pytest.fail(f"no address line; stdout: {seen!r}, stderr: {self.log.read_text()}")

    def pause(self):
        """Stops the process in its tracks and waits until it stands still."""
        self.popen.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, self.popen.pid, os.WSTOPPED | os.WNOWAIT)

    def resume(self):
        self.popen.send_signal(signal.SIGCONT)

    def stop(self, how=signal.SIGKILL):
        if self.popen.poll() is None:
            self.popen.send_signal(how)
        self.popen.wait(timeout=60)
        self.popen.stdout.close()


def start_server(directory, *arguments, listen="127.0.0.1:0"):
    return Process(binary("server"), "--listen", listen, *arguments, log=directory / "server.log")


def start_learner(directory, *arguments, listen="127.0.0.1:0"):
    return Process(
        binary("learner"),
        "serve",
        "--listen",
        listen,
        "--data",
        str(directory / "data"),
        *arguments,
        log=directory / "learner.log",
    )


@pytest.fixture(params=["native", "grpc"], autouse=True)
def which_client(request, monkeypatch):
    """Every test is run with both clients, in the processes that it starts, too."""
    if request.param == "native" and not _transport.has_native():
        pytest.skip("the native client is not built")
    monkeypatch.setenv(_transport.CLIENT_VARIABLE, request.param)
    return request.param


@pytest.fixture(scope="session")
def server(tmp_path_factory):
    """Address of an environment server that all tests share."""
    process = start_server(tmp_path_factory.mktemp("server"))
    yield process.address
    process.stop(signal.SIGTERM)


@pytest.fixture(scope="session")
def learner_address(tmp_path_factory):
    """Address of a learner that all tests share; tests keep apart by their styles."""
    process = start_learner(tmp_path_factory.mktemp("learner"))
    yield process.address
    process.stop(signal.SIGTERM)
