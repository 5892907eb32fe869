"""A session on the environment server: what `MazewayEnv` and `MazewayVectorEnv` share.

Opened with the first use, and again after a fork, an unpickling or a loss; episodes never move from
one session to another, so the first call on a new one must be `reset`. Deliberately absent: spaces,
info dictionaries and `np_random`, which differ between the two.
"""

from __future__ import annotations

import contextlib
import os
import time
import weakref
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from mazeway import _arrays, _wire
from mazeway._access import Access
from mazeway._link import First, Link, Stepped, SteppedOne
from mazeway._link import link as make_link
from mazeway._transport import RECONNECT_SECS, Transport, choose, connect, reconnecting
from mazeway.errors import (
    ConnectionLostError,
    DeadlineExceededError,
    InvalidArgumentError,
    MazewayError,
    NotFoundError,
    ResetNeededError,
    ServerUnreachableError,
    SessionLostError,
    WrongStateError,
)

T = TypeVar("T")

_AUTORESET = _wire.env.AutoresetMode

DEFAULT_ADDRESS = "127.0.0.1:50051"
DEFAULT_TIMEOUT_SECS = 60.0

#: Steps that may be sent before their answers are received.
MAX_PENDING = 1024

#: Closing is a courtesy, for sessions expire: a server that does not answer must not hold it up.
_CLOSE_TIMEOUT_SECS = 1.0


@dataclass
class _Connection:
    """What belongs to one process and one session on the server."""

    transport: Transport
    link: Link
    session_id: str
    timeout: float
    pid: int

    def release(self) -> None:
        """Closes the session and the connection; a child leaves its parent's alone."""
        if self.pid != os.getpid():
            return
        timeout = min(self.timeout, _CLOSE_TIMEOUT_SECS)
        with contextlib.suppress(MazewayError):
            self.link.close(timeout)
        self.transport.close()


