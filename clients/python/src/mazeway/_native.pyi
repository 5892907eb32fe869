"""The compiled module; `native/` has its source."""

from collections.abc import Sequence
from typing import Any, final

import numpy as np
import numpy.typing as npt

_First = tuple[npt.NDArray[Any], list[npt.NDArray[Any]]]
_Stepped = tuple[
    npt.NDArray[Any],
    npt.NDArray[np.float64],
    npt.NDArray[np.bool_],
    npt.NDArray[np.bool_],
    list[npt.NDArray[Any]],
    _First | None,
]

class CallError(Exception):
    """A call failed: status code, message, and field and description of each violation."""

    args: tuple[int, str, list[tuple[str, str]]]

class LateError(Exception):
    """The answer did not come within the timeout."""

class ForeignProcessError(Exception):
    """The object belongs to the process that this one was forked from."""

@final
class Keeper:
    """Answers the pings of silent connections; one a process."""

    def __new__(cls) -> Keeper: ...

@final
class Channel:
    """One connection to a server; connects with the first call. Timeouts are in seconds."""

    def __new__(
        cls,
        address: str,
        keeper: Keeper,
        token: str | None = None,
        ca: bytes | None = None,
        cert: bytes | None = None,
        key: bytes | None = None,
    ) -> Channel: ...
    def unary(self, path: str, request: bytes, timeout: float) -> bytes: ...
    def requests(self, path: str, requests: Sequence[bytes], timeout: float) -> bytes: ...
    def answers(self, path: str, request: bytes) -> Answers: ...
    def exchange(self, path: str) -> Exchange: ...

@final
class Answers:
    """The answers of a call, one after another."""

    def receive(self, timeout: float) -> bytes | None: ...
    def cancel(self) -> None: ...

@final
class Exchange:
    """A stream both ways, whose n-th answer is to the n-th request."""

    def send(self, request: bytes) -> None: ...
    def end(self) -> None: ...
    def receive(self, timeout: float) -> bytes | None: ...
    def cancel(self) -> None: ...

@final
class Interaction:
    """The stream of a session; opened with its first use."""

    def __new__(cls, channel: Channel, created: bytes, timeout: float) -> Interaction: ...
    def reset(
        self,
        seed: int | None = None,
        seeds: Sequence[int] | None = None,
        mask: Sequence[bool] | None = None,
    ) -> _First: ...
    def step(self, actions: npt.NDArray[np.int64]) -> _Stepped: ...
    def send(self, actions: npt.NDArray[np.int64]) -> None: ...
    def receive(self) -> _Stepped: ...
    def reset_one(self, seed: int | None = None) -> tuple[Any, dict[str, Any]]: ...
    def step_one(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]] | None: ...
    def close(self, timeout: float) -> None: ...
