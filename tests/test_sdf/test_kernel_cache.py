"""Compiled kernels on disk: shared by all checkouts, compiled by one process alone, removed when nobody reads them."""

import importlib
import os
import shutil
import sys

import numpy as np
import pytest

pytest.importorskip("numba")

import numba

from sdf import compiled, kernel_cache
from sdf.kernel_cache import SEASON_S
from sdf.part_numba import indices

SOURCE = """
from sdf.compiled import Kernel


def _fill(result, which):
    result[0] = {value}


fill = Kernel(_fill)
"""


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "cache"))
    return tmp_path / "cache"


def misses(kernel):
    """How often a kernel was compiled."""
    return sum(kernel._compiled.stats.cache_misses.values())


def test_checkouts_share_what_is_the_same_and_keep_what_is_not(tmp_path, cache, monkeypatch):
    found = []
    for name, value in (("one", 1.0), ("other", 1.0), ("changed", 2.0), ("one", 1.0)):
        (tmp_path / name).mkdir(exist_ok=True)
        (tmp_path / name / "checkout_numba.py").write_text(SOURCE.format(value=value))
        importlib.invalidate_caches()
        with monkeypatch.context() as patch:
            patch.syspath_prepend(tmp_path / name)
            kernel = importlib.import_module("checkout_numba").fill
        result = np.zeros(1)
        kernel(result)
        del sys.modules["checkout_numba"]
        found.append((result[0], misses(kernel)))
    assert found == [(1.0, 1), (1.0, 0), (2.0, 1), (1.0, 0)]
    assert len(list(cache.rglob("*.nbi"))) == 2


def test_checkouts_whose_kernels_import_other_numbers_share_nothing(tmp_path, monkeypatch):
    found = []
    for value in (1.0, 2.0):
        (tmp_path / "plain.py").write_text(f"NUMBER = {value}\n")
        (tmp_path / "checkout_numba.py").write_text("from plain import NUMBER\n" + SOURCE.format(value="NUMBER"))
        importlib.invalidate_caches()
        result = np.zeros(1)
        with monkeypatch.context() as patch:
            patch.syspath_prepend(tmp_path)
            patch.setattr(sys, "dont_write_bytecode", True)
            importlib.import_module("checkout_numba").fill(result)
        for name in ("checkout_numba", "plain"):
            del sys.modules[name]
        found.append(result[0])
    assert found == [1.0, 2.0]


@pytest.mark.skipif(sys.platform == "win32", reason="no such locks")
def test_what_another_process_compiles_is_waited_for(tmp_path, cache, monkeypatch):
    import fcntl

    compiled.Kernel(_twice)(np.ones(1))
    (index,) = cache.rglob("*.nbi")
    lock = os.open(next(cache.rglob("*.lock")), os.O_RDWR)
    fcntl.flock(lock, fcntl.LOCK_EX)  # the other
    there = index.parent
    shutil.move(there, tmp_path / "aside")
    there.mkdir()
    os.link(tmp_path / "aside" / next((tmp_path / "aside").glob("*.lock")).name, there / f"{index.stem}.lock")
    waited = []

    def other_is_ready(seconds):
        waited.append(seconds)
        for path in (tmp_path / "aside").glob("*.nb[ic]"):
            shutil.copy(path, there)
        os.close(lock)

    monkeypatch.setattr(kernel_cache.time, "sleep", other_is_ready)
    kernel = compiled.Kernel(_twice)
    kernel(np.ones(1))
    assert len(waited) == 1 and misses(kernel) == 0


@pytest.mark.skipif(sys.platform == "win32", reason="no such locks")
def test_where_files_cannot_be_locked_each_compiles_and_leaves_nothing_open(monkeypatch):
    import errno
    import fcntl

    opened, closed = [], []

    def no_locks(handle, operation):
        opened.append(handle)
        raise OSError(errno.ENOLCK, "no locks")

    close = os.close
    monkeypatch.setattr(fcntl, "flock", no_locks)
    monkeypatch.setattr(kernel_cache.os, "close", lambda handle: (closed.append(handle), close(handle)))
    values = np.ones(1)
    compiled.Kernel(_twice)(values)
    assert values[0] == 2.0 and opened and set(opened) <= set(closed)


def _twice(values, part):
    for index in indices(part, len(values)):
        values[index] *= 2.0


def test_what_nobody_reads_is_removed_and_what_is_read_stays(cache):
    values = np.ones(1)
    compiled.Kernel(_twice)(values)
    (index,) = cache.rglob("*.nbi")
    (old := index.parent / "_old-.py311.nbi").write_bytes(b"")
    for path in (index, old):
        os.utime(path, times=(0.0, 0.0))
    compiled.Kernel(_twice)(values)  # read, which counts as use
    assert index.stat().st_mtime > SEASON_S and values[0] == 4.0
    compiled.Kernel(_twice)(values.astype(np.float32))
    assert index.exists() and not old.exists()


def test_a_kernel_that_cannot_be_compiled_keeps_nobody_waiting(monkeypatch):
    def wrong(values, part):
        values.nothing_of_the_sort()

    monkeypatch.setattr(kernel_cache, "LONGEST_S", 0.1)
    for _ in range(2):
        with pytest.raises(numba.core.errors.TypingError):
            compiled.Kernel(wrong)(np.ones(1))
    compiled.Kernel(_twice)(np.ones(1))
    assert kernel_cache.KernelCache._held is None


def test_where_nothing_can_be_written_kernels_run_all_the_same(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "file"))
    values = np.ones(1)
    compiled.Kernel(_twice)(values)
    assert values[0] == 2.0
