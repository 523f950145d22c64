"""A package from outside adds members to the families by entry points alone; nothing of rumi names them."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PATHS = os.pathsep.join([str(ROOT), str(ROOT / "tests/fixtures/outside")])
SMALL = [
    *("--initialise.particles", "12", "--initialise.starts", "40", "--initialise.polished", "12"),
    *("--steps", "1", "--no-figures"),
]


def python(*arguments, cwd):
    env = {**os.environ, "PYTHONPATH": PATHS}
    return subprocess.run([sys.executable, *arguments], cwd=cwd, env=env, capture_output=True, text=True, check=False)


@pytest.mark.sim
def test_a_task_a_policy_and_a_stop_rule_carry_out_a_run(tmp_path):
    asked = ["run", "can-0", "--method", "wandering", "--stop.rule", "patient", "--out", "run", *SMALL]
    done = python("-m", "rumi", *asked, cwd=tmp_path)
    assert done.returncode == 1, done.stderr
    assert "can-0: not sure after 1 action" in done.stdout
    settings = json.loads((tmp_path / "run/settings.json").read_text())
    assert (settings["task"], settings["method"], settings["stop"]["rule"]) == ("can-0", "wandering", "patient")


def test_members_are_listed_beside_rumis_own(tmp_path):
    code = (
        "from rumi.tasks.registry import TASKS; from rumi.tasks.rummage.objects import OBJECTS;"
        "from rumi.planning.registry import POLICIES; from rumi.information.stopping import STOP_RULES;"
        "print([list(t)[-1] for t in (TASKS, OBJECTS, POLICIES, STOP_RULES)], OBJECTS['can']().name)"
    )
    done = python("-c", code, cwd=tmp_path)
    assert done.stdout.strip() == "['can-0', 'can', 'wandering', 'patient'] mug", done.stderr
