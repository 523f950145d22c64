"""The displacement model of a tool that moves in space, against a loop that spells Alg 7 out."""

import math
from typing import get_args

import pytest
import torch
from torch import Tensor

from rumi.dynamics.contact import ContactField
from rumi.dynamics.displacement import DisplacementRollouts, DisplacementSettings, Hazard
from rumi.fields.information import information_field
from rumi.fields.workspace import Workspace
from rumi.robot.reach import SpatialReach
from rumi.robot.reach_table import ReachTable
from rumi.robot.tool import Tool
from sdf import backend, se3
from sdf.drill import Drill
from sdf.primitives import Box

BOUNDS = torch.tensor([[0.0, -0.4, 0.0], [0.8, 0.4, 0.2]])
FREE = torch.tensor([[-5.0, -5.0, 0.03], [5.0, 5.0, 0.3]])


# every test of this file holds for the plain and for the compiled version
pytestmark = pytest.mark.usefixtures("version")


def make_tool(dtype: torch.dtype, *, reaching: bool = False, spacing: float = 0.03) -> Tool:
    """A gripper; one that is `reaching` must stay within 0.5 m of the origin on the floor, less higher up."""
    radius = torch.arange(141.0)[:, None].expand(141, 61) * 0.01
    tables = [ReachTable((radius - most).clamp_min(0), torch.zeros(141, 61)) for most in (0.5, 0.45, 0.42)]
    reach = SpatialReach(tables, (0.03, 0.115, 0.2)) if reaching else None
    return Tool(FREE.to(dtype), reach, body_spacing_m=spacing, info_spacing_m=0.02)


def drill_field(dtype: torch.dtype, generator: torch.Generator, count: int = 12) -> ContactField:
    place = torch.tensor([0.4, 0.0, 0.2]) + torch.randn(count, 3, generator=generator) * torch.tensor([0.01, 0.01, 0.5])
    return field_of(Drill().to(dtype), se3.from_planar(place.to(dtype)), dtype)


def field_of(sdf: Drill | Box, poses: Tensor, dtype: torch.dtype) -> ContactField:
    lattice = Workspace.from_bounds(BOUNDS.to(dtype), 0.02)
    log_weights = torch.zeros(len(poses), dtype=dtype).log_softmax(-1)
    fields = information_field(sdf, poses, log_weights, lattice.points)
    return ContactField.from_belief(sdf, poses, log_weights, lattice, fields)


