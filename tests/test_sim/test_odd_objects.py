"""Objects that do what none is expected to: the robot's readings tell, and ordinary runs raise no remark."""

import json
import math
from dataclasses import replace

import pytest
import torch

from rumi import loop
from rumi.belief.remarks import Limits
from rumi.clock import Clock
from rumi.runs.folder import RunRecorder, load_run
from rumi.sim.settings import PhysicsSettings
from rumi.tasks.rummage.build import build, build_rummager, make_task
from rumi.tasks.rummage.entry import Rummaging, ending
from rumi.tasks.rummage.scenes import SCENES, make_tool
from rumi.tasks.rummage.settings import preset, to_dict
from sdf.object_model import object_model
from sdf.primitives import Box
from sdf.symmetry import Symmetries

pytestmark = pytest.mark.sim

HEAVY = ((0.03, 0.04, 0.05), PhysicsSettings(mass_kg=200.0))
POST = ((0.012, 0.012, 0.09), PhysicsSettings(mass_kg=0.2, friction=0.9))
LIGHT = ((0.03, 0.04, 0.05), PhysicsSettings())


def pushed(half, physics, folder, *, motion="measured", actions=4):
    """Records of straight pushes at a box ahead, and the run's folder."""
    model = object_model("box", Box(half), Symmetries.parse("z2"), spacing=0.004)
    spec = replace(SCENES["mug-0"], start=(0.36, 0.0, 0.0), physics=physics, object_factory=lambda: model)
    small = preset("fast")
    first = replace(small.initialise, particles=12, starts=40, polished=12)
    small = replace(small, initialise=first, filter=replace(small.filter, motion=motion))
    tool = make_tool(spec, free_flying=True)
    task, agent = make_task(spec, tool=tool, model=model), build_rummager(spec, small, model, tool)
    control = torch.tensor([1.0, 0.0, 0.0])
    with RunRecorder(folder, to_dict(small)) as recorder:
        state = agent.begin(task.reset(1000), seed=1000, clock=Clock())
        recorder(state.record)
        for _ in range(actions):
            state = agent.update(state, control, task.step(control))
            recorder(state.record)
        result = agent.result(state, "steps", None)
        recorder.finish(result)
    return state.history, result


@pytest.mark.parametrize(
    ("case", "motion", "names"),
    [
        (HEAVY, "measured", {"resists"}),
        (HEAVY, "corrected", {"resists"}),
        (POST, "measured", {"toppled"}),
        (LIGHT, "measured", set()),
        (LIGHT, "corrected", set()),
    ],
    ids=["heavy", "heavy, unmeasured", "post", "light", "light, unmeasured"],
)
def test_what_pushes_tell(case, motion, names, tmp_path):
    history, result = pushed(*case, tmp_path / "run", motion=motion)
    assert {remark.name for remark in result.remarks} == names
    lines = [json.loads(line) for line in (tmp_path / "run" / "steps.jsonl").read_text().splitlines()]
    for remark in result.remarks:
        step = history[remark.step]
        assert remark in step.remarks and remark.name in Rummaging().describe(step)
        assert remark.name in [one["name"] for one in lines[remark.step]["remarks"]]
        assert remark.sentence in " ".join(" ".join(ending(result)).split())
    read = load_run(tmp_path / "run")
    assert read.result.remarks == result.remarks and [step.remarks for step in read.steps] == [
        s.remarks for s in history
    ]


@pytest.mark.slow
@pytest.mark.parametrize("task", ["mug-0", "mug-2", "drill-0", "box-0", "shelf-box"])
def test_ordinary_runs_raise_none(task, cache):
    """But for drills that topple, which is true of them."""
    settings, upright = preset("fast", task=task, seed=1000), []
    with build(settings, cache_dir=cache) as (robot, agent):
        result = loop.run(robot, agent, seed=1000, on_step=lambda step: upright.append(float(step.truth[2, 2])))
    toppled = agent.upright and min(upright) < math.cos(Limits().tilt_rad)
    assert [remark.name for remark in result.remarks] == ["toppled"] * toppled
