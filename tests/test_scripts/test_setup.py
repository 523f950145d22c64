"""scripts/setup with a pip that only writes down what it was asked for: which torch is installed where."""

import glob
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent.parent
CPU = "https://download.pytorch.org/whl/cpu"
PYTHON = """#!/usr/bin/env bash
here="$(dirname "$0")"
case "$*" in
  *'version("torch")'*) [ -f "$here/torch" ] && echo 2.13.0 ;;
  "- $CPU/torch/") cat >/dev/null; [ -n "$REACHED" ] ;;
  *" install "*)
    echo "$*" >>"$LOG"
    case "$*" in *"--index-url"*) [ -n "$SERVED" ] || exit 1 ;; esac
    case "$*" in *torch==*) touch "$here/torch" ;; esac ;;
esac
"""


def executable(path, text):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    path.chmod(0o755)


@pytest.fixture
def asked(tmp_path):
    """Sets a copy of the project up; what pip was asked to install, in order."""

    def run(system="Linux", reached="yes", served="yes", gpu=False):
        for name in ("scripts/setup", "scripts/constraints.txt", "pyproject.toml"):
            (tmp_path / name).parent.mkdir(exist_ok=True)
            shutil.copy(ROOT / name, tmp_path / name)
        executable(tmp_path / ".venv/bin/python", PYTHON)
        executable(tmp_path / "bin/uname", f"#!/bin/sh\necho {system}\n")
        if gpu:
            executable(tmp_path / "bin/nvidia-smi", "#!/bin/sh\n")
        log = tmp_path / "log"
        environment = {"PATH": f"{tmp_path / 'bin'}:/usr/bin:/bin", "LOG": str(log), "CPU": CPU}
        environment |= {"REACHED": reached, "SERVED": served}
        done = subprocess.run(["bash", "scripts/setup"], cwd=tmp_path, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return [line for line in log.read_text().splitlines() if "torch==" in line and "--constraint" not in line]

    return run


pinned = next(
    line for line in (ROOT / "scripts/constraints.txt").read_text().splitlines() if line.startswith("torch==")
)


@pytest.mark.skipif(bool(glob.glob("/dev/nvidia*")), reason="this machine has a GPU")
def test_without_a_gpu_linux_asks_for_the_cpu_wheels(asked):
    (one,) = asked()
    assert one.endswith(f"--no-deps --index-url {CPU} {pinned}")


@pytest.mark.skipif(bool(glob.glob("/dev/nvidia*")), reason="this machine has a GPU")
def test_an_index_without_this_torch_is_followed_by_the_usual_one(asked):
    first, second = asked(served="")
    assert f"--index-url {CPU}" in first and second.endswith(f"install --quiet --quiet {pinned}")


@pytest.mark.parametrize("case", [{"reached": ""}, {"system": "Darwin"}, {"gpu": True}])
def test_elsewhere_the_usual_index_is_asked(case, asked):
    (one,) = asked(**case)
    assert one.endswith(f"install --quiet --quiet {pinned}") and "index-url" not in one
