"""The script that the README shows, as a newcomer would run it."""

import importlib.util
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = ROOT / "scripts" / "rummage_mug.py"

pytestmark = pytest.mark.sim


def test_the_script_runs(capsys, tmp_path):
    spec = importlib.util.spec_from_file_location("rummage_mug", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert module.main(steps=2, cache=tmp_path) is False
    printed = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in printed[:3]] == ["step 0", "step 1", "step 2"]
    assert printed[3].startswith("steps after 2 actions")


def test_the_readme_shows_it_and_it_is_short():
    code = SCRIPT.read_text()
    assert len(code.splitlines()) <= 30
    assert code.split('"""', 2)[2].strip() in (ROOT / "README.md").read_text()
