"""The transport over grpcio: what works wherever Python does.

gRPC's core survives a fork only if nothing of it is at work at that moment. So every transport lets its
channel go before a fork and connects again, in parent and child alike, with the next call.
"""

from __future__ import annotations

import contextlib
import functools
import math
import os
import threading
import time
import weakref
from collections.abc import Callable, Iterable, Iterator
from queue import SimpleQueue
from typing import Any

import grpc

from mazeway import _wire
from mazeway._access import Credentials
from mazeway._transport import (
    MAX_MESSAGE_BYTES,
    START,
    Exchange,
    late,
    repeated,
)
from mazeway.errors import MazewayError, ServerFailureError, ServerUnreachableError, from_status

#: How long a fork waits for a call that another thread is making.
_FORK_WAIT_SECS = 5.0

#: gRPC's own threads finish with a closed channel in the background; a fork comes so long after it.
_FORK_REST_SECS = 0.05

#: What every server answers, one way or another: it may be asked without an effect.
_HEALTH = "/grpc.health.v1.Health/Check"

#: How long a call to a server that was not there waits for a connection first: see `_attend`.
_ATTEND_SECS = 0.25


class GrpcTransport:
    """The transport over grpcio."""

    def __init__(
        self,
        target: str,
        service: str,
        *,
        secure: bool = False,
        credentials: Credentials | None = None,
    ) -> None:
        """Takes "host:port" or "unix:path", whether to use TLS, and what goes along."""
        self.address = target
        self.service = service
        self._methods = _wire.services[service]
        options: list[tuple[str, int | str]] = [
            ("grpc.max_receive_message_length", MAX_MESSAGE_BYTES),
            ("grpc.max_send_message_length", MAX_MESSAGE_BYTES),
            # A new transport to a server that came back must not inherit another's waiting time.
            ("grpc.use_local_subchannel_pool", 1),
            ("grpc.initial_reconnect_backoff_ms", 100),
            ("grpc.max_reconnect_backoff_ms", 1000),
            # A peer that vanished without a word is found out.
            ("grpc.keepalive_time_ms", 10_000),
            ("grpc.keepalive_timeout_ms", 10_000),
            # The same by another name, whose default of a minute would else be what counts.
            ("grpc.http2.ping_timeout_ms", 10_000),
            ("grpc.http2.max_pings_without_data", 0),
        ]
        if target.startswith("unix:"):
            # Else the path goes into the `:authority`, which is none, and servers reset the stream.
            options.append(("grpc.default_authority", "localhost"))
        if target.rpartition(":")[0] in ("127.0.0.1", "localhost", "[::1]"):
            options.append(("grpc.enable_http_proxy", 0))
        self._target, self._secure, self._options = target, secure, options
        self._credentials = credentials or Credentials()
        #: True once the server has answered: from then on it is waited for when it goes away.
        self.known = False
        self._channel: Any = None
        #: Whether the last that was heard of the channel is that the server is not there.
        self._away = False
        self._callables: dict[str, Callable[..., Any]] = {}
        self._exchanges: weakref.WeakSet[_GrpcAnswers] = weakref.WeakSet()
        #: Held during a call, so that no fork comes between. Reentrant, for the garbage collector may
        #: close a forgotten environment at any point, also while this thread holds it for a fork.
        self._lock = threading.RLock()
        #: Calls whose messages the caller's own code makes or takes: a fork cannot wait for them.
        self._streaming = 0
        self._paused = False
        _forks.add(self)

    def unary(self, method: str, request: Any, *, timeout: float) -> Any:
        """See `Transport`."""

        def call(left: float) -> Any:
            with self._translated(timeout), self._lock:
                return self._callable(method, left)(request, timeout=left)

        return repeated(self, method, call, timeout)

    def responses(
        self,
        method: str,
        request: Any,
        *,
        timeout: float,
        each: bool = False,
        alive: Callable[[], object] | None = None,
    ) -> Iterator[Any]:
        """See `Transport`."""
        deadline = time.monotonic() + timeout

        def begin(left: float) -> tuple[contextlib.ExitStack, _GrpcAnswers, Any]:
            with contextlib.ExitStack() as stack:
                stack.enter_context(self._counted())
                with self._translated(timeout), self._lock:
                    whole = None if each else max(deadline - time.monotonic(), 0.0)
                    call = self._callable(method, left)(request, timeout=whole)
                    answers = _GrpcAnswers(self, call, timeout, watched=each, ask=alive)
                    if each:
                        self._exchanges.add(answers)
                stack.callback(answers.cancel)
                answer = answers.next()
                return stack.pop_all(), answers, answer

        # Until the first answer the call may be made anew.
        stack, answers, answer = repeated(self, method, begin, timeout)
        with stack:
            while answer is not None:
                yield answer
                answer = answers.next()

    def requests(self, method: str, requests: Iterable[Any], *, timeout: float) -> Any:
        """See `Transport`."""
        messages = list(requests)

        def call(left: float) -> Any:
            with self._translated(timeout), self._counted():
                with self._lock:
                    made = self._callable(method, left)
                return made(iter(messages), timeout=left)

        return repeated(self, method, call, timeout)

    def exchange(self, method: str, *, timeout: float) -> Exchange:
        """See `Transport`."""
        with self._lock:
            exchange = _GrpcExchange(self, self._callable(method, timeout), timeout, self._lock)
            self._exchanges.add(exchange)
            return exchange

    def close(self) -> None:
        """See `Transport`."""
        with self._lock:
            self._disconnect()

    def pause(self) -> None:
        """Lets the channel go for a fork; calls wait for `resume`."""
        self._paused = self._lock.acquire(timeout=_FORK_WAIT_SECS)
        if self._paused and not self._streaming:
            self._disconnect()

    def resume(self) -> None:
        """The fork is over."""
        if self._paused:
            self._paused = False
            self._lock.release()

    def _disconnect(self) -> None:
        """Closes the channel and ends its streams; the caller holds the lock."""
        for exchange in list(self._exchanges):
            exchange.cancel()
        self._exchanges.clear()
        self._callables.clear()
        if self._channel is not None:
            self._channel.close()
            self._channel = None
            self._away = False
            _forks.closed()

    @contextlib.contextmanager
    def _counted(self) -> Iterator[None]:
        self._streaming += 1
        try:
            yield
        finally:
            self._streaming -= 1

    def translate(self, error: grpc.RpcError, timeout: float) -> MazewayError:
        """The `MazewayError` that says what `error` says."""
        if error.code() is grpc.StatusCode.DEADLINE_EXCEEDED and _is_local_deadline(error):
            return late(self.address, timeout)
        if error.code() is grpc.StatusCode.UNAVAILABLE:
            self._away = True
        return from_status(
            error.code().value[0],
            error.details() or "",
            _violations(error),
            address=self.address,
            start=START[self.service],
        )

    @contextlib.contextmanager
    def _translated(self, timeout: float) -> Iterator[None]:
        try:
            yield
        except grpc.RpcError as error:
            raise self.translate(error, timeout) from None
        except ValueError as error:  # grpcio's word for a closed channel
            raise ServerUnreachableError(f"the connection to {self.address} is closed ({error})") from None

    def _callable(self, name: str, within: float) -> Callable[..., Any]:
        """What makes the call; the caller holds the lock.

        Args:
            name: Of the method.
            within: Seconds that may pass until it returns.
        """
        if self._channel is None:
            self._channel = (
                grpc.secure_channel(self._target, self._tls(), self._options)
                if self._secure
                else grpc.insecure_channel(self._target, self._options)
            )
        elif self._away:
            self._attend(min(within, _ATTEND_SECS))
        if name not in self._callables:
            method = self._methods[name]
            kind = ("stream" if method.client_streaming else "unary") + (
                "_stream" if method.server_streaming else "_unary"
            )
            call = getattr(self._channel, kind)(
                method.path,
                request_serializer=method.request.SerializeToString,
                response_deserializer=method.response.FromString,
            )
            if self._credentials.token is not None:
                metadata = (("authorization", f"Bearer {self._credentials.token}"),)
                call = functools.partial(call, metadata=metadata)
            self._callables[name] = call
        return self._callables[name]

    def _attend(self, within: float) -> None:
        """Waits until there is a connection, for so many seconds at most; the caller holds the lock.

        gRPC's core, up to version 1.76 at least, learns what became of an attempt to connect only while
        somebody waits on the channel. Calls fail at once while it does not know, so whoever calls again
        and again would be told for ten seconds, or for ever, that a server that is back is not there.
        """
        ask = self._channel.unary_unary(_HEALTH)
        try:
            # Not `subscribe`: the thread that it leaves behind can keep an interpreter from ending.
            ask(b"", timeout=within, wait_for_ready=True)
        except grpc.RpcError as error:
            self._away = error.code() in (grpc.StatusCode.DEADLINE_EXCEEDED, grpc.StatusCode.UNAVAILABLE)
        else:
            self._away = False

    def _tls(self) -> grpc.ChannelCredentials:
        files = self._credentials
        return grpc.ssl_channel_credentials(files.ca, files.key, files.cert)


