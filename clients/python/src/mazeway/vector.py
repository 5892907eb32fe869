"""`MazewayVectorEnv`: a batch of environments in one session as a `gymnasium.vector.VectorEnv`."""

from __future__ import annotations

import enum
import os
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.vector.utils import batch_space

from mazeway import _arrays
from mazeway._access import Access, DiscreetSpec
from mazeway._link import First, Stepped
from mazeway._session import DEFAULT_ADDRESS, DEFAULT_TIMEOUT_SECS, Session
from mazeway.env import MazewayEnv, action_space, check_seed, refuse_options, render, server_env_id
from mazeway.errors import InvalidArgumentError

try:
    from gymnasium.vector import AutoresetMode
except ImportError:  # Gymnasium 1.0 knows the first mode only and has no name for it

    class AutoresetMode(enum.Enum):  # type: ignore[no-redef]
        """What happens to an environment whose episode has ended, as Gymnasium 1.1 names it."""

        NEXT_STEP = "NextStep"
        SAME_STEP = "SameStep"
        DISABLED = "Disabled"


Flags = npt.NDArray[np.bool_]


class MazewayVectorEnv(DiscreetSpec, gymnasium.vector.VectorEnv[Any, Any, Any]):
    """A batch of environments that runs on a Mazeway server, stepped with one message.

    Made by `gymnasium.make_vec("mazeway/Maze-v0", num_envs=64, address="127.0.0.1:50051")`. Behaves as a
    `gymnasium.vector.SyncVectorEnv` of `MazewayEnv`s: environment i, seeded with seed + i, is the same as
    a single one seeded so.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - Gymnasium's own convention
        **MazewayEnv.metadata,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        env_id: str,
        num_envs: int = 1,
        address: str = DEFAULT_ADDRESS,
        *,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
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
        """Opens the session.

        Args:
            env_id: Name on the server, such as "Maze-v0".
            num_envs: How many environments.
            address: "host:port" of the server.
            render_mode: "ansi", "rgb_array" or None.
            max_episode_steps: Steps after which an episode is truncated; None is the environment's
                default, 0 or -1 never.
            autoreset_mode: An `AutoresetMode` or its value, such as "SameStep".
            action_masks: True adds `infos["action_mask"]`, int8, shape (num_envs, n_actions).
            timeout: Longest wait for any answer, in seconds.
            lease_secs: How long the session outlives its last use; None is the server's default.
            client: "native", "grpc", or "auto" for the native one where it is built.
            token: What the service knows you by; None: MAZEWAY_TOKEN, or what MAZEWAY_TOKEN_FILE holds.
            ca: File, in PEM, of authorities that may vouch for an https:// address instead of the
                usual ones; None: MAZEWAY_TLS_CA.
            cert: File, in PEM, of your own certificate; None: MAZEWAY_TLS_CERT.
            key: File, in PEM, of its key; None: MAZEWAY_TLS_KEY.
            insecure: True sends the token unencrypted beyond this machine.
            **options: The environment's own options.
        """
        super().__init__()
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise InvalidArgumentError(
                f"render_mode: expected one of {self.metadata['render_modes']} or None, got {render_mode!r}",
                field="render_mode",
            )
        self.autoreset_mode = _autoreset_mode(autoreset_mode)
        self.env_id = server_env_id(env_id)
        self.address = address
        self.access = Access(client, token, ca, cert, key, insecure)
        self.options = options
        self.num_envs = num_envs
        self.render_mode = render_mode
        self._session = Session(
            address,
            self.env_id,
            options,
            num_envs=num_envs,
            autoreset_mode=self.autoreset_mode.name,
            max_episode_steps=0 if max_episode_steps == -1 else max_episode_steps,
            action_masks=action_masks,
            timeout=timeout,
            lease_secs=lease_secs,
            access=self.access,
        )
        spec = self._session.open()
        self.metadata = {**type(self).metadata, "autoreset_mode": self.autoreset_mode}
        if spec.render_fps:
            self.metadata["render_fps"] = spec.render_fps
        self.single_action_space = action_space(spec)
        self.single_observation_space = _arrays.space_from_wire(spec.observation_space)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._columns = [(column.name, f"_{column.name}") for column in spec.info_columns]

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[npt.NDArray[Any], dict[str, Any]]:
        """Begins episodes.

        Args:
            seed: Environment i gets seed + i; or one each, None where its generator is to go on.
            options: `{"reset_mask": flags}` of shape (num_envs,) resets these alone; the others keep
                their episode and their last observation.

        Returns:
            Observations, shape (num_envs, …), and infos of the environments that were reset.
        """
        options = dict(options or {})
        mask = self._check_mask(options.pop("reset_mask", None))
        refuse_options(options)
        if seed is None or isinstance(seed, (int, np.integer)):
            seed = None if seed is None else check_seed(seed)
            super().reset(seed=seed)
            observations, columns = self._reset(seed, None, mask)
        else:
            observations, columns = self._reset_each(list(seed), mask)
        return observations, self._infos(columns, mask)

    def step(
        self, actions: Any
    ) -> tuple[npt.NDArray[Any], npt.NDArray[np.float64], Flags, Flags, dict[str, Any]]:
        """Takes one action an environment.

        Returns:
            Observations, shape (num_envs, …); rewards, terminated and truncated, shape (num_envs,);
            infos, with the last observation and info of ended episodes in "final_obs" and "final_info"
            under SAME_STEP.
        """
        return self._said(self._session.step(actions))

    def send(self, actions: Any) -> None:
        """Sends one action an environment and returns at once: the agent may work while the server does.

        `recv` brings what came of them. Several steps may be under way; they are answered in order.
        """
        self._session.send(actions)

    def recv(self) -> tuple[npt.NDArray[Any], npt.NDArray[np.float64], Flags, Flags, dict[str, Any]]:
        """What came of the oldest actions that were sent and not yet received, as `step` returns it."""
        return self._said(self._session.receive())

    def step_async(self, actions: Any) -> None:
        """`send` by the name that `gymnasium.vector.AsyncVectorEnv` has for it."""
        self.send(actions)

    def step_wait(self) -> tuple[npt.NDArray[Any], npt.NDArray[np.float64], Flags, Flags, dict[str, Any]]:
        """`recv` by the name that `gymnasium.vector.AsyncVectorEnv` has for it."""
        return self.recv()

    def render(self) -> tuple[Any, ...] | None:
        """Draws every environment."""
        if self.render_mode is None:
            gymnasium.logger.warn("render() was called without a render mode")
            return None
        return tuple(render(self._session, i, self.render_mode) for i in range(self.num_envs))

    @property
    def session_id(self) -> str:
        """Name of the session on the server. Whoever knows it can watch it, and take it over."""
        return self._session.session_id

    def close_extras(self, **_kwargs: Any) -> None:
        """Ends the session on the server."""
        if hasattr(self, "_session"):  # Gymnasium 1.0 closes what failed to be made, too
            self._session.close()

    def _reset(self, seed: int | None, seeds: list[int] | None, mask: Flags | None) -> First:
        return self._session.reset(
            seed=seed,
            seeds=seeds,
            mask=mask,
            draw=lambda: int(self.np_random.integers(2**63)),
        )

    def _reset_each(self, seeds: list[int | None], mask: Flags | None) -> First:
        """Resets with a seed each; environments without one go on with their generator."""
        if len(seeds) != self.num_envs:
            raise InvalidArgumentError(
                f"seed: expected an int or {self.num_envs} of them, got {len(seeds)}", field="seed"
            )
        given = np.array([s is not None for s in seeds])
        if not given.any():
            return self._reset(None, None, mask)
        values = [0 if s is None else check_seed(s) for s in seeds]
        if given.all():
            return self._reset(None, values, mask)
        every = np.ones(self.num_envs, np.bool_) if mask is None else mask
        if not self._session.seeded:  # all have a generator from here on
            self._reset(None, None, mask)
        elif (every & ~given).any():
            self._reset(None, None, every & ~given)
        return self._reset(None, values, every & given)

    def _check_mask(self, mask: Any) -> Flags | None:
        if mask is None:
            return None
        if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_:
            kind = mask.dtype if isinstance(mask, np.ndarray) else type(mask).__name__
            raise InvalidArgumentError(
                f"reset_mask: expected a numpy array of bool, got {kind}", field="reset_mask"
            )
        if mask.shape != (self.num_envs,) or not mask.any():
            raise InvalidArgumentError(
                f"reset_mask: expected shape ({self.num_envs},) with at least one True, "
                f"got shape {mask.shape} with {int(mask.sum())}",
                field="reset_mask",
            )
        return mask

    def _said(
        self, stepped: Stepped
    ) -> tuple[npt.NDArray[Any], npt.NDArray[np.float64], Flags, Flags, dict[str, Any]]:
        observations, rewards, terminated, truncated, columns, last = stepped
        infos = self._infos(columns, None)
        if last is not None:
            infos = {**self._final(last, terminated | truncated), **infos}
        return observations, rewards, terminated, truncated, infos

    def _infos(self, columns: list[npt.NDArray[Any]], mask: Flags | None) -> dict[str, Any]:
        """Each column and, as Gymnasium has it, `_column`: which rows mean something; None is all."""
        infos: dict[str, Any] = {}
        for (name, masked), values in zip(self._columns, columns, strict=True):
            infos[name] = values
            if mask is None:
                infos[masked] = np.ones(self.num_envs, np.bool_)
            else:
                values[~mask] = 0
                infos[masked] = mask.copy()
        return infos

    def _final(self, last: First, ended: Flags) -> dict[str, Any]:
        """Last observations and infos of the episodes that ended in this step."""
        rows, columns = last
        observations = np.full(self.num_envs, None, dtype=object)
        for i in np.flatnonzero(ended):
            observations[i] = rows[i].copy()
        return {
            "final_obs": observations,
            "_final_obs": ended.copy(),
            "final_info": self._infos(columns, ended),
            "_final_info": ended.copy(),
        }


def _autoreset_mode(mode: AutoresetMode | str) -> AutoresetMode:
    if isinstance(mode, AutoresetMode):
        return mode
    for known in AutoresetMode:
        if mode in (known.value, known.name):
            return known
    names = ", ".join(repr(known.value) for known in AutoresetMode)
    raise InvalidArgumentError(
        f"autoreset_mode: expected one of {names}, got {mode!r}", field="autoreset_mode"
    )
