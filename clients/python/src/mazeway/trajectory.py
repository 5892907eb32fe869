"""`Trajectory`: one demonstration as numpy arrays."""

from __future__ import annotations

import datetime
import uuid
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from mazeway import _arrays, _wire
from mazeway.errors import InvalidArgumentError


@dataclass(frozen=True, eq=False)
class Trajectory:
    """The states an expert was in and the actions it took there, or the states alone."""

    env_id: str
    style: str
    n_states: int
    n_actions: int
    #: State before each step, shape (steps,).
    states: npt.NDArray[np.int32]
    #: Action of each step, shape (steps,); None where only the states were seen.
    actions: npt.NDArray[np.int32] | None
    #: Reward of each step, shape (steps,); None where unknown.
    rewards: npt.NDArray[np.float64] | None = None
    #: State after the last step; None where unknown.
    final_state: int | None = None
    terminated: bool = False
    truncated: bool = False
    model_id: str = ""
    #: Who acted.
    source: str = "python"
    #: Seed of the episode, where the source is scripted and so can be repeated.
    seed: int | None = None
    #: A UUID, what makes a retry safe.
    trajectory_id: str = field(default_factory=lambda: str(uuid.uuid4()))

    def __post_init__(self) -> None:
        """Raises InvalidArgumentError for ragged, empty or out-of-range arrays."""
        if not len(self.states):
            raise InvalidArgumentError("states: expected at least one step", field="states")
        if self.actions is None:
            if len(self.states) == 1 and self.final_state is None:
                raise InvalidArgumentError(
                    "states: expected at least two where there are no actions, got one", field="states"
                )
        elif len(self.actions) != len(self.states):
            raise InvalidArgumentError(
                f"actions: expected {len(self.states)}, as many as states, got {len(self.actions)}",
                field="actions",
            )
        for name, values, size in (
            ("states", self.states, self.n_states),
            ("actions", self.actions, self.n_actions),
        ):
            if values is None:
                continue
            low, high = int(np.min(values)), int(np.max(values))
            if low < 0 or high >= size:
                raise InvalidArgumentError(
                    f"{name}: expected 0 to {size - 1}, got {low if low < 0 else high}", field=name
                )

    def __len__(self) -> int:
        """Number of steps, at least 1; without actions the number of transitions."""
        return len(self.states) - (self.actions is None and self.final_state is None)

    def __repr__(self) -> str:
        """What it is, without the arrays."""
        return (
            f"Trajectory({self.env_id!r}, {self.style!r}, steps={len(self)}, "
            f"source={self.source!r}, id={self.trajectory_id[:8]})"
        )

    def to_wire(self) -> Any:
        """The wire's `Trajectory`."""
        steps = (len(self.states),)
        message = _wire.learner.Trajectory(
            trajectory_id=self.trajectory_id,
            env_id=self.env_id,
            model_id=self.model_id,
            style=self.style,
            source=self.source,
            n_states=self.n_states,
            n_actions=self.n_actions,
            states=_arrays.pack(self.states, _arrays.INT32, steps, "states"),
            terminated=self.terminated,
            truncated=self.truncated,
        )
        if self.actions is not None:
            message.actions = _arrays.pack(self.actions, _arrays.INT32, steps, "actions")
        if self.rewards is not None:
            message.rewards = _arrays.pack(self.rewards, _arrays.FLOAT64, steps, "rewards")
        if self.final_state is not None:
            message.final_state = self.final_state
        if self.seed is not None:
            message.seed = self.seed
        return message

    @classmethod
    def from_wire(cls, message: Any) -> Trajectory:
        """Reads the wire's `Trajectory`."""
        return cls(
            env_id=message.env_id,
            style=message.style,
            n_states=message.n_states,
            n_actions=message.n_actions,
            states=_arrays.unpack(message.states, _arrays.INT32),
            actions=_arrays.unpack(message.actions, _arrays.INT32) if message.actions else None,
            rewards=_arrays.unpack(message.rewards, _arrays.FLOAT64) if message.rewards else None,
            final_state=message.final_state if message.HasField("final_state") else None,
            terminated=message.terminated,
            truncated=message.truncated,
            model_id=message.model_id,
            source=message.source,
            seed=message.seed if message.HasField("seed") else None,
            trajectory_id=message.trajectory_id,
        )


def timestamp(message: Any) -> datetime.datetime:
    """A wire timestamp in UTC."""
    epoch = datetime.datetime(1970, 1, 1, tzinfo=datetime.timezone.utc)
    return epoch + datetime.timedelta(seconds=message.seconds, microseconds=message.nanos // 1000)
