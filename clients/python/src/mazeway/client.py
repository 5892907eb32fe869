"""`Client`: what the environment server offers beside stepping: catalogue, models, roll-outs."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt

from mazeway import _arrays, _wire
from mazeway._access import Access
from mazeway._session import DEFAULT_ADDRESS, DEFAULT_TIMEOUT_SECS, Session
from mazeway._transport import connect
from mazeway.env import check_seed, server_env_id
from mazeway.errors import InvalidArgumentError
from mazeway.model import Model
from mazeway.trajectory import Trajectory


@dataclass(frozen=True)
class Environment:
    """An environment that the server offers, with default options."""

    env_id: str
    description: str
    observation_space: gymnasium.Space[Any]
    action_space: gymnasium.Space[Any]
    #: Default and explanation of each option.
    options: dict[str, tuple[Any, str]]
    #: What each scripted driver does.
    drivers: dict[str, str]
    #: Meaning of each info column, with its unit.
    infos: dict[str, str]
    #: Names of the reward tables of its model; the first is the default.
    styles: list[str]
    n_states: int
    n_actions: int
    max_episode_steps: int


@dataclass(frozen=True, eq=False)
class Rollout:
    """Episodes that were driven on the server, one after another in flat arrays."""

    env_id: str
    n_states: int
    n_actions: int
    #: "driver:NAME" or "policy".
    source: str
    #: Episode i was seeded with seed + i.
    seed: int
    #: Steps of each episode, shape (episodes,).
    lengths: npt.NDArray[np.int32]
    #: State before each step, shape (sum of lengths,); empty where only totals were asked for.
    states: npt.NDArray[np.int32]
    #: Action of each step, shape (sum of lengths,).
    actions: npt.NDArray[np.int32]
    #: Reward of each step, shape (sum of lengths,).
    rewards: npt.NDArray[np.float64]
    #: State after the last step of each episode, shape (episodes,).
    final_states: npt.NDArray[np.int32]
    #: Whether each episode came to an end of its own, shape (episodes,).
    terminated: npt.NDArray[np.bool_]
    #: Sum of the rewards of each episode, shape (episodes,).
    returns: npt.NDArray[np.float64]
    #: Sums of the info columns over each episode, shape (episodes,) each.
    totals: dict[str, npt.NDArray[np.float64]]

    def per_step(self, name: str) -> float:
        """Mean of a total per step, such as collisions a step."""
        return float(self.totals[name].sum() / self.lengths.sum())

    def trajectories(self, style: str, *, model_id: str = "") -> list[Trajectory]:
        """The episodes as demonstrations of a style, for `Learner.record`."""
        ends = np.cumsum(self.lengths)
        return [
            Trajectory(
                env_id=self.env_id,
                style=style,
                model_id=model_id,
                source=self.source,
                seed=self.seed + i if self.source.startswith("driver:") else None,
                n_states=self.n_states,
                n_actions=self.n_actions,
                states=self.states[end - length : end],
                actions=self.actions[end - length : end],
                rewards=self.rewards[end - length : end],
                final_state=int(self.final_states[i]),
                terminated=bool(self.terminated[i]),
            )
            for i, (end, length) in enumerate(zip(ends, self.lengths, strict=True))
        ]

    def __len__(self) -> int:
        """Number of episodes."""
        return len(self.lengths)

    def __repr__(self) -> str:
        """What was driven, without the arrays."""
        return (
            f"Rollout({self.env_id!r}, {self.source!r}, episodes={len(self)}, "
            f"steps={int(self.lengths.sum())}, mean_return={self.returns.mean():.4g})"
        )


class Client:
    """Speaks with the environment server at `address`."""

    def __init__(
        self,
        address: str = DEFAULT_ADDRESS,
        *,
        timeout: float = DEFAULT_TIMEOUT_SECS,
        client: str = "auto",
        token: str | None = None,
        ca: str | os.PathLike[str] | None = None,
        cert: str | os.PathLike[str] | None = None,
        key: str | os.PathLike[str] | None = None,
        insecure: bool = False,
    ) -> None:
        """Describes the server; nothing is sent yet.

        Args:
            address: "host:port" of the server, or "https://host:port".
            timeout: Longest wait for a call, in seconds.
            client: "native", "grpc", or "auto" for the native one where it is built.
            token: What the service knows you by; None: MAZEWAY_TOKEN, or what MAZEWAY_TOKEN_FILE holds.
            ca: File, in PEM, of authorities that may vouch for an https:// address instead of the
                usual ones; None: MAZEWAY_TLS_CA.
            cert: File, in PEM, of your own certificate; None: MAZEWAY_TLS_CERT.
            key: File, in PEM, of its key; None: MAZEWAY_TLS_KEY.
            insecure: True sends the token unencrypted beyond this machine.
        """
        self.address = address
        self.timeout = timeout
        self.access = Access(client, token, ca, cert, key, insecure)
        self._transport = connect(address, _wire.ENVIRONMENT_SERVICE, self.access)

    def __enter__(self) -> Client:
        """Itself."""
        return self

    def __exit__(self, *_exception: object) -> None:
        """Closes the connection."""
        self.close()

    def __repr__(self) -> str:
        """Where it points."""
        return f"Client({self.address!r})"

    def close(self) -> None:
        """Frees the connection; may be called twice."""
        self._transport.close()

    def list_environments(self) -> list[Environment]:
        """The catalogue, in alphabetical order."""
        request = _wire.env.ListEnvironmentsRequest()
        response = self._transport.unary("ListEnvironments", request, timeout=self.timeout)
        return [_environment(spec) for spec in response.environments]

    def model(self, env_id: str, **options: Any) -> Model:
        """The tabular model of an environment under its options."""
        return Model.from_parts(self.model_parts(env_id, options))

    def model_parts(self, env_id: str, options: Mapping[str, Any]) -> Any:
        """The wire's parts of a model, to be passed on as they are."""
        request = _wire.env.GetModelRequest(env_id=server_env_id(env_id), options=_arrays.struct(options))
        for response in self._transport.responses("GetModel", request, timeout=self.timeout):
            yield response.part

    def rollout(
        self,
        env_id: str,
        *,
        driver: str | None = None,
        policy: npt.ArrayLike | None = None,
        episodes: int = 1,
        steps: int = 100,
        seed: int = 0,
        burn_in_steps: int = 0,
        totals_only: bool = False,
        options: Mapping[str, Any] | None = None,
    ) -> Rollout:
        """Runs episodes in a closed loop on the server.

        Args:
            env_id: Which environment.
            driver: A scripted driver of it, or "random" (the default where no policy is given).
            policy: pi(a|s) of shape (n_states, n_actions) instead; an action is drawn each step.
            episodes: How many.
            steps: Longest length of each.
            seed: Episode i is seeded with seed + i.
            burn_in_steps: Steps driven before the recording of each episode begins.
            totals_only: Leaves the arrays of every step out.
            options: The environment's own options.
        """
        if driver is not None and policy is not None:
            raise InvalidArgumentError("expected a driver or a policy, got both", field="policy")
        request = _wire.env.RolloutRequest(
            env_id=server_env_id(env_id),
            options=_arrays.struct(options or {}),
            seed=check_seed(seed),
            burn_in_steps=burn_in_steps,
            totals_only=totals_only,
            compact=True,  # the same numbers in fewer bytes
        )
        for name, value in (("episodes", episodes), ("steps", steps)):
            if value < 1:
                raise InvalidArgumentError(f"{name}: expected at least 1, got {value}", field=name)
            setattr(request, name, value)
        if policy is None:
            request.driver = driver or "random"
        else:
            table = np.asarray(policy, np.float64)
            if table.ndim != 2:
                raise InvalidArgumentError(
                    f"policy: expected shape (n_states, n_actions), got {table.shape}",
                    field="policy",
                )
            request.policy.probabilities = table.astype(_arrays.FLOAT64).tobytes()
        sizes = self._sizes(request.env_id, options or {})
        source = "policy" if policy is not None else f"driver:{request.driver}"
        parts = list(self._transport.responses("Rollout", request, timeout=self.timeout))
        joined: dict[str, npt.NDArray[Any]] = {
            "states": _join(_integers(part.states, part.states_dtype) for part in parts),
            "actions": _join(_integers(part.actions, part.actions_dtype) for part in parts),
            "rewards": _join(_rewards(part) for part in parts),
        }
        joined |= {
            name: _join(_arrays.unpack(getattr(part, name), dtype) for part in parts)
            for name, dtype in (
                ("lengths", _arrays.INT32),
                ("final_states", _arrays.INT32),
                ("returns", _arrays.FLOAT64),
                ("terminated", _arrays.UINT8),
            )
        }
        totals: dict[str, list[npt.NDArray[np.float64]]] = {}
        for part in parts:
            for total in part.totals:
                totals.setdefault(total.name, []).append(_arrays.unpack(total.values, _arrays.FLOAT64))
        joined["terminated"] = joined["terminated"] != 0
        return Rollout(
            env_id=request.env_id,
            n_states=sizes[0],
            n_actions=sizes[1],
            source=source,
            seed=seed,
            totals={name: np.concatenate(values) for name, values in totals.items()},
            **joined,
        )

    def _sizes(self, env_id: str, options: Mapping[str, Any]) -> tuple[int, int]:
        """States and actions under the options, which may change them (a maze's layout does)."""
        session = Session(self.address, env_id, dict(options), timeout=self.timeout, access=self.access)
        try:
            spec = session.open()
            return spec.n_states, spec.n_actions
        finally:
            session.close()


