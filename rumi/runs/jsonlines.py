"""Files of JSON lines that several processes add to, and that a kill at any moment leaves readable."""

import json
import os
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from rumi.errors import UsageError
from rumi.runs.files import naming

if sys.platform != "win32":  # there one process at a time
    import fcntl


def read_lines(path: Path, start: int = 0) -> Iterator[tuple[dict[str, Any], int]]:
    """The objects of a file, each with the byte at which the next line starts.

    Lines that are no JSON object (cut off by a kill, say) are passed over; a last one without its end is left for
    later, since whoever writes it may not be done.

    Args:
        path: of the file; none there is an empty one.
        start: byte to start from, such as one that was given before.
    """
    if not path.exists():
        return
    with path.open("rb") as file:
        file.seek(start)
        for text in file:
            start += len(text)
            whole = text.endswith(b"\n")
            try:
                found = json.loads(text)
            except ValueError:
                continue
            if isinstance(found, dict) and whole:
                yield found, start


def append_line(path: Path, value: Mapping[str, Any]) -> None:
    """Add an object, after those that others add at the same time, and have it on the disk when this returns.

    What a kill had cut off ends before it, with a line of its own.

    Raises:
        UsageError: it cannot be written.
    """
    text = json.dumps(value, allow_nan=False) + "\n"
    with naming(path):
        _append(path, text)


def _append(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    file = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT, 0o644)
    try:
        if sys.platform != "win32":
            fcntl.flock(file, fcntl.LOCK_EX)
        if os.lseek(file, 0, os.SEEK_END) and os.lseek(file, -1, os.SEEK_END) >= 0 and os.read(file, 1) != b"\n":
            text = "\n" + text
        data = text.encode()
        while data:
            data = data[os.write(file, data) :]
        os.fsync(file)
    finally:
        os.close(file)  # and with it the lock


def check_writable(path: Path) -> None:
    """Make the folder of a file, and make sure that the file can be written there.

    Raises:
        UsageError: it cannot.
    """
    try:
        if path.is_dir():
            raise IsADirectoryError(21, "it is a folder")
        path.parent.mkdir(parents=True, exist_ok=True)
        # a file of lines grows; any other is written aside and put in its place
        probe = path if path.suffix == ".jsonl" else path.with_name(path.name + ".part")
        there = probe.exists()
        with probe.open("a", encoding="utf-8"):
            pass
        if not there:
            probe.unlink()
    except OSError as error:
        raise UsageError(f"Cannot write {path}: {error.strerror or error}; give another file") from error
