"""The transport over Rust's client, compiled into `mazeway._native`.

The calling thread drives the I/O, so that a call costs no hop to another thread. One keeper thread a
process, which Python never sees, answers the server's pings for connections that are silent. A forked
child shares its parent's sockets: it lets them alone and connects anew.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from mazeway import _native, _wire
from mazeway._access import Credentials
from mazeway._transport import START, Exchange, late, repeated
from mazeway.errors import MazewayError, ServerFailureError, from_status

_keeper: tuple[int, _native.Keeper] | None = None


def _keep() -> _native.Keeper:
    """This process's keeper."""
    global _keeper  # one a process
    if _keeper is None or _keeper[0] != os.getpid():
        _keeper = os.getpid(), _native.Keeper()
    return _keeper[1]


class NativeTransport:
    """Calls as bytes through `mazeway._native.Channel`."""

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
        self._channel: _native.Channel | None = None
        self._secure = secure
        self._credentials = credentials or Credentials()
        #: True once the server has answered: from then on it is waited for when it goes away.
        self.known = False
        self._pid = os.getpid()

    def unary(self, method: str, request: Any, *, timeout: float) -> Any:
        """See `Transport`."""
        called = self._methods[method]

        def call(left: float) -> bytes:
            with self.translated(timeout):
                return self.channel().unary(called.path, request.SerializeToString(), left)

        return called.response.FromString(repeated(self, method, call, timeout))

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
        called = self._methods[method]
        deadline = time.monotonic() + timeout

        def begin(_left: float) -> tuple[_native.Answers, bytes | None]:
            with self.translated(timeout):
                answers = self.channel().answers(called.path, request.SerializeToString())
            try:
                return answers, receive(answers)
            except BaseException:
                answers.cancel()
                raise

        def receive(answers: _native.Answers) -> bytes | None:
            while True:
                left = timeout if each else max(deadline - time.monotonic(), 0.0)
                try:
                    return answers.receive(left)
                except _native.LateError as error:
                    if alive is None:
                        raise self.translate(error, timeout) from None
                except _native.CallError as error:
                    raise self.translate(error, timeout) from None
                alive()

        # Until the first answer the call may be made anew.
        answers, answer = repeated(self, method, begin, timeout)
        try:
            while answer is not None:
                yield called.response.FromString(answer)
                answer = receive(answers)
        finally:
            if self._pid == os.getpid():
                answers.cancel()

    def requests(self, method: str, requests: Iterable[Any], *, timeout: float) -> Any:
        """See `Transport`."""
        called = self._methods[method]
        packed = [request.SerializeToString() for request in requests]

        def call(left: float) -> bytes:
            with self.translated(timeout):
                return self.channel().requests(called.path, packed, left)

        return called.response.FromString(repeated(self, method, call, timeout))

    def exchange(self, method: str, *, timeout: float) -> Exchange:
        """See `Transport`."""
        with self.translated(timeout):
            return _NativeExchange(self, self._methods[method], timeout)

    def close(self) -> None:
        """See `Transport`."""
        self._channel = None

    def channel(self) -> _native.Channel:
        """The connection, which is another one in a forked child."""
        if self._channel is None or self._pid != os.getpid():
            self._pid = os.getpid()
            address = f"https://{self.address}" if self._secure else self.address
            files = self._credentials
            self._channel = _native.Channel(address, _keep(), files.token, files.ca, files.cert, files.key)
        return self._channel

    @contextlib.contextmanager
    def translated(self, timeout: float) -> Iterator[None]:
        """Turns the module's exceptions into `MazewayError`s."""
        try:
            yield
        except (_native.CallError, _native.LateError) as error:
            raise self.translate(error, timeout) from None

    def translate(self, error: Exception, timeout: float) -> MazewayError:
        """The `MazewayError` that says what an exception of the module says."""
        if isinstance(error, _native.LateError):
            return late(self.address, timeout)
        code, message, violations = error.args
        return from_status(code, message, violations, address=self.address, start=START[self.service])


class _NativeExchange:
    """A bidirectional stream."""

    def __init__(self, transport: NativeTransport, method: _wire.Method, timeout: float) -> None:
        self.timeout = timeout
        self._transport = transport
        self._response = method.response
        self._pid = os.getpid()
        self._over = False
        self._stream = transport.channel().exchange(method.path)

    @property
    def alive(self) -> bool:
        """See `Exchange`."""
        return not self._over and self._pid == os.getpid()

    @property
    def over(self) -> bool:
        """See `Exchange`."""
        return not self.alive

    def send(self, request: Any) -> None:
        """See `Exchange`."""
        try:
            self._stream.send(request.SerializeToString())
        except _native.CallError as error:
            raise self._transport.translate(error, self.timeout) from None

    def receive(self) -> Any:
        """See `Exchange`."""
        answer = None
        try:
            with self._transport.translated(self.timeout):
                answer = self._stream.receive(self.timeout)
        finally:
            if answer is None:  # also by a KeyboardInterrupt, after which answers are out of step
                self.cancel()
        if answer is None:
            raise ServerFailureError(
                f"the server at {self._transport.address} ended the stream without an answer"
            )
        return self._response.FromString(answer)

    def finish(self, timeout: float) -> None:
        """See `Exchange`."""
        try:
            self._stream.end()
            with self._transport.translated(timeout):
                while self._stream.receive(timeout) is not None:
                    pass
        finally:
            self.cancel()

    def cancel(self) -> None:
        """See `Exchange`."""
        if self.alive:
            self._stream.cancel()
        self._over = True
