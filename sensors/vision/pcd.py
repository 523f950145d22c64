"""PCD files of the Point Cloud Library, version 0.7 and before: ASCII, binary and compressed (LZF)."""

import struct
from typing import NamedTuple

import numpy as np

_KINDS = {"I": "i", "U": "u", "F": "f"}
_SIZES = {"I": (1, 2, 4, 8), "U": (1, 2, 4, 8), "F": (4, 8)}
_AT_ORIGIN = ["0", "0", "0", "1", "0", "0", "0"]


class PCDFile(NamedTuple):
    """Contents of a PCD file.

    Attributes:
        columns: values by field; fields of several values a point are (M, count), padding is left out.
        width: points a row, or all of an unorganised cloud.
        height: rows, 1 of an unorganised cloud.
        viewpoint: place and quaternion (w, x, y, z) of the sensor.
    """

    columns: dict[str, np.ndarray]
    width: int
    height: int
    viewpoint: tuple[float, ...]


def read_pcd(data: bytes) -> PCDFile:
    """Read the bytes of a PCD file.

    Raises:
        ValueError: something in it is missing or contradicts the rest.
    """
    header, body = _header(data)
    fields = header["FIELDS"]
    sizes = [int(x) for x in header["SIZE"]]
    types = header["TYPE"]
    counts = [int(x) for x in header.get("COUNT", ["1"] * len(fields))]
    if not len(fields) == len(sizes) == len(types) == len(counts):
        raise ValueError(
            f"expected a SIZE, TYPE and COUNT for each of FIELDS, got {len(fields)} fields, {len(sizes)} sizes, "
            f"{len(types)} types and {len(counts)} counts"
        )
    if any(kind not in _KINDS for kind in types) or any(count < 1 for count in counts):
        raise ValueError(f"expected TYPE of I, U and F and COUNT of 1 or more, got {' '.join(types)} and {counts}")
    if any(size not in _SIZES[kind] for kind, size in zip(types, sizes, strict=True)):
        raise ValueError(f"expected SIZE of 1, 2, 4 or 8 bytes, of F 4 or 8, got {sizes} for {' '.join(types)}")
    width, height = int(header["WIDTH"][0]), int(header["HEIGHT"][0])
    points = int(header["POINTS"][0]) if "POINTS" in header else width * height
    if width < 0 or points != width * height:
        raise ValueError(f"expected POINTS to be WIDTH times HEIGHT, got {points} and {width} x {height}")
    viewpoint = tuple(float(x) for x in header.get("VIEWPOINT", _AT_ORIGIN))
    if len(viewpoint) != 7:
        raise ValueError(f"expected 7 numbers of VIEWPOINT, got {len(viewpoint)}")
    kinds = [np.dtype(f"<{_KINDS[kind]}{size}") for kind, size in zip(types, sizes, strict=True)]
    way = header["DATA"][0].lower()
    if way == "ascii":
        arrays = _ascii(body, kinds, counts, points)
    elif way == "binary":
        arrays = _binary(body, kinds, counts, points)
    elif way == "binary_compressed":
        arrays = _compressed(body, kinds, counts, points)
    else:
        raise ValueError(f"expected DATA ascii, binary or binary_compressed, got {way!r}")
    columns = {
        name: array[:, 0] if count == 1 else array
        for name, array, count in zip(fields, arrays, counts, strict=True)
        if name != "_"
    }
    return PCDFile(columns, width, height, viewpoint)


def lzf_decompressed(data: bytes, size: int) -> bytes:
    """Bytes that LZF packed: runs of bytes as they are, and runs that were there before.

    Args:
        data: what was packed.
        size: of what comes out.

    Raises:
        ValueError: it comes out otherwise.
    """
    out = bytearray()
    place, end = 0, len(data)
    try:
        while place < end:
            control = data[place]
            place += 1
            if control < 32:  # so many bytes and one as they are
                if place + control + 1 > end:
                    raise ValueError("expected compressed data to end with a run, got a part of one")
                out += data[place : place + control + 1]
                place += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += data[place]
                place += 1
            start = len(out) - ((control & 31) << 8) - data[place] - 1
            place += 1
            if start < 0:
                raise ValueError("expected compressed data to point into what was unpacked, got a place before it")
            length += 2
            if start + length <= len(out):
                out += out[start : start + length]
            else:  # it repeats what it makes itself
                piece = bytes(out[start:])
                out += (piece * (length // len(piece) + 1))[:length]
    except IndexError:
        raise ValueError("expected compressed data to end with a run, got a part of one") from None
    if len(out) != size:
        raise ValueError(f"expected {size} bytes unpacked, got {len(out)}")
    return bytes(out)


def _header(data: bytes) -> tuple[dict[str, list[str]], bytes]:
    header: dict[str, list[str]] = {}
    place = 0
    while "DATA" not in header:
        end = data.find(b"\n", place)
        if end < 0 or end - place > 10_000:
            raise ValueError("expected a PCD header that ends with DATA")
        words = data[place:end].decode("ascii", errors="replace").split()
        place = end + 1
        if words and not words[0].startswith("#"):
            header[words[0].upper()] = words[1:]
    for name in ("FIELDS", "SIZE", "TYPE", "WIDTH", "HEIGHT", "DATA"):
        if not header.get(name):
            raise ValueError(f"expected {name} in the PCD header")
    return header, data[place:]


def _ascii(body: bytes, kinds: list[np.dtype], counts: list[int], points: int) -> list[np.ndarray]:
    rows = [line.split() for line in body.decode("ascii", errors="replace").splitlines() if line.strip()]
    if len(rows) != points or any(len(row) != sum(counts) for row in rows):
        raise ValueError(f"expected {points} lines of {sum(counts)} numbers, got {len(rows)} lines")
    found, column = [], 0
    for kind, count in zip(kinds, counts, strict=True):
        own = [row[column : column + count] for row in rows]
        table = np.array(own, dtype=np.float64 if kind.kind == "f" else np.int64).reshape(points, count)
        found.append(table.astype(kind))
        column += count
    return found


def _binary(body: bytes, kinds: list[np.dtype], counts: list[int], points: int) -> list[np.ndarray]:
    row = np.dtype([(f"f{i}", kind, (count,)) for i, (kind, count) in enumerate(zip(kinds, counts, strict=True))])
    if len(body) < points * row.itemsize:
        raise ValueError(f"expected {points} points of {row.itemsize} bytes, got {len(body)} bytes")
    table = np.frombuffer(body, dtype=row, count=points)
    return [np.ascontiguousarray(table[f"f{i}"]) for i in range(len(kinds))]


def _compressed(body: bytes, kinds: list[np.dtype], counts: list[int], points: int) -> list[np.ndarray]:
    if len(body) < 8:
        raise ValueError("expected two sizes before compressed data")
    packed, size = struct.unpack("<II", body[:8])
    wanted = points * sum(kind.itemsize * count for kind, count in zip(kinds, counts, strict=True))
    if size != wanted or len(body) < 8 + packed:
        raise ValueError(
            f"expected {wanted} bytes from {packed} compressed ones, got {size} bytes from {len(body) - 8}"
        )
    # field after field, each with all points
    data = lzf_decompressed(body[8 : 8 + packed], size)
    found, place = [], 0
    for kind, count in zip(kinds, counts, strict=True):
        end = place + points * kind.itemsize * count
        found.append(np.frombuffer(data[place:end], dtype=kind).reshape(points, count))
        place = end
    return found
