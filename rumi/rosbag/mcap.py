"""Salvage of an MCAP file that was cut short or is damaged: its records one after the other.

An undamaged file is read by rosbags, by its index. This needs no index, takes of a chunk that was cut short what can be
unpacked, and goes on after a chunk that is damaged. (Format: mcap.dev/spec.)
"""

import importlib.util
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from sdf.extras import optional

MAGIC = b"\x89MCAP0\r\n"
_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _LAST = 0x01, 0x02, 0x03, 0x04, 0x05, 0x06, 0x0F
_LONGEST = 1 << 40  # of a record; more is damage


class BagError(Exception):
    """The bag cannot be read, or not further."""


class Message(NamedTuple):
    """A message of a recording.

    Attributes:
        topic: of its channel.
        kind: name of its type.
        received_ns: when it was written down.
        data: packed; of text, the message itself.
    """

    topic: str
    kind: str
    received_ns: int
    data: Any


class Walk:
    """Walks a file.

    Args:
        path: of the file.

    Attributes:
        problems: what could not be read, as far as the walk went.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, tuple[int, str]] = {}
        self.problems: list[str] = []

    def messages(self) -> Iterator[Message]:
        """All messages that can be read, in the order in which they lie.

        Raises:
            ValueError: the file does not begin as MCAP.
        """
        size = self._path.stat().st_size
        with self._path.open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise ValueError(f"{self._path} does not begin as an MCAP file")
            while True:
                at = file.tell()
                head = file.read(9)
                if len(head) < 9:
                    self.problems.append(f"the file ends without its index, after {at} bytes: it was cut short")
                    return
                code, length = head[0], struct.unpack("<Q", head[1:])[0]
                left = size - file.tell()
                if code == _FOOTER:
                    return
                if not _HEADER <= code <= _LAST or length > _LONGEST:
                    self.problems.append(f"the file is damaged at byte {at}: {size - at} bytes from there are left out")
                    return
                if code == _CHUNK:
                    yield from self._chunk(file.read(min(length, left)), at)
                    file.seek(at + 9 + length)
                    continue
                content = file.read(min(length, left))  # a damaged length may be of more than fits in memory
                if len(content) < length:
                    self.problems.append(f"the file ends within a record, at byte {at}: it was cut short")
                    return
                yield from self._record(code, content)

    def _chunk(self, content: bytes, at: int) -> Iterator[Message]:
        try:
            _, _, whole, crc, named = struct.unpack_from("<QQQII", content)
            packing = content[32 : 32 + named].decode()
            (packed,) = struct.unpack_from("<Q", content, 32 + named)
        except (struct.error, UnicodeDecodeError):
            self.problems.append(f"a chunk at byte {at} is damaged and left out")
            return
        data = _unpacked(content[40 + named : 40 + named + packed], packing)
        if len(data) == whole and crc and zlib.crc32(data) != crc:
            self.problems.append(f"a chunk at byte {at} has another checksum than it says and is left out")
            return
        place = 0
        while place + 9 <= len(data):
            code, size = data[place], struct.unpack_from("<Q", data, place + 1)[0]
            if place + 9 + size > len(data):
                break
            yield from self._record(code, data[place + 9 : place + 9 + size])
            place += 9 + size
        if place < whole:
            self.problems.append(f"of a chunk at byte {at} the last {whole - place} of {whole} bytes are left out")

    def _record(self, code: int, content: bytes) -> Iterator[Message]:
        try:
            if code == _SCHEMA:
                (key,) = struct.unpack_from("<H", content)
                self._schemas[key] = _text(content, 2)
            elif code == _CHANNEL:
                key, schema = struct.unpack_from("<HH", content)
                self._channels[key] = (schema, _text(content, 4))
            elif code == _MESSAGE:
                key, _, received, _ = struct.unpack_from("<HIQQ", content)
                if key in self._channels:
                    schema, topic = self._channels[key]
                    yield Message(topic, self._schemas.get(schema, ""), received, content[22:])
        except (struct.error, UnicodeDecodeError):
            self.problems.append("a record is damaged and left out")


def _text(content: bytes, at: int) -> str:
    (size,) = struct.unpack_from("<I", content, at)
    return content[at + 4 : at + 4 + size].decode()


def _unpacked(data: bytes, packing: str) -> bytes:
    """As much of a chunk as can be unpacked."""
    if not packing:
        return data
    unpacker: Any
    if packing == "lz4":
        unpacker, errors = optional("lz4.frame", "This bag").LZ4FrameDecompressor(), (RuntimeError, EOFError)
    elif packing == "zstd":
        # part of Python from 3.14 on
        home = "compression.zstd" if importlib.util.find_spec("compression") else "backports.zstd"
        zstd = optional(home, "This bag")
        unpacker, errors = zstd.ZstdDecompressor(), (zstd.ZstdError, EOFError)
    else:
        return b""
    found = b""
    try:
        # in pieces: what was unpacked before a damaged one is kept
        for start in range(0, len(data), 1 << 14):
            found += unpacker.decompress(data[start : start + (1 << 14)])
    except errors:
        pass
    return found
