"""Vertices of PLY files."""

import numpy as np

from sdf.number_lines import numbers_of, table_of

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}


def read_vertices(data: bytes) -> dict[str, np.ndarray]:
    """Columns of the vertices of a PLY file, which must come first in it; ASCII or binary.

    Args:
        data: the file.

    Raises:
        ValueError: with what was expected.
    """
    head, mark, body = data.partition(b"end_header")
    lines = head.decode("ascii", errors="replace").splitlines()
    if not lines or lines[0].strip() != "ply" or not mark:
        raise ValueError("expected a PLY header")
    form = next((" ".join(line.split()[1:2]) for line in lines if line.startswith("format")), "")
    if form not in ("ascii", *_ORDERS):
        raise ValueError(f"expected the format of a PLY to be one of ascii, {', '.join(_ORDERS)}, got {form!r}")
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
        if len(words) != 3 or words[1] not in _TYPES:
            raise ValueError(
                f"expected vertices of properties without lists, of types {', '.join(_TYPES)}, got "
                f"{' '.join(words)[:60]!r}"
            )
    body = body[body.index(b"\n") + 1 :] if b"\n" in body else b""
    if form == "ascii":
        rows = numbers_of(body.decode("ascii", errors="replace").splitlines(), len(lines) + 2)[:count]
        if len(rows) < count:
            raise ValueError(f"expected the {count} vertices that its header says, got {len(rows)}")
        columns = zip(fields, table_of(rows, len(fields)).T, strict=True)
        # text may have more digits than the type that it is said to be of; whole numbers stay whole
        return {name: row if "f" in _TYPES[kind] else row.astype(_TYPES[kind]) for (_, kind, name), row in columns}
    kind = np.dtype([(words[2], _ORDERS[form] + _TYPES[words[1]]) for words in fields])
    if len(body) < count * kind.itemsize:
        raise ValueError(f"expected the {count} vertices that its header says, got {len(body) // kind.itemsize}")
    table = np.frombuffer(body, dtype=kind, count=count)
    return {words[2]: table[words[2]] for words in fields}
