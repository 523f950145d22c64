"""What the pretended device counts, each kind seen once: a count of zero means something."""

from typing import Any

import pytest
import torch

from rumi import seeding
from sdf import gpu
from tests.fixtures.pretended_gpu import CUDA, Pretended, pretended_gpu, to_cpu, to_gpu

warp = pytest.importorskip("warp")
wp = gpu.warp()


@gpu.Kernel
def _doubled(a: wp.array(dtype=Any), out: wp.array(dtype=Any)):
    i = wp.tid()
    out[i] = a[i] + a[i]


@pytest.fixture
def counts():
    with pretended_gpu() as counted:
        yield counted


def total(counts, **expected):
    return counts.totals() == {name: expected.get(name, 0) for name in counts.totals()}


def test_a_launch_is_an_operation_that_is_no_view(counts):
    x = to_gpu(torch.arange(6.0).view(2, 3))
    assert isinstance(x, Pretended) and x.device == CUDA and x.mT[0].device == CUDA
    assert total(counts)
    y = (x.reshape(3, 2)[..., 0] + 1.0) * x[0].sum()
    assert total(counts, launches=3)
    y.clamp_(0.0, 1.0)
    assert total(counts, launches=4)
    assert to_cpu(y).tolist() == [1.0, 1.0, 1.0]
    assert set(counts.by_line()) == {line for line in counts.by_line() if "test_pretended_gpu.py" in line}


def test_a_launch_of_a_kernel_of_warp_is_counted_where_it_is_called(counts):
    a, out = to_gpu(torch.arange(3.0)), torch.empty(3, device="cuda")
    assert total(counts)
    _doubled.launch(3, a, out)
    assert total(counts, launches=1)
    (where,) = counts.launches
    assert "warp" in where and "test_pretended_gpu.py" in where
    assert to_cpu(out).tolist() == [0.0, 2.0, 4.0]
    _doubled.launch(3, torch.arange(3.0), torch.empty(3))  # on the CPU it is none of the device's affair
    assert counts.totals()["launches"] == 1


def test_makers_launch_and_copy(counts):
    zeros = torch.zeros(3, device="cuda")
    like = torch.zeros_like(zeros)
    drawn = torch.randn(3, generator=gpu_generator(), device="cuda")
    assert all(isinstance(x, Pretended) for x in (zeros, like, drawn, zeros.new_zeros(2), zeros.new_empty(2)))
    assert total(counts, launches=4)
    listed, told = torch.tensor([1.0, 2.0], device=CUDA), zeros.new_tensor([1.0])
    moved = torch.arange(3).to(zeros)
    assert all(isinstance(x, Pretended) for x in (listed, told, moved))
    assert moved.dtype == zeros.dtype
    assert counts.totals()["copies_in"] == 3


def gpu_generator():
    return seeding.generator(3, "cuda")


@pytest.mark.parametrize(
    "wait",
    [
        lambda x: x.sum().item(),
        lambda x: float(x[0]),
        lambda x: bool((x > 0).any()),
        lambda x: x.nonzero(),
        lambda x: x[x > 1],
        lambda x: x.tolist(),
        lambda x: x.cpu(),
        lambda x: x.to("cpu"),
        lambda x: torch.zeros(3).copy_(x),
        lambda x: x.unique(),
        lambda x: x.masked_select(x > 1),
        lambda x: torch.equal(x, x),
    ],
)
def test_waits(counts, wait):
    x = to_gpu(torch.arange(3.0))
    assert total(counts)
    wait(x)
    assert counts.totals()["waits"] == 1


def test_a_cpu_tensor_among_those_of_the_device_is_refused(counts):
    x = to_gpu(torch.arange(3.0))
    assert to_cpu(x * torch.tensor(2.0)).tolist() == [0.0, 2.0, 4.0]  # a lone number is let pass, as by CUDA
    with pytest.raises(RuntimeError, match="same device"):
        x + torch.ones(3)
    with pytest.raises(ValueError, match="on one device"):
        _doubled.launch(3, x, torch.empty(3))
    with pytest.raises(RuntimeError, match="generator"):
        torch.rand(3, generator=torch.Generator(), device="cuda")
    with pytest.raises(TypeError, match="numpy"):
        x.numpy()
    assert counts.totals()["mixed"] == 1
    assert to_cpu(x[torch.tensor([0])]).tolist() == [0.0]
    assert counts.totals()["copies_in"] == 1


def test_results_are_those_of_the_cpu(counts):
    """Also where torch leaves work to whoever reads, as with a conjugate."""
    x, y = torch.rand(5, 6, generator=torch.Generator().manual_seed(1)), torch.arange(30.0).view(5, 6)
    found = torch.fft.irfftn(torch.fft.rfftn(to_gpu(x)) * torch.fft.rfftn(to_gpu(y)).conj(), (5, 6))
    expected = torch.fft.irfftn(torch.fft.rfftn(x) * torch.fft.rfftn(y).conj(), (5, 6))
    torch.testing.assert_close(to_cpu(found), expected)
    torch.testing.assert_close(to_cpu(to_gpu(x).mT.softmax(-1) @ to_gpu(y)), x.mT.softmax(-1) @ y)
