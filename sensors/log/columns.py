"""Columns of a log's tables: by kind of raw stream, and of readings by the fields of their dataclass."""

import dataclasses
import types
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sensors.log.errors import LogError
from sensors.reading import Reading


@dataclass(frozen=True)
class Column:
    """One array a row.

    Attributes:
        name: path within the table, such as `observation/points`.
        dtype: numpy's name of the number type.
        tail: the axes whose length is the same in all rows.
        variable: how many axes before them differ in length from row to row: 0, 1 or 2.
        optional: whether a row may lack it.
        about: what it is, with its unit.
    """

    name: str
    dtype: str
    tail: tuple[int, ...] = ()
    variable: int = 0
    optional: bool = False
    about: str = ""

    def array(self, value: object) -> np.ndarray:
        """A value as it is stored.

        Raises:
            LogError: another shape than the column's, or what cannot be its numbers.
        """
        if isinstance(value, Tensor):
            value = value.detach().cpu().numpy()
        given, kind = np.asarray(value), np.dtype(self.dtype)
        whole = given.dtype.kind in "iu" and kind.kind in "iu"
        if not (whole or np.can_cast(given.dtype, kind, "same_kind")):
            raise LogError(f"Expected {self.name} to be numbers of type {self.dtype}, got {given.dtype}")
        array = np.asarray(given.astype(kind, copy=False), order="C")
        if whole and not (array == given).all():
            raise LogError(f"Expected {self.name} to fit numbers of type {self.dtype}, got some that do not")
        if array.ndim != self.variable + len(self.tail) or array.shape[self.variable :] != self.tail:
            wanted = ", ".join(["n", "m"][: self.variable] + [str(size) for size in self.tail])
            raise LogError(f"Expected {self.name} to have shape ({wanted}), got {given.shape}")
        return array


STAMPS = (
    Column("stamp_ns", "i8", about="ns since 1970, by the sensor's clock"),
    Column("received_ns", "i8", about="ns since 1970, when it was written down"),
    Column("flag", "u1", about="what is odd about the stamp: bits of `Odd`"),
)
"""What every raw stream has beside its kind's columns."""

KINDS: dict[str, tuple[Column, ...]] = {
    "points": (
        Column("points", "f4", (3,), 2, about="m, in the stream's frame; NaN where unknown; 1 x M where unorganised"),
        Column("color", "u1", (3,), 2, optional=True, about="red, green, blue of each point"),
    ),
    "depth": (Column("depth", "f4", (), 2, about="m along the camera's axis"),),
    "depth16": (Column("depth", "u2", (), 2, about="along the camera's axis, in the stream's `unit_m`; 0: unknown"),),
    "color": (Column("color", "u1", (3,), 2, about="red, green, blue"),),
    "camera": (
        Column("intrinsics", "f8", (3, 3), about="K, for pixel centres at whole numbers"),
        Column("distortion", "f8", (), 1, about="coefficients of the stream's `distortion_model`"),
        Column("size", "i4", (2,), about="rows, columns"),
    ),
    "wrench": (
        Column("force", "f8", (3,), about="N, in the stream's frame"),
        Column("torque", "f8", (3,), about="N m, about the frame's origin"),
    ),
    "joints": (
        Column("position", "f8", (), 1, about="rad or m, in the order of the stream's `names`; NaN where not given"),
        Column("velocity", "f8", (), 1, about="rad/s or m/s; NaN where not given"),
        Column("effort", "f8", (), 1, about="N m or N; NaN where not given"),
    ),
    "pose": (Column("pose", "f8", (4, 4), about="parent_T_child, m"),),
    "numbers": (Column("numbers", "f8", (), 1, about="of one sensor; NaN where it gave none"),),
    "contact": (Column("touched", "u1", (), 1, about="1 where a taxel, finger or pad touches"),),
}
"""Columns of each kind of raw stream."""


