"""`Model`: a tabular Markov decision process as compressed sparse rows, to fetch, make and send."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt

from mazeway import _arrays, _wire
from mazeway.errors import InvalidArgumentError, ServerFailureError

_ENTRIES_PER_PART = 100_000

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Model:
    """P(s'|s,a) as sparse rows, in order of s * n_actions + a.

    `(probabilities, next_states, row_offsets)` is what `scipy.sparse.csr_array` takes as
    `(data, indices, indptr)`, with shape (n_states * n_actions, n_states).
    """

    #: Environment that it describes.
    env_id: str
    n_states: int
    n_actions: int
    #: Start of each row's entries, int64, shape (n_states * n_actions + 1,).
    row_offsets: npt.NDArray[np.int64]
    #: Next state of each entry, rising within a row, int32, shape (entries,).
    next_states: npt.NDArray[np.int32]
    #: Probability of each entry, float64, shape (entries,); each row sums to 1.
    probabilities: Floats
    #: p(s1), shape (n_states,).
    initial_distribution: Floats
    #: R(s,a) of each style, shape (n_states, n_actions).
    rewards: dict[str, Floats] = field(default_factory=dict)
    #: Labels for people; empty or one each.
    state_labels: Sequence[str] = ()
    action_labels: Sequence[str] = ()
    #: Visits from which each row was estimated, int64, shape (n_states * n_actions,); None where exact.
    visit_counts: npt.NDArray[np.int64] | None = None
    #: True where the rows were estimated rather than computed.
    estimated: bool = False
    #: Rows, columns and the row-major cell of each state, where the environment lies on a grid.
    grid: tuple[int, int, npt.NDArray[np.int32]] | None = None

    def __post_init__(self) -> None:
        """Raises InvalidArgumentError where the arrays are no process."""
        rows = self.n_states * self.n_actions
        if self.n_states < 1 or self.n_actions < 1:
            raise InvalidArgumentError(
                f"expected at least one state and action, got {self.n_states} and {self.n_actions}"
            )
        for name, shape in (
            ("row_offsets", (rows + 1,)),
            ("next_states", (len(self.probabilities),)),
            ("initial_distribution", (self.n_states,)),
        ):
            if getattr(self, name).shape != shape:
                raise InvalidArgumentError(
                    f"{name}: expected shape {shape}, got {getattr(self, name).shape}", field=name
                )
        offsets = self.row_offsets
        if offsets[0] != 0 or offsets[-1] != len(self.probabilities) or (np.diff(offsets) < 1).any():
            raise InvalidArgumentError(
                "row_offsets: expected to rise from 0 to the number of entries with no empty row",
                field="row_offsets",
            )
        if ((self.next_states < 0) | (self.next_states >= self.n_states)).any():
            raise InvalidArgumentError(
                f"next_states: expected states below {self.n_states}", field="next_states"
            )
        if not (np.isfinite(self.probabilities).all() and (self.probabilities >= 0).all()):
            raise InvalidArgumentError(
                "probabilities: expected finite values of at least 0", field="probabilities"
            )
        sums = np.add.reduceat(self.probabilities, offsets[:-1])
        worst = int(np.abs(sums - 1).argmax())
        if abs(sums[worst] - 1) > 1e-6:
            state, action = divmod(worst, self.n_actions)
            raise InvalidArgumentError(
                f"probabilities: expected rows that sum to 1, got {sums[worst]:.6g} "
                f"for state {state}, action {action}",
                field="probabilities",
            )
        for style, reward in self.rewards.items():
            if reward.shape != (self.n_states, self.n_actions):
                raise InvalidArgumentError(
                    f"rewards[{style!r}]: expected shape {(self.n_states, self.n_actions)}, "
                    f"got {reward.shape}",
                    field="rewards",
                )

    @classmethod
    def from_csr(
        cls,
        env_id: str,
        matrix: Any,
        n_actions: int,
        *,
        initial_distribution: npt.ArrayLike | None = None,
        rewards: Mapping[str, npt.ArrayLike] | None = None,
        **described: Any,
    ) -> Model:
        """From a matrix of shape (n_states * n_actions, n_states).

        Args:
            env_id: Environment that it describes.
            matrix: A scipy CSR array, or anything with `data`, `indices`, `indptr`, or a tuple of these.
            n_actions: Number of actions.
            initial_distribution: p(s1), shape (n_states,); None is uniform.
            rewards: R(s,a) of each style.
            **described: Further fields, such as `state_labels`.
        """
        if isinstance(matrix, tuple):
            data, indices, indptr = (np.asarray(part) for part in matrix)
        else:
            data, indices, indptr = matrix.data, matrix.indices, matrix.indptr
        if n_actions < 1 or (len(indptr) - 1) % n_actions or len(indptr) < 2:
            raise InvalidArgumentError(
                f"expected n_states * {n_actions} rows, got {len(indptr) - 1}", field="n_actions"
            )
        n_states = (len(indptr) - 1) // n_actions
        # Sort within rows, add duplicates up and drop zeros: the wire wants rising next states.
        rows = np.repeat(np.arange(len(indptr) - 1), np.diff(indptr))
        keys, inverse = np.unique(rows * n_states + indices, return_inverse=True)
        sums = np.bincount(inverse, weights=data, minlength=len(keys))
        keys, sums = keys[sums != 0], sums[sums != 0]
        counts = np.bincount(keys // n_states, minlength=n_states * n_actions)
        return cls(
            env_id=env_id,
            n_states=n_states,
            n_actions=n_actions,
            row_offsets=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
            next_states=(keys % n_states).astype(np.int32),
            probabilities=sums.astype(np.float64),
            initial_distribution=(
                np.full(n_states, 1 / n_states)
                if initial_distribution is None
                else np.asarray(initial_distribution, np.float64)
            ),
            rewards={k: np.asarray(v, np.float64) for k, v in (rewards or {}).items()},
            **described,
        )

    @classmethod
    def from_dense(cls, env_id: str, transition: npt.ArrayLike, **described: Any) -> Model:
        """From P of shape (n_states, n_actions, n_states); further arguments as `from_csr`."""
        dense = np.asarray(transition, np.float64)
        if dense.ndim != 3 or dense.shape[0] != dense.shape[2]:
            raise InvalidArgumentError(
                f"transition: expected shape (n_states, n_actions, n_states), got {dense.shape}",
                field="transition",
            )
        flat = dense.reshape(-1, dense.shape[2])
        rows, columns = np.nonzero(flat)
        indptr = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=len(flat)))])
        return cls.from_csr(env_id, (flat[rows, columns], columns, indptr), dense.shape[1], **described)

    @classmethod
    def from_gymnasium(cls, env: gymnasium.Env[Any, Any], env_id: str | None = None) -> Model:
        """From a toy-text environment's own table `P[s][a] = [(p, next, reward, terminated), …]`.

        States in which an episode terminates become absorbing. The true reward, its mean over next
        states, is kept as the style "true". Raises InvalidArgumentError where there is no such table.
        """
        table = getattr(env.unwrapped, "P", None)
        spaces = (env.observation_space, env.action_space)
        if table is None or not all(isinstance(s, gymnasium.spaces.Discrete) for s in spaces):
            raise InvalidArgumentError(
                f"expected a discrete environment with a transition table P, got {env}",
                hint="make a Model with from_dense or from_csr",
            )
        n_states, n_actions = (int(space.n) for space in spaces)  # type: ignore[attr-defined]
        absorbing = {
            int(entry[1])
            for actions in table.values()
            for entries in actions.values()
            for entry in entries
            if entry[3]
        }
        data, indices, indptr = [], [], [0]
        reward = np.zeros((n_states, n_actions))
        for state in range(n_states):
            for action in range(n_actions):
                if state in absorbing:
                    data.append(1.0)
                    indices.append(state)
                else:
                    for probability, following, value, _ in table[state][action]:
                        data.append(float(probability))
                        indices.append(int(following))
                        reward[state, action] += probability * value
                indptr.append(len(data))
        return cls.from_csr(
            env_id or (env.spec.id if env.spec else type(env.unwrapped).__name__),
            (np.array(data), np.array(indices), np.array(indptr)),
            n_actions,
            initial_distribution=getattr(env.unwrapped, "initial_state_distrib", None),
            rewards={"true": reward},
        )

    @property
    def model_id(self) -> str:
        """SHA-256, hexadecimal, over sizes and rows as `mazeway/env/v1/model.proto` lays them down."""
        rows = self.n_states * self.n_actions
        counts = np.diff(self.row_offsets)
        layout = np.empty(4 * rows + 12 * len(self.probabilities), np.uint8)
        heads = 4 * np.arange(rows) + 12 * self.row_offsets[:-1]
        row_of_entry = np.repeat(np.arange(rows), counts)
        entries = 4 * (row_of_entry + 1) + 12 * np.arange(len(self.probabilities))
        for start, values in (
            (heads, counts.astype("<u4")),
            (entries, self.next_states.astype("<u4")),
            (entries + 4, self.probabilities.astype("<f8")),
        ):
            width = values.dtype.itemsize
            layout[start[:, None] + np.arange(width)] = values.view(np.uint8).reshape(-1, width)
        digest = hashlib.sha256(b"mazeway-model-v1")
        digest.update(np.array([self.n_states, self.n_actions], "<u4").tobytes())
        digest.update(layout.tobytes())
        return digest.hexdigest()

    @property
    def csr(self) -> tuple[Floats, npt.NDArray[np.int32], npt.NDArray[np.int64]]:
        """`(data, indices, indptr)` as `scipy.sparse.csr_array` takes them."""
        return self.probabilities, self.next_states, self.row_offsets

    def to_dense(self) -> Floats:
        """P of shape (n_states, n_actions, n_states)."""
        dense = np.zeros((self.n_states * self.n_actions, self.n_states))
        rows = np.repeat(np.arange(len(dense)), np.diff(self.row_offsets))
        dense[rows, self.next_states] = self.probabilities
        return dense.reshape(self.n_states, self.n_actions, self.n_states)

    def __repr__(self) -> str:
        """Sizes and the beginning of the id."""
        return (
            f"Model({self.env_id!r}, id={self.model_id[:8]}, n_states={self.n_states}, "
            f"n_actions={self.n_actions}, entries={len(self.probabilities)}, "
            f"{'estimated' if self.estimated else 'exact'}, rewards={sorted(self.rewards)})"
        )

    def parts(self) -> Iterator[Any]:
        """The wire's `ModelPart`s: a header, then blocks of rows."""
        part = _wire.env.ModelPart()
        header = part.header
        header.model_id = self.model_id
        header.env_id = self.env_id
        header.n_states, header.n_actions = self.n_states, self.n_actions
        header.state_labels.extend(self.state_labels)
        header.action_labels.extend(self.action_labels)
        header.initial_distribution = self.initial_distribution.astype(_arrays.FLOAT64).tobytes()
        header.estimated = self.estimated
        for style, values in self.rewards.items():
            header.rewards.add(style=style, values=values.astype(_arrays.FLOAT64).tobytes())
        if self.grid is not None:
            header.grid.rows, header.grid.columns = self.grid[:2]
            header.grid.cells = self.grid[2].astype(_arrays.INT32).tobytes()
        yield part
        first, rows = 0, self.n_states * self.n_actions
        while first < rows:
            budget = self.row_offsets[first] + _ENTRIES_PER_PART
            last = max(first + 1, int(np.searchsorted(self.row_offsets, budget, "right")) - 1)
            begin, end = self.row_offsets[first], self.row_offsets[last]
            part = _wire.env.ModelPart()
            block = part.rows
            block.first_row = first
            counts = np.diff(self.row_offsets[first : last + 1])
            block.row_lengths = counts.astype(_arrays.INT32).tobytes()
            block.next_states = self.next_states[begin:end].astype(_arrays.INT32).tobytes()
            block.probabilities = self.probabilities[begin:end].astype(_arrays.FLOAT64).tobytes()
            if self.visit_counts is not None:
                visits = self.visit_counts[first:last].astype(_arrays.INT64)
                block.visit_counts = visits.tobytes()
            yield part
            first = last

    @classmethod
    def from_parts(cls, parts: Iterable[Any]) -> Model:
        """From the wire's `ModelPart`s; raises ServerFailureError where they are no whole model."""
        header: Any = None
        lengths, following, probabilities, visits = [], [], [], []
        rows = 0
        for part in parts:
            if part.WhichOneof("part") == "header":
                header = part.header
                continue
            block = part.rows
            if header is None or block.first_row != rows:
                raise ServerFailureError(
                    f"model: expected row {rows} after a header, got row {block.first_row}"
                )
            lengths.append(_arrays.unpack(block.row_lengths, _arrays.INT32))
            following.append(_arrays.unpack(block.next_states, _arrays.INT32))
            probabilities.append(_arrays.unpack(block.probabilities, _arrays.FLOAT64))
            visits.append(_arrays.unpack(block.visit_counts, _arrays.INT64))
            rows += len(lengths[-1])
        if header is None or rows != header.n_states * header.n_actions:
            raise ServerFailureError(f"model: the stream ended early, after {rows} rows")
        shape = (header.n_states, header.n_actions)
        counts = np.concatenate(visits)
        initial = _arrays.unpack(header.initial_distribution, _arrays.FLOAT64)
        cells = _arrays.unpack(header.grid.cells, _arrays.INT32)
        return cls(
            env_id=header.env_id,
            n_states=header.n_states,
            n_actions=header.n_actions,
            row_offsets=np.concatenate([[0], np.cumsum(np.concatenate(lengths))]).astype(np.int64),
            next_states=np.concatenate(following),
            probabilities=np.concatenate(probabilities),
            initial_distribution=initial if len(initial) else np.full(shape[0], 1 / shape[0]),
            rewards={
                table.style: _arrays.unpack(table.values, _arrays.FLOAT64, shape, "rewards")
                for table in header.rewards
            },
            state_labels=list(header.state_labels),
            action_labels=list(header.action_labels),
            visit_counts=counts if len(counts) else None,
            estimated=header.estimated,
            grid=(header.grid.rows, header.grid.columns, cells) if header.HasField("grid") else None,
        )
