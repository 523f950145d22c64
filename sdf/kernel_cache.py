"""Kernel cache: compiled kernels on disk, one folder for all checkouts of a user, each compiled by one process alone.

Numba keeps what it compiles beside the source, so that every clone and every installation compiles it anew, and two
processes that need a kernel at the same time both compile it. Here a name stands for the content: of numba, the
processor, the kernel's file and those of its building blocks. Files that nothing has read for a season are removed.
"""

import hashlib
import os
import sys
import time
from contextlib import suppress
from pathlib import Path
from types import FunctionType
from typing import Any

import numba
from numba.core import config
from numba.core.caching import CompileResultCacheImpl, FunctionCache, _CacheLocator
from numba.core.registry import cpu_target

SEASON_S = 60 * 86400.0
"""Seconds after which a file that was not read is removed."""
LONGEST_S = 120.0
"""Seconds that a process waits for another to compile a kernel; then it does so itself."""


def folder() -> Path:
    """Folder of what is compiled for this processor, in $NUMBA_CACHE_DIR, else `rumi/kernels` of the user's cache."""
    user = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rumi" / "kernels"
    _, name, features = cpu_target.target_context.codegen().magic_tuple()
    processor = f"{name}-{hashlib.sha256(str(features).encode()).hexdigest()[:8]}"
    return Path(getattr(config, "CACHE_DIR", "") or user) / f"numba-{numba.__version__}" / processor


class _Locator(_CacheLocator):
    """Where a kernel is kept; None, as numba asks, where that cannot be written."""

    def __init__(self, py_func: FunctionType) -> None:
        self._py_file, self._path = py_func.__code__.co_filename, folder() / py_func.__module__

    @classmethod
    def from_function(cls, py_func: FunctionType, _: str) -> "_Locator | None":
        try:
            found = cls(py_func)
            found.ensure_cache_path()
        except (OSError, RuntimeError):  # as where there is no home
            return None
        return found

    def get_cache_path(self) -> str:
        return str(self._path)

    def get_source_stamp(self) -> str:
        return ""  # the kernel's name tells its content

    def get_disambiguator(self) -> str:
        return ""


class _Implementation(CompileResultCacheImpl):
    _locator_classes: Any = (_Locator, *CompileResultCacheImpl._locator_classes)


class KernelCache(FunctionCache):
    """Numba's cache of a function, in `folder()`; whoever finds nothing there has it to itself until it is saved.

    Args:
        py_func: the function, by a name that stands for its content.
    """

    _impl_class = _Implementation
    _held: int | None = None  # the lock of the kernel that this process compiles: there is one at a time

    def load_overload(self, sig: Any, target_context: Any) -> Any:  # noqa: ANN401
        """What is kept for a signature; None, with the lock, where nothing is."""
        self._release()  # of one that could not be compiled
        found = super().load_overload(sig, target_context)
        if found is None and self._acquire():
            found = super().load_overload(sig, target_context)  # another may have compiled it meanwhile
            if found is not None:
                self._release()
        if found is not None:
            with suppress(OSError):
                for path in self._files():
                    os.utime(path)
        return found

    def save_overload(self, sig: Any, data: Any) -> None:  # noqa: ANN401
        """Keep what was compiled, and remove what nobody reads any more."""
        try:
            super().save_overload(sig, data)
        finally:
            self._release()
        with suppress(OSError):
            for path in Path(self.cache_path).iterdir():
                with suppress(FileNotFoundError):  # another process cleans up too
                    if time.time() - path.stat().st_mtime > SEASON_S:
                        path.unlink()

    def _files(self) -> list[Path]:
        return list(Path(self.cache_path).glob(f"{self._impl.filename_base}*.nb[ic]"))

    def _acquire(self) -> bool:
        """Wait for the kernel's lock; False where there are none, or another process takes too long."""
        if sys.platform == "win32":
            return False
        import fcntl

        path = Path(self.cache_path) / f"{self._impl.filename_base}.lock"
        try:
            handle = os.open(path, os.O_CREAT | os.O_RDWR)
        except OSError:
            return False
        until = time.monotonic() + LONGEST_S
        while time.monotonic() < until:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                os.utime(handle)  # so that nobody removes it as old while it is held
            except BlockingIOError:
                time.sleep(0.02)
                continue
            except OSError:  # a file system without locks
                break
            KernelCache._held = handle
            return True
        os.close(handle)
        return False

    @staticmethod
    def _release() -> None:
        if KernelCache._held is not None:
            os.close(KernelCache._held)
            KernelCache._held = None
