"""How calls travel. `Transport` is the contract; `GrpcTransport` keeps it with grpcio.

Everything above this module speaks of messages, methods and `MazewayError`s, and nothing of gRPC, so
another transport can take this one's place (`connect` chooses). Invariants: every call ends, by an
answer or by a `MazewayError`, within its timeout; a transport belongs to the process that made it.
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
import weakref
from collections.abc import Callable, Iterable, Iterator
from queue import SimpleQueue
from typing import Any, Protocol

import grpc

from mazeway import _wire
from mazeway.errors import (
    DeadlineExceededError,
    InvalidArgumentError,
    MazewayError,
    ServerFailureError,
    ServerUnreachableError,
    from_rpc_error,
)

#: The command that starts each service, for hints.
START = {
    _wire.ENVIRONMENT_SERVICE: "cargo run --release --bin server",
    _wire.LEARNER_SERVICE: "cargo run --release --bin learner -- serve",
}

#: Longest message either way; a batch or a frame beyond it is refused rather than held.
MAX_MESSAGE_BYTES = 256 * 1024 * 1024


class Exchange(Protocol):
    """One bidirectional stream, used in lock step: the n-th answer is to the n-th request."""

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

    def responses(self, method: str, request: Any, *, timeout: float) -> Iterator[Any]:
        """One request, many answers. Closing the iterator cancels the call."""

    def requests(self, method: str, requests: Iterable[Any], *, timeout: float) -> Any:
        """Many requests, one answer."""

    def exchange(self, method: str, *, timeout: float) -> Exchange:
        """A bidirectional stream; `timeout` is the longest wait for any one answer."""

    def close(self) -> None:
        """Frees the connection; may be called twice."""


def connect(address: str, service: str) -> Transport:
    """A transport to `address`; connects with the first call."""
    return GrpcTransport(address, service)


def _target(address: str) -> tuple[str, bool]:
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


class GrpcTransport:
    """The transport over grpcio."""

    def __init__(self, address: str, service: str) -> None:
        """Takes the address ("host:port", "http://…" or, for TLS, "https://…")."""
        target, secure = _target(address)
        self.address = address
        self.service = service
        self._methods = _wire.services[service]
        options: list[tuple[str, int]] = [
            ("grpc.max_receive_message_length", MAX_MESSAGE_BYTES),
            ("grpc.max_send_message_length", MAX_MESSAGE_BYTES),
            # A new transport to a server that came back must not inherit another's waiting time.
            ("grpc.use_local_subchannel_pool", 1),
            ("grpc.initial_reconnect_backoff_ms", 100),
            ("grpc.max_reconnect_backoff_ms", 1000),
        ]
        if target.rpartition(":")[0] in ("127.0.0.1", "localhost", "[::1]"):
            options.append(("grpc.enable_http_proxy", 0))
        self._channel = (
            grpc.secure_channel(target, grpc.ssl_channel_credentials(), options)
            if secure
            else grpc.insecure_channel(target, options)
        )
        self._callables: dict[str, Callable[..., Any]] = {}

    def unary(self, method: str, request: Any, *, timeout: float) -> Any:
        """See `Transport`."""
        with self._translated(timeout):
            return self._callable(method)(request, timeout=timeout)

    def responses(self, method: str, request: Any, *, timeout: float) -> Iterator[Any]:
        """See `Transport`."""
        with self._translated(timeout):
            call = self._callable(method)(request, timeout=timeout)
            try:
                yield from call
            finally:
                call.cancel()

    def requests(self, method: str, requests: Iterable[Any], *, timeout: float) -> Any:
        """See `Transport`."""
        with self._translated(timeout):
            return self._callable(method)(iter(requests), timeout=timeout)

    def exchange(self, method: str, *, timeout: float) -> Exchange:
        """See `Transport`."""
        return _GrpcExchange(self, self._callable(method), timeout)

    def close(self) -> None:
        """See `Transport`."""
        self._channel.close()

    def translate(self, error: grpc.RpcError, timeout: float) -> MazewayError:
        """The `MazewayError` that says what `error` says."""
        if error.code() is grpc.StatusCode.DEADLINE_EXCEEDED and _is_local_deadline(error):
            return _late(self.address, timeout)
        return from_rpc_error(error, address=self.address, start=START[self.service])

    @contextlib.contextmanager
    def _translated(self, timeout: float) -> Iterator[None]:
        try:
            yield
        except grpc.RpcError as error:
            raise self.translate(error, timeout) from None
        except ValueError as error:  # grpcio's word for a closed channel
            raise ServerUnreachableError(f"the connection to {self.address} is closed ({error})") from None

    def _callable(self, name: str) -> Callable[..., Any]:
        if name not in self._callables:
            method = self._methods[name]
            kind = ("stream" if method.client_streaming else "unary") + (
                "_stream" if method.server_streaming else "_unary"
            )
            self._callables[name] = getattr(self._channel, kind)(
                method.path,
                request_serializer=method.request.SerializeToString,
                response_deserializer=method.response.FromString,
            )
        return self._callables[name]


def _is_local_deadline(error: grpc.RpcError) -> bool:
    """Whether the deadline passed here rather than by the server's word about a lease."""
    return "Deadline Exceeded" in (error.details() or "Deadline Exceeded")


