"""What all tasks' views show of a belief, and what the viewer's primitives are."""

import math

import numpy as np
import pytest
import torch
from torch.distributions import MultivariateNormal

from rumi.registration.pose_summary import summarise_particles
from rumi.tasks.registry import TASKS
from rumi.viz.primitives import block_edges, circle, rgb, shades
from rumi.viz.rummaging_view import RummagingView
from rumi.viz.task_view import TaskView, planar_entropy, planar_nll
from sdf import se3
from sdf.symmetry import Symmetries
from tests.fixtures.made_up_run import make_up


@pytest.fixture(scope="module")
def summary():
    generator = torch.Generator().manual_seed(0)
    poses = torch.tensor([0.4, -0.1, 0.3]) + 0.05 * torch.randn(300, 3, generator=generator, dtype=torch.float64)
    return summarise_particles(se3.from_planar(poses), torch.zeros(300).double().log_softmax(-1))


def normal(pose):
    plane = [0, 1, 5]
    yaw = math.atan2(float(pose.world_T_object[1, 0]), float(pose.world_T_object[0, 0]))
    mean = torch.cat((pose.world_T_object[:2, 3], torch.tensor([yaw]).double()))
    return MultivariateNormal(mean, pose.covariance[plane][:, plane])


def test_entropy_and_nll_are_those_of_the_normal_distribution(summary):
    known = normal(summary)
    assert planar_entropy(summary) == pytest.approx(float(known.entropy()), abs=1e-6)
    truth = torch.tensor([0.45, -0.05, 0.25], dtype=torch.float64)
    assert planar_nll(summary, truth) == pytest.approx(-float(known.log_prob(truth)), abs=1e-6)


def test_of_a_truth_that_looks_the_same_the_nearest_counts(summary):
    truth = torch.tensor([0.45, -0.05, 0.25], dtype=torch.float64)
    turned = truth + torch.tensor([0.0, 0.0, math.pi], dtype=torch.float64)
    assert planar_nll(summary, turned, math.pi) == pytest.approx(planar_nll(summary, truth, math.pi), abs=1e-9)
    assert planar_nll(summary, turned) > planar_nll(summary, truth) + 100.0


def test_a_belief_of_one_pose_has_finite_curves():
    one = summarise_particles(se3.identity((1,)), torch.zeros(1), symmetries=Symmetries.none())
    assert math.isfinite(planar_entropy(one)) and math.isfinite(planar_nll(one, torch.tensor([1.0, 0.0, 0.0])))


def test_primitives():
    edges = block_edges((0.1, 0.05), 0.06)
    corners = np.unique(np.concatenate(edges), axis=0)
    assert len(edges) == 6 and len(corners) == 8
    np.testing.assert_array_equal(np.abs(corners[:, :2]), np.broadcast_to([0.1, 0.05], (8, 2)))
    assert set(corners[:, 2]) == {0.0, 0.06}
    round_one = circle((1.0, 2.0), 0.5, 0.3)
    np.testing.assert_allclose(np.hypot(round_one[:, 0] - 1.0, round_one[:, 1] - 2.0), 0.5)
    np.testing.assert_allclose(round_one[0], round_one[-1], atol=1e-12)
    assert shades("#0b5fa5", torch.tensor([0.0, 1.0])) == [(255, 255, 255), rgb("#0b5fa5")]


def test_every_task_has_a_view_of_its_runs(tmp_path):
    from rumi.runs.folder import Run

    for name in ("mug-0", "handle", "touch-box", "peg"):
        entry = TASKS[name]
        about = entry.as_dict(entry.preset(entry.presets[0]))
        view = entry.view(Run(tmp_path, about, None, [], None))
        assert isinstance(view, TaskView) and {"nll", "entropy", "right"} <= set(view.plots)


def test_of_rummaging_the_truth_and_the_plan_are_shown():
    made = make_up(5, particles=10)
    view = RummagingView(made.geometry)
    shown = view.step(made.steps, None)
    assert len(shown.scene["truth"].lines) == len(view.outline(made.steps[-1].truth)) > 0
    found = view.decision(made.steps)
    assert {"path", "samples", "information"} == set(found.scene) and "**gain**" in found.words
    assert view.decision(made.steps[:1]) is None, "the first view comes of no plan"
