"""Files written whole: under another name until they are, and with their path in what goes wrong."""

import contextlib
import os
import uuid
from collections.abc import Iterator
from pathlib import Path

from rumi.errors import UsageError


@contextlib.contextmanager
def naming(path: Path) -> Iterator[None]:
    """Within the block, a system's error that stops a write says what was written: a full disk does not say where.

    Args:
        path: of the file or folder.

    Raises:
        UsageError: with the path; a file that is there already stays a FileExistsError.
    """
    try:
        yield
    except FileExistsError:
        raise
    except OSError as error:
        raise UsageError(f"Cannot write {path}: {error.strerror or error}") from error


@contextlib.contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A name to write a file under; at the end the file takes its place, so that a reader finds it whole or not at all.

    Args:
        path: of the file. The other name ends as it does and is no other process's.

    Raises:
        UsageError: it cannot be written.
    """
    aside = _aside(path)
    with naming(path):
        try:
            yield aside
            aside.replace(path)
        finally:
            aside.unlink(missing_ok=True)


def new_file(path: Path, text: str) -> None:
    """Write a file that is not there yet, whole; of several processes that do so at the same time one succeeds.

    Args:
        path: of the file.
        text: all that it holds.

    Raises:
        FileExistsError: it is there.
        UsageError: it cannot be written.
    """
    aside = _aside(path)
    with naming(path):
        try:
            aside.write_text(text, encoding="utf-8")
            try:
                os.link(aside, path)
            except FileExistsError:
                raise
            except OSError:  # where the file system knows no links
                with path.open("x", encoding="utf-8") as file:
                    file.write(text)
        finally:
            aside.unlink(missing_ok=True)


def _aside(path: Path) -> Path:
    """A name beside a file's, with its ending, that nobody else takes."""
    return path.with_name(f".{uuid.uuid4().hex[:12]}-{path.name}")