def _is_local_deadline(error: grpc.RpcError) -> bool:
    """Whether the deadline passed here rather than by the server's word about a lease."""
    return "Deadline Exceeded" in (error.details() or "Deadline Exceeded")


def _violations(error: grpc.RpcError) -> list[tuple[str, str]]:
    """Field and description of each violation that the trailers name."""
    metadata: Any = error.trailing_metadata() or ()
    violations: list[tuple[str, str]] = []
    for detail in (
        detail
        for key, value in metadata
        if key == "grpc-status-details-bin"
        for detail in _wire.status.Status.FromString(value).details
    ):
        if detail.type_url.endswith("/google.rpc.BadRequest"):
            fields = _wire.status.BadRequest.FromString(detail.value).field_violations
            violations += [(violation.field, violation.description) for violation in fields]
        elif detail.type_url.endswith("/google.rpc.PreconditionFailure"):
            subjects = _wire.status.PreconditionFailure.FromString(detail.value).violations
            violations += [(violation.subject, violation.description) for violation in subjects]
    return violations


class _GrpcAnswers:
    """The answers of a stream over grpcio, with a deadline on each.

    A gRPC deadline covers a whole stream and grpcio's iterator waits for ever, so the watchdog thread
    cancels the call when an answer is late, or asks first whether the server is there.
    """

    def __init__(
        self,
        transport: GrpcTransport,
        call: Any,
        timeout: float,
        *,
        watched: bool = True,
        ask: Callable[[], object] | None = None,
    ) -> None:
        self._transport = transport
        self.alive = True
        self._call = call
        self.timeout = timeout
        self.waiting_since: float | None = None
        #: Why it was ended here.
        self._failure: MazewayError | None = None
        self._ask = ask
        #: When the server was asked last whether it is there; infinity meanwhile.
        self._asked = 0.0
        if watched and timeout < math.inf:
            _watchdog.watch(self)

    @property
    def over(self) -> bool:
        """Whether the stream has ended, as far as is known here."""
        call = self._call
        return call is None or not call.is_active()

    def next(self) -> Any:
        """The next answer; None where there are no more."""
        call = self._call
        if call is None:
            return None
        self.waiting_since = time.monotonic()
        answer = None
        try:
            answer = next(call)
        except StopIteration:
            return None
        except grpc.RpcError as error:
            if self._failure is not None:
                raise self._failure from None
            raise self._transport.translate(error, self.timeout) from None
        finally:
            self.waiting_since = None
            if answer is None:  # also by a KeyboardInterrupt, after which answers are out of step
                self.cancel()
        return answer

    def look(self, now: float) -> None:
        """Ends the call where its answer is late and the server is not there; never waits."""
        since = self.waiting_since
        if since is None or now - max(since, self._asked) <= self.timeout:
            return
        if self._ask is None:
            self._fail(late(self._transport.address, self.timeout))
        else:
            self._asked = math.inf
            threading.Thread(target=self._ask_now, args=(self._ask,), daemon=True).start()

    def _ask_now(self, ask: Callable[[], object]) -> None:
        try:
            ask()
        except MazewayError as error:
            self._fail(error)
        finally:
            self._asked = time.monotonic()

    def _fail(self, failure: MazewayError) -> None:
        self._failure = failure
        self.cancel()

    def cancel(self) -> None:
        self.alive = False
        call, self._call = self._call, None
        if call is not None:
            # Not kept: what grpcio deletes only as the interpreter ends waits for ever where a thread of
            # its own was stopped with the call's lock.
            call.cancel()


