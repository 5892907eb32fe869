"""What can go wrong, as exceptions of one line each.

Every error is a `MazewayError` and, where Python has a built-in word for it, that as well: a wrong
argument is also a `ValueError`, an absent server also a `ConnectionError`.
"""

from __future__ import annotations

from typing import Any

import grpc
import gymnasium

from mazeway import _wire


class MazewayError(Exception):
    """Anything that Mazeway raises. `hint` says what to do next, where that is known."""

    def __init__(self, message: str, *, hint: str = "") -> None:
        """Takes what was expected and what came, and the next thing to do."""
        super().__init__(message)
        self.message = message
        self.hint = hint

    def __str__(self) -> str:
        """One line: the message, then the hint."""
        return f"{self.message}; hint: {self.hint}" if self.hint else self.message

    def __reduce__(self) -> tuple[object, ...]:
        """Survives pickling, so that a worker process can hand it to its parent."""
        return (_rebuild, (type(self), self.message, self.__dict__.copy()))


def _rebuild(kind: type[MazewayError], message: str, state: dict[str, object]) -> MazewayError:
    error = kind.__new__(kind)
    Exception.__init__(error, message)
    error.__dict__.update(state)
    return error


class ServerUnreachableError(MazewayError, ConnectionError):
    """Nothing answers at the address."""


class DeadlineExceededError(MazewayError, TimeoutError):
    """The answer did not come within the timeout."""


class SessionLostError(MazewayError):
    """The server no longer knows the session: its lease expired or the server was restarted."""


class InvalidArgumentError(MazewayError, ValueError):
    """A value is not what it should be; `field` names it as the wire does."""

    def __init__(self, message: str, *, field: str = "", hint: str = "") -> None:
        """Takes the field beside the message."""
        super().__init__(message, hint=hint)
        self.field = field


class NotFoundError(MazewayError, LookupError):
    """There is no such environment, model, trajectory or fit."""


class AlreadyExistsError(MazewayError):
    """The id is taken by another content."""


class WrongStateError(MazewayError, RuntimeError):
    """The call makes no sense now, such as a step after the episode's end."""


class ResetNeededError(WrongStateError, gymnasium.error.ResetNeeded):
    """`reset` must come first."""


class LimitReachedError(MazewayError):
    """The server refuses for want of room: too many sessions, too large a batch, a full disk."""


class CancelledError(MazewayError):
    """The call was cancelled."""


class UnsupportedError(MazewayError, NotImplementedError):
    """The server does not know the method: it is older than this client."""


class ServerFailureError(MazewayError):
    """The server failed; this is a defect of the server, not of the call."""


_BY_CODE: dict[grpc.StatusCode, type[MazewayError]] = {
    grpc.StatusCode.UNAVAILABLE: ServerUnreachableError,
    grpc.StatusCode.DEADLINE_EXCEEDED: DeadlineExceededError,
    grpc.StatusCode.INVALID_ARGUMENT: InvalidArgumentError,
    grpc.StatusCode.OUT_OF_RANGE: InvalidArgumentError,
    grpc.StatusCode.NOT_FOUND: NotFoundError,
    grpc.StatusCode.ALREADY_EXISTS: AlreadyExistsError,
    grpc.StatusCode.FAILED_PRECONDITION: WrongStateError,
    grpc.StatusCode.RESOURCE_EXHAUSTED: LimitReachedError,
    grpc.StatusCode.CANCELLED: CancelledError,
    grpc.StatusCode.UNIMPLEMENTED: UnsupportedError,
}


def _violations(error: grpc.RpcError) -> list[tuple[str, str]]:
    """Field and description of each google.rpc.BadRequest violation in the trailers."""
    metadata: Any = error.trailing_metadata() or ()
    for key, value in metadata:
        if key == "grpc-status-details-bin":
            return [
                (violation.field, violation.description)
                for detail in _wire.status.Status.FromString(value).details
                if detail.type_url.endswith("/google.rpc.BadRequest")
                for violation in _wire.status.BadRequest.FromString(detail.value).field_violations
            ]
    return []


def from_rpc_error(error: grpc.RpcError, *, address: str, start: str) -> MazewayError:
    """Translates a failed call.

    Args:
        error: What grpcio raised.
        address: Where the call went.
        start: The command that starts such a server, for the hint.
    """
    code = error.code()
    details = " ".join((error.details() or code.name.lower().replace("_", " ")).split())
    if code is grpc.StatusCode.UNAVAILABLE:
        cause = details.rpartition(": ")[2].lower()  # grpcio prefixes every layer it went through
        return ServerUnreachableError(
            f"no server answers at {address} ({cause})", hint=f"start one with: {start}"
        )
    if code is grpc.StatusCode.UNIMPLEMENTED:
        return UnsupportedError(
            f"the server at {address} does not know this method ({details})",
            hint=f"check that the address is right and the server current: {start}",
        )
    kind = _BY_CODE.get(code, ServerFailureError)
    if kind is ServerFailureError:
        return ServerFailureError(
            f"the server at {address} failed: {code.name.lower().replace('_', ' ')}: {details}"
        )
    if kind is InvalidArgumentError:
        violations = _violations(error)
        field = violations[0][0] if violations else ""
        named = details if field.rpartition(".")[2] in details else f"{field}: {details}"
        further = [f"{f}: {d}" for f, d in violations[1:]]
        return InvalidArgumentError("; ".join([named, *further]), field=field)
    return kind(details)
