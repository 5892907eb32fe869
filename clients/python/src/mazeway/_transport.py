"""How calls travel. `Transport` is the contract, which two clients keep; `connect` chooses.

The native one (`_native_transport`) is Rust's client in a compiled module, the other (`_grpc`) needs
grpcio and no compiler. Everything above this module speaks of messages, methods and `MazewayError`s, and
nothing of gRPC. Invariants: every call ends, by an answer or by a `MazewayError`, within its timeout; a
transport works on both sides of a fork.
"""

from __future__ import annotations

import importlib.util
import os
import random
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Protocol, TypeVar

from mazeway import _wire
from mazeway._access import Access
from mazeway.errors import (
    DeadlineExceededError,
    InvalidArgumentError,
    ServerUnreachableError,
    UnsupportedError,
)

#: The command that starts each service, for hints.
START = {
    _wire.ENVIRONMENT_SERVICE: "cargo run --release --bin server",
    _wire.LEARNER_SERVICE: "cargo run --release --bin learner -- serve",
}

#: Longest message either way; a batch or a frame beyond it is refused rather than held.
MAX_MESSAGE_BYTES = 256 * 1024 * 1024

#: How long a server that went away is waited for, at most.
RECONNECT_SECS = 10.0

#: Calls that change nothing when they are made twice: what only reads, and what is known by its content. A
#: session that was made in vain ends with its lease.
REPEATABLE = frozenset(
    {
        "Act",
        "CreateSession",
        "ExportTrajectories",
        "GetFit",
        "GetModel",
        "ListEnvironments",
        "ListFitTrajectories",
        "ListFits",
        "ListModels",
        "ListTrajectories",
        "PutModel",
        "Render",
        "Watch",
    }
)

T = TypeVar("T")

#: What `client` may be. "auto" is the native client where it is built and knows the kind of address.
CLIENTS = ("auto", "native", "grpc")

#: Names the client that "auto" stands for.
CLIENT_VARIABLE = "MAZEWAY_CLIENT"


class Exchange(Protocol):
    """One bidirectional stream, used in lock step: the n-th answer is to the n-th request."""

    #: False once the stream is over, be it by an error, by `cancel` or by a fork.
    alive: bool
    #: Longest wait for an answer, in seconds.
    timeout: float

    @property
    def over(self) -> bool:
        """Whether the stream has ended, as far as is known here: one may break while nobody looks."""

    def send(self, request: Any) -> None:
        """Queues a request; never blocks.

        Whoever sends bounds what is sent and not answered: `Session` (`MAX_PENDING`), `Uploader`.
        """

    def receive(self) -> Any:
        """Waits for the next answer; raises `MazewayError`, after which the stream is over."""

    def finish(self, timeout: float) -> None:
        """Says that no more requests will come, and reads to the end."""

    def cancel(self) -> None:
        """Ends the stream at once; may be called twice."""


class Transport(Protocol):
    """Calls of one service at one address. Timeouts are in seconds."""

    address: str
    service: str
    #: True once the server has answered: from then on it is waited for when it goes away.
    known: bool

    def unary(self, method: str, request: Any, *, timeout: float) -> Any:
        """One request, one answer."""

    def responses(
        self,
        method: str,
        request: Any,
        *,
        timeout: float,
        each: bool = False,
        alive: Callable[[], object] | None = None,
    ) -> Iterator[Any]:
        """One request, many answers. Closing the iterator cancels the call.

        The timeout is for the whole call, or with `each` for the wait for any one answer. With `alive` too,
        a late answer is waited for again where that returns, and what it raises ends the call.
        """

    def requests(self, method: str, requests: Iterable[Any], *, timeout: float) -> Any:
        """Many requests, one answer."""

    def exchange(self, method: str, *, timeout: float) -> Exchange:
        """A bidirectional stream; `timeout` is the longest wait for any one answer."""

    def close(self) -> None:
        """Frees the connection; may be called twice."""


