"""What `import rumi` gives, on a small run of the peg task, which needs no simulator."""

import subprocess
import sys

import pytest
import torch

import rumi
from rumi.errors import UsageError
from rumi.runs.folder import free_folder
from rumi.runs.replay import digest
from rumi.sim.settings import SimSettings
from rumi.tasks.peg.entry import PegRunSettings
from rumi.tasks.peg.settings import PegSettings
from rumi.tasks.rummage.agent import Rummager
from sdf.object_model import box_model

SMALL = PegRunSettings(PegSettings(particles=150, search_particles=400, most_actions=3), seed=2)


def test_a_run_is_kept_drawn_and_replayed(tmp_path):
    pytest.importorskip("matplotlib")
    seen = []
    with rumi.build(SMALL) as (task, agent):
        result = rumi.run(task, agent, seed=2, folder=tmp_path / "run", on_step=seen.append)
    run = rumi.load_run(tmp_path / "run")
    assert [digest(step.belief) for step in run.steps] == [digest(step.belief) for step in seen]
    assert run.task == "peg" and run.ended["stopped_by"] == result.stopped_by
    assert rumi.replay(tmp_path / "run").same == [True] * len(seen)
    assert all(path.is_relative_to(tmp_path / "run" / "figures") for path in rumi.plot(tmp_path / "run"))
    with rumi.build(SMALL) as (task, agent), pytest.raises(UsageError, match="holds a run already"):
        rumi.run(task, agent, seed=2, folder=tmp_path / "run")


def test_an_agent_for_a_robot_of_ones_own_has_its_workspace():
    bounds = torch.tensor([[0.2, -0.2, 0.03], [0.6, 0.2, 0.03]])
    workspace = rumi.Workspace.from_bounds(bounds, 0.05, planar_height=0.03)
    agent = rumi.rummager(box_model(), workspace)
    assert isinstance(agent, Rummager) and isinstance(agent, rumi.Agent)
    assert torch.equal(agent.workspace.points, workspace.points)
    assert agent.filter.search == "SE(2)" and float(agent.tool.scale[0]) == pytest.approx(SimSettings().action_scale_m)


def test_folders_by_name_are_each_ones_own(tmp_path):
    """The name is claimed by making the folder, so that no two processes take the same."""
    assert [free_folder(tmp_path / "run").name for _ in range(3)] == ["run", "run-2", "run-3"]
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(UsageError, match="Cannot write"):
        free_folder(tmp_path / "file" / "run")


def test_the_names_are_there_and_cost_nothing_before_they_are_used():
    assert len(rumi.__all__) == 14 and all(getattr(rumi, name).__doc__ for name in rumi.__all__)
    with pytest.raises(AttributeError, match="it has Agent, ArmReach"):
        rumi.rummage  # noqa: B018
    code = "import sys, rumi; sys.exit(any(name in sys.modules for name in ('torch', 'numpy', 'numba')))"
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == 0


@pytest.mark.parametrize("settings", ["mug-0", None, {"task": "mug-0"}])
def test_what_is_no_settings_is_refused_with_the_way_to_them(settings):
    with pytest.raises(UsageError, match=r"Expected settings, as rumi.preset\(task='mug-0'\) gives, got"):
        rumi.build(settings)


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"seed": -1}, "Expected seed to be 0 or more, below .*, got -1"),
        ({"seed": 2**63}, "Expected seed to be 0 or more, below .*, got 9223372036854775808"),
        ({"seed": "a"}, "Expected seed to be 0 or more, below .*, got 'a'"),
        ({"seed": 1.5}, "Expected seed to be 0 or more, below .*, got 1.5"),
        ({"seed": 0, "steps": -1}, "Expected steps to be 0 or more, or None, got -1"),
        ({"seed": 0, "steps": 1.5}, "Expected steps to be 0 or more, or None, got 1.5"),
        ({"seed": 0, "steps": "3"}, "Expected steps to be 0 or more, or None, got '3'"),
    ],
)
def test_seeds_and_steps_that_cannot_be_are_refused_before_the_run(no_shape_check, asked, message, tmp_path):
    with rumi.build(SMALL) as (task, agent), pytest.raises(UsageError, match=message):
        rumi.run(task, agent, folder=tmp_path / "run", **asked)
    assert not (tmp_path / "run").exists()
