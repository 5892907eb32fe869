"""Packed little-endian arrays of the wire as numpy arrays, spaces and Python values, and back."""

from __future__ import annotations

import math
import struct as struct_module
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt

from mazeway import _wire
from mazeway.errors import InvalidArgumentError, ServerFailureError

_DTYPES: dict[int, np.dtype[Any]] = {
    _wire.env.DType["D_TYPE_UINT8"]: np.dtype("u1"),
    _wire.env.DType["D_TYPE_UINT16"]: np.dtype("<u2"),
    _wire.env.DType["D_TYPE_INT32"]: np.dtype("<i4"),
    _wire.env.DType["D_TYPE_INT64"]: np.dtype("<i8"),
    _wire.env.DType["D_TYPE_FLOAT32"]: np.dtype("<f4"),
    _wire.env.DType["D_TYPE_FLOAT64"]: np.dtype("<f8"),
}

INT32 = np.dtype("<i4")
INT64 = np.dtype("<i8")
FLOAT64 = np.dtype("<f8")
UINT8 = np.dtype("u1")
UINT64 = np.dtype("<u8")


def dtype_of(number: int) -> np.dtype[Any]:
    """The numpy dtype of a wire `DType`."""
    try:
        return _DTYPES[number]
    except KeyError:
        raise ServerFailureError(
            f"expected a known element type, got number {number}", hint="update the mazeway package"
        ) from None


def unpack(
    data: bytes, dtype: np.dtype[Any], shape: Sequence[int] = (-1,), what: str = "array"
) -> npt.NDArray[Any]:
    """A writable array of its own in native byte order; raises where the length does not fit."""
    count = math.prod(shape)
    if count >= 0 and len(data) != count * dtype.itemsize:
        raise ServerFailureError(
            f"{what}: expected {count * dtype.itemsize} bytes for shape {tuple(shape)}, got {len(data)}"
        )
    return np.frombuffer(data, dtype).astype(dtype.newbyteorder("="), copy=True).reshape(shape)


def number(dtype: np.dtype[Any], what: str) -> Callable[[bytes], Any]:
    """Reads one packed number as Python's own; a numpy array would take ten times as long."""
    unpack_number = struct_module.Struct("<" + {"l": "q"}.get(dtype.char, dtype.char)).unpack

    def read(data: bytes) -> Any:
        try:
            return unpack_number(data)[0]
        except struct_module.error:
            raise ServerFailureError(f"{what}: expected {dtype.itemsize} bytes, got {len(data)}") from None

    return read


def pack(values: npt.ArrayLike, dtype: np.dtype[Any], shape: Sequence[int], what: str) -> bytes:
    """Packs values; raises InvalidArgumentError for another shape or values that do not fit."""
    array = np.asarray(values)
    if array.shape != tuple(shape):
        raise InvalidArgumentError(f"{what}: expected shape {tuple(shape)}, got {array.shape}", field=what)
    if dtype.kind in "iu" and array.size:
        if array.dtype.kind not in "iub":
            raise InvalidArgumentError(f"{what}: expected integers, got {array.dtype}", field=what)
        limits = np.iinfo(dtype)
        low, high = int(array.min()), int(array.max())
        if low < limits.min or high > limits.max:
            raise InvalidArgumentError(
                f"{what}: expected values from {limits.min} to {limits.max}, "
                f"got {low if low < limits.min else high}",
                field=what,
            )
    return array.astype(dtype).tobytes()


def integers(values: npt.ArrayLike, shape: tuple[int, ...], what: str) -> npt.NDArray[np.int64]:
    """A contiguous int64 array; raises InvalidArgumentError for another shape or what are no integers."""
    array = np.asarray(values)
    if array.shape != shape:
        raise InvalidArgumentError(f"{what}: expected shape {shape}, got {array.shape}", field=what)
    if array.dtype.kind not in "iub" and array.size:
        raise InvalidArgumentError(f"{what}: expected integers, got {array.dtype}", field=what)
    if array.dtype == np.uint64 and array.size and array.max() > np.iinfo(np.int64).max:
        pack(array, INT32, shape, what)  # says what is wrong
    return np.ascontiguousarray(array, np.int64)