def connect(address: str, service: str, access: Access | None = None) -> Transport:
    """A transport to `address`; connects with the first call.

    Raises InvalidArgumentError for no address, no such client, or certificates and tokens that do not go
    with them, UnsupportedError for a client that is not there.
    """
    target, secure = check_address(address)
    access = access or Access()
    credentials = access.resolve(target, secure=secure)
    if choose(access.client) == "native":
        from mazeway._native_transport import NativeTransport  # there may be none

        return NativeTransport(target, service, secure=secure, credentials=credentials)
    from mazeway._grpc import GrpcTransport  # the native client needs no grpcio

    return GrpcTransport(target, service, secure=secure, credentials=credentials)


def choose(client: str) -> str:
    """The client that is meant: "native" or "grpc"."""
    if client not in CLIENTS:
        names = ", ".join(map(repr, CLIENTS))
        raise InvalidArgumentError(f"client: expected one of {names}, got {client!r}", field="client")
    if client == "auto":
        client = os.environ.get(CLIENT_VARIABLE, "") or "auto"
        if client not in CLIENTS:
            names = ", ".join(map(repr, CLIENTS))
            raise InvalidArgumentError(
                f"{CLIENT_VARIABLE}: expected one of {names}, got {client!r}", field="client"
            )
    native = has_native()
    if client == "auto":
        return "native" if native else "grpc"
    if client == "native" and not native:
        raise UnsupportedError(
            "the native client is not built",
            hint="pip install ./clients/python with a Rust toolchain at hand, or take client='grpc'",
        )
    return client


def has_native() -> bool:
    """Whether the native client is built."""
    return importlib.util.find_spec("mazeway._native") is not None


def check_address(address: str) -> tuple[str, bool]:
    """Host and port, and whether to use TLS; raises InvalidArgumentError for no address."""
    if not isinstance(address, str):
        raise InvalidArgumentError(
            f"address: expected a string such as '127.0.0.1:50051', got {address!r}",
            field="address",
        )
    secure = address.startswith("https://")
    target = address.removeprefix("https://").removeprefix("http://").rstrip("/")
    host, _, port = target.rpartition(":")
    if not target.startswith("unix:") and not (host and port.isdigit() and int(port) < 65536):
        raise InvalidArgumentError(
            f"address: expected 'host:port' such as '127.0.0.1:50051', got {address!r}",
            field="address",
        )
    return target, secure


def late(address: str, timeout: float) -> DeadlineExceededError:
    """The error of a call whose answer did not come within the client's own timeout."""
    return DeadlineExceededError(
        f"no answer from {address} within {timeout:g} s",
        hint="raise `timeout`, or see whether the server is busy",
    )


class Backoff:
    """Growing pauses, drawn at random within their length, until it is time to give up."""

    def __init__(self, within: float, first: float = 0.01, longest: float = 1.0) -> None:
        """Takes seconds."""
        self._deadline = time.monotonic() + within
        self._pause, self._longest = first, longest

    def pause(self) -> bool:
        """Pauses; False where there is no time left for it."""
        pause = self._pause * random.uniform(0.5, 1.0)
        if time.monotonic() + pause > self._deadline:
            return False
        time.sleep(pause)
        self._pause = min(2 * self._pause, self._longest)
        return True


def reconnecting(call: Callable[[float], T], timeout: float, within: float = RECONNECT_SECS) -> T:
    """Calls, with the seconds that are left of the timeout, until the server answers, within bounds."""
    deadline = time.monotonic() + timeout
    backoff = Backoff(min(within, 0.8 * timeout))
    while True:
        try:
            return call(max(deadline - time.monotonic(), 0.0))
        except ServerUnreachableError:
            if not backoff.pause():
                raise


def repeated(transport: Transport, method: str, call: Callable[[float], T], timeout: float) -> T:
    """Calls, again where that is harmless and a server that was there has gone."""
    repeat = transport.known and method in REPEATABLE
    answer = reconnecting(call, timeout) if repeat else call(timeout)
    transport.known = True
    return answer