def reference(
    field: ContactField, tool: Tool, settings: DisplacementSettings, start: Tensor, controls: Tensor, draws: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """RUMI's Alg 7 as corrected, one rollout, one mini step and one point after the other."""
    samples, rollouts, horizon, parts = draws.shape
    states = torch.zeros(samples, rollouts, horizon + 1, 4, dtype=start.dtype)
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
                    if float(normal.norm()) < 1e-6 or float(motion.norm()) < 1e-6:
                        continue
                    cosine = -float(normal @ motion / (normal.norm() * motion.norm()))
                    sideways = float(normal[:2].norm()) >= abs(float(normal[2]))
                    if math.acos(max(-1.0, min(1.0, cosine))) < settings.push_angle and sideways:
                        q, d = ahead, d + motion * motion.new_tensor([1.0, 1.0, 0.0])
                states[k, m, h + 1], moved[k, m, h + 1] = q, d
    return states, moved, contact


@pytest.mark.parametrize("hazard", get_args(Hazard))
@pytest.mark.parametrize(("discs", "reaching"), [(0, False), (5, True)])
def test_is_the_algorithm(hazard: Hazard, discs: int, reaching: bool, generator: torch.Generator) -> None:
    settings = DisplacementSettings(mini_steps=3, hazard=hazard, discs=discs)
    field, tool = drill_field(torch.float64, generator), make_tool(torch.float64, reaching=reaching)
    start = torch.tensor([0.30, 0.02, 0.12, 0.1], dtype=torch.float64)
    controls = 1.2 * torch.rand(6, 4, 4, generator=generator, dtype=torch.float64) - 0.5
    model = DisplacementRollouts(field, tool, settings)
    draws = model.draw(6, 3, 4, generator=generator)
    result = model.rollout_drawn(start, controls, draws)
    states, moved, contact = reference(field, tool, settings, start, controls, draws)
    assert torch.equal(result.contact, contact)
    torch.testing.assert_close(result.configurations, states, atol=1e-9, rtol=0)
    torch.testing.assert_close(result.displacements, moved, atol=1e-9, rtol=0)
    # the case is worth its name: there is contact and none, pushing and blocking
    assert 0.1 < float(contact.double().mean()) < 0.95
    assert float(moved.norm(dim=-1).max()) > 0.02
    assert bool((contact & (moved[:, :, 1:] == moved[:, :, :-1]).all(-1)).any())
    assert float(moved[..., 2].abs().max()) == 0.0 and float((states[..., 2] - 0.12).abs().max()) > 0.05


@pytest.mark.parametrize("hazard", get_args(Hazard))
def test_bound_changes_nothing_but_the_work(hazard: Hazard, generator: torch.Generator) -> None:
    field, tool = drill_field(torch.float32, generator, 30), make_tool(torch.float32, reaching=True, spacing=0.012)
    controls = torch.rand(100, 8, 4, generator=generator) * 2 - 1
    start = torch.tensor([0.28, 0.0, 0.1, 0.0])
    every = DisplacementRollouts(field, tool, DisplacementSettings(hazard=hazard, discs=0))
    draws = every.draw(100, 4, 8, generator=generator)
    exact = every.rollout_drawn(start, controls, draws)
    for discs in (1, 8):
        lean = DisplacementRollouts(field, tool, DisplacementSettings(hazard=hazard, discs=discs))
        result = lean.rollout_drawn(start, controls, draws)
        assert torch.equal(result.configurations, exact.configurations)
        assert torch.equal(result.displacements, exact.displacements)
        assert torch.equal(result.contact, exact.contact)
        assert result.checked < 0.9 * exact.checked


def box_field() -> ContactField:
    """A box 10 cm high about (0.4, 0), known exactly."""
    pose = se3.make(torch.eye(3, dtype=torch.float64), torch.tensor([0.4, 0.0, 0.05], dtype=torch.float64))
    return field_of(Box((0.05, 0.05, 0.05)).double(), pose[None], torch.float64)


@pytest.mark.parametrize(
    ("start", "control", "pushes"),
    [((0.25, 0.0, 0.05, 0.0), (1.0, 0.0, 0.0, 0.0), True), ((0.4, 0.0, 0.19, 0.0), (0.0, 0.0, -1.0, 0.0), False)],
)
def test_gives_way_sideways_alone(start: tuple[float, ...], control: tuple[float, ...], pushes: bool) -> None:
    model = DisplacementRollouts(box_field(), make_tool(torch.float64, spacing=0.01))
    result = model.nominal_rollout(
        torch.tensor(start, dtype=torch.float64), torch.tensor([control] * 2, dtype=torch.float64)
    )
    assert bool(result.contact.any())
    moved = result.displacements[0, 0, -1]
    if pushes:
        assert float(moved[0]) > 0.05 and abs(float(moved[1])) < 1e-9
    else:
        # it stops on the top, at the height at which the pads and the palm touch it
        assert moved.tolist() == [0.0, 0.0, 0.0]
        assert 0.11 < float(result.configurations[0, 0, -1, 2]) < 0.16


def test_passes_over_what_is_lower() -> None:
    model = DisplacementRollouts(box_field(), make_tool(torch.float64, spacing=0.01))
    over = torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 6, dtype=torch.float64)
    high, low = (torch.tensor([0.1, 0.0, z, 0.0], dtype=torch.float64) for z in (0.20, 0.08))
    assert not bool(model.nominal_rollout(high, over).contact.any())
    assert bool(model.nominal_rollout(low, over).contact.any())


@pytest.mark.parametrize("hazard", get_args(Hazard))
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_versions_agree(hazard: Hazard, dtype: torch.dtype, generator: torch.Generator) -> None:
    field = drill_field(dtype, generator)
    for reaching, horizon, count in ((True, 8, 60), (False, 1, 1), (False, 3, 0)):
        model = DisplacementRollouts(field, make_tool(dtype, reaching=reaching), DisplacementSettings(hazard=hazard))
        start = torch.tensor([0.30, 0.0, 0.1, 0.0], dtype=dtype)
        controls = torch.rand(count, horizon, 4, generator=generator, dtype=dtype) * 2 - 1
        draws = model.draw(count, 3, horizon, generator=generator)
        with backend.force("torch"):
            plain = model.rollout_drawn(start, controls, draws)
        result = model.rollout_drawn(start, controls, draws)
        # where a number that decides is hit within rounding, rollouts part
        same = (result.configurations - plain.configurations).abs().amax((-1, -2)) < 1e-4
        assert count == 0 or float(same.double().mean()) > (0.95 if dtype == torch.float32 else 0.999)
        torch.testing.assert_close(result.displacements[same], plain.displacements[same], atol=1e-4, rtol=0)
        assert torch.equal(result.contact[same], plain.contact[same])