class Session:
    """A batch of environments on the server."""

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
        access: Access | None = None,
    ) -> None:
        """Keeps what the session is made from; nothing is sent.

        Raises InvalidArgumentError for what no server would take.
        """
        if not timeout > 0:
            raise InvalidArgumentError(f"timeout: expected seconds above 0, got {timeout!r}", field="timeout")
        if num_envs < 1:
            raise InvalidArgumentError(f"num_envs: expected at least 1, got {num_envs!r}", field="num_envs")
        self.access = access or Access()
        choose(self.access.client)
        self.address = address
        self.timeout = timeout
        self.num_envs = num_envs
        #: True from the first seeded reset on: the server's generators may then go on by themselves.
        self.seeded = False
        #: Steps that were sent and not received.
        self.pending = 0
        #: True where a step makes sense.
        self.started = False
        self.spec: Any = None
        #: True once the server has answered: from then on it is waited for when it goes away.
        self._known = False
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
        state.update(_connection=None, _finalizer=None, _known=False, seeded=False, started=False, pending=0)
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

    @property
    def session_id(self) -> str:
        """The server's name of the session, which is made where there is none."""
        self._ensure()
        assert self._connection is not None
        return self._connection.session_id

    def reset(
        self,
        *,
        seed: int | None,
        seeds: Sequence[int] | None = None,
        mask: npt.NDArray[np.bool_] | None = None,
        draw: Callable[[], int],
    ) -> First:
        """Begins episodes; returns observations and info columns.

        Args:
            seed: Environment i is seeded with seed + i; None lets the generators go on.
            seeds: A seed each instead.
            mask: Which environments are meant; None is all.
            draw: Gives the seed for generators that were never seeded.
        """
        return self._begin(
            lambda link, first: link.reset(first, seeds, mask),
            seed=seed,
            draw=None if seeds else draw,
            whole=mask is None,
        )

    def reset_one(self, *, seed: int | None, draw: Callable[[], int]) -> tuple[Any, dict[str, Any]]:
        """As `reset` in a session of one environment: its observation and info."""
        return self._begin(lambda link, first: link.reset_one(first), seed=seed, draw=draw, whole=True)

    def _begin(
        self,
        begin: Callable[[Link, int | None], T],
        *,
        seed: int | None,
        draw: Callable[[], int] | None,
        whole: bool,
    ) -> T:
        began = time.monotonic()
        for attempt in (0, 1):
            fresh = self._ensure(RECONNECT_SECS - (time.monotonic() - began))
            self._refuse_pending("reset")
            first = draw() if seed is None and draw is not None and not self.seeded else seed
            assert self._connection is not None
            try:
                begun = begin(self._connection.link, first)
            except BaseException as error:  # noqa: BLE001 - raised as what it means
                failure = self._failed(error)
                # A session that was lost since its last use is made anew, once; part of a batch
                # cannot be, for the other part is gone.
                lost = isinstance(failure, (SessionLostError, ServerUnreachableError))
                if lost and whole and not fresh and not attempt:
                    continue
                raise failure from None
            self.seeded = True
            self.started = True
            return begun
        raise AssertionError("unreachable")

    def step(self, actions: Any) -> Stepped:
        """Steps every environment."""
        link = self._under_way("step")
        self._refuse_pending("step")
        try:
            return link.step(_arrays.integers(actions, (self.num_envs,), "actions"))
        except BaseException as error:  # noqa: BLE001 - raised as what it means
            raise self._failed(error, stepping=True) from None

    def step_one(self, action: Any) -> SteppedOne:
        """As `step` in a session of one environment."""
        link = self._under_way("step")
        try:
            stepped = link.step_one(action)
            if stepped is None and isinstance(action, np.ndarray) and action.size == 1:
                stepped = link.step_one(action.item())
        except BaseException as error:  # noqa: BLE001 - raised as what it means
            raise self._failed(error, stepping=True) from None
        if stepped is None:
            last = self.spec.n_actions - 1
            raise InvalidArgumentError(
                f"actions: expected an integer from 0 to {last}, got {action!r}", field="actions"
            )
        return stepped

    def send(self, actions: Any) -> None:
        """Sends actions; `receive` brings what came of them, in order."""
        link = self._under_way("send")
        if self.pending >= MAX_PENDING:
            raise WrongStateError(
                f"expected at most {MAX_PENDING} steps that are sent and not received", hint="call recv()"
            )
        try:
            link.send(_arrays.integers(actions, (self.num_envs,), "actions"))
        except InvalidArgumentError:
            raise  # nothing was sent
        except BaseException as error:  # noqa: BLE001 - raised as what it means
            raise self._failed(error, stepping=True) from None
        self.pending += 1

    def receive(self) -> Stepped:
        """What came of the oldest actions that were sent and not yet received."""
        link = self._under_way("recv")
        if not self.pending:
            raise WrongStateError("cannot receive what was not sent", hint="call send() first")
        self.pending -= 1
        try:
            return link.receive()
        except BaseException as error:  # noqa: BLE001 - raised as what it means
            raise self._failed(error, stepping=True) from None

    def _under_way(self, what: str) -> Link:
        """The link, where an episode goes on."""
        connection = self._connection
        if not self.started or connection is None or connection.pid != os.getpid():
            self._refuse_closed()
            raise ResetNeededError(f"cannot {what} before the first reset", hint="call reset() first")
        return connection.link

    def _refuse_pending(self, what: str) -> None:
        if self.pending:
            raise WrongStateError(
                f"cannot {what} with {self.pending} steps sent and not received", hint="call recv() first"
            )

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
        try:
            return connection.transport.unary("Render", request, timeout=self.timeout)
        except MazewayError as error:
            raise self._failed(error) from None

    def close(self) -> None:
        """Ends the session; may be called twice, and with the server gone."""
        self.closed = True
        self._drop()

    def _refuse_closed(self) -> None:
        if self.closed:
            raise ResetNeededError("the environment is closed", hint="make a new one")

    def _ensure(self, within: float = RECONNECT_SECS) -> bool:
        """Opens a session where there is none; returns whether it did.

        Args:
            within: How long a server is waited for that has answered this session before.
        """
        self._refuse_closed()
        if self._connection is not None:
            if self._connection.pid == os.getpid():
                return False
            self._drop()
        transport = connect(self.address, _wire.ENVIRONMENT_SERVICE, self.access)
        try:

            def create(_left: float = 0.0) -> Any:
                return transport.unary("CreateSession", self._create, timeout=self.timeout)

            response = reconnecting(create, self.timeout, within) if self._known else create()
            link = make_link(transport, response, self.timeout)
        except BaseException:
            transport.close()
            raise
        self.spec = response.spec
        self._known = True
        self._connection = _Connection(transport, link, response.session_id, self.timeout, os.getpid())
        self._finalizer = weakref.finalize(self, self._connection.release)
        return True

    def _drop(self) -> None:
        """Forgets the connection, closing what can be closed."""
        self._connection = None
        self.seeded = self.started = False
        self.pending = 0
        if self._finalizer is not None:
            self._finalizer()
            self._finalizer = None

    def _failed(self, error: BaseException, *, stepping: bool = False) -> BaseException:
        """Takes note of a failure, within an episode where `stepping`; returns the error to raise."""
        self.pending = 0  # whatever was under way went with the stream
        if isinstance(error, ServerUnreachableError):
            if stepping:
                # The session may live on, and the next reset takes it up; what its generators have drawn
                # since the last answer is unknown.
                self.started = self.seeded = False
                return error if isinstance(error, ConnectionLostError) else _interrupted(error)
            self._drop()
        elif isinstance(error, (NotFoundError, DeadlineExceededError)):
            self._drop()
            if not error.hint:  # not our own deadline
                return _lost(error)
        elif not isinstance(error, MazewayError):
            # Interrupted between request and answer: the episode's state is unknown.
            self.started = False
        # Else the stream is over; the session lives on and the next stream takes it up.
        return error


def _interrupted(error: ServerUnreachableError) -> ConnectionLostError:
    return ConnectionLostError(
        f"the episode is lost: {error.message}",
        hint=f"call reset() to begin anew; where no server is left, {error.hint or 'start one'}",
    )


def _lost(error: MazewayError) -> SessionLostError:
    message = f"the server no longer knows the session ({error.message})"
    if isinstance(error, NotFoundError):  # it does not say why, and may not be the one that made it
        return SessionLostError(
            message, hint="the server was restarted or the lease has run out; call reset() to begin anew"
        )
    return SessionLostError(
        message, hint="call reset() to begin anew; a longer `lease_secs` keeps an idle session alive"
    )
