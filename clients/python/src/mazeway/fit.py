"""`Fit`: what the learner worked out, as numpy arrays, and how it shows itself."""

from __future__ import annotations

import datetime
import html
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from mazeway import _arrays, _wire
from mazeway.errors import InvalidArgumentError
from mazeway.trajectory import timestamp

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Progress:
    """One iteration of a fit."""

    #: From 1 on.
    iteration: int
    #: What the method maximises.
    objective: float
    #: Change of the quantity that the stopping rule watches.
    change: float
    #: Seconds since the fit began.
    elapsed_secs: float

    @classmethod
    def from_wire(cls, message: Any) -> Progress:
        """Reads the wire's `FitProgress`."""
        return cls(message.iteration, message.objective, message.change, message.elapsed_secs)


@dataclass(frozen=True)
class Queued:
    """The place of a fit that waits its turn; printed, "waiting: 3rd of 7"."""

    #: From 1, the next to begin.
    place: int
    #: How many fits wait.
    length: int

    def __str__(self) -> str:
        """As a person says it."""
        teens = 11 <= self.place % 100 <= 13
        ending = "th" if teens else {1: "st", 2: "nd", 3: "rd"}.get(self.place % 10, "th")
        return f"waiting: {self.place}{ending} of {self.length}"


@dataclass(frozen=True)
class Posterior:
    """What the data leave open of the weights, each array of shape (n_basis,)."""

    standard_deviations: Floats
    #: Lower ends of the central 95% intervals.
    low: Floats
    #: Upper ends.
    high: Floats
    #: Chains, draws kept of each, and the share of accepted proposals; None unless it was sampled.
    chains: int | None = None
    draws: int | None = None
    acceptance: float | None = None
    #: Near 1 where the chains agree; None unless it was sampled.
    split_rhat: Floats | None = None
    #: Number of independent draws that would tell as much; None unless it was sampled.
    effective_sample_size: Floats | None = None

    @classmethod
    def from_wire(cls, message: Any, shape: tuple[int, ...]) -> Posterior:
        """Reads the wire's `Posterior`."""

        def array(part: Any, name: str) -> Floats:
            return _arrays.unpack(getattr(part, name), _arrays.FLOAT64, shape, name)

        intervals = [array(message, name) for name in ("standard_deviations", "low", "high")]
        if not message.HasField("diagnostics"):
            return cls(*intervals)
        sampled = message.diagnostics
        return cls(
            *intervals,
            sampled.chains,
            sampled.draws,
            sampled.acceptance,
            array(sampled, "split_rhat"),
            array(sampled, "effective_sample_size"),
        )


