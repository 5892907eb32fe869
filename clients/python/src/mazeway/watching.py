"""`watch`: pictures of a session as they change, whoever steps it."""

from __future__ import annotations

import contextlib
import dataclasses
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt

from mazeway import _arrays, _wire
from mazeway._access import Access
from mazeway._session import DEFAULT_ADDRESS, DEFAULT_TIMEOUT_SECS
from mazeway._transport import Transport, connect
from mazeway.env import MazewayEnv
from mazeway.errors import AccessDeniedError, InvalidArgumentError, LimitReachedError, UnsupportedError
from mazeway.vector import MazewayVectorEnv

#: How long a session may show nothing until the server is asked whether it is there, and how long that
#: may take.
_SILENCE_SECS = DEFAULT_TIMEOUT_SECS

#: What pictures may be.
MODES = ("ansi", "rgb_array", "png")


@dataclass(frozen=True, eq=False)
class Frame:
    """A picture and when it was."""

    #: Text, an array of shape (height, width, 3), or the bytes of a PNG file, as the mode says.
    content: str | bytes | npt.NDArray[np.uint8] = field(repr=False)
    #: Steps of the session so far.
    step: int
    #: Steps of the environment's present episode so far.
    episode_step: int
    #: Whether that episode has ended and no other has begun.
    episode_ended: bool
    #: Steps and resets since the picture before that were not shown.
    skipped: int


def watch(
    what: str | gymnasium.Env[Any, Any] | gymnasium.vector.VectorEnv[Any, Any, Any],
    index: int = 0,
    *,
    mode: str = "rgb_array",
    max_fps: float = 0.0,
    max_width: int = 0,
    address: str | None = None,
    timeout: float | None = None,
    client: str | None = None,
    token: str | None = None,
    ca: str | os.PathLike[str] | None = None,
    cert: str | os.PathLike[str] | None = None,
    key: str | os.PathLike[str] | None = None,
    insecure: bool | None = None,
) -> Iterator[Frame]:
    """Pictures of one environment of a session: the present one, then others as it changes.

    They come over a connection of their own and end with the session. Whoever reads slowly is shown fewer
    of them; the session never waits.

    Args:
        what: A Mazeway environment or vector environment, wrapped or not, or the id of a session
            (`env.unwrapped.session_id`).
        index: Which environment of the batch.
        mode: "ansi", "rgb_array" or "png".
        max_fps: Pictures a second at most, up to 60; 0 is the environment's own `render_fps`.
        max_width: Pixels across at most, not for "ansi"; 0 is as wide as the environment draws.
        address: "host:port" of the server; None is the environment's own.
        timeout: Longest wait for a change, in seconds. None waits as long as the session lives and the
            server is there: after a minute without a change it is asked, and has a minute to answer.
        client: As for the environment; None, as for all that follows, is the environment's own.
        token: What the server knows you by.
        ca: File of authorities.
        cert: File of your own certificate.
        key: File of its key.
        insecure: True sends the token unencrypted beyond this machine.
    """
    if mode not in MODES:
        raise InvalidArgumentError(f"mode: expected one of {MODES}, got {mode!r}", field="mode")
    if index < 0 or max_width < 0:
        name, value = ("index", index) if index < 0 else ("max_width", max_width)
        raise InvalidArgumentError(f"{name}: expected at least 0, got {value}", field=name)
    session_id: str
    access = Access()
    if isinstance(what, str):
        session_id, address = what, address or DEFAULT_ADDRESS
    else:
        env = what.unwrapped
        if not isinstance(env, (MazewayEnv, MazewayVectorEnv)):
            raise InvalidArgumentError(
                f"what: expected an environment of Mazeway or the id of a session, got {what!r}", field="what"
            )
        session_id, address, access = env.session_id, address or env.address, env.access
    given = {"client": client, "token": token, "ca": ca, "cert": cert, "key": key, "insecure": insecure}
    access = dataclasses.replace(
        access, **{name: value for name, value in given.items() if value is not None}
    )
    request = _wire.env.WatchRequest(
        session_id=session_id,
        index=index,
        mode=_wire.env.RenderMode[f"RENDER_MODE_{mode.upper()}"],
        max_fps=max_fps,
        max_width=max_width,
    )
    transport = connect(address, _wire.ENVIRONMENT_SERVICE, access)
    return _frames(transport, request, mode, timeout)


def _frames(transport: Transport, request: Any, mode: str, timeout: float | None) -> Iterator[Frame]:
    def ask() -> None:
        """Raises where the server does not answer: no pictures may mean that nothing happens."""
        with contextlib.suppress(AccessDeniedError, LimitReachedError, UnsupportedError):  # answers as well
            transport.unary("ListEnvironments", _wire.env.ListEnvironmentsRequest(), timeout=_SILENCE_SECS)

    try:
        for answer in transport.responses(
            "Watch",
            request,
            timeout=_SILENCE_SECS if timeout is None else timeout,
            each=True,
            alive=ask if timeout is None else None,
        ):
            content = answer.content
            if mode == "ansi":
                content = content.decode()
            elif mode == "rgb_array":
                shape = (answer.height, answer.width, 3)
                content = _arrays.unpack(content, _arrays.UINT8, shape, "content")
            yield Frame(content, answer.step, answer.episode_step, answer.episode_ended, answer.skipped)
    finally:
        transport.close()
