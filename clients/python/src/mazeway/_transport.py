"""How calls travel. `Transport` is the contract, which two clients keep; `connect` chooses.

The native one (`_native_transport`) is Rust's client in a compiled module, the other (`_grpc`) needs
grpcio and no compiler. Everything above this module speaks of messages, methods and `MazewayError`s, and
nothing of gRPC. Invariants: every call ends, by an answer or by a `MazewayError`, within its timeout; a
transport works on both sides of a fork.
"""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Iterable, Iterator
from typing import Any, Protocol

from mazeway import _wire
from mazeway.errors import DeadlineExceededError, InvalidArgumentError, UnsupportedError

#: The command that starts each service, for hints.
START = {
    _wire.ENVIRONMENT_SERVICE: "cargo run --release --bin server",
    _wire.LEARNER_SERVICE: "cargo run --release --bin learner -- serve",
}

#: Longest message either way; a batch or a frame beyond it is refused rather than held.
MAX_MESSAGE_BYTES = 256 * 1024 * 1024

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

    def send(self, request: Any) -> None:
        """Queues a request; never blocks."""

    def receive(self) -> Any:
        """Waits for the next answer; raises `MazewayError`, after which the stream is over."""

    def cancel(self) -> None:
        """Ends the stream at once; may be called twice."""


class Transport(Protocol):
    """Calls of one service at one address. Timeouts are in seconds."""

    address: str
    service: str

    def unary(self, method: str, request: Any, *, timeout: float) -> Any:
        """One request, one answer."""

    def responses(self, method: str, request: Any, *, timeout: float, each: bool = False) -> Iterator[Any]:
        """One request, many answers. Closing the iterator cancels the call.

        The timeout is for the whole call, or with `each` for the wait for any one answer.
        """

    def requests(self, method: str, requests: Iterable[Any], *, timeout: float) -> Any:
        """Many requests, one answer."""

    def exchange(self, method: str, *, timeout: float) -> Exchange:
        """A bidirectional stream; `timeout` is the longest wait for any one answer."""

    def close(self) -> None:
        """Frees the connection; may be called twice."""


def connect(address: str, service: str, client: str = "auto") -> Transport:
    """A transport to `address`; connects with the first call.

    Raises InvalidArgumentError for no address or no such client, UnsupportedError for a client that is
    not there.
    """
    target, secure = check_address(address)
    if choose(client, secure=secure) == "native":
        from mazeway._native_transport import NativeTransport  # there may be none

        return NativeTransport(target, service)
    from mazeway._grpc import GrpcTransport  # the native client needs no grpcio

    return GrpcTransport(target, service, secure=secure)


def choose(client: str, *, secure: bool = False) -> str:
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
        return "native" if native and not secure else "grpc"
    if client == "native" and not native:
        raise UnsupportedError(
            "the native client is not built",
            hint="pip install ./clients/python with a Rust toolchain at hand, or take client='grpc'",
        )
    if client == "native" and secure:
        raise UnsupportedError("the native client has no TLS", hint="take client='grpc'")
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