class Fit:
    """A stored fit: the reward and the policies that explain the demonstrations."""

    def __init__(self, message: Any) -> None:
        """Takes the wire's `Fit`."""
        pairs = (message.n_states, message.n_actions)
        states = (message.n_states,)

        def array(name: str, shape: tuple[int, ...]) -> Floats:
            return _arrays.unpack(getattr(message, name), _arrays.FLOAT64, shape, name)

        self.fit_id: str = message.fit_id
        self.created_at: datetime.datetime = timestamp(message.created_at)
        self.version: str = message.version
        self.env_id: str = message.env_id
        self.style: str = message.style
        self.model_id: str = message.model_id
        self.method: str = message.request.method
        #: What was asked, defaults filled in.
        self.options: dict[str, Any] = _options_from_wire(message.request.options)
        self.n_states, self.n_actions = pairs
        #: Number of demonstrations used; `Learner.fit_trajectories` gives their ids.
        self.trajectories: int = message.trajectories
        #: SHA-256 over their ids in the order used: the same for two fits of the same data.
        self.trajectories_digest: bytes = message.trajectories_digest
        #: How many of them came from each source.
        self.sources: dict[str, int] = {s.source: s.trajectories for s in message.sources}
        #: Demonstrated steps used in all.
        self.steps: int = message.steps
        #: Weights of the basis functions, shape (n_basis,).
        self.weights: Floats = array("weights", (-1,))
        #: Their standard errors, shape (n_basis,), NaN where not determined; None unless the fit is an
        #: unpenalised maximum of the likelihood.
        self.standard_errors: Floats | None = (
            array("standard_errors", self.weights.shape) if message.standard_errors else None
        )
        #: Intervals of the weights; None where the method has no posterior.
        self.posterior: Posterior | None = (
            Posterior.from_wire(message.posterior, self.weights.shape)
            if message.HasField("posterior")
            else None
        )
        #: What the method learned beside the reward, such as the strength of its prior.
        self.hyperparameters: dict[str, float] = {h.name: h.value for h in message.hyperparameters}
        #: R(s,a), shape (n_states, n_actions).
        self.reward: Floats = array("reward", pairs)
        #: pi(a|s) that explains the demonstrations, shape (n_states, n_actions).
        self.policy: Floats = array("policy", pairs)
        #: Policy to act with, ties split evenly, shape (n_states, n_actions).
        self.greedy_policy: Floats = array("greedy_policy", pairs)
        #: V(s), shape (n_states,).
        self.state_values: Floats = array("state_values", states)
        #: Visits of each state by the demonstrations, shape (n_states,).
        self.state_visits: Floats = array("state_visits", states)
        self.trace: list[Progress] = [Progress.from_wire(step) for step in message.trace]
        #: "converged", "max-iterations", "stalled" or "closed-form".
        self.stopped: str = stopped_name(message.stopped)
        self.iterations: int = message.iterations
        self.fit_secs: float = message.fit_secs
        self.warnings: list[str] = list(message.warnings)
        #: Mean log pi(a|s) of the demonstrated steps.
        self.log_likelihood_per_step: float = message.log_likelihood_per_step
        #: Share of demonstrated steps whose action the greedy policy takes.
        self.agreement: float = message.agreement
        #: States that the demonstrations visit.
        self.states_covered: int = message.states_covered

    def act(
        self,
        observation: npt.ArrayLike,
        *,
        rng: np.random.Generator | None = None,
        stochastic: bool = False,
    ) -> Any:
        """The action for an observation, or an array of them for an array.

        Args:
            observation: States from 0 to n_states - 1, of any shape.
            rng: Draws among actions that are equally good; without it the first of them is taken.
            stochastic: Draws from `policy`, as the demonstrator would, rather than from
                `greedy_policy`; needs `rng`.
        """
        states = np.asarray(observation)
        if states.dtype.kind not in "iu" or (
            states.size and not (states.min() >= 0 and states.max() < self.n_states)
        ):
            raise InvalidArgumentError(
                f"observation: expected integers from 0 to {self.n_states - 1}, got {observation!r}",
                field="observation",
            )
        if stochastic and rng is None:
            raise InvalidArgumentError("stochastic: expected a generator `rng` too", field="rng")
        table = self.policy if stochastic else self.greedy_policy
        if rng is None:
            actions = table.argmax(axis=1)[states]
        else:
            rows = np.cumsum(table[states], axis=-1)
            draws = rng.random(states.shape)[..., None] * rows[..., -1:]
            actions = (rows > draws).argmax(axis=-1)
        return actions if states.shape else int(actions)

    def _facts(self) -> list[tuple[str, str]]:
        return [
            ("environment", self.env_id),
            ("style", self.style or "(several)"),
            ("method", self.method),
            ("demonstrations", f"{self.trajectories} ({self.steps} steps)"),
            ("states covered", f"{self.states_covered} of {self.n_states}"),
            ("agreement", f"{self.agreement:.3f}"),
            ("log-likelihood a step", f"{self.log_likelihood_per_step:.4f}"),
            ("stopped", f"{self.stopped} after {self.iterations} iterations"),
            ("time", f"{self.fit_secs:.3g} s"),
            *((name, f"{value:.4g}") for name, value in self.hyperparameters.items()),
            *(("warning", warning) for warning in self.warnings),
        ]

    def __repr__(self) -> str:
        """What was fitted and how well, on a few lines."""
        lines = [f"Fit {self.fit_id}"]
        lines += [f"  {name:<22} {value}" for name, value in self._facts()]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        """The same as a table, with the convergence trace, for notebooks."""
        rows = "".join(
            f"<tr><th style='text-align:left'>{html.escape(name)}</th>"
            f"<td style='text-align:left'>{html.escape(value)}</td></tr>"
            for name, value in self._facts()
        )
        return (
            f"<table><caption>Fit {html.escape(self.fit_id)}</caption>{rows}</table>"
            f"{_trace_svg([step.objective for step in self.trace])}"
        )


