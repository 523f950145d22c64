"""How many threads there are, what each does, and that results are the same to the bit for any number of them."""

import math
import os
import threading
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import numpy as np
import pytest
import torch

from sdf import threads
from sdf.compiled import Kernel
from sdf.part_numba import indices
from sdf.threads import PARTS, WORTH_S, chosen, count, divide, free, quota, running, team, using


@pytest.mark.parametrize(
    ("cores", "others", "allowed", "expected"),
    [
        (2, 0, math.inf, 2),
        (2, 1, math.inf, 1),
        (2, 5, math.inf, 1),
        (16, 5, math.inf, 11),
        (64, 40, 2.0, 2),
        (64, 63, 2.0, 1),
        (8, 0, 2.5, 2),
        (8, 0, 0.5, 1),
        (8, 1.5, math.inf, 6),
    ],
)
def test_as_many_threads_as_there_are_cores_free(cores, others, allowed, expected):
    assert free(cores, others, allowed) == expected


@pytest.mark.parametrize(
    ("most", "work_s", "expected"),
    [(8, 0.0, 1), (8, 1.9 * WORTH_S, 1), (8, 3.5 * WORTH_S, 3), (8, 1.0, 8), (1, 1.0, 1)],
)
def test_small_work_takes_one_thread(most, work_s, expected):
    assert team(most, work_s) == expected


def test_what_a_control_group_allows(tmp_path):
    assert quota(tmp_path / "none") == math.inf
    (tmp_path / "cpu").mkdir()
    for listed, expected in (("-1", math.inf), ("150000", 1.5)):
        (tmp_path / "cpu" / "cpu.cfs_quota_us").write_text(listed)
        (tmp_path / "cpu" / "cpu.cfs_period_us").write_text("100000")
        assert quota(tmp_path) == expected
    for listed, expected in (("max 100000", math.inf), ("250000 100000\n", 2.5), ("what?", math.inf)):
        (tmp_path / "cpu.max").write_text(listed)
        assert quota(tmp_path) == expected


def test_what_else_runs(tmp_path):
    (tmp_path / "loadavg").write_text("0.50 0.40 0.30 6/431 9876\n")
    assert running(tmp_path / "loadavg") == 5
    (tmp_path / "loadavg").write_text("0.50 0.40 0.30 1/431 9876\n")
    assert running(tmp_path / "loadavg") == 0
    assert running(tmp_path / "none") >= 0


@pytest.fixture
def torch_threads():
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


def test_a_library_follows_torch_and_a_block_its_own_number(torch_threads):
    torch_threads(2)
    assert count() == 2
    with using(3):
        assert (count(), torch.get_num_threads()) == (3, 1)
        with using(2, torch_too=True):
            assert (count(), torch.get_num_threads()) == (2, 2)
        assert (count(), torch.get_num_threads()) == (3, 1)
    assert (count(), torch.get_num_threads()) == (2, 2)
    with pytest.raises(ValueError, match="Expected 1 thread or more, got 0"), using(0):
        pass


def test_a_command_takes_what_the_user_says_and_else_what_is_free(torch_threads, monkeypatch):
    torch_threads(2)
    monkeypatch.setattr(threads, "cores", lambda: 8)
    monkeypatch.setattr(threads, "running", lambda: 5)
    monkeypatch.setattr(threads, "quota", lambda: math.inf)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.delenv("RUMI_THREADS", raising=False)
    with chosen():
        assert (count(), torch.get_num_threads()) == (3, 1)
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    with chosen():
        assert (count(), torch.get_num_threads()) == (2, 2)
    monkeypatch.setenv("RUMI_THREADS", "5")
    with chosen():
        assert (count(), torch.get_num_threads()) == (5, 1)
    assert (count(), torch.get_num_threads()) == (2, 2)
    for wrong in ("0", "-1", "two"):
        monkeypatch.setenv("RUMI_THREADS", wrong)
        with pytest.raises(ValueError, match=f"Expected RUMI_THREADS to be 1 or more, got '{wrong}'"), chosen():
            pass


@pytest.mark.parametrize("size", [0, 1, 2, 31, 32, 33, 1000])
def test_parts_have_each_iteration_once(size):
    edges = [0, 1, 4, 20, PARTS]
    found = [k for first, last in pairwise(edges) for k in indices.py_func((first, last, PARTS), size)]
    assert found == list(indices.py_func((0, 1, 1), size)) == list(range(size))


@pytest.mark.parametrize("most", [1, 2, 3, 7])
@pytest.mark.parametrize("worth_s", [0.0, math.inf], ids=["much work", "little work"])
def test_each_part_is_done_once(most, worth_s, monkeypatch):
    monkeypatch.setattr(threads, "team", lambda threads, work_s: threads if worth_s == 0.0 else 1)
    done, lock = [], threading.Lock()

    def work(part):
        with lock:
            done.extend(k / part[2] for k in range(part[0], part[1]))

    divide(work, most)
    assert sorted(done) == ([0.0] if most == 1 else [k / PARTS for k in range(PARTS)])


def test_what_goes_wrong_in_a_part_is_raised(monkeypatch):
    monkeypatch.setattr(threads, "team", lambda threads, work_s: threads)
    for wrong in (0, 1, PARTS - 1):

        def work(part, wrong=wrong):
            if part[0] <= wrong < part[1]:
                raise ArithmeticError(wrong)

        with pytest.raises(ArithmeticError):
            divide(work, 3)


def _means(values, weights, result, part):
    for row in indices(part, len(values)):
        total = 0.0
        for column in range(values.shape[1]):
            total += weights[column] * values[row, column]
        result[row] = total


means = Kernel(_means, fast=True)


def _found(values, weights):
    result = np.empty(len(values))
    means(values, weights, result)
    return result


@pytest.fixture
def rows():
    draw = np.random.default_rng(0)
    return draw.normal(size=(257, 1001)), draw.normal(size=1001)


def test_results_are_the_same_to_the_bit_for_any_number_of_threads(rows, monkeypatch):
    monkeypatch.setattr(threads, "team", lambda threads, work_s: threads)
    with using(1):
        expected = _found(*rows)
    for most in (2, 3, 5):
        with using(most):
            np.testing.assert_array_equal(_found(*rows), expected)
            with ThreadPoolExecutor(4) as callers:  # kernels may be called from several threads at once
                for found in callers.map(lambda _: _found(*rows), range(8)):
                    np.testing.assert_array_equal(found, expected)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork")
@pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork:DeprecationWarning")
def test_kernels_run_in_a_process_that_was_forked(rows, monkeypatch):
    monkeypatch.setattr(threads, "team", lambda threads, work_s: threads)
    with using(2):
        expected = _found(*rows)  # which wakes helpers, that a child does not have
        pid = os.fork()
        if pid == 0:
            try:
                os._exit(0 if np.array_equal(_found(*rows), expected) else 3)
            finally:
                os._exit(4)
        assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
