"""`Learner`: records demonstrations, keeps models and fits rewards and policies."""

from __future__ import annotations

import datetime
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import numpy.typing as npt

from mazeway import _wire
from mazeway._access import Access
from mazeway._session import DEFAULT_TIMEOUT_SECS
from mazeway._transport import RECONNECT_SECS, connect
from mazeway._uploader import Uploader, batches
from mazeway.env import server_env_id
from mazeway.errors import InvalidArgumentError, ServerFailureError
from mazeway.fit import Fit, FitSummary, ModelSummary, Progress, Queued, options_to_wire, stopped_name
from mazeway.model import Model
from mazeway.trajectory import Trajectory, timestamp

DEFAULT_LEARNER_ADDRESS = "127.0.0.1:50052"


class Learner:
    """Speaks with the learner service at `address`."""

    def __init__(
        self,
        address: str = DEFAULT_LEARNER_ADDRESS,
        *,
        timeout: float = DEFAULT_TIMEOUT_SECS,
        client: str = "auto",
        token: str | None = None,
        ca: str | os.PathLike[str] | None = None,
        cert: str | os.PathLike[str] | None = None,
        key: str | os.PathLike[str] | None = None,
        insecure: bool = False,
    ) -> None:
        """Describes the learner; nothing is sent yet.

        Args:
            address: "host:port" of the learner, or "https://host:port".
            timeout: Longest wait for a call other than `fit`, in seconds.
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
        self._transport = connect(
            address, _wire.LEARNER_SERVICE, Access(client, token, ca, cert, key, insecure)
        )

    def __enter__(self) -> Learner:
        """Itself."""
        return self

    def __exit__(self, *_exception: object) -> None:
        """Closes the connection."""
        self.close()

    def __repr__(self) -> str:
        """Where it points."""
        return f"Learner({self.address!r})"

    def close(self) -> None:
        """Frees the connection; may be called twice."""
        self._transport.close()

    def fit(
        self,
        env_id: str,
        style: str,
        method: str = "em-tied",
        *,
        model_id: str = "",
        max_trajectories: int = 0,
        source: str = "",
        trajectory_ids: Sequence[str] = (),
        progress: Callable[[Progress], None] | None = None,
        queued: Callable[[Queued], None] | None = None,
        timeout_secs: float = 600.0,
        **options: Any,
    ) -> Fit:
        """Fits a reward and a policy to the recorded demonstrations of a style.

        Args:
            env_id: Environment of the demonstrations.
            style: Their style.
            method: "em-tied", "em" or "bc".
            model_id: Model to fit in; empty is the one that the demonstrations name.
            max_trajectories: Use the first so many; 0 is all.
            source: Only demonstrations by this source.
            trajectory_ids: Only these demonstrations.
            progress: Called after each iteration.
            queued: Called when the place of a fit that waits its turn changes; `queued=print` prints
                "waiting: 3rd of 7".
            timeout_secs: Longest time without a word from the learner; the fit itself may take longer.
            **options: discount, horizon, horizon_prior ("geometric", "uniform"), basis ("state",
                "state-action", "features"), features (names), m_step ("nnls", "simplex"),
                responsibility ("approximate", "exact"),
                planner ("value-iteration", "policy-iteration", "soft-value-iteration",
                "expectation-maximization"), reference_basis, penalty ("l1", "l2", "none"),
                penalty_strength, tolerance, max_iterations, smoothing, seed,
                posterior ("none", "laplace", "hmc"), reward_prior ("uniform", "exponential",
                "beta"), rationality, chains, draws, warm_up.
        """
        request = _wire.learner.FitRequest(
            method=method,
            filter=_filter(env_id=env_id, style=style, source=source, trajectory_ids=list(trajectory_ids)),
            model_id=model_id,
            options=options_to_wire(options),
        )
        _assign(request, "max_trajectories", max_trajectories)
        for response in self._transport.responses("Fit", request, timeout=timeout_secs, each=True):
            match response.WhichOneof("event"):
                case "fit":
                    return Fit(response.fit)
                case "progress" if progress is not None:
                    progress(Progress.from_wire(response.progress))
                case "queued" if queued is not None:
                    queued(Queued(response.queued.place, response.queued.length))
        raise ServerFailureError(f"the learner at {self.address} ended the fit without a result")

    def show(self, fit_id: str) -> Fit:
        """A stored fit by its id, or its first eight or more characters."""
        request = _wire.learner.GetFitRequest(fit_id=fit_id)
        return Fit(self._transport.unary("GetFit", request, timeout=self.timeout).fit)

    def fits(self, env_id: str = "", style: str = "") -> list[FitSummary]:
        """Stored fits, newest first."""
        request = _wire.learner.ListFitsRequest(env_id=server_env_id(env_id), style=style)
        return [
            FitSummary(
                fit_id=fit.fit_id,
                created_at=timestamp(fit.created_at),
                env_id=fit.env_id,
                style=fit.style,
                method=fit.method,
                trajectories=fit.trajectories,
                stopped=stopped_name(fit.stopped),
                iterations=fit.iterations,
                agreement=fit.agreement,
                model_id=fit.model_id,
            )
            for page in self._pages("ListFits", request)
            for fit in page.fits
        ]

    def fit_trajectories(self, fit_id: str) -> Iterator[str]:
        """Ids of the demonstrations that a fit used, in the order used, a page at a time.

        Args:
            fit_id: The fit's id, or the first eight or more characters of it.
        """
        request = _wire.learner.ListFitTrajectoriesRequest(fit_id=fit_id, page_size=10_000)
        for page in self._pages("ListFitTrajectories", request):
            yield from page.trajectory_ids

    def delete_fit(self, fit_id: str) -> None:
        """Deletes a stored fit by its whole id."""
        request = _wire.learner.DeleteFitRequest(fit_id=fit_id)
        self._transport.unary("DeleteFit", request, timeout=self.timeout)

    def trajectories(
        self, env_id: str = "", style: str = "", *, fit_id: str = "", **conditions: Any
    ) -> list[Trajectory]:
        """Stored demonstrations with their arrays, in the order in which they were recorded.

        Args:
            env_id: Of this environment; empty is any.
            style: Of this style; empty is any.
            fit_id: Those alone that this fit used; empty is any.
            **conditions: model_id, source, trajectory_ids, min_seed, max_seed, min_steps,
                recorded_from, recorded_until (datetimes with a time zone).
        """
        request = _wire.learner.ExportTrajectoriesRequest(
            filter=_filter(env_id=env_id, style=style, **conditions), fit_id=fit_id
        )
        return [
            Trajectory.from_wire(trajectory)
            for response in self._transport.responses("ExportTrajectories", request, timeout=self.timeout)
            for trajectory in response.trajectories
        ]

    def count(self, env_id: str = "", style: str = "", **conditions: Any) -> int:
        """How many demonstrations `trajectories` would return."""
        request = _wire.learner.ListTrajectoriesRequest(
            filter=_filter(env_id=env_id, style=style, **conditions), page_size=1
        )
        return self._transport.unary("ListTrajectories", request, timeout=self.timeout).total

    def delete_trajectories(self, env_id: str = "", style: str = "", **conditions: Any) -> int:
        """Deletes the demonstrations that `trajectories` would return; returns how many."""
        request = _wire.learner.DeleteTrajectoriesRequest(
            filter=_filter(env_id=env_id, style=style, **conditions)
        )
        return self._transport.unary("DeleteTrajectories", request, timeout=self.timeout).deleted

    def record(self, trajectories: Iterable[Trajectory]) -> int:
        """Stores demonstrations durably; returns how many were not stored before.

        Where the connection breaks, what is not acknowledged goes out again under the same ids and so is
        stored once; what was stored already counts as stored before then.
        """
        uploader = Uploader(lambda: self._transport, self.timeout, shared=True)
        try:
            for batch in batches(trajectories):
                uploader.put(batch)
                uploader.flush(within=min(RECONNECT_SECS, 0.8 * self.timeout) if self._transport.known else 0)
        finally:
            uploader.finish()
        return uploader.stored

    def models(self, env_id: str = "") -> list[ModelSummary]:
        """The models that the learner knows."""
        request = _wire.learner.ListModelsRequest(env_id=server_env_id(env_id))
        response = self._transport.unary("ListModels", request, timeout=self.timeout)
        return [
            ModelSummary(
                model_id=model.model_id,
                env_id=model.env_id,
                n_states=model.n_states,
                n_actions=model.n_actions,
                n_transitions=model.n_transitions,
                estimated=model.estimated,
                styles=list(model.styles),
                stored_at=timestamp(model.stored_at),
            )
            for model in response.models
        ]

    def put_model(
        self, model: Model | str, transition: Any = None, n_actions: int = 0, **described: Any
    ) -> str:
        """Stores a model; returns its id.

        Args:
            model: A `Model`, or the environment's name where the arrays are given.
            transition: P as an array of shape (n_states, n_actions, n_states), or as a CSR matrix of
                shape (n_states * n_actions, n_states) together with `n_actions`.
            n_actions: Number of actions, for a CSR matrix.
            **described: As `Model.from_csr`: initial_distribution, rewards, state_labels, …
        """
        if isinstance(model, Model):
            made = model
        elif transition is None:
            raise InvalidArgumentError("transition: expected an array", field="transition")
        elif isinstance(transition, tuple) or hasattr(transition, "indptr"):
            made = Model.from_csr(model, transition, n_actions, **described)
        else:
            made = Model.from_dense(model, transition, **described)
        return self.put_model_parts(made.parts())

    def put_model_parts(self, parts: Iterable[Any]) -> str:
        """Stores a model from the wire's parts; returns its id."""
        requests = (_wire.learner.PutModelRequest(part=part) for part in parts)
        return self._transport.requests("PutModel", requests, timeout=self.timeout).model_id

    def _pages(self, method: str, request: Any) -> Iterator[Any]:
        while True:
            page = self._transport.unary(method, request, timeout=self.timeout)
            yield page
            if not page.next_page_token:
                return
            request.page_token = page.next_page_token


def _filter(**conditions: Any) -> Any:
    """The wire's `TrajectoryFilter`; raises InvalidArgumentError for an unknown condition."""
    message = _wire.learner.TrajectoryFilter()
    known = [field.name for field in message.DESCRIPTOR.fields]
    conditions["env_id"] = server_env_id(conditions["env_id"])
    for name, value in conditions.items():
        if name not in known:
            raise InvalidArgumentError(
                f"{name}: unknown condition, expected one of {', '.join(known)}", field=name
            )
        if isinstance(value, datetime.datetime):
            if value.tzinfo is None:
                raise InvalidArgumentError(f"{name}: expected a datetime with a time zone", field=name)
            getattr(message, name).FromMicroseconds(round(value.timestamp() * 1e6))
        elif name == "trajectory_ids":
            message.trajectory_ids.extend(value)
        elif value is not None:
            _assign(message, name, value)
    return message


def _assign(message: Any, name: str, value: npt.ArrayLike) -> None:
    try:
        setattr(message, name, value)
    except (TypeError, ValueError) as error:
        raise InvalidArgumentError(f"{name}: {error}", field=name) from None
