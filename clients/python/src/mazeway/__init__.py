"""Mazeway: Gymnasium environments over gRPC, and a learner that works out what experts want.

```python
import gymnasium, mazeway

env = gymnasium.make("mazeway/Highway-v0", address="127.0.0.1:50051")
env = mazeway.Recorder(env, style="aggressive", address="127.0.0.1:50052")
fit = mazeway.Learner("127.0.0.1:50052").fit("Highway-v0", "aggressive")
```

Importing the package registers `mazeway/Maze-v0` and `mazeway/Highway-v0` with Gymnasium.
"""

from __future__ import annotations

import gymnasium

from mazeway.client import Client, Environment, Rollout
from mazeway.env import REGISTERED, MazewayEnv
from mazeway.errors import (
    AccessDeniedError,
    AlreadyExistsError,
    CancelledError,
    ConnectionLostError,
    DeadlineExceededError,
    EpisodeLostError,
    InvalidArgumentError,
    LimitReachedError,
    MazewayError,
    NotFoundError,
    ResetNeededError,
    ServerFailureError,
    ServerUnreachableError,
    SessionInUseError,
    SessionLostError,
    UnsupportedError,
    WrongStateError,
)
from mazeway.fit import Fit, FitSummary, ModelSummary, Posterior, Progress, Queued
from mazeway.learner import Learner
from mazeway.model import Model
from mazeway.recorder import Recorder
from mazeway.trajectory import Trajectory
from mazeway.vector import MazewayVectorEnv
from mazeway.watching import Frame, watch

__version__ = "0.1.0"

__all__ = [
    "AccessDeniedError",
    "AlreadyExistsError",
    "CancelledError",
    "Client",
    "ConnectionLostError",
    "DeadlineExceededError",
    "Environment",
    "EpisodeLostError",
    "Fit",
    "FitSummary",
    "Frame",
    "InvalidArgumentError",
    "Learner",
    "LimitReachedError",
    "MazewayEnv",
    "MazewayError",
    "MazewayVectorEnv",
    "Model",
    "ModelSummary",
    "NotFoundError",
    "Posterior",
    "Progress",
    "Queued",
    "Recorder",
    "ResetNeededError",
    "Rollout",
    "ServerFailureError",
    "ServerUnreachableError",
    "SessionInUseError",
    "SessionLostError",
    "Trajectory",
    "UnsupportedError",
    "WrongStateError",
    "watch",
]

for _name, _steps in REGISTERED.items():
    gymnasium.register(
        id=f"mazeway/{_name}",
        entry_point="mazeway.env:MazewayEnv",
        vector_entry_point="mazeway.vector:MazewayVectorEnv",
        max_episode_steps=_steps,
        kwargs={"env_id": _name},
    )