def reading_columns(float_type: str, kind: type[Reading] = Reading) -> tuple[Column, ...]:
    """The columns of what a run takes in step by step: reading, control, truth, and a digest of the belief after it.

    Args:
        float_type: of floating numbers, `f4` or `f8`.
        kind: of the readings; one with further fields has further columns.
    """
    return (
        *(
            dataclasses.replace(column, dtype=float_type) if column.dtype == "float" else column
            for column in _of_dataclass(kind, "reading/")
        ),
        Column("control", float_type, (), 1, optional=True, about="the action that led here, in [-1, 1]"),
        Column("truth", float_type, (4, 4), optional=True, about="true world_T_object, for metrics alone"),
        Column("digest", "u1", (32,), optional=True, about="SHA-256 of the belief after this reading"),
        Column("taken_ns", "i8", about="ns since 1970, when it was written down"),
    )


def reading_values(reading: Reading) -> dict[str, object]:
    """What `reading_columns` names, of a reading.

    Raises:
        LogError: it has measurements of further sensors, which have no columns.
    """
    values = dict(_flat(reading, "reading/"))
    if values.pop("reading/measurements"):
        names = ", ".join(reading.measurements)
        raise LogError(f"Expected a reading without measurements of further sensors, got {names}: add a stream of each")
    return values


def reading_of(values: Mapping[str, np.ndarray | None], kind: type[Reading] = Reading) -> Reading:
    """The reading of a row, of a kind; fields that the row has no columns for have their defaults.

    Raises:
        ValueError: the row holds no reading.
    """
    made: Reading = _built(kind, values, "reading/")
    return made


def _of_dataclass(kind: type, prefix: str) -> Iterator[Column]:
    """Columns of a dataclass of tensors, by its hints: a log follows what a reading holds."""
    for name, hint in typing.get_type_hints(kind).items():
        inner, optional = _bare(hint)
        if typing.get_origin(inner) is Mapping:
            continue  # the measurements of further sensors: each is a stream of its own
        if dataclasses.is_dataclass(inner) and isinstance(inner, type) and not optional:
            yield from _of_dataclass(inner, f"{prefix}{name}/")
        elif inner is float:
            yield Column(prefix + name, "f8", optional=optional)
        elif hasattr(inner, "dim_str"):
            axes = [axis for axis in inner.dim_str.split() if not axis.startswith("*")]
            tail = tuple(int(axis) for axis in axes if axis.isdigit())
            variable = len(axes) - len(tail)
            if axes[variable:] != [str(size) for size in tail]:
                raise TypeError(f"Expected {name} to have its fixed axes last, got {inner.dim_str!r}")
            yield Column(prefix + name, _number_type(inner), tail, variable, optional)
        else:
            raise TypeError(f"Expected {kind.__name__}.{name} to be a tensor, a float or a dataclass of these")


def _bare(hint: Any) -> tuple[Any, bool]:  # noqa: ANN401  (a type, or what jaxtyping makes of one)
    """A hint without None, and whether it had it."""
    if typing.get_origin(hint) in (types.UnionType, typing.Union):
        options = [option for option in typing.get_args(hint) if option is not types.NoneType]
        return options[0], len(options) < len(typing.get_args(hint))
    return hint, False


def _number_type(hint: Any) -> str:  # noqa: ANN401  (a jaxtyping hint)
    names = hint.dtypes
    if "bool" in names or "bool_" in names:
        return "?"
    return "i8" if any(name.startswith("int") for name in names) else "float"


def _flat(value: object, prefix: str) -> Iterator[tuple[str, object]]:
    for field in dataclasses.fields(value):  # type: ignore[arg-type]
        item = getattr(value, field.name)
        if dataclasses.is_dataclass(item):
            yield from _flat(item, f"{prefix}{field.name}/")
        else:
            yield prefix + field.name, item


def _built(kind: Any, values: Mapping[str, np.ndarray | None], prefix: str) -> Any:  # noqa: ANN401
    made: dict[str, Any] = {}
    for name, hint in typing.get_type_hints(kind).items():
        inner, _ = _bare(hint)
        at = prefix + name
        if dataclasses.is_dataclass(inner) and any(key.startswith(f"{at}/") for key in values):
            made[name] = _built(inner, values, f"{at}/")
        elif at in values:  # a field that is younger than the log keeps its default
            value = values[at]
            made[name] = None if value is None else float(value) if inner is float else torch.from_numpy(value.copy())
    try:
        return kind(**made)
    except TypeError as error:
        raise LogError(f"Expected a reading, got a row without all that one needs: {error}") from None
