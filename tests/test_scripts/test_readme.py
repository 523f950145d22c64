"""The README's commands, each carried out where nothing is installed but what `scripts/demo` installs."""

import os
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
# packages of the extras that `scripts/demo` leaves out, by the names that they are imported by; others need mpmath too
OTHERS = {
    "baselines": ["gpytorch"],
    "peers": ["pytorch_volumetric", "chsel", "pytorch_mppi"],
    "cluster": ["submitit"],
    "view": ["rerun"],
    "gym": ["gymnasium"],
    "gpu": ["warp"],
    "stress": ["hypothesis"],
    "docs": ["sphinx", "myst_parser", "furo"],
    "dev": ["gymnasium", "pytest", "xdist", "hypothesis", "beartype", "ruff", "mypy", "importlinter", "igl"],
}
RUN = f"""
import sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {sorted({one for names in OTHERS.values() for one in names})}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Absent())
from rumi.cli import main
sys.exit(main(sys.argv[1:]))
"""


def commands():
    text = (ROOT / "README.md").read_text()
    lines = re.findall(r"(?m)^ {4}\.venv/bin/rumi (.*)$", text) + re.findall(r"`rumi ([a-z].*?)`", text)
    return [shlex.split(line, comments=True) for line in lines]


def test_the_extras_left_out_are_all_known():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    (everything,) = extras["all"]
    installed = {"all", *everything.removeprefix("rumi[").removesuffix("]").split(",")}
    assert set(extras) - installed == set(OTHERS)


@pytest.mark.slow
@pytest.mark.sim
def test_each_command_of_the_readme_runs_with_what_the_demo_installs(tmp_path, cache):
    trimesh = pytest.importorskip("trimesh")
    box = trimesh.creation.box((0.1, 0.06, 0.04))
    box.export(tmp_path / "part.stl")
    points, _ = trimesh.sample.sample_surface(box, 20, seed=1)
    (tmp_path / "touches.csv").write_text("".join(f"{x:.5f}, {y:.5f}, {z:.5f}\n" for x, y, z in points + 0.2))
    env = {**os.environ, "PYTHONPATH": str(ROOT), "RUMI_CACHE": str(cache)}

    def carry_out(*words):
        return subprocess.run(
            [sys.executable, "-c", RUN, *words], cwd=tmp_path, env=env, capture_output=True, text=True
        )

    first = carry_out("run", "mug-0", "--preset", "fast", "--steps", "1", "--out", "runs/mug-0-rumi-default-s0")
    assert first.returncode in (0, 1), first.stderr
    found = commands()
    assert {words[0] for words in found} >= {"run", "plot", "replay", "result", "localize", "tasks"}
    for words in found:
        if words[0] in ("replay", "result") and len(words) == 1:
            words = [*words, "runs/mug-0-rumi-default-s0"]
        done = carry_out(*words)
        assert done.returncode in (0, 1) and "Traceback" not in done.stderr, (words, done.stderr)
    lacking = carry_out("view", "runs/mug-0-rumi-default-s0")
    assert lacking.returncode == 2 and "[view]" in lacking.stderr and len(lacking.stderr.splitlines()) == 1
