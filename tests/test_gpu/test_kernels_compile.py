"""Every kernel compiles for CUDA by NVRTC, which needs no GPU."""

from importlib import import_module
from pathlib import Path

import pytest

from sdf import gpu

pytest.importorskip("warp")

ROOT = Path(__file__).resolve().parents[2]
FILES = sorted(path for package in ("sdf", "sensors", "rumi") for path in (ROOT / package).rglob("*_warp.py"))
ARCHITECTURE = 80  # Ampere, and by the driver's compiler what came after


def kernels(path: Path) -> list[gpu.Kernel]:
    module = import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))
    return [value for value in vars(module).values() if isinstance(value, gpu.Kernel)]


def test_there_are_kernels():
    assert sum(len(kernels(path)) for path in FILES) >= 10


@pytest.mark.slow
@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_compiles_for_cuda(path, tmp_path):
    for module in {kernel.module for kernel in kernels(path)}:
        made = gpu.warp().compile_aot_module(module, arch=ARCHITECTURE, module_dir=tmp_path)
        (binary,) = [file for file in made if f"sm{ARCHITECTURE}" in file.name]
        assert binary.stat().st_size > 1000
