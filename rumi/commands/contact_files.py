"""Files of points that were touched, and of their normals: CSV, OFF, PLY and NPZ."""

import math
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.errors import UsageError
from sdf.cache import DAMAGED
from sdf.mesh.off import read_off
from sdf.number_lines import numbers_of, table_of
from sensors.vision.numpy_files import read_arrays
from sensors.vision.ply import read_vertices

SUFFIXES = (".csv", ".txt", ".xyz", ".off", ".ply", ".npz", ".npy")

_Arrays = tuple[np.ndarray, np.ndarray | None]
_PLACE, _NORMAL = ("x", "y", "z"), ("nx", "ny", "nz")


class Contacts(NamedTuple):
    """What a file holds.

    Attributes:
        points: (K, 3), metres.
        normals: (K, 3), as they came; None where the file has none.
    """

    points: Float[Tensor, "K 3"]
    normals: Float[Tensor, "K 3"] | None


def read_contacts(path: str | Path, *, scale: float = 1.0) -> Contacts:
    """Read points and, where there are some, normals; lines without numbers and what follows # are passed over.

    Args:
        path: .csv, .txt or .xyz (3 columns, or 6 with normals; a header may name them x, y, z, nx, ny, nz in any
            order), .off, .ply, .npz (arrays `points` and `normals`) or .npy (3 columns, or 6).
        scale: metres that one unit of the file is.

    Raises:
        UsageError: no such file, or nothing in it that can be points; with the line, where there is one.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise UsageError(f"Expected contacts ending in {', '.join(SUFFIXES)}, got {path}")
    if not path.is_file():
        raise UsageError(f"Expected contacts in {path}, got {'a folder' if path.is_dir() else 'no such file'}")
    if not (scale > 0 and math.isfinite(scale)):
        raise UsageError(f"Expected a scale of the points above 0 and finite, got {scale}")
    try:
        if suffix in (".npz", ".npy"):
            points, normals = _arrays(path.read_bytes())
        elif suffix == ".ply":
            points, normals = _named(read_vertices(path.read_bytes()))
        elif suffix == ".off":
            points, normals = _split(read_off(path.read_text(errors="replace"))[0])
        else:
            points, normals = _table(path.read_text(errors="replace"))
    except (IndexError, *DAMAGED) as error:
        raise UsageError(f"Expected contacts in {path}, could not read them: {error}") from error
    if points.ndim != 2 or points.shape[1] != 3 or (normals is not None and normals.shape != points.shape):
        shapes = f"{points.shape}" + ("" if normals is None else f" and normals {normals.shape}")
        raise UsageError(f"Expected points (K, 3), and as many normals where there are some, in {path}, got {shapes}")
    if len(points) == 0:
        raise UsageError(f"Expected contacts in {path}, got none: one point a line, as x, y, z in metres")
    return Contacts(torch.tensor(points * scale), None if normals is None else torch.tensor(normals))


def _split(rows: list[tuple[int, list[float]]], columns: list[str] | None = None) -> _Arrays:
    """Points and normals of rows that are all as long."""
    if not rows:
        return np.empty((0, 3)), None
    table = table_of(rows, len(columns or rows[0][1]))
    if columns is None:
        if table.shape[1] not in (3, 6):
            raise ValueError(f"expected 3 numbers a line, or 6 with normals, got {table.shape[1]}")
        columns = [*_PLACE, *_NORMAL][: table.shape[1]]
    if twice := [name for name in (*_PLACE, *_NORMAL) if columns.count(name) > 1]:
        raise ValueError(f"expected each column once, got {', '.join(twice)} more than once")
    return _named(dict(zip(columns, table.T, strict=True)))


def _named(columns: dict[str, np.ndarray]) -> _Arrays:
    lacking = [name for name in _PLACE if name not in columns]
    if lacking:
        raise ValueError(f"expected columns x, y and z, found {', '.join(columns) or 'none'}")
    points = np.stack([columns[name].astype(float) for name in _PLACE], -1)
    if not all(name in columns for name in _NORMAL):
        return points, None
    return points, np.stack([columns[name].astype(float) for name in _NORMAL], -1)


def _table(text: str) -> _Arrays:
    """Columns, with a header or without."""
    lines = text.lstrip("\ufeff").splitlines()
    for place, line in enumerate(lines):
        words = [word.strip().strip('"').lower() for word in re.split(r"[,;\s]+", line.strip()) if word]
        if not words or words[0].startswith("#"):
            continue
        if all(name in words for name in _PLACE):
            return _split(numbers_of(lines[place + 1 :], place + 2), words)
        break
    return _split(numbers_of(lines))


def _arrays(data: bytes) -> _Arrays:
    arrays = {name: array.astype(float) for name, array in read_arrays(data, "points", "normals").items()}
    if "points" not in arrays:
        raise ValueError("expected an array `points`, found normals alone")
    points, normals = arrays["points"], arrays.get("normals")
    if normals is None and points.ndim == 2 and points.shape[1] == 6:
        return points[:, :3], points[:, 3:]
    return points, normals
