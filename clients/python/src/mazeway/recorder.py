"""`Recorder`: a Gymnasium wrapper that records episodes into the learner."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import os
from typing import Any, SupportsFloat

import gymnasium
import numpy as np

from mazeway import _wire
from mazeway._access import Access, Secret
from mazeway._session import DEFAULT_TIMEOUT_SECS
from mazeway._transport import connect
from mazeway._uploader import Uploader
from mazeway.client import Client
from mazeway.env import MazewayEnv, server_env_id
from mazeway.errors import InvalidArgumentError
from mazeway.learner import DEFAULT_LEARNER_ADDRESS, Learner
from mazeway.model import Model
from mazeway.trajectory import Trajectory


class Recorder(gymnasium.Wrapper[Any, Any, Any, Any], gymnasium.utils.RecordConstructorArgs):
    """Records the episodes of any environment with Discrete observations and actions.

    An episode is sent when it ends, and is on the learner's stable storage before the next `reset`
    returns; `flush` waits for it earlier, `close` sends the last, unfinished episode too. Where the
    learner cannot be reached, the call tries again until `timeout` and then raises; the episodes stay in
    `pending` and go out, under the same ids and so stored once, with the next `reset`, `flush` or
    `close`.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        style: str,
        address: str = DEFAULT_LEARNER_ADDRESS,
        env_id: str | None = None,
        model_id: str | None = "",
        *,
        source: str = "python",
        timeout: float = DEFAULT_TIMEOUT_SECS,
        client: str = "auto",
        token: str | None = None,
        ca: str | os.PathLike[str] | None = None,
        cert: str | os.PathLike[str] | None = None,
        key: str | os.PathLike[str] | None = None,
        insecure: bool = False,
    ) -> None:
        """Wraps an environment; nothing is sent yet.

        Args:
            env: The environment.
            style: What the demonstrator is after, such as "aggressive".
            address: "host:port" of the learner.
            env_id: Name to record under; None is the environment's own.
            model_id: Model in which the episodes were made. Empty: the environment's own model, where
                it has one (Mazeway's environments, and those with a toy-text table `P`), is put into
                the learner. None: none.
            source: Who acts.
            timeout: Longest wait for the learner, in seconds.
            client: "native", "grpc", or "auto" for the native one where it is built.
            token: What the learner knows you by; None: MAZEWAY_TOKEN, or what MAZEWAY_TOKEN_FILE holds.
            ca: File, in PEM, of authorities that may vouch for an https:// address instead of the
                usual ones; None: MAZEWAY_TLS_CA.
            cert: File, in PEM, of your own certificate; None: MAZEWAY_TLS_CERT.
            key: File, in PEM, of its key; None: MAZEWAY_TLS_KEY.
            insecure: True sends the token unencrypted beyond this machine.
        """
        gymnasium.utils.RecordConstructorArgs.__init__(
            self,
            style=style,
            address=address,
            env_id=env_id,
            model_id=model_id,
            source=source,
            timeout=timeout,
            client=client,
            token=None if token is None else Secret(token),
            ca=ca,
            cert=cert,
            key=key,
            insecure=insecure,
        )
        gymnasium.Wrapper.__init__(self, env)
        observations: Any = env.observation_space
        actions: Any = env.action_space
        for name, space in (("observation", observations), ("action", actions)):
            if not isinstance(space, gymnasium.spaces.Discrete):
                raise InvalidArgumentError(
                    f"expected a Discrete {name} space, got {space}", field=f"{name}_space"
                )
        if not style:
            raise InvalidArgumentError("style: expected a name, got an empty one", field="style")
        self.style = style
        self.learner_address = address
        self.recorded_env_id = env_id or _env_id(env)
        self.model_id = model_id
        self.source = source
        self._n_states, self._first_state = int(observations.n), int(observations.start)
        self._n_actions, self._first_action = int(actions.n), int(actions.start)
        self._access = Access(client, token, ca, cert, key, insecure)
        dial = functools.partial(connect, address, _wire.LEARNER_SERVICE, self._access)
        self._uploader = Uploader(dial, timeout)
        self._timeout = timeout
        self._forget()

    @property
    def pending(self) -> list[Trajectory]:
        """Episodes that the learner has not acknowledged."""
        return self._uploader.pending

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Sends what was recorded, waits until it is stored, and begins an episode."""
        self._end_episode()
        if self.model_id == "":
            self.model_id = self._put_model()
        self._uploader.flush()
        observation, info = self.env.reset(seed=seed, options=options)
        self._states.append(self._state(observation))
        return observation, info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Steps, and sends the episode where it ends."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        if self._states:  # between an end and the next reset there is no episode
            self._actions.append(int(action) - self._first_action)
            self._rewards.append(float(reward))
            self._states.append(self._state(observation))
            self._terminated, self._truncated = bool(terminated), bool(truncated)
            if terminated or truncated:
                self._end_episode()
        return observation, reward, terminated, truncated, info

    def flush(self) -> None:
        """Waits until every episode that has ended is on the learner's stable storage."""
        self._uploader.flush()

    def close(self) -> None:
        """Records the unfinished episode, waits until all is stored, and closes the environment."""
        try:
            self._end_episode()
            self._uploader.flush()
            self._uploader.finish()
        finally:
            self.env.close()

    def _forget(self) -> None:
        self._states: list[int] = []
        self._actions: list[int] = []
        self._rewards: list[float] = []
        self._terminated = self._truncated = False

    def _state(self, observation: Any) -> int:
        return int(observation) - self._first_state

    def _end_episode(self) -> None:
        """Queues the episode, where it has a step; does not wait."""
        if self._actions:
            self._uploader.put(
                [
                    Trajectory(
                        env_id=self.recorded_env_id,
                        style=self.style,
                        n_states=self._n_states,
                        n_actions=self._n_actions,
                        states=np.array(self._states[:-1], np.int32),
                        actions=np.array(self._actions, np.int32),
                        rewards=np.array(self._rewards),
                        final_state=self._states[-1],
                        terminated=self._terminated,
                        truncated=self._truncated,
                        model_id=self.model_id or "",
                        source=self.source,
                    )
                ]
            )
        self._forget()

    def _put_model(self) -> str:
        """Puts the environment's model into the learner; empty where it has none."""
        inner = self.env.unwrapped
        parts: Any
        if isinstance(inner, MazewayEnv):
            client = Client(inner.address, timeout=self._timeout, **dataclasses.asdict(inner.access))
            parts = client.model_parts(inner.env_id, inner.options)
        elif isinstance(getattr(inner, "P", None), dict):
            client = None
            parts = Model.from_gymnasium(self.env, self.recorded_env_id).parts()
        else:
            return ""
        with contextlib.ExitStack() as stack:
            if client is not None:
                stack.callback(client.close)
            learner = stack.enter_context(
                Learner(self.learner_address, timeout=self._timeout, **dataclasses.asdict(self._access))
            )
            return learner.put_model_parts(list(parts))


def _env_id(env: gymnasium.Env[Any, Any]) -> str:
    if isinstance(env.unwrapped, MazewayEnv):
        return env.unwrapped.env_id
    if env.spec is None:
        raise InvalidArgumentError(f"env_id: expected a name, for {env} has none of its own", field="env_id")
    return server_env_id(env.spec.id)
