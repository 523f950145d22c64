"""An .npz file that grows: arrays are added one by one, and a file cut short is readable up to the cut.

A finished file is a plain zip of .npy members, so that `numpy.load` opens it too. Its index stands at the end of the
file; while that is missing (the writer still runs, or was killed) the members are found by walking their headers.
"""

import io
import json
import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any, Self

import numpy as np

from sdf.cache import DAMAGED

_DATE = (1980, 1, 1, 0, 0, 0)  # the same arrays give the same bytes at any time
_HEADER = struct.Struct("<4s5H3I2H")
_SIGNATURE = b"PK\x03\x04"


class TraceWriter:
    """Adds members to a new file; what was added before `flush` survives a kill of the process."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("w+b")
        self._zip = zipfile.ZipFile(self._file, "w")

    def array(self, name: str, values: np.ndarray, *, compress: bool = True) -> None:
        """Add an array (never an array of objects); `compress` pays for anything but coordinates."""
        buffer = io.BytesIO()
        np.lib.format.write_array(buffer, np.asarray(values, order="C"), allow_pickle=False)
        self._add(f"{name}.npy", buffer.getvalue(), compress)

    def json(self, name: str, value: Any) -> None:  # noqa: ANN401  (whatever JSON holds)
        """Add a value as JSON; no number may be non-finite."""
        self._add(f"{name}.json", json.dumps(value, allow_nan=False).encode(), True)

    def flush(self) -> None:
        """Hand everything over to the operating system."""
        self._file.flush()

    def close(self) -> None:
        """Write the index and close; nothing can be added afterwards."""
        try:
            self._zip.close()
        except ValueError:
            pass  # an interrupt cut a member short: without an index the file is still read up to that one
        finally:
            self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _add(self, name: str, data: bytes, compress: bool) -> None:
        member = zipfile.ZipInfo(name, _DATE)
        member.compress_type = zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED
        self._zip.writestr(member, data, compresslevel=1)


def read_trace(path: Path) -> dict[str, Any]:
    """Everything that a file holds, by name without suffix: arrays and JSON values, in the order of writing.

    A member that was cut short, and all after it, is left out.
    """
    data = path.read_bytes()
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = {info.filename: archive.read(info) for info in archive.infolist()}
    except DAMAGED:
        members = _walk(data)
    return {name.rsplit(".", 1)[0]: _decode(name, member) for name, member in members.items()}


def _decode(name: str, data: bytes) -> Any:  # noqa: ANN401  (an array or whatever JSON holds)
    if name.endswith(".json"):
        return json.loads(data)
    return np.lib.format.read_array(io.BytesIO(data), allow_pickle=False)


def _walk(data: bytes) -> dict[str, bytes]:
    """Members of a zip file without its index, as far as they are whole."""
    members: dict[str, bytes] = {}
    position = 0
    while position + _HEADER.size <= len(data):
        fields = _HEADER.unpack_from(data, position)
        signature, method, crc, packed, _, name_length, extra_length = fields[0], fields[3], *fields[6:]
        start = position + _HEADER.size + name_length + extra_length
        # a header is written with sizes of 0 first and mended once its member is: no member of ours is empty
        if signature != _SIGNATURE or packed == 0 or start + packed > len(data):
            break
        content = data[start : start + packed]
        try:
            if method == zipfile.ZIP_DEFLATED:
                content = zlib.decompress(content, wbits=-15)
        except zlib.error:
            break
        if zlib.crc32(content) != crc:
            break
        members[data[position + _HEADER.size :][:name_length].decode()] = content
        position = start + packed
    return members
