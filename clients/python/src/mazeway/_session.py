"""A session on the environment server: what `MazewayEnv` and `MazewayVectorEnv` share.

Opened with the first use, and again after a fork, an unpickling or a loss; episodes never move from
one session to another, so the first call on a new one must be `reset`. Deliberately absent: spaces,
info dictionaries and `np_random`, which differ between the two.
"""

from __future__ import annotations

import contextlib
import os
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from mazeway import _arrays, _wire
from mazeway._transport import Exchange, Transport, connect
from mazeway.errors import (
    DeadlineExceededError,
    InvalidArgumentError,
    MazewayError,
    NotFoundError,
    ResetNeededError,
    ServerUnreachableError,
    SessionLostError,
)

_AUTORESET = _wire.env.AutoresetMode

DEFAULT_ADDRESS = "127.0.0.1:50051"
DEFAULT_TIMEOUT_SECS = 60.0

#: Closing is a courtesy, for sessions expire: a server that does not answer must not hold it up.
_CLOSE_TIMEOUT_SECS = 1.0


@dataclass
class _Connection:
    """What belongs to one process and one session on the server."""

    transport: Transport
    session_id: str
    timeout: float
    pid: int
    exchange: Exchange | None = None

    def release(self) -> None:
        """Closes the session and the connection; a child leaves its parent's alone."""
        if self.pid != os.getpid():
            return
        timeout = min(self.timeout, _CLOSE_TIMEOUT_SECS)
        with contextlib.suppress(MazewayError):
            if self.exchange is not None and self.exchange.alive:
                request = _wire.env.InteractRequest()
                request.close.session_id = self.session_id
                self.exchange.timeout = timeout
                self.exchange.send(request)
                self.exchange.receive()
            else:
                request = _wire.env.CloseSessionRequest(session_id=self.session_id)
                self.transport.unary("CloseSession", request, timeout=timeout)
        self.transport.close()