@dataclass(frozen=True)
class FitSummary:
    """What is known of a fit without its arrays."""

    fit_id: str
    created_at: datetime.datetime
    env_id: str
    style: str
    method: str
    trajectories: int
    stopped: str
    iterations: int
    agreement: float
    model_id: str


@dataclass(frozen=True)
class ModelSummary:
    """What is known of a model without its rows."""

    model_id: str
    env_id: str
    n_states: int
    n_actions: int
    n_transitions: int
    estimated: bool
    styles: list[str]
    stored_at: datetime.datetime


#: Options of `FitOptions` that are enums: their names and the prefix of their values.
_ENUMS = {
    "horizon_prior": ("HorizonPrior", "HORIZON_PRIOR_"),
    "basis": ("Basis", "BASIS_"),
    "m_step": ("MStep", "M_STEP_"),
    "responsibility": ("Responsibility", "RESPONSIBILITY_"),
    "planner": ("Planner", "PLANNER_"),
    "penalty": ("Penalty", "PENALTY_"),
    "posterior": ("PosteriorKind", "POSTERIOR_KIND_"),
    "reward_prior": ("RewardPrior", "REWARD_PRIOR_"),
}


def stopped_name(number: int) -> str:
    """How a fit stopped, in words."""
    return _wire.enum_name(_wire.learner.Stopped, "STOPPED_", number)


def options_to_wire(options: dict[str, Any]) -> Any:
    """The wire's `FitOptions`; raises InvalidArgumentError for an unknown name or a wrong value."""
    message = _wire.learner.FitOptions()
    known: Sequence[str] = [field.name for field in message.DESCRIPTOR.fields]
    for name, value in options.items():
        if name not in known:
            raise InvalidArgumentError(
                f"{name}: unknown option, expected one of {', '.join(known)}", field=name
            )
        if value is None:
            continue
        if name in _ENUMS:
            enum, prefix = _ENUMS[name]
            try:
                value = _wire.enum_number(getattr(_wire.learner, enum), prefix, name, str(value))
            except ValueError as error:
                raise InvalidArgumentError(str(error), field=name) from None
        elif isinstance(value, np.generic):
            value = value.item()
        try:
            if isinstance(value, (list, tuple)):
                getattr(message, name).extend(value)
            else:
                setattr(message, name, value)
        except (AttributeError, TypeError, ValueError) as error:
            raise InvalidArgumentError(f"{name}: {error}", field=name) from None
    return message


def _options_from_wire(message: Any) -> dict[str, Any]:
    return {
        field.name: (
            _wire.enum_name(getattr(_wire.learner, _ENUMS[field.name][0]), _ENUMS[field.name][1], value)
            if field.name in _ENUMS
            else list(value)
            if field.name == "features"
            else value
        )
        for field, value in message.ListFields()
    }


def _trace_svg(values: list[float], width: int = 320, height: int = 80) -> str:
    """The objective over the iterations as a small picture; nothing for less than two of them."""
    finite = np.array(values)[np.isfinite(values)]
    if len(finite) < 2:
        return ""
    x = np.linspace(2, width - 2, len(finite))
    span = float(np.ptp(finite)) or 1.0
    y = height - 2 - (finite - finite.min()) / span * (height - 4)
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
    return (
        f"<svg xmlns='http://www.w3.org/2000/svg' width='{width}' height='{height}' role='img'>"
        f"<title>objective over {len(finite)} iterations, {finite[0]:.6g} to {finite[-1]:.6g}"
        f"</title><polyline points='{points}' fill='none' stroke='#1f77b4' stroke-width='1.5'/>"
        "</svg>"
    )
