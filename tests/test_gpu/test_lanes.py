"""Kernels whose work a GPU's lanes share, with the lanes that warp pretends on a CPU: what one lane does alone."""

import pytest
import torch

from rumi.dynamics.base import PushRollouts
from rumi.fields.information import information_field
from rumi.seeding import split
from sdf import backend, gpu
from tests.test_gpu.test_planning_pass import PASSES, scene_of

pytest.importorskip("warp")


@pytest.fixture
def reach(task, request):
    return request.getfixturevalue("cache" if task == "mug-0" else "all_in_reach")


def rolled_out(task, push_model, cache) -> PushRollouts:
    """Samples about the object, which some of their rollouts meet."""
    policy, belief, scene = scene_of(task, push_model, cache)
    poses, weights = belief.world_T_object, belief.log_weights
    with torch.no_grad():
        fields = information_field(scene.model.sdf, poses, weights, scene.workspace.points)
        known = (scene.model, poses, weights, scene.tool, scene.workspace, fields)
        model = policy.push_models.rollouts(*known)
        controls = 2.0 * torch.rand(12, 6, len(scene.configuration), generator=split(3, "controls")) - 1.0
        with backend.force(gpu.VERSION):
            return model.rollout(scene.configuration, controls, rollouts=4, generator=split(4, "rollouts"))


@pytest.mark.sim
@pytest.mark.parametrize(("task", "push_model"), PASSES)
def test_lanes_roll_out_what_one_lane_does(task, push_model, reach, monkeypatch):
    alone = rolled_out(task, push_model, reach)
    monkeypatch.setattr(gpu.warp().config, "enable_cpu_blocks", True)
    shared = rolled_out(task, push_model, reach)
    assert bool(alone.contact.any()) and not bool(alone.contact.all())
    assert torch.equal(shared.contact, alone.contact)
    for name in ("configurations", "displacements", "turns"):
        if getattr(alone, name) is not None:
            torch.testing.assert_close(getattr(shared, name), getattr(alone, name), atol=1e-6, rtol=0.0)
