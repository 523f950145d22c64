"""Disk cache of arrays: written aside and renamed, never pickled, computed again where a file cannot be read."""

import hashlib
import logging
import os
import struct
import tempfile
import tokenize
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sdf.grid_sdf import GridSDF
from sdf.processor import processor

_TABLE = ("values", "origin", "spacing", "bounds", "outer", "outer_spacing")

DAMAGED = (
    *(OSError, EOFError, ValueError, KeyError, TypeError, OverflowError, MemoryError, SyntaxError),
    *(zipfile.BadZipFile, zlib.error, tokenize.TokenError, struct.error),
    *(NotImplementedError, RuntimeError),  # a way of packing, or a password, that a flipped byte asks for
)
"""What reading a damaged .npz or .npy may raise, without pickles."""

_logger = logging.getLogger(__name__)


def content_key(*parts: bytes | str) -> str:
    """A name for what is worked out from these parts alone, on a processor such as this.

    Another may round it otherwise, and a home is shared: a run must not hang on who filled the cache.
    """
    digest = hashlib.sha256()
    for part in (*processor()[1:], *parts):
        content = part.encode() if isinstance(part, str) else part
        digest.update(len(content).to_bytes(8, "little"))
        digest.update(content)
    return digest.hexdigest()[:24]


def load_arrays(path: Path, names: Sequence[str]) -> dict[str, np.ndarray] | None:
    """Arrays of a file; None if there is no such file, or with a warning if it is not what was written there."""
    if not path.exists():
        return None
    try:
        with np.load(path, allow_pickle=False) as stored:
            return {name: stored[name] for name in names}
    except DAMAGED as error:
        _logger.warning("%s cannot be read (%s): working it out again", path, error)
        return None


def save_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays so that a reader never sees half a file, whoever else writes it meanwhile."""
    named: Any = dict(arrays)  # else they are checked against options of the function
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=path.stem, suffix=".tmp")
    try:
        with os.fdopen(handle, "wb") as file:
            np.savez(file, **named)
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def keep_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """`save_arrays`, or a warning where that cannot be: what was worked out is as good without being kept."""
    try:
        save_arrays(path, arrays)
    except OSError as error:
        _logger.warning("%s cannot be kept (%s): it will be worked out again next time", path, error)


def load_table(path: Path) -> GridSDF | None:
    """A tabulated SDF that `save_table` wrote; None if there is none, or with a warning if it is not one."""
    arrays = load_arrays(path, _TABLE)
    if arrays is None:
        return None
    try:
        values = torch.from_numpy(arrays["values"])
        if values.dtype != torch.float32 or not bool(torch.isfinite(values).all()):
            raise ValueError("its values are no finite numbers")
        x, y, z = arrays["origin"].tolist()
        return GridSDF(
            values,
            (x, y, z),
            float(arrays["spacing"]),
            torch.from_numpy(arrays["bounds"]),
            outer=int(arrays["outer"]),
            outer_spacing=float(arrays["outer_spacing"]),
        )
    except (ValueError, TypeError) as error:
        _logger.warning("%s holds no table of distances (%s): working it out again", path, error)
        return None


def save_table(path: Path, table: GridSDF) -> None:
    """Write a tabulated SDF, or warn where that cannot be."""
    keep_arrays(
        path,
        {
            "values": table.values.numpy(),
            "origin": np.array(table.origin),
            "spacing": np.array(table.spacing),
            "bounds": table.bounds.numpy(),
            "outer": np.array(table.outer),
            "outer_spacing": np.array(table.outer_spacing),
        },
    )