def _late(address: str, timeout: float) -> DeadlineExceededError:
    return DeadlineExceededError(
        f"no answer from {address} within {timeout:g} s",
        hint="raise `timeout`, or see whether the server is busy",
    )


class _GrpcExchange:
    """A bidirectional stream over grpcio with a deadline on each answer.

    A gRPC deadline covers a whole stream and grpcio's iterator waits for ever, so the watchdog thread
    cancels the call when an answer is late.
    """

    def __init__(self, transport: GrpcTransport, method: Callable[..., Any], timeout: float) -> None:
        self._transport = transport
        self._timeout = timeout
        self._requests: SimpleQueue[Any] = SimpleQueue()
        self._call = method(iter(self._requests.get, None))
        self.timeout = timeout
        self.waiting_since: float | None = None
        self.expired = False
        _watchdog.watch(self)

    def send(self, request: Any) -> None:
        self._requests.put(request)

    def receive(self) -> Any:
        self.waiting_since = time.monotonic()
        try:
            return next(self._call)
        except StopIteration:
            raise ServerFailureError(
                f"the server at {self._transport.address} ended the stream without an answer"
            ) from None
        except grpc.RpcError as error:
            if self.expired:
                raise _late(self._transport.address, self._timeout) from None
            raise self._transport.translate(error, self._timeout) from None
        except BaseException:  # such as KeyboardInterrupt: an answer is now out of step
            self.cancel()
            raise
        finally:
            self.waiting_since = None

    def cancel(self) -> None:
        self._requests.put(None)  # ends the request iterator and so grpcio's thread
        self._call.cancel()


class _Watchdog:
    """One daemon thread a process that cancels exchanges whose answer is late."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Starts afresh, as a forked child must: the thread and the calls are its parent's."""
        self._exchanges: weakref.WeakSet[_GrpcExchange] = weakref.WeakSet()
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._wake = threading.Event()

    def watch(self, exchange: _GrpcExchange) -> None:
        with self._lock:
            self._exchanges.add(exchange)
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="mazeway-watchdog", daemon=True)
                self._thread.start()
        self._wake.set()

    def _run(self) -> None:
        while True:
            with self._lock:
                exchanges = list(self._exchanges)
                if not exchanges:
                    self._thread = None
                    return
            now = time.monotonic()
            period = 1.0
            for exchange in exchanges:
                period = min(period, max(exchange.timeout / 4, 0.005))
                since = exchange.waiting_since
                if since is not None and now - since > exchange.timeout:
                    exchange.expired = True
                    exchange.cancel()
            del exchange, exchanges  # hold no exchange while asleep
            self._wake.wait(period)
            self._wake.clear()


_watchdog = _Watchdog()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_watchdog.forget)
