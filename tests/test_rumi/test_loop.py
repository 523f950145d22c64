"""The loop with a task that is told beforehand: what its records say of each step."""

from dataclasses import replace

import torch

from rumi import loop
from rumi.belief.initialise import InitialiseSettings
from rumi.belief.pose_filter import FilterSettings, PoseFilter
from rumi.belief.prior import PosePrior
from rumi.belief.reinitialise import ReinitialiseSettings
from rumi.fields.workspace import Workspace
from rumi.information.stopping import StopSettings
from rumi.planning.rummaging import RummagingPolicy
from rumi.records import StepRecord
from rumi.registration.descent import DescentSettings
from rumi.robot.tool import Tool
from rumi.runs.replay import LogTask, Repeat
from rumi.tasks.rummage.agent import Rummager
from sdf import se3
from sdf.object_model import box_model
from sensors.discrepancy import Discrepancy
from sensors.log.reader import Taken
from sensors.observation import Observation
from sensors.reading import Reading
from sensors.semantics import Semantics

BOUNDS = torch.tensor([[0.2, -0.2, 0.02], [0.6, 0.2, 0.02]])
QUICK = DescentSettings(iterations=1)


def reading(observation: Observation, *, touched: bool) -> Reading:
    pose = se3.identity((1,))
    none = torch.zeros(len(observation)).long()
    return Reading(observation, none, pose, torch.tensor([touched]), pose, torch.zeros(3), torch.zeros(()))


def test_a_step_after_which_poses_were_drawn_anew_keeps_all_its_seconds() -> None:
    """The last step of a run that ends sure is looked at twice; its first look's seconds are its own, too."""
    box = box_model()
    prior = PosePrior.of((0.4, 0.0), 0.02, box.sdf.bounds, ("z",))
    truth = se3.from_planar(torch.tensor([0.4, 0.0, 0.2])) @ prior.ways[0]
    felt = Observation.of(se3.apply(truth, box.surface_points), Semantics.SURFACE)
    nothing = reading(Observation.empty(), touched=False)
    taken = [
        Taken(nothing, None, None, None),
        Taken(nothing, torch.zeros(3), None, None),
        Taken(replace(reading(felt, touched=True), stamp=1.0), torch.zeros(3), None, None),
    ]
    task = LogTask(taken)
    rummager = Rummager(
        box,
        PoseFilter(FilterSettings(descent=QUICK), [Discrepancy(box.sdf, box.radius)], "SE(3)", prior),
        RummagingPolicy(torch.ones(0)),
        Workspace.from_bounds(BOUNDS, 0.05, planar_height=0.02),
        Tool(BOUNDS[:, :2]),
        initialise=InitialiseSettings(particles=20),
        renewal=ReinitialiseSettings(starts=50, polished=10, coarse=QUICK, fine=QUICK),
        stop_rule=StopSettings(expected_nll=1e6, fit=1e6),
        agreement_points=10,
    )
    steps: list[StepRecord] = []
    result = loop.run(task, Repeat(rummager, [torch.zeros(3)] * 2), seed=0, steps=2, on_step=steps.append)
    assert result.stopped_by == "sure"
    assert [sorted(step.timings_s) for step in steps[1:]] == [["agree", "belief", "score", "simulate"]] * 2
    total = sum(sum(step.timings_s.values()) for step in steps)
    assert sum(result.timings_s.values()) == total
