import sys
from typing import Any

import pytest
import torch

from sdf import backend, gpu

warp = pytest.importorskip("warp")
wp = gpu.warp()


def _scaled(a: wp.array(dtype=Any), factor: Any, shift: gpu.Numbers(2), rows: wp.int32, out: wp.array2d(dtype=Any)):
    i, j = wp.tid()
    if j < rows:
        out[i, j] = factor * a[i] + shift[j]


@pytest.fixture(scope="module")
def kernel():
    return gpu.Kernel(_scaled)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_kernel_fills_a_tensor_of_either_type_in_place(kernel, dtype):
    a = torch.tensor([1.0, 9.0, 2.0, 9.0], dtype=dtype)[::2]  # strides are what they are
    out = torch.zeros(2, 3, dtype=dtype)
    kernel.launch((2, 3), a, 0.1, [1.0, 2.0], 2, out)
    tenth = torch.tensor(0.1, dtype=dtype)
    expected = torch.stack((tenth * a + 1.0, tenth * a + 2.0, torch.zeros_like(a)), -1)
    torch.testing.assert_close(out, expected)


def test_no_threads_do_nothing(kernel):
    kernel.launch((0, 3), torch.zeros(0), 1.0, [0.0, 0.0], 2, torch.zeros(0, 3))


def test_kernels_of_a_module_compile_for_cuda_without_a_gpu(kernel, tmp_path):
    (made,) = [
        path for path in wp.compile_aot_module(kernel.module, arch=80, module_dir=tmp_path) if "sm80" in path.name
    ]
    assert made.stat().st_size > 0


def test_default_on_a_cpu_is_never_warp_and_it_can_be_forced(monkeypatch):
    monkeypatch.setattr(backend, "_VERSIONS", {})
    monkeypatch.delenv(backend.VARIABLE, raising=False)
    backend.register("twice")(lambda x: "plain")
    backend.register("twice", gpu.VERSION, gpu.supports, gpu.suits)(lambda x: "warp")
    x = torch.zeros(1)
    assert backend.dispatch("twice", x)(x) == "plain"
    with backend.force(gpu.VERSION):
        assert backend.dispatch("twice", x)(x) == "warp"
        with pytest.raises(ValueError, match=r"forced version 'warp' of twice supports, got torch\.float16"):
            backend.dispatch("twice", x.half())
        with pytest.raises(ValueError, match="with graph"):
            backend.dispatch("twice", x.requires_grad_())


def test_lacking_warp_is_told_with_what_installs_it(monkeypatch):
    gpu.warp.cache_clear()
    monkeypatch.setitem(sys.modules, "warp", None)
    with pytest.raises(ModuleNotFoundError, match=r"Running on a GPU needs warp .*\[gpu\]"):
        gpu.warp()
    monkeypatch.undo()
    gpu.warp()


@pytest.mark.gpu
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_kernel_on_a_gpu_in_torch_s_stream(kernel, dtype):
    a = torch.arange(1000, dtype=dtype, device="cuda")
    with torch.cuda.stream(torch.cuda.Stream()):
        out = torch.zeros(1000, 2, dtype=dtype, device="cuda")
        kernel.launch((1000, 2), a * 2.0, 0.5, [1.0, 2.0], 2, out)
        found = (out - 1.0).cpu()
    torch.testing.assert_close(found[:, 0], a.cpu())
