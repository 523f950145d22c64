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

SUFFIXES = (".csv", ".txt", ".xyz", ".off", ".ply", ".npz", ".npy")

_PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_Arrays = tuple[np.ndarray, np.ndarray | None]
_PLY_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
_DECIMAL_COMMA = re.compile(r"[-+]?\d+(,\d+)?([eE][-+]?\d+)?")
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
            order), .off, .ply, .npz (arrays `points` and `normals`) or .npy.
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
            points, normals = _arrays(path)
        elif suffix == ".ply":
            points, normals = _ply(path.read_bytes())
        else:
            points, normals = (_off if suffix == ".off" else _table)(path.read_text(errors="replace"))
    except (IndexError, *DAMAGED) as error:
        raise UsageError(f"Expected contacts in {path}, could not read them: {error}") from error
    if points.ndim != 2 or points.shape[1] != 3 or (normals is not None and normals.shape != points.shape):
        shapes = f"{points.shape}" + ("" if normals is None else f" and normals {normals.shape}")
        raise UsageError(f"Expected points (K, 3), and as many normals where there are some, in {path}, got {shapes}")
    if len(points) == 0:
        raise UsageError(f"Expected contacts in {path}, got none: one point a line, as x, y, z in metres")
    return Contacts(torch.tensor(points * scale), None if normals is None else torch.tensor(normals))


def _numbers(lines: list[str], first: int = 1) -> list[tuple[int, list[float]]]:
    """The numbers of each line that has something, with the line's number."""
    rows = []
    for number, line in enumerate(lines, first):
        text = line.partition("#")[0]
        words = [word for word in re.split(r"[,;\s]+", text) if word]
        if words:
            if "," in text and _has_decimal_commas(text):
                raise ValueError(
                    f"line {number} seems to have decimal commas, where a comma is taken to part two numbers: "
                    f"{line.strip()[:60]!r}; write decimal points, or a blank behind each comma that parts"
                )
            try:
                rows.append((number, [float(word) for word in words]))
            except ValueError:
                raise ValueError(f"line {number} has something that is no number: {line.strip()[:60]!r}") from None
    return rows


def _has_decimal_commas(text: str) -> bool:
    """Whether commas stand within numbers that something else parts: 3 or 6 of them then."""
    words = [word for word in re.split(r"[;\s]+", text) if word]
    return len(words) in (3, 6) and all(_DECIMAL_COMMA.fullmatch(word) for word in words)


def _split(rows: list[tuple[int, list[float]]], columns: list[str] | None = None) -> _Arrays:
    """Points and normals of rows that are all as long."""
    if not rows:
        return np.empty((0, 3)), None
    width = len(columns) if columns else len(rows[0][1])
    for number, row in rows:
        if len(row) != width:
            raise ValueError(f"line {number} has {len(row)} numbers where others have {width}")
    table = np.array([row for _, row in rows])
    if columns is None:
        if width not in (3, 6):
            raise ValueError(f"expected 3 numbers a line, or 6 with normals, got {width}")
        columns = [*_PLACE, *_NORMAL][:width]
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
            return _split(_numbers(lines[place + 1 :], place + 2), words)
        break
    return _split(_numbers(lines))


def _off(text: str) -> _Arrays:
    """OFF without faces, or with: the header may have numbers of any kind."""
    lines = text.splitlines()
    for place, line in enumerate(lines):
        words = line.partition("#")[0].split()
        if not words:
            continue
        if not words[0].upper().endswith("OFF"):
            raise ValueError(f"expected OFF in its first line, got {line.strip()[:40]!r}")
        lines[place] = " ".join(words[1:])
        break
    rows = _numbers(lines)
    if not rows:
        raise ValueError("expected the number of points after OFF, got nothing")
    said = rows[0][1][0]
    if not (said >= 0 and said.is_integer()):
        raise ValueError(f"expected the number of points after OFF, got {said:g}")
    count = int(said)
    if len(rows) - 1 < count:
        raise ValueError(f"expected the {count} points that its header says, got {len(rows) - 1}")
    if len(rows) - 1 > count and not (len(rows[0][1]) > 1 and rows[0][1][1] > 0):
        raise ValueError(f"expected the {count} points that its header says, got {len(rows) - 1}")
    return _split(rows[1 : 1 + count])


def _ply(data: bytes) -> _Arrays:
    """The vertices of a PLY file, which must come first in it; ASCII or binary."""
    head, mark, body = data.partition(b"end_header")
    lines = head.decode("ascii", errors="replace").splitlines()
    if not lines or lines[0].strip() != "ply" or not mark:
        raise ValueError("expected a PLY header")
    form = next((" ".join(line.split()[1:2]) for line in lines if line.startswith("format")), "")
    if form not in ("ascii", *_PLY_ORDERS):
        raise ValueError(f"expected the format of a PLY to be one of ascii, {', '.join(_PLY_ORDERS)}, got {form!r}")
    elements = [place for place, line in enumerate(lines) if line.startswith("element")]
    first = lines[elements[0]].split() if elements else []
    if first[1:2] != ["vertex"]:
        raise ValueError("expected vertices as its first element")
    if len(first) != 3 or not first[2].isdecimal():
        raise ValueError(f"expected `element vertex` and a count of 0 or more, got {lines[elements[0]].strip()[:60]!r}")
    count = int(first[2])
    end = elements[1] if len(elements) > 1 else len(lines)
    fields = [line.split() for line in lines[elements[0] + 1 : end] if line.startswith("property")]
    for words in fields:
        if len(words) != 3 or words[1] not in _PLY_TYPES:
            raise ValueError(
                f"expected vertices of properties without lists, of types {', '.join(_PLY_TYPES)}, got "
                f"{' '.join(words)[:60]!r}"
            )
    body = body[body.index(b"\n") + 1 :] if b"\n" in body else b""
    if form == "ascii":
        rows = _numbers(body.decode("ascii", errors="replace").splitlines(), len(lines) + 2)[:count]
        if len(rows) < count:
            raise ValueError(f"expected the {count} vertices that its header says, got {len(rows)}")
        return _split(rows, [words[2] for words in fields])
    kind = np.dtype([(words[2], _PLY_ORDERS[form] + _PLY_TYPES[words[1]]) for words in fields])
    if len(body) < count * kind.itemsize:
        raise ValueError(f"expected the {count} vertices that its header says, got {len(body) // kind.itemsize}")
    table = np.frombuffer(body, dtype=kind, count=count)
    return _named({words[2]: table[words[2]] for words in fields})


def _arrays(path: Path) -> _Arrays:
    with path.open("rb") as file:
        begins = file.read(6)
    if not (begins.startswith(b"PK") or begins == b"\x93NUMPY"):
        kind = "an archive of arrays, as numpy.savez writes it" if path.suffix.lower() == ".npz" else "a NumPy array"
        raise ValueError(f"expected {kind}, and it is none")
    loaded = np.load(path, allow_pickle=False)
    if isinstance(loaded, np.ndarray):
        table = _real(loaded, "an array")
        return (table[:, :3], table[:, 3:]) if table.ndim == 2 and table.shape[1] == 6 else (table, None)
    with loaded:
        if "points" not in loaded:
            raise ValueError(f"expected an array `points`, found {', '.join(loaded) or 'none'}")
        normals = _real(loaded["normals"], "`normals`") if "normals" in loaded else None
        return _real(loaded["points"], "`points`"), normals


def _real(array: np.ndarray, name: str) -> np.ndarray:
    if array.dtype.kind not in "fiu":
        raise ValueError(f"expected {name} of real numbers, got {array.dtype}")
    return np.array(array, dtype=float)
