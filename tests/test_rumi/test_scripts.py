"""The scripts, as a newcomer would run them; the README shows the first."""

import importlib.util
import sys
from pathlib import Path

import pytest

from rumi.sim.tasks import TASKS

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = ROOT / "scripts" / "rummage_mug.py"

pytestmark = pytest.mark.sim


def load(path):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def test_the_script_runs(capsys, tmp_path):
    module = load(SCRIPT)
    assert module.main(steps=2, cache=tmp_path) is False
    printed = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in printed[:3]] == ["step 0", "step 1", "step 2"]
    assert printed[3].startswith("steps after 2 actions")


def test_the_readme_shows_it_and_it_is_short():
    code = SCRIPT.read_text()
    assert len(code.splitlines()) <= 30
    assert code.split('"""', 2)[2].strip() in (ROOT / "README.md").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_the_first_belief_covers_what_the_view_leaves_open(task, tmp_path):
    script = load(ROOT / "scripts" / "first_view.py")
    figure = tmp_path / "view.png"
    (found,) = script.main(script.Options((task,), seeds=3, figure=figure, cache=tmp_path))
    assert 40 < found.plausible_deg < 180
    assert found.gap_deg <= 15
    assert found.outside <= 0.01
    assert figure.stat().st_size > 1000
