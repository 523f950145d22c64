"""HDF5 file whose superblock is repaired as it is read: one that still grows, was cut, or whose writer was killed.

HDF5 refuses such files by what their superblock says: marks of a writer, and an end that is not the file's. (Its own
way to read them, SWMR, waits for ever on parts that were cut off.) This view shows another superblock and zeros past
the end; whatever is missing then fails by its own checksum, and all else is read as usual.
"""

import io
import struct
from pathlib import Path
from typing import Any

_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_HEAD = struct.Struct("<8sBBBBQQQQ")  # superblock of version 3, without its checksum
_MASK = 0xFFFFFFFF


class RepairedHeader(io.RawIOBase):
    """The file, read-only; h5py takes it in place of a path.

    Args:
        path: of the file.

    Raises:
        ValueError: the file does not begin with a superblock of version 3, which all logs have.
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("rb")
        head = self._file.read(_HEAD.size)
        if len(head) < _HEAD.size or head[:8] != _SIGNATURE or head[8] != 3:
            self._file.close()
            raise ValueError("expected an HDF5 superblock of version 3 at its start")
        signature, version, offsets, lengths, _, base, extension, stored_end, root = _HEAD.unpack(head)
        self._size = max(stored_end, self._file.seek(0, io.SEEK_END))
        head = _HEAD.pack(signature, version, offsets, lengths, 0, base, extension, self._size, root)
        self._head = head + struct.pack("<I", _lookup3(head))
        self._at = 0

    def readinto(self, buffer: Any) -> int:  # noqa: ANN401  (whatever has a buffer)
        """Fill the buffer from where the view is; zeros where the file has ended."""
        view = memoryview(buffer).cast("B")
        count = max(0, min(len(view), self._size - self._at))
        self._file.seek(self._at)
        data = self._file.read(count)
        view[: len(data)] = data
        view[len(data) : count] = bytes(count - len(data))
        if self._at < len(self._head):
            part = self._head[self._at : self._at + count]
            view[: len(part)] = part
        self._at += count
        return count

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Go to a place."""
        start = {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._size}[whence]
        self._at = start + offset
        return self._at

    def tell(self) -> int:
        """Where the view is."""
        return self._at

    def readable(self) -> bool:
        """It is."""
        return True

    def seekable(self) -> bool:
        """It is."""
        return True

    def close(self) -> None:
        """Close the file."""
        self._file.close()
        super().close()


def _lookup3(data: bytes) -> int:
    """The checksum of HDF5's metadata: Bob Jenkins's lookup3 (public domain), of less than 2^32 bytes."""
    a = b = c = (0xDEADBEEF + len(data)) & _MASK
    words = list(struct.unpack(f"<{-(-len(data) // 12) * 3}I", data.ljust(-(-len(data) // 12) * 12, b"\0")))
    while len(words) > 3:
        a, b, c = ((x + y) & _MASK for x, y in zip((a, b, c), words[:3], strict=True))
        a, b, c = _mixed(a, b, c)
        words = words[3:]
    if not words:
        return c
    a, b, c = ((x + y) & _MASK for x, y in zip((a, b, c), words, strict=True))
    for bits in (14, 11, 25, 16, 4, 14, 24):
        # the three take turns: each is the next one's, less what the last one was turned by
        c = ((c ^ b) - _turned(b, bits)) & _MASK
        a, b, c = b, c, a
    return b


def _mixed(a: int, b: int, c: int) -> tuple[int, int, int]:
    for bits in (4, 6, 8, 16, 19, 4):
        a = ((a - c) & _MASK) ^ _turned(c, bits)
        c = (c + b) & _MASK
        a, b, c = b, c, a
    return a, b, c


def _turned(word: int, bits: int) -> int:
    return ((word << bits) | (word >> (32 - bits))) & _MASK
