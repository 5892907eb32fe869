"""How a service is reached: by which client, with what token and which certificates.

Invariants: a token is shown by no text of ours, and leaves the machine unencrypted only where that was asked
for by name. What is not given is looked up in the environment when a connection is made, so that a worker
process finds its own.
"""

from __future__ import annotations

import dataclasses
import ipaddress
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mazeway.errors import InvalidArgumentError

#: The token itself, a file that holds it, and files in PEM, for what is not given as an argument.
TOKEN_VARIABLE = "MAZEWAY_TOKEN"
TOKEN_FILE_VARIABLE = "MAZEWAY_TOKEN_FILE"
_FILE_VARIABLES = {"ca": "MAZEWAY_TLS_CA", "cert": "MAZEWAY_TLS_CERT", "key": "MAZEWAY_TLS_KEY"}


class Secret(str):
    """A text that does not show itself."""

    __slots__ = ()

    def __repr__(self) -> str:
        """Stars."""
        return "'***'"


def hidden(arguments: dict[str, Any]) -> dict[str, Any]:
    """Arguments whose token does not show itself, as for Gymnasium's record of them."""
    token = arguments.get("token")
    return arguments if token is None else {**arguments, "token": Secret(token)}


class DiscreetSpec:
    """An environment whose `spec`, which shows its arguments, shows no token."""

    _spec: Any = None

    @property
    def spec(self) -> Any:
        """What `gymnasium.make` or `gymnasium.make_vec` was given."""
        return self._spec

    @spec.setter
    def spec(self, spec: Any) -> None:
        if spec is not None and spec.kwargs.get("token") is not None:
            spec.kwargs = hidden(spec.kwargs)
        self._spec = spec


@dataclass(frozen=True)
class Access:
    """What goes along with an address."""

    client: str = "auto"
    token: str | None = dataclasses.field(default=None, repr=False)
    #: Paths of files in PEM.
    ca: str | os.PathLike[str] | None = None
    cert: str | os.PathLike[str] | None = None
    key: str | os.PathLike[str] | None = None
    #: Whether the token may leave the machine unencrypted.
    insecure: bool = False

    def resolve(self, target: str, *, secure: bool) -> Credentials:
        """Everything as it is sent to `target`; raises InvalidArgumentError for what does not go together."""
        token = self._find_token()
        files: dict[str, bytes | None] = {}
        for name, variable in _FILE_VARIABLES.items():
            given = getattr(self, name)
            if given is not None and not secure:
                raise InvalidArgumentError(
                    f"{name}: expected an address that begins with https://, got {target!r}", field=name
                )
            path = given if given is not None else os.environ.get(variable, "")
            files[name] = _read(path, name) if path and secure else None
        for one, other in (("cert", "key"), ("key", "cert")):
            if files[one] is not None and files[other] is None:
                raise InvalidArgumentError(f"{other}: expected a file beside {one}, got none", field=other)
        if token is not None and not secure and not self.insecure and not _is_local(target):
            raise InvalidArgumentError(
                f"token: expected an https:// address, for {target!r} would send it unencrypted",
                field="token",
                hint="insecure=True where the network is trusted",
            )
        return Credentials(token=token, **files)

    def _find_token(self) -> str | None:
        token = self.token
        if token is None:
            token = os.environ.get(TOKEN_VARIABLE) or None
        if token is None:
            path = os.environ.get(TOKEN_FILE_VARIABLE)
            token = None if not path else _read(path, TOKEN_FILE_VARIABLE).decode(errors="replace")
        if token is None:
            return None
        token = str(token).strip()
        if not token or not all("!" <= character <= "~" for character in token):
            raise InvalidArgumentError(
                "token: expected visible ASCII characters, got something else", field="token"
            )
        return token


@dataclass(frozen=True, repr=False)
class Credentials:
    """The token, and the contents of files in PEM."""

    token: str | None = None
    ca: bytes | None = None
    cert: bytes | None = None
    key: bytes | None = None


def _read(path: str | os.PathLike[str], field: str) -> bytes:
    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise InvalidArgumentError(f"{field}: cannot read {path} ({error.strerror})", field=field) from None


def _is_local(target: str) -> bool:
    """Whether what is sent there does not leave the machine."""
    if target.startswith("unix:"):
        return True
    host = target.rpartition(":")[0].strip("[]")
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
