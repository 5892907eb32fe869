"""`MazewayEnv`: one environment on the server as a `gymnasium.Env`."""

from __future__ import annotations

import operator
import os
from typing import Any, SupportsFloat

import gymnasium
import numpy as np
import numpy.typing as npt

from mazeway import _arrays
from mazeway._access import Access, DiscreetSpec
from mazeway._session import DEFAULT_ADDRESS, DEFAULT_TIMEOUT_SECS, Session
from mazeway.errors import InvalidArgumentError

#: What `gymnasium.make` and `make_vec` name by default.
REGISTERED = {"Highway-v0": 200, "Maze-v0": 100}

_MAX_SEED = 2**64
_NAMESPACE = "mazeway/"


def server_env_id(env_id: str) -> str:
    """The server's name of an environment: "mazeway/Maze-v0" is "Maze-v0" there."""
    return env_id.removeprefix(_NAMESPACE)


def check_seed(seed: int) -> int:
    """The seed as an int below 2^64; raises InvalidArgumentError."""
    try:
        value = operator.index(seed)
    except TypeError:
        value = -1
    if not 0 <= value < _MAX_SEED:
        raise InvalidArgumentError(
            f"seed: expected an integer from 0 to 2**64 - 1, got {seed!r}", field="seed"
        )
    return value


def refuse_options(options: dict[str, Any] | None) -> None:
    """Raises InvalidArgumentError for options that `reset` does not have."""
    if options:
        raise InvalidArgumentError(
            f"options: expected none at reset, got {sorted(options)}",
            field="options",
            hint="an environment's own options go to gymnasium.make",
        )


class MazewayEnv(DiscreetSpec, gymnasium.Env[Any, Any]):
    """One environment that runs on a Mazeway server.

    Made by `gymnasium.make("mazeway/Maze-v0", address="127.0.0.1:50051")`, which also adds Gymnasium's
    `TimeLimit`; the server itself never truncates then. The connection is opened with the first use and
    again, for a new episode, after a fork or an unpickling.

    Seeding: `reset(seed=s)` seeds `np_random` and the server's generator. A first reset without a seed
    draws the server's seed from `np_random`; later ones let the server's generator go on. Both are
    repeatable.

    Observations are `np.int64` for Discrete and arrays of float32 for Box spaces; `info` holds a Python
    number or an array for each of the server's columns.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - Gymnasium's own convention
        "render_modes": ["ansi", "rgb_array"],
        "render_fps": 5,
    }

    def __init__(
        self,
        env_id: str,
        address: str = DEFAULT_ADDRESS,
        *,
        render_mode: str | None = None,
        max_episode_steps: int | None = 0,
        action_masks: bool = False,
        timeout: float = DEFAULT_TIMEOUT_SECS,
        lease_secs: float | None = None,
        client: str = "auto",
        token: str | None = None,
        ca: str | os.PathLike[str] | None = None,
        cert: str | os.PathLike[str] | None = None,
        key: str | os.PathLike[str] | None = None,
        insecure: bool = False,
        **options: Any,
    ) -> None:
        """Describes the environment; nothing is sent yet.

        Args:
            env_id: Name on the server, such as "Maze-v0".
            address: "host:port" of the server.
            render_mode: "ansi", "rgb_array" or None.
            max_episode_steps: Steps after which the server truncates; 0 never, None the environment's
                default. `gymnasium.make` takes an argument of this name for its own `TimeLimit`.
            action_masks: True adds `info["action_mask"]`, an int8 array for `action_space.sample`.
            timeout: Longest wait for any answer, in seconds.
            lease_secs: How long the session outlives its last use; None is the server's default.
            client: "native", "grpc", or "auto" for the native one where it is built.
            token: What the service knows you by; None: MAZEWAY_TOKEN, or what MAZEWAY_TOKEN_FILE holds.
            ca: File, in PEM, of authorities that may vouch for an https:// address instead of the
                usual ones; None: MAZEWAY_TLS_CA.
            cert: File, in PEM, of your own certificate; None: MAZEWAY_TLS_CERT.
            key: File, in PEM, of its key; None: MAZEWAY_TLS_KEY.
            insecure: True sends the token unencrypted beyond this machine.
            **options: The environment's own options (see `mazeway.Client.list_environments`).
        """
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise InvalidArgumentError(
                f"render_mode: expected one of {self.metadata['render_modes']} or None, got {render_mode!r}",
                field="render_mode",
            )
        self.env_id = server_env_id(env_id)
        self.address = address
        self.access = Access(client, token, ca, cert, key, insecure)
        self.options = options
        self.render_mode = render_mode
        self._session = Session(
            address,
            self.env_id,
            options,
            max_episode_steps=max_episode_steps,
            action_masks=action_masks,
            timeout=timeout,
            lease_secs=lease_secs,
            access=self.access,
        )
        self._observation_space: gymnasium.Space[Any] | None = None
        self._action_space: gymnasium.spaces.Discrete | None = None

    @property
    def observation_space(self) -> gymnasium.Space[Any]:  # type: ignore[override]
        """Space of the observations, as the server describes it."""
        self._describe()
        assert self._observation_space is not None
        return self._observation_space

    @property
    def action_space(self) -> gymnasium.spaces.Discrete:  # type: ignore[override]
        """Space of the actions, as the server describes it."""
        self._describe()
        assert self._action_space is not None
        return self._action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begins an episode; returns the first observation and its info."""
        refuse_options(options)
        if seed is not None:
            seed = check_seed(seed)
        super().reset(seed=seed)
        self._describe()
        return self._session.reset_one(seed=seed, draw=self._draw_seed)

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Takes one action; returns observation, reward, terminated, truncated and info."""
        return self._session.step_one(action)

    def render(self) -> str | npt.NDArray[np.uint8] | None:  # type: ignore[override]
        """Draws the present state: text, or an array of shape (height, width, 3)."""
        if self.render_mode is None:
            gymnasium.logger.warn(
                "render() was called without a render mode: "
                f'gymnasium.make("mazeway/{self.env_id}", render_mode="rgb_array")'
            )
            return None
        return render(self._session, 0, self.render_mode)

    @property
    def session_id(self) -> str:
        """Name of the session on the server. Whoever knows it can watch it, and take it over."""
        return self._session.session_id

    def close(self) -> None:
        """Ends the session on the server; may be called twice."""
        self._session.close()

    def _describe(self) -> None:
        """Asks the server for the spaces, once."""
        if self._observation_space is None:
            spec = self._session.open()
            self._action_space = action_space(spec)
            self._observation_space = _arrays.space_from_wire(spec.observation_space)
            if spec.render_fps:
                self.metadata = {**self.metadata, "render_fps": spec.render_fps}

    def _draw_seed(self) -> int:
        return int(self.np_random.integers(2**63))


def action_space(spec: Any) -> gymnasium.spaces.Discrete:
    """The action space of a spec; only Discrete ones are served."""
    space = _arrays.space_from_wire(spec.action_space)
    if not isinstance(space, gymnasium.spaces.Discrete):
        raise InvalidArgumentError(f"expected a discrete action space, got {space}")
    return space


def render(session: Session, index: int, mode: str) -> str | npt.NDArray[np.uint8]:
    """Draws environment `index` of a session."""
    response = session.render(index, mode)
    if mode == "ansi":
        return response.content.decode()
    shape = (response.height, response.width, 3)
    return _arrays.unpack(response.content, _arrays.UINT8, shape, "content")
