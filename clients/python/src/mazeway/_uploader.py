"""Demonstrations on their way to a learner: sent over one stream, and again over another where that breaks.

Invariants: what is put is kept until the learner has acknowledged it, and then it is on stable storage; its
id makes it safe to send it twice. Requests are acknowledged in the order in which they were sent, and so
many are under way at most that what waits in the transport is bounded.
"""

from __future__ import annotations

import contextlib
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator

from mazeway import _wire
from mazeway._transport import Backoff, Exchange, Transport
from mazeway.errors import (
    AlreadyExistsError,
    DeadlineExceededError,
    InvalidArgumentError,
    MazewayError,
    ServerFailureError,
    ServerUnreachableError,
)
from mazeway.trajectory import Trajectory

_TRAJECTORIES_PER_REQUEST = 500
_STEPS_PER_REQUEST = 100_000

#: Requests under way at most.
_IN_FLIGHT = 16

#: To end a stream as it should be is a courtesy: a learner that does not answer must not hold it up.
_FINISH_TIMEOUT_SECS = 1.0


class Uploader:
    """Sends demonstrations in requests of bounded size."""

    def __init__(self, dial: Callable[[], Transport], timeout: float, *, shared: bool = False) -> None:
        """Takes what makes a connection, and the longest wait for the learner, in seconds.

        Args:
            dial: Called for each stream.
            timeout: How long `flush` tries.
            shared: Whether the connection is another's, who closes it.
        """
        self._dial = dial
        self._timeout = timeout
        self._shared = shared
        #: Requests that are not acknowledged, the oldest first.
        self._waiting: deque[list[Trajectory]] = deque()
        #: How many of them went over the present stream.
        self._sent = 0
        #: Acknowledged trajectories that were not stored before.
        self.stored = 0
        self._transport: Transport | None = None
        self._exchange: Exchange | None = None
        self._pid = os.getpid()

    def __getstate__(self) -> dict[str, object]:
        """Everything but the connection, which belongs to this process."""
        return {**self.__dict__, "_transport": None, "_exchange": None, "_sent": 0}

    @property
    def pending(self) -> list[Trajectory]:
        """What is not acknowledged, in the order in which it was put."""
        return [trajectory for request in self._waiting for trajectory in request]

    def put(self, request: list[Trajectory]) -> None:
        """Queues a request and, where there is a stream, sends it at once; never waits."""
        self._waiting.append(request)
        if self._is_open():
            self._send()

    def flush(self, within: float | None = None) -> None:
        """Waits until nothing is pending.

        Args:
            within: How long to try again where the learner cannot be reached; None is until the timeout.
        """
        backoff = Backoff(self._timeout if within is None else within, first=0.05)
        while self._waiting:
            try:
                self._attempt()
            except (ServerUnreachableError, DeadlineExceededError):
                self.close()
                if not backoff.pause():
                    raise
            except (InvalidArgumentError, AlreadyExistsError) as error:
                # Refused for good: a retry would fail for ever and hold back what follows.
                self.close()
                refused = self.pending
                self._waiting.clear()
                error.refused = refused  # type: ignore[union-attr]
                raise
            except BaseException:  # also a KeyboardInterrupt, after which answers are out of step
                self.close()
                raise

    def finish(self) -> None:
        """Ends the stream as one that has said all, not as one whose caller went; what is pending stays."""
        if self._exchange is not None and self._is_open():
            with contextlib.suppress(MazewayError):
                self._exchange.finish(min(self._timeout, _FINISH_TIMEOUT_SECS))
        self.close()

    def close(self) -> None:
        """Drops the connection; what is pending stays."""
        if self._pid == os.getpid():
            if self._exchange is not None:
                self._exchange.cancel()
            if self._transport is not None and not self._shared:
                self._transport.close()
        self._exchange = self._transport = None
        self._sent = 0
        self._pid = os.getpid()

    def _is_open(self) -> bool:
        return self._exchange is not None and self._exchange.alive and self._pid == os.getpid()

    def _send(self) -> None:
        """Sends what waits, as far as there is room for it."""
        assert self._exchange is not None
        while self._sent < min(len(self._waiting), _IN_FLIGHT):
            messages = [trajectory.to_wire() for trajectory in self._waiting[self._sent]]
            self._exchange.send(_wire.learner.RecordTrajectoriesRequest(trajectories=messages))
            self._sent += 1

    def _attempt(self) -> None:
        """Sends and receives until all is acknowledged, over another stream where there is none."""
        if not self._is_open():
            self.close()
            self._transport = self._dial()
            self._exchange = self._transport.exchange("RecordTrajectories", timeout=self._timeout)
        assert self._exchange is not None
        while self._waiting:
            self._send()
            answer = self._exchange.receive()
            if set(answer.trajectory_ids) != {trajectory.trajectory_id for trajectory in self._waiting[0]}:
                raise ServerFailureError("the learner acknowledged other trajectories than were sent")
            self.stored += answer.stored
            self._waiting.popleft()
            self._sent -= 1


def batches(trajectories: Iterable[Trajectory]) -> Iterator[list[Trajectory]]:
    """Trajectories in requests of bounded size."""
    batch: list[Trajectory] = []
    steps = 0
    for trajectory in trajectories:
        batch.append(trajectory)
        steps += len(trajectory)
        if len(batch) >= _TRAJECTORIES_PER_REQUEST or steps >= _STEPS_PER_REQUEST:
            yield batch
            batch, steps = [], 0
    if batch:
        yield batch
