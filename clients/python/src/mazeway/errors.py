"""What can go wrong, as exceptions of one line each.

Every error is a `MazewayError` and, where Python has a built-in word for it, that as well: a wrong
argument is also a `ValueError`, an absent server also a `ConnectionError`.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import gymnasium


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


class AccessDeniedError(MazewayError, PermissionError):
    """The service wants a token or a certificate, or another one, or the token is not good for this."""


class EpisodeLostError(MazewayError):
    """The episode cannot go on: nobody knows whether its last step was made. `reset` begins another."""


class ConnectionLostError(EpisodeLostError, ServerUnreachableError):
    """The connection broke during a step."""


class SessionLostError(EpisodeLostError):
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


class SessionInUseError(WrongStateError):
    """Another call or stream has the session at this moment."""


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


#: gRPC's status codes by number.
_CODES = (
    "ok",
    "cancelled",
    "unknown",
    "invalid argument",
    "deadline exceeded",
    "not found",
    "already exists",
    "permission denied",
    "resource exhausted",
    "failed precondition",
    "aborted",
    "out of range",
    "unimplemented",
    "internal",
    "unavailable",
    "data loss",
    "unauthenticated",
)

_KINDS: dict[str, type[MazewayError]] = {
    "cancelled": CancelledError,
    "invalid argument": InvalidArgumentError,
    "deadline exceeded": DeadlineExceededError,
    "not found": NotFoundError,
    "already exists": AlreadyExistsError,
    "resource exhausted": LimitReachedError,
    "failed precondition": WrongStateError,
    "out of range": InvalidArgumentError,
}

#: How the operating system's number of an error is added to its words by some.
_OS_ERROR = re.compile(r" \(os error \d+\)$")


def from_status(
    code: int,
    details: str,
    violations: Sequence[tuple[str, str]],
    *,
    address: str,
    start: str,
) -> MazewayError:
    """Translates a failed call.

    Args:
        code: gRPC's status code.
        details: What the server says, or what happened to the connection.
        violations: Field and description of each violation that the server names.
        address: Where the call went.
        start: The command that starts such a server, for the hint.
    """
    name = _CODES[code] if 0 <= code < len(_CODES) else str(code)
    details = " ".join(details.split()) or name
    if name == "unavailable":
        # Every layer that an error went through puts its own words before it.
        cause = _OS_ERROR.sub("", details.rpartition(": ")[2]).lower()
        return ServerUnreachableError(
            f"no server answers at {address} ({cause})", hint=f"start one with: {start}"
        )
    if name == "unimplemented":
        return UnsupportedError(
            f"the server at {address} does not know this method ({details})",
            hint=f"check that the address is right and the server current: {start}",
        )
    if name in ("unauthenticated", "permission denied"):
        return AccessDeniedError(
            f"{address} denies access ({details})",
            hint="give a token that is good for this: token=, MAZEWAY_TOKEN or MAZEWAY_TOKEN_FILE",
        )
    if name == "aborted":
        return ConnectionLostError(
            details, hint=f"call reset() to begin anew; where no server is left, start one with: {start}"
        )
    kind = _KINDS.get(name)
    if kind is WrongStateError and violations and violations[0][0] == "session_id":
        kind = SessionInUseError
    if kind is None:
        return ServerFailureError(f"the server at {address} failed: {name}: {details}")
    if kind is InvalidArgumentError:
        field = violations[0][0] if violations else ""
        named = details if field.rpartition(".")[2] in details else f"{field}: {details}"
        further = [f"{f}: {d}" for f, d in violations[1:]]
        return InvalidArgumentError("; ".join([named, *further]), field=field)
    return kind(details)
