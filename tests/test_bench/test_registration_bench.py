"""The drill's registration problem at reduced size."""

import os

import pytest
import torch

from rumi.registration.register import RegisterSettings
from scripts.bench import drill
from scripts.bench.registration import ours

pytest.importorskip("scipy")
pytest.importorskip("trimesh")


@pytest.mark.data
def test_most_poses_kept_of_the_drill_are_right():
    assert os.environ["RUMI_DATA"]
    model = drill.drill(0.005)
    problem = drill.problem(model.sdf, 1000, each=100)
    assert len(problem.observation) == 300
    torch.testing.assert_close(problem.observation.points.mean(0), torch.zeros(3), atol=1e-6, rtol=0)
    settings = RegisterSettings(kept=50, starts=1500, polished=200)
    poses = ours(model, problem, 1000, settings)()
    error = drill.surface_error(model, poses, problem.truth)
    assert len(poses) == 50
    assert int((error < drill.FOUND_M).sum()) >= 40
    assert float(drill.surface_error(model, problem.truth[None], problem.truth)[0]) < 5e-4
