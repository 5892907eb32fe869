"""Real servers on free ports, and environments against them."""

import contextlib
import os
import re
import selectors
import signal
import socket
import subprocess
import threading
import time
import urllib.request
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
        self._said = b""
        self.address = self._read(rb"listening on (?:http://)?(unix:\S+|\S+:\d+)\s")

    def _read(self, pattern):
        """What the pattern's group matches in what the process has said so far, or says next."""
        deadline = time.monotonic() + 60
        with selectors.DefaultSelector() as selector:
            selector.register(self.popen.stdout, selectors.EVENT_READ)
            while time.monotonic() < deadline:
                if found := re.search(pattern, self._said):
                    return found[1].decode()
                if selector.select(timeout=1):
                    chunk = os.read(self.popen.stdout.fileno(), 4096)
                    self._said += chunk
                    if not chunk:
                        break
        self.stop()
        pytest.fail(f"no such line; stdout: {self._said!r}, stderr: {self.log.read_text()}")

    def calls(self):
        """How many calls have ended, by method and code; needs `--metrics-listen`."""
        url = self._read(rb"metrics on (http://\S+)\s")
        with urllib.request.urlopen(url, timeout=30) as answer:
            text = answer.read().decode()
        counted = re.findall(r'_calls_total\{method="\S+/(\w+)",code="(\w+)"\} (\d+)', text)
        return {(method, code): int(calls) for method, code, calls in counted if int(calls)}

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


class Proxy:
    """Forwards TCP connections until they are cut."""

    def __init__(self, target):
        host, _, port = target.rpartition(":")
        self._target = host, int(port)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self._listener.getsockname()[1]}"
        self._sockets = []
        #: While set, what the server answers goes nowhere.
        self.mute = threading.Event()
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self):
        """Breaks every connection; new ones are welcome."""
        while self._sockets:
            with contextlib.suppress(OSError):
                self._sockets.pop().shutdown(socket.SHUT_RDWR)

    def close(self):
        self._listener.close()
        self.cut()

    def _accept(self):
        with contextlib.suppress(OSError):
            while True:
                near, _ = self._listener.accept()
                try:
                    far = socket.create_connection(self._target)
                except OSError:
                    near.close()
                    continue
                self._sockets += [near, far]
                for source, sink, muted in ((near, far, None), (far, near, self.mute)):
                    threading.Thread(target=self._copy, args=(source, sink, muted), daemon=True).start()

    @staticmethod
    def _copy(source, sink, muted):
        with contextlib.suppress(OSError), source:
            while data := source.recv(65536):
                if muted is None or not muted.is_set():
                    sink.sendall(data)
        with contextlib.suppress(OSError):
            sink.shutdown(socket.SHUT_RDWR)


@pytest.fixture
def proxy(server):
    """A way to the shared server that a test can break."""
    proxy = Proxy(server)
    yield proxy
    proxy.close()
