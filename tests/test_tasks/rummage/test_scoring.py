"""What a step's record holds of the belief's agreement with itself."""

from dataclasses import replace

import pytest
import torch

from rumi.belief.pose_filter import FilterSettings, PoseFilter
from rumi.fields.workspace import Workspace
from rumi.information.stopping import StopSettings
from rumi.metrics.likelihood import self_agreement
from rumi.planning.rummaging import RummagingPolicy
from rumi.robot.tool import Tool
from rumi.tasks.rummage import evaluation
from rumi.tasks.rummage.agent import Rummager
from sdf.object_model import mug_model
from sensors.discrepancy import Discrepancy
from tests.fixtures.made_up_run import make_up


@pytest.fixture(scope="module")
def rummager() -> Rummager:
    model = mug_model(spacing=0.004, points=100)
    bounds = torch.tensor([[0.0, -0.2, 0.05], [0.4, 0.2, 0.05]])
    workspace = Workspace.from_bounds(bounds, 0.05, planar_height=0.05)
    tool = Tool(torch.tensor([[-1.0, -1.0], [1.0, 1.0]]), None, height_m=0.05)
    discrepancy = Discrepancy(model.sdf, model.radius)
    policy = RummagingPolicy(torch.ones(len(workspace.points)))
    return Rummager(
        model, PoseFilter(FilterSettings(), [discrepancy], "SE(2)"), policy, workspace, tool, agreement_points=50
    )


def test_agreement_is_worked_out_where_the_belief_changed_and_only_there(rummager, monkeypatch):
    asked = []

    def counted(*arguments, **options):
        asked.append(arguments[0])
        return self_agreement(*arguments, **options)

    monkeypatch.setattr(evaluation, "self_agreement", counted)
    steps = make_up().steps
    record = steps[2]
    expected, apc = evaluation._agreement(rummager, None, record.belief, 1)
    fresh = self_agreement(record.belief, rummager.model.surface_points[::2], rummager.model.sdf, nll_points=100)
    assert (expected, apc) == (float(fresh.expected_nll), float(fresh.apc))
    assert len(asked) == 1
    last = replace(record, expected_nll=expected, apc=apc)
    # the same particles and weights, carried along by a motion
    carried = record.belief.moved(steps[-1].belief.world_T_attached)
    assert evaluation._agreement(rummager, last, carried, 1) == (expected, apc)
    assert len(asked) == 1
    other = record.belief.reweighted(record.belief.log_weights * 2)
    assert evaluation._agreement(rummager, last, other, 1) != (expected, apc)
    moved = replace(record.belief, attached_T_object=record.belief.attached_T_object.roll(1, 0))
    evaluation._agreement(rummager, last, moved, 1)
    assert len(asked) == 3
    # by "probability" what was told by points in turn is worked out anew, once the stop depends on it
    by_probability = replace(rummager, stop_rule=StopSettings(rule="probability"))
    for converged, every, more in ((False, 8, 0), (True, 1, 0), (False, 1, 1)):
        known = len(asked)
        evaluation._agreement(by_probability, replace(last, converged=converged), carried, every)
        assert len(asked) == known + more
