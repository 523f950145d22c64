"""Kernels: the same for any number of threads, and announced while they are compiled for the first time."""

import importlib
import math
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest
import torch
from numba.core.compiler import Flags

from rumi.robot import tool_numba
from sdf import compiled
from sdf.part_numba import indices


def _squares(values, result, part):
    for index in indices(part, len(values)):
        result[index] = values[index] ** 2


@pytest.fixture
def threads():
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.mark.parametrize("count", [1, 2])
def test_kernel_is_announced_once_and_the_same_for_any_threads(count, threads, capsys, tmp_path, monkeypatch):
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    kernel = compiled.Kernel(_squares)
    threads(count)
    values = np.arange(100.0)
    for _ in range(2):
        result = np.empty(100)
        kernel(values, result)
        np.testing.assert_array_equal(result, values**2)
    assert capsys.readouterr().err.count("compiling squares") == 1
    assert list(Path(tmp_path).rglob("*.nbi"))
    # what is kept is not compiled, nor announced, again
    compiled.Kernel(_squares)(values, np.empty(100))
    assert capsys.readouterr().err == ""


def test_code_of_a_changed_building_block_is_not_taken_from_what_is_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "kept"))
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "user_numba.py").write_text(
        "from part_numba import part\nfrom sdf.compiled import Kernel\n\n\n"
        "def _fill(result, which):\n    result[0] = part()\n\n\nfill = Kernel(_fill)\n"
    )
    found = []
    for number in (1, 2):
        (tmp_path / "part_numba.py").write_text(f"import numba\n\n\n@numba.njit\ndef part():\n    return {number}.0\n")
        for name in ("part_numba", "user_numba"):
            sys.modules.pop(name, None)
        importlib.invalidate_caches()
        sys.dont_write_bytecode, before = True, sys.dont_write_bytecode
        result = np.zeros(1)
        importlib.import_module("user_numba").fill(result)
        sys.dont_write_bytecode = before
        found.append(result[0])
    assert found == [1.0, 2.0]
    for name in ("part_numba", "user_numba"):
        del sys.modules[name]


def test_what_a_fused_version_can_take():
    plain = torch.zeros(3)
    assert compiled.supports(plain, torch.zeros(2, dtype=torch.long))
    assert not compiled.supports(plain.requires_grad_())
    with torch.no_grad():
        assert compiled.supports(plain)
    assert not compiled.supports(torch.zeros(3, dtype=torch.float16))
    assert not compiled.supports(torch.zeros(3, device="meta"))


def test_no_kernel_under_a_transform_of_torch_func():
    seen = []
    torch.func.vmap(lambda x: seen.append(compiled.supports(x)) or x)(torch.zeros(3))
    assert seen == [False]
    assert compiled.supports(torch.zeros(3)) == compiled.available()


def test_a_function_of_kernels_refuses_python_which_may_have_it_interpreted():
    with pytest.raises(TypeError, match="kernel"):
        tool_numba.residual(0.0, 0.0, 0.0, 0.0, np.zeros((2, 2)), np.zeros(3), np.zeros(6))
    residual = compiled.interpreted(tool_numba.residual)
    table, far = np.zeros((3, 5)), math.hypot(0.3, 0.4) - 0.2
    found = residual(0.3, 0.4, 0.0, 0.0, table, [0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0, 0.0, 0.1, math.pi])
    assert found == pytest.approx(far)


def test_linear_algebra_is_not_loaded_until_it_is_asked_for() -> None:
    """Numba looks for scipy's by loading it; whoever needs it later has it all the same."""
    pytest.importorskip("scipy")
    code = (
        "import sys; from sdf import compiled; assert compiled.available(); assert 'scipy.linalg' not in sys.modules; "
        "import numba, numpy; product = numba.njit(lambda a, b: numpy.dot(a, b)); "
        "assert product(numpy.eye(2), numpy.ones((2, 2))).sum() == 4; assert 'scipy.linalg' in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@compiled.inner()
def _positive(value):
    if value < 0.0:
        raise ValueError("Expected none below 0")
    return value


def _roots(values, result, part):
    for index in indices(part, len(values)):
        result[index] = math.sqrt(_positive(values[index]))


def test_of_a_function_that_kernels_alone_call_no_machine_code_is_made_by_itself(tmp_path, monkeypatch):
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    values, result = np.array([4.0, 9.0]), np.zeros(2)
    compiled.Kernel(_roots)(values, result)
    np.testing.assert_array_equal(result, [2.0, 3.0])
    (made,) = _positive.overloads.values()
    assert made.library.get_pointer_to_function(made.fndesc.mangled_name) == 0
    for _ in ("compiled", "loaded"):
        with pytest.raises(ValueError, match="below 0"):
            compiled.Kernel(_roots)(-values, result)


def test_flags_of_one_content_are_one_object_to_the_compiler() -> None:
    plain, fast = (_positive._compiler._customize_flags(Flags()) for _ in range(2))
    fast.error_model = "numpy"
    assert plain.copy() is plain.copy()
    assert hash(plain.copy()) == hash(plain) == hash(Flags())
    assert plain.copy() == plain == Flags()
    assert plain.copy() != fast.copy()
