"""The interactive stream of one session, with arrays as Gymnasium wants them: `Link` is the contract.

`NativeLink` has Rust decode straight into numpy arrays; `MessageLink` does it here, over any transport's
messages. Both give the same, number for number and type for type: Discrete observations are int64, flags
bool, scalar infos Python numbers (alone) or int64 and float64 (in a batch), action masks int8.
"""

from __future__ import annotations

import contextlib
import operator
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import gymnasium
import numpy as np
import numpy.typing as npt

from mazeway import _arrays, _wire
from mazeway._transport import Backoff, Exchange, Transport
from mazeway.errors import MazewayError, SessionInUseError

if TYPE_CHECKING:
    from mazeway._native_transport import NativeTransport

#: Longest wait for the server to notice that a stream of ours is gone.
_SETTLE_SECS = 10.0

_CATALOGUE = _wire.env.ListEnvironmentsRequest()

#: Which environments are meant, shape (num_envs,).
Mask = npt.NDArray[np.bool_]
#: Observations and info columns of a batch.
First = tuple[npt.NDArray[Any], list[npt.NDArray[Any]]]
#: Observations, rewards, terminated, truncated, info columns; under SAME_STEP, where an episode ended, the
#: last observations and columns of those that did.
Stepped = tuple[
    npt.NDArray[Any],
    npt.NDArray[np.float64],
    npt.NDArray[np.bool_],
    npt.NDArray[np.bool_],
    list[npt.NDArray[Any]],
    First | None,
]
#: Observation, reward, terminated, truncated, info.
SteppedOne = tuple[Any, float, bool, bool, dict[str, Any]]


class Link(Protocol):
    """A session's stream; opened with its first use, and anew after an error."""

    def reset(
        self, seed: int | None, seeds: Sequence[int] | None, mask: npt.NDArray[np.bool_] | None
    ) -> First:
        """Begins episodes: with `seeds`, else `seed` + i, else as the generators go on."""

    def step(self, actions: npt.NDArray[np.int64]) -> Stepped:
        """Steps every environment; `actions` is contiguous and of the right shape."""

    def send(self, actions: npt.NDArray[np.int64]) -> None:
        """Sends actions without waiting."""

    def receive(self) -> Stepped:
        """What came of the oldest actions that were sent and not yet received."""

    def reset_one(self, seed: int | None) -> tuple[Any, dict[str, Any]]:
        """As `reset` in a session of one environment: its observation and info."""

    def step_one(self, action: Any) -> SteppedOne | None:
        """As `step` in a session of one environment; None for what is none of its actions."""

    def close(self, timeout: float) -> None:
        """Ends the session."""


class NativeLink:
    """Over `mazeway._native.Interaction`."""

    def __init__(self, transport: NativeTransport, created: Any, timeout: float) -> None:
        """Takes the answer to `CreateSession`."""
        from mazeway import _native  # there may be none

        self._failures = (_native.CallError, _native.LateError)
        self._transport = transport
        self._timeout = timeout
        self._interaction = _native.Interaction(transport.channel(), created.SerializeToString(), timeout)

    def reset(
        self, seed: int | None, seeds: Sequence[int] | None, mask: npt.NDArray[np.bool_] | None
    ) -> First:
        """See `Link`."""
        try:
            return self._interaction.reset(seed, seeds, None if mask is None else mask.tolist())
        except self._failures as error:
            raise self._transport.translate(error, self._timeout) from None

    def step(self, actions: npt.NDArray[np.int64]) -> Stepped:
        """See `Link`."""
        try:
            return self._interaction.step(actions)
        except self._failures as error:
            raise self._transport.translate(error, self._timeout) from None

    def send(self, actions: npt.NDArray[np.int64]) -> None:
        """See `Link`."""
        try:
            self._interaction.send(actions)
        except self._failures as error:
            raise self._transport.translate(error, self._timeout) from None

    def receive(self) -> Stepped:
        """See `Link`."""
        try:
            return self._interaction.receive()
        except self._failures as error:
            raise self._transport.translate(error, self._timeout) from None

    def reset_one(self, seed: int | None) -> tuple[Any, dict[str, Any]]:
        """See `Link`."""
        try:
            return self._interaction.reset_one(seed)
        except self._failures as error:
            raise self._transport.translate(error, self._timeout) from None

    def step_one(self, action: Any) -> SteppedOne | None:
        """See `Link`."""
        try:
            return self._interaction.step_one(action)
        except self._failures as error:
            raise self._transport.translate(error, self._timeout) from None

    def close(self, timeout: float) -> None:
        """See `Link`."""
        with self._transport.translated(timeout):
            self._interaction.close(timeout)