class Session:
    """A batch of environments on the server, by the wire's own messages."""

    def __init__(
        self,
        address: str,
        env_id: str,
        options: dict[str, Any],
        *,
        num_envs: int = 1,
        autoreset_mode: str = "DISABLED",
        max_episode_steps: int | None = None,
        action_masks: bool = False,
        timeout: float = DEFAULT_TIMEOUT_SECS,
        lease_secs: float | None = None,
    ) -> None:
        """Keeps what the session is made from; nothing is sent.

        Raises InvalidArgumentError for what no server would take.
        """
        if not timeout > 0:
            raise InvalidArgumentError(f"timeout: expected seconds above 0, got {timeout!r}", field="timeout")
        if num_envs < 1:
            raise InvalidArgumentError(f"num_envs: expected at least 1, got {num_envs!r}", field="num_envs")
        self.address = address
        self.timeout = timeout
        self.num_envs = num_envs
        #: True from the first seeded reset on: the server's generators may then go on by themselves.
        self.seeded = False
        #: True where a step makes sense.
        self.started = False
        self.spec: Any = None
        self.closed = False
        self._create = _wire.env.CreateSessionRequest(
            env_id=env_id,
            options=_arrays.struct(options),
            num_envs=num_envs,
            autoreset_mode=_AUTORESET[f"AUTORESET_MODE_{autoreset_mode}"],
            action_masks=action_masks,
        )
        if max_episode_steps is not None:
            if max_episode_steps < 0:
                raise InvalidArgumentError(
                    f"max_episode_steps: expected at least 0, got {max_episode_steps}",
                    field="max_episode_steps",
                )
            self._create.max_episode_steps = max_episode_steps
        if lease_secs is not None:
            self._create.lease.FromNanoseconds(round(lease_secs * 1e9))
        self._connection: _Connection | None = None
        self._finalizer: Any = None

    def __getstate__(self) -> dict[str, Any]:
        """Everything but the connection, which belongs to this process."""
        state = self.__dict__.copy()
        state.update(_connection=None, _finalizer=None, seeded=False, started=False)
        for key in ("_create", "spec"):
            message = state[key]
            state[key] = None if message is None else message.SerializeToString()
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Takes up the description; the connection comes with the first use."""
        self.__dict__.update(state)
        self._create = _wire.env.CreateSessionRequest.FromString(state["_create"])
        if state["spec"] is not None:
            self.spec = _wire.env.EnvironmentSpec.FromString(state["spec"])

    def open(self) -> Any:
        """Makes sure that there is a session; returns the environment's spec."""
        self._ensure()
        return self.spec

    def reset(self, *, seed: int | None, seeds: bytes, mask: bytes, draw: Callable[[], int]) -> Any:
        """Begins episodes; returns a `ResetResponse`.

        Args:
            seed: Environment i is seeded with seed + i; None lets the generators go on.
            seeds: A packed seed each instead; empty for none.
            mask: Packed flags of the environments meant; empty for all.
            draw: Gives the seed for generators that were never seeded.
        """
        for attempt in (0, 1):
            fresh = self._ensure()
            first = None if seed is not None or seeds or self.seeded else draw()
            request = _wire.env.InteractRequest()
            reset = request.reset
            reset.SetInParent()
            if seeds:
                reset.seeds = seeds
            elif seed is not None or first is not None:
                reset.seed = seed if seed is not None else first
            reset.reset_mask = mask
            try:
                response = self._exchange(request).reset
            except (SessionLostError, ServerUnreachableError):
                # A session that was lost since its last use is made anew, once; part of a batch
                # cannot be, for the other part is gone.
                if fresh or attempt or mask:
                    raise
                continue
            self.seeded = True
            self.started = True
            return response
        raise AssertionError("unreachable")

    def step(self, actions: bytes) -> Any:
        """Steps every environment; returns a `StepResponse`."""
        if not self.started or self._connection is None or self._connection.pid != os.getpid():
            self._refuse_closed()
            raise ResetNeededError("cannot step before the first reset", hint="call reset() first")
        request = _wire.env.InteractRequest()
        request.step.actions = actions
        return self._exchange(request).step

    def render(self, index: int, mode: str) -> Any:
        """Draws one environment; returns a `RenderResponse`."""
        connection = self._connection
        if not self.started or connection is None or connection.pid != os.getpid():
            self._refuse_closed()
            raise ResetNeededError("cannot render before the first reset", hint="call reset() first")
        request = _wire.env.RenderRequest(
            session_id=connection.session_id,
            index=index,
            mode=_wire.env.RenderMode[f"RENDER_MODE_{mode.upper()}"],
        )
        with self._watched():
            return connection.transport.unary("Render", request, timeout=self.timeout)

    def close(self) -> None:
        """Ends the session; may be called twice, and with the server gone."""
        self.closed = True
        self._drop()

    def _refuse_closed(self) -> None:
        if self.closed:
            raise ResetNeededError("the environment is closed", hint="make a new one")

    def _ensure(self) -> bool:
        """Opens a session where there is none; returns whether it did."""
        self._refuse_closed()
        if self._connection is not None:
            if self._connection.pid == os.getpid():
                return False
            self._drop()
        transport = connect(self.address, _wire.ENVIRONMENT_SERVICE)
        try:
            response = transport.unary("CreateSession", self._create, timeout=self.timeout)
        except BaseException:
            transport.close()
            raise
        self.spec = response.spec
        self._connection = _Connection(transport, response.session_id, self.timeout, os.getpid())
        self._finalizer = weakref.finalize(self, self._connection.release)
        return True

    def _drop(self) -> None:
        """Forgets the connection, closing what can be closed."""
        self._connection = None
        self.seeded = self.started = False
        if self._finalizer is not None:
            self._finalizer()
            self._finalizer = None

    def _exchange(self, request: Any) -> Any:
        """Sends one request on the fast path and waits for its answer."""
        connection = self._connection
        assert connection is not None
        with self._watched():
            if connection.exchange is None or not connection.exchange.alive:
                connection.exchange = connection.transport.exchange("Interact", timeout=self.timeout)
                getattr(request, request.WhichOneof("request")).session_id = connection.session_id
            try:
                connection.exchange.send(request)
                return connection.exchange.receive()
            except MazewayError:
                raise  # the stream is over; the session lives on and the next stream takes it up
            except BaseException:
                # Interrupted between request and answer: the episode's state is unknown.
                self.started = False
                raise

    @contextlib.contextmanager
    def _watched(self) -> Any:
        """Turns the loss of the session into its own error and forgets the connection."""
        try:
            yield
        except ServerUnreachableError:
            self._drop()
            raise
        except NotFoundError as error:
            self._drop()
            raise _lost(error) from None
        except DeadlineExceededError as error:
            self._drop()
            if error.hint:  # our own deadline
                raise
            raise _lost(error) from None


def _lost(error: MazewayError) -> SessionLostError:
    return SessionLostError(
        f"the server no longer knows the session ({error.message})",
        hint="call reset() to begin anew; a longer `lease_secs` keeps an idle session alive",
    )