def _join(parts: Iterable[npt.NDArray[Any]]) -> npt.NDArray[Any]:
    return np.concatenate(list(parts))


def _integers(data: bytes, dtype: int) -> npt.NDArray[np.int32]:
    """States or actions, of the element type that the message tells; none means int32."""
    return np.frombuffer(data, _arrays.dtype_of(dtype) if dtype else _arrays.INT32).astype(np.int32)


def _rewards(part: Any) -> npt.NDArray[np.float64]:
    """The rewards of a message, or those whose ranks it holds."""
    if not part.reward_values:
        return _arrays.unpack(part.rewards, _arrays.FLOAT64)
    values = _arrays.unpack(part.reward_values, _arrays.FLOAT64)
    return values[np.frombuffer(part.rewards, _arrays.UINT8)]


def _environment(spec: Any) -> Environment:
    return Environment(
        env_id=spec.env_id,
        description=spec.description,
        observation_space=_arrays.space_from_wire(spec.observation_space),
        action_space=_arrays.space_from_wire(spec.action_space),
        options={o.name: (_arrays.plain(o.default_value), o.description) for o in spec.options},
        drivers={driver.name: driver.description for driver in spec.drivers},
        infos={c.name: f"{c.description} ({c.unit})" for c in spec.info_columns},
        styles=list(spec.styles),
        n_states=spec.n_states,
        n_actions=spec.n_actions,
        max_episode_steps=spec.max_episode_steps,
    )