class MessageLink:
    """Over a transport's exchange of messages."""

    def __init__(self, transport: Transport, created: Any, timeout: float) -> None:
        """Takes the answer to `CreateSession`."""
        spec = created.spec
        self._transport = transport
        self._session_id = created.session_id
        self._timeout = timeout
        self._exchange: Exchange | None = None
        #: What was sent on a stream that has not answered yet; None from its first answer on.
        self._opening: list[Any] | None = None
        #: Requests whose answer nobody has received.
        self._awaited = 0
        self._n_actions = spec.n_actions
        self._dtype = _arrays.space_dtype(spec.observation_space)
        space = _arrays.space_from_wire(spec.observation_space)
        self._discrete = isinstance(space, gymnasium.spaces.Discrete)
        self._shape = tuple(space.shape or ())
        self._num_envs = created.num_envs
        self._columns = [_arrays.Column.from_wire(column) for column in spec.info_columns]
        #: Names and readers, for a session of one environment.
        self._singles = [(column.name, column.single()) for column in self._columns]
        self._state = _arrays.number(self._dtype, "observations")
        self._reward = _arrays.number(_arrays.FLOAT64, "rewards")

    def reset(
        self, seed: int | None, seeds: Sequence[int] | None, mask: npt.NDArray[np.bool_] | None
    ) -> First:
        """See `Link`."""
        request = _wire.env.InteractRequest()
        reset = request.reset
        reset.SetInParent()
        if seeds is not None:
            reset.seeds = np.array(seeds, _arrays.UINT64).tobytes()
        elif seed is not None:
            reset.seed = seed
        if mask is not None:
            reset.reset_mask = mask.astype(_arrays.UINT8).tobytes()
        return self._first(self._ask(request).reset)

    def step(self, actions: npt.NDArray[np.int64]) -> Stepped:
        """See `Link`."""
        self.send(actions)
        return self.receive()

    def send(self, actions: npt.NDArray[np.int64]) -> None:
        """See `Link`."""
        request = _wire.env.InteractRequest()
        request.step.actions = _arrays.pack(actions, _arrays.INT32, (self._num_envs,), "actions")
        self._send(request)

    def receive(self) -> Stepped:
        """See `Link`."""
        response = self._receive().step
        shape = (self._num_envs,)
        observations, columns = self._first(response)
        last = None
        if response.final_observations:
            last = (
                self._observations(response.final_observations),
                self._batch(response.final_infos),
            )
        return (
            observations,
            _arrays.unpack(response.rewards, _arrays.FLOAT64, shape, "rewards"),
            _arrays.unpack(response.terminated, _arrays.UINT8, shape, "terminated") != 0,
            _arrays.unpack(response.truncated, _arrays.UINT8, shape, "truncated") != 0,
            columns,
            last,
        )

    def reset_one(self, seed: int | None) -> tuple[Any, dict[str, Any]]:
        """See `Link`."""
        request = _wire.env.InteractRequest()
        request.reset.SetInParent()
        if seed is not None:
            request.reset.seed = seed
        response = self._ask(request).reset
        return self._observation(response.observations), self._info(response.infos)

    def step_one(self, action: Any) -> SteppedOne | None:
        """See `Link`."""
        try:
            value = operator.index(action)
        except TypeError:
            return None
        if not 0 <= value < self._n_actions:
            return None
        request = _wire.env.InteractRequest()
        request.step.actions = value.to_bytes(4, "little")
        response = self._ask(request).step
        return (
            self._observation(response.observations),
            self._reward(response.rewards),
            response.terminated != b"\0",
            response.truncated != b"\0",
            self._info(response.infos),
        )

    def close(self, timeout: float) -> None:
        """See `Link`."""
        if self._exchange is not None and not self._exchange.over:
            request = _wire.env.InteractRequest()
            request.close.session_id = self._session_id
            self._exchange.timeout = timeout
            self._exchange.send(request)
            self._exchange.receive()
        else:
            request = _wire.env.CloseSessionRequest(session_id=self._session_id)
            self._insist(lambda: self._transport.unary("CloseSession", request, timeout=timeout), timeout)

    def _ask(self, request: Any) -> Any:
        self._send(request)
        return self._receive()

    def _send(self, request: Any) -> None:
        if self._exchange is None or not self._exchange.alive or (not self._awaited and self._exchange.over):
            if self._exchange is not None:
                # Nothing is known to be lost: the session is taken up where it stands. But what is sent
                # before the server is there again might be.
                self._transport.unary("ListEnvironments", _CATALOGUE, timeout=self._timeout)
            self._exchange = self._transport.exchange("Interact", timeout=self._timeout)
            self._awaited = 0
            getattr(request, request.WhichOneof("request")).session_id = self._session_id
            self._opening = []
        if self._opening is not None:
            self._opening.append(request)
        self._exchange.send(request)
        self._awaited += 1

    def _receive(self) -> Any:
        if self._exchange is None:
            raise MazewayError("expected an answer that was asked for")
        opening, self._opening = self._opening, None
        self._awaited -= 1
        try:
            return self._exchange.receive()
        except SessionInUseError:
            if opening is None:
                raise
        # The server has not noticed yet that our last stream is gone; it carried out nothing of this one.
        return self._insist(lambda: self._ask_anew(opening), self._timeout)

    def _ask_anew(self, requests: list[Any]) -> Any:
        self._exchange = self._transport.exchange("Interact", timeout=self._timeout)
        for request in requests:
            self._exchange.send(request)
        return self._exchange.receive()

    def _insist(self, call: Callable[[], Any], timeout: float) -> Any:
        """Calls until the session is free, within bounds."""
        backoff = Backoff(min(0.8 * timeout, _SETTLE_SECS), first=0.005, longest=0.25)
        while True:
            try:
                return call()
            except SessionInUseError:
                if not backoff.pause():
                    raise

    def _first(self, response: Any) -> First:
        return self._observations(response.observations), self._batch(response.infos)

    def _batch(self, infos: Any) -> list[npt.NDArray[Any]]:
        return [column.batch(data, self._num_envs) for column, data in zip(self._columns, infos, strict=True)]

    def _observations(self, data: bytes) -> npt.NDArray[Any]:
        array = _arrays.unpack(data, self._dtype, (self._num_envs, *self._shape), "observations")
        return array.astype(np.int64) if self._discrete else array

    def _observation(self, data: bytes) -> Any:
        if self._discrete:
            return np.int64(self._state(data))
        return _arrays.unpack(data, self._dtype, self._shape, "observations")

    def _info(self, infos: Any) -> dict[str, Any]:
        return {name: read(data) for (name, read), data in zip(self._singles, infos, strict=True)}


def link(transport: Transport, created: Any, timeout: float) -> Link:
    """The fastest link that a transport has."""
    with contextlib.suppress(ImportError):
        from mazeway._native_transport import NativeTransport  # there may be none

        if isinstance(transport, NativeTransport):
            return NativeLink(transport, created, timeout)
    return MessageLink(transport, created, timeout)