def space_from_wire(space: Any) -> gymnasium.Space[Any]:
    """The Gymnasium space of a wire `Space`: Discrete (int64, as Gymnasium expects) or Box."""
    kind = space.WhichOneof("kind")
    if kind == "discrete":
        return gymnasium.spaces.Discrete(space.discrete.n)
    if kind == "box":
        box = space.box
        dtype = dtype_of(box.dtype)
        shape = tuple(box.shape)
        return gymnasium.spaces.Box(
            low=unpack(box.low, dtype, shape, "low"),
            high=unpack(box.high, dtype, shape, "high"),
            dtype=dtype.newbyteorder("=").type,
        )
    raise ServerFailureError("expected a discrete or box space", hint="update the mazeway package")


def space_dtype(space: Any) -> np.dtype[Any]:
    """Element type of a wire `Space` on the wire."""
    return dtype_of(getattr(space, space.WhichOneof("kind")).dtype)


@dataclass(frozen=True)
class Column:
    """One info column: its key and how its values are packed."""

    name: str
    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    unit: str = ""
    description: str = ""
    summed: bool = False

    @classmethod
    def from_wire(cls, column: Any) -> Column:
        """Reads a wire `InfoColumn`."""
        return cls(
            name=column.name,
            dtype=dtype_of(column.dtype),
            shape=tuple(column.shape),
            unit=column.unit,
            description=column.description,
            summed=column.summed,
        )

    def batch(self, data: bytes, num_envs: int) -> npt.NDArray[Any]:
        """Values of every environment, shape (num_envs, *shape).

        Scalars become int64 and float64, as Gymnasium's vector environments batch Python numbers; an
        action mask becomes int8, which is what `Discrete.sample(mask)` takes.
        """
        values = np.frombuffer(data, self.dtype).reshape((num_envs, *self.shape))
        if self.name == "action_mask":
            return values.astype(np.int8)
        if self.shape:
            return values.astype(self.dtype.newbyteorder("="))
        return values.astype(np.float64 if self.dtype.kind == "f" else np.int64)

    def single(self) -> Callable[[bytes], Any]:
        """Reads the value of a session of one environment: a Python number, or an array of `shape`."""
        return (lambda data: self.batch(data, 1)[0]) if self.shape else number(self.dtype, self.name)


def _value(value: Any, where: str) -> Any:
    message = _wire.well_known.Value()
    if value is None:
        message.null_value = 0
    elif isinstance(value, (bool, np.bool_)):
        message.bool_value = bool(value)
    elif isinstance(value, (int, float, np.integer, np.floating)):
        message.number_value = float(value)
    elif isinstance(value, str):
        message.string_value = value
    elif isinstance(value, Mapping):
        message.struct_value.CopyFrom(struct(value, where))
    elif isinstance(value, np.ndarray):
        return _value(value.tolist(), where)
    elif isinstance(value, (list, tuple)):
        message.list_value.values.extend(_value(item, f"{where}[{i}]") for i, item in enumerate(value))
        message.list_value.SetInParent()
    else:
        raise InvalidArgumentError(
            f"{where}: expected None, a bool, number, string, list or dict, got {type(value).__name__}",
            field=where,
        )
    return message


def struct(values: Mapping[str, Any], where: str = "options") -> Any:
    """A `google.protobuf.Struct` of plain Python and numpy values."""
    message = _wire.well_known.Struct()
    for key, value in values.items():
        message.fields[key].CopyFrom(_value(value, f"{where}.{key}"))
    return message


def plain(value: Any) -> Any:
    """The Python value of a `google.protobuf.Value`."""
    kind = value.WhichOneof("kind")
    if kind == "struct_value":
        return {key: plain(item) for key, item in value.struct_value.fields.items()}
    if kind == "list_value":
        return [plain(item) for item in value.list_value.values]
    if kind == "number_value" and value.number_value.is_integer():
        return int(value.number_value)
    return None if kind in (None, "null_value") else getattr(value, kind)