class _GrpcExchange(_GrpcAnswers):
    """A bidirectional stream over grpcio with a deadline on each answer."""

    def __init__(
        self,
        transport: GrpcTransport,
        method: Callable[..., Any],
        timeout: float,
        lock: contextlib.AbstractContextManager[Any],
    ) -> None:
        self._lock = lock
        # Bounded by those who send: see `Exchange`.
        self._requests: SimpleQueue[Any] = SimpleQueue()
        super().__init__(transport, method(iter(self._requests.get, None)), timeout)

    def send(self, request: Any) -> None:
        self._requests.put(request)

    def receive(self) -> Any:
        with self._lock:
            answer = self.next()
        if answer is None:
            raise ServerFailureError(
                f"the server at {self._transport.address} ended the stream without an answer"
            )
        return answer

    def finish(self, timeout: float) -> None:
        self._requests.put(None)
        self.timeout = timeout
        with self._lock:
            while self.next() is not None:
                pass

    def cancel(self) -> None:
        self._requests.put(None)  # ends the request iterator and so grpcio's thread
        super().cancel()


class _Watchdog:
    """One daemon thread a process that cancels exchanges whose answer is late."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Starts afresh, as a forked child must: the thread and the calls are its parent's."""
        self._exchanges: weakref.WeakSet[_GrpcAnswers] = weakref.WeakSet()
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._wake = threading.Event()

    def watch(self, exchange: _GrpcAnswers) -> None:
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
                exchange.look(now)
            del exchange, exchanges  # hold no exchange while asleep
            self._wake.wait(period)
            self._wake.clear()


class _Forks:
    """All transports of this process, paused while it forks."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._transports: weakref.WeakSet[GrpcTransport] = weakref.WeakSet()
        self._paused: list[GrpcTransport] = []
        self._last_close: float | None = None

    def closed(self) -> None:
        self._last_close = time.monotonic()

    def add(self, transport: GrpcTransport) -> None:
        with self._lock:
            self._transports.add(transport)

    def before(self) -> None:
        self._lock.acquire()
        self._paused = list(self._transports)
        for transport in self._paused:
            transport.pause()
        if self._last_close is not None:
            time.sleep(max(0.0, self._last_close + _FORK_REST_SECS - time.monotonic()))

    def after_in_parent(self) -> None:
        for transport in self._paused:
            transport.resume()
        self._paused = []
        self._lock.release()

    def after_in_child(self) -> None:
        _watchdog.forget()
        self.after_in_parent()


_watchdog = _Watchdog()
_forks = _Forks()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(
        before=_forks.before,
        after_in_parent=_forks.after_in_parent,
        after_in_child=_forks.after_in_child,
    )
