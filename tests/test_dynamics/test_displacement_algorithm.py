"""The displacement model, in a plane and in space, against a loop that spells Alg 7 out."""

import functools
import math
from typing import NamedTuple, get_args

import pytest
import torch
from torch import Tensor

from rumi.dynamics.contact import ContactField
from rumi.dynamics.displacement_rollouts import DisplacementRollouts, DisplacementSettings, Hazard
from rumi.robot.tool import Tool
from sdf import backend
from tests.fixtures.push_fields import F64, begin, make_tool, spread_field

# for the plain and for the compiled versions
pytestmark = [
    pytest.mark.usefixtures("version"),
    pytest.mark.parametrize("version", ["torch", "numba", "warp"], indirect=True),
]


def reference(
    field: ContactField, tool: Tool, settings: DisplacementSettings, start: Tensor, controls: Tensor, draws: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """RUMI's Alg 7 as corrected, one rollout, one mini step and one point after the other."""
    samples, rollouts, horizon, parts = draws.shape
    states = torch.zeros(samples, rollouts, horizon + 1, len(start), dtype=start.dtype)
    moved = torch.zeros_like(states[..., :3])
    contact = torch.zeros(samples, rollouts, horizon, dtype=torch.bool)
    for k in range(samples):
        for m in range(rollouts):
            q, d = start, torch.zeros(3, dtype=start.dtype)
            states[k, m, 0] = q
            for h in range(horizon):
                way = (tool.free_step(q, controls[k, h])[0] - q) / settings.mini_steps
                for part in range(settings.mini_steps):
                    ahead = q + way
                    points = tool.points(ahead)
                    meets = field.probability.interpolate(points - d)
                    if not float(draws[k, m, h, min(part, parts - 1)]) < float(meets.max()):
                        q = ahead
                        continue
                    contact[k, m, h] = True
                    i = int((meets > meets.max() - 1e-5).nonzero()[0, 0])
                    motion = points[i] - tool.points(q)[i]
                    normal = field.normal.interpolate((points - d)[i])
                    if float(normal.norm()) >= 1e-6 and float(motion.norm()) >= 1e-6:
                        cosine = -float(normal @ motion / (normal.norm() * motion.norm()))
                        sideways = not tool.spatial or float(normal[:2].norm()) >= abs(float(normal[2]))
                        if math.acos(max(-1.0, min(1.0, cosine))) < settings.push_angle and sideways:
                            q, d = ahead, d + motion * motion.new_tensor([1.0, 1.0, 0.0])
                    if settings.guarded:
                        break
                states[k, m, h + 1], moved[k, m, h + 1] = q, d
    return states, moved, contact


class Case(NamedTuple):
    """A field, a tool, what is drawn, and what Alg 7 makes of it."""

    field: ContactField
    tool: Tool
    start: Tensor
    controls: Tensor
    draws: Tensor
    states: Tensor
    moved: Tensor
    contact: Tensor


@functools.cache  # the loop takes longer than all that is compared with it
def case(hazard: Hazard, guarded: bool, spatial: bool, reaching: bool) -> Case:
    random = torch.Generator().manual_seed(0)
    with backend.force("torch"):
        field = spread_field(F64, random, spatial)
        tool = make_tool(F64, reaching=reaching, spacing=0.03 if spatial else 0.02, spatial=spatial)
        start, count = begin(F64, spatial, 0.02), 6 if spatial else 12
        controls = 1.2 * torch.rand(count, 4, len(start), generator=random, dtype=F64) - 0.5
        settings = DisplacementSettings(mini_steps=3, hazard=hazard, guarded=guarded)
        draws = DisplacementRollouts(field, tool, settings).draw(count, 3, 4, generator=random)
        expected = reference(field, tool, settings, start, controls, draws)
    return Case(field, tool, start, controls, draws, *expected)


@pytest.mark.parametrize("guarded", [False, True])
@pytest.mark.parametrize("hazard", get_args(Hazard))
@pytest.mark.parametrize(
    ("spatial", "discs", "reaching"),
    [*((False, discs, reaching) for discs in (0, 5) for reaching in (False, True)), (True, 0, False), (True, 5, True)],
)
def test_is_the_algorithm(hazard: Hazard, guarded: bool, spatial: bool, discs: int, reaching: bool) -> None:
    field, tool, start, controls, draws, states, moved, contact = case(hazard, guarded, spatial, reaching)
    settings = DisplacementSettings(mini_steps=3, hazard=hazard, discs=discs, guarded=guarded)
    result = DisplacementRollouts(field, tool, settings).rollout_drawn(start, controls, draws)
    assert torch.equal(result.contact, contact)
    torch.testing.assert_close(result.configurations, states, atol=1e-9, rtol=0)
    torch.testing.assert_close(result.displacements, moved, atol=1e-9, rtol=0)
    # the case is worth its name: there is contact and none, pushing and blocking, and rollouts that differ
    assert float(result.touched.double().mean()) > 0.1
    assert 0.1 < float(contact.double().mean()) < 0.95
    assert float(moved.norm(dim=-1).max()) > 0.02
    assert bool((result.contact & (moved[:, :, 1:] == moved[:, :, :-1]).all(-1)).any())
    if spatial:
        assert float(moved[..., 2].abs().max()) == 0.0 and float((states[..., 2] - 0.12).abs().max()) > 0.05
    else:
        assert float(result.touched.double().mean()) < 0.95
        assert result.checked < 0.6 if discs else result.checked > 0.3
