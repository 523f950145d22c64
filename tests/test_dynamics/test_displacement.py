"""The displacement model, in a plane and in space: what its bound leaves out, and what pushing must do."""

import math
from typing import get_args

import pytest
import torch
from torch import Tensor

from rumi.dynamics import tool_lookup
from rumi.dynamics.base import PushRollouts
from rumi.dynamics.contact import ContactField
from rumi.dynamics.displacement_rollouts import DisplacementRollouts, DisplacementSettings, Hazard
from rumi.fields.workspace import Workspace
from rumi.robot.tool import Tool
from sdf import se3
from sdf.primitives import Box, Mug, Sphere
from tests.fixtures.push_fields import BOUNDS, F64, HEIGHT, belief_field, make_tool, spread_field, workspace

# every test of this file holds for the plain and for the compiled versions
pytestmark = [
    pytest.mark.usefixtures("version"),
    pytest.mark.parametrize("version", ["torch", "numba", "warp"], indirect=True),
]


@pytest.mark.parametrize("hazard", get_args(Hazard))
@pytest.mark.parametrize("spread", [0.002, 0.04, None], ids=["0.002", "0.04", "space"])
def test_bound_changes_nothing_but_the_work(hazard: Hazard, spread: float | None, generator: torch.Generator) -> None:
    spatial = spread is None
    if spread is None:
        field, start = spread_field(torch.float32, generator, True, 30), torch.tensor([0.28, 0.0, 0.1, 0.0])
    else:
        scale = torch.tensor([spread, spread, 1.0])
        place = torch.tensor([0.4, 0.0, 0.2]) + torch.randn(30, 3, generator=generator) * scale
        field = belief_field(Mug(), se3.from_planar(place), workspace(torch.float32))
        start = torch.tensor([0.28, 0.0, 0.0])
    tool = make_tool(torch.float32, reaching=True, spacing=0.012 if spatial else 0.006, spatial=spatial)
    controls = torch.rand(60, 10, len(start), generator=generator) * 2 - 1
    every = DisplacementRollouts(field, tool, DisplacementSettings(hazard=hazard, discs=0))
    draws = every.draw(60, 4, 10, generator=generator)
    exact = every.rollout_drawn(start, controls, draws)
    for discs in (1, 8):
        lean = DisplacementRollouts(field, tool, DisplacementSettings(hazard=hazard, discs=discs))
        result = lean.rollout_drawn(start, controls, draws)
        assert torch.equal(result.configurations, exact.configurations)
        assert torch.equal(result.displacements, exact.displacements)
        assert torch.equal(result.contact, exact.contact)
        assert result.checked < (0.9 if spatial else 0.7) * exact.checked


def ball_field(dtype: torch.dtype = F64) -> ContactField:
    """A ball of radius 5 cm in the middle of the tool's plane, known exactly."""
    pose = se3.make(torch.eye(3, dtype=dtype), torch.tensor([0.4, 0.0, HEIGHT], dtype=dtype))
    return belief_field(Sphere(0.05).to(dtype), pose[None], workspace(dtype, 0.005))


def drive(
    field: ContactField, start: list[float], control: list[float], steps: int, tool: Tool | None = None
) -> PushRollouts:
    tool = tool or make_tool(F64, spacing=0.006)
    controls = torch.tensor(control, dtype=F64).expand(steps, 3)
    return DisplacementRollouts(field, tool).nominal_rollout(torch.tensor(start, dtype=F64), controls)


def test_pushing_a_ball_head_on_moves_it_along() -> None:
    result = drive(ball_field(), [0.2, 0.0, 0.0], [1.0, 0.0, 0.0], 3)
    moved = result.displacements[0, 0, -1]
    travelled = result.configurations[0, 0, -1, 0] - 0.2
    assert float(travelled) == pytest.approx(0.24, abs=1e-6)
    # the pads' tips begin 35 mm ahead of the tool and 24 mm to the side, where the ball reaches 44 mm out
    assert float(moved[0]) == pytest.approx(0.24 - (0.2 - 0.035 - 0.044), abs=0.025)
    assert moved[1:].tolist() == [0.0, 0.0]
    assert bool(result.contact[0, 0, -1])


def test_a_grazing_contact_does_not_push_but_holds_up() -> None:
    # the palm's side slides along the ball's widest part
    result = drive(ball_field(), [0.30, 0.095, 0.0], [1.0, 0.0, 0.0], 4)
    assert bool(result.touched.all())
    assert result.displacements.abs().max() == 0
    assert float(result.configurations[0, 0, -1, 0]) < 0.30 + 4 * 0.08 - 0.02


def test_far_from_everything_the_path_is_the_free_one(generator: torch.Generator) -> None:
    tool = make_tool(F64)
    model = DisplacementRollouts(ball_field(), tool)
    controls = 0.2 * torch.rand(5, 6, 3, generator=generator, dtype=F64)
    start = torch.tensor([-2.0, -2.0, 1.0], dtype=F64)
    result = model.rollout(start, controls, rollouts=2, generator=generator)
    free = tool.free_path(start.expand(5, 3), controls, 4)[:, None, 3::4].expand(5, 2, 6, 3)
    torch.testing.assert_close(result.configurations[:, :, 1:], free)
    assert not bool(result.contact.any())
    assert result.checked == 0.0


def even_field(probability: float) -> ContactField:
    """The same contact probability everywhere (a field of one cell), with all surfaces facing -x."""
    lattice = Workspace.from_bounds(torch.zeros(2, 3, dtype=F64), 0.01)
    normal = lattice.points.new_tensor([[-1.0, 0.0, 0.0]])
    return ContactField(lattice.grid(lattice.points.new_tensor([probability])), lattice.grid(normal))


@pytest.mark.parametrize("hazard", ["per_step", "per_mini_step"])
def test_chance_of_contact_and_mini_steps(hazard: Hazard) -> None:
    """One draw a step makes contact as likely as the field says; a draw a mini step adds up, as in the paper."""
    tool = make_tool(F64)
    controls = torch.tensor([1.0, 0.0, 0.0], dtype=F64).expand(400, 3, 3)
    shares = []
    for mini in (1, 4):
        model = DisplacementRollouts(even_field(0.3), tool, DisplacementSettings(mini_steps=mini, hazard=hazard))
        random = torch.Generator().manual_seed(3)
        rollouts = model.rollout(torch.zeros(3, dtype=F64), controls, rollouts=5, generator=random)
        shares.append(float(rollouts.contact.double().mean()))
        # all contacts push here, for the whole step or for the mini steps that were drawn
        expected = 3 * 0.08 * 0.3
        assert float(rollouts.displacements[:, :, -1, 0].mean()) == pytest.approx(expected, rel=0.05)
    assert shares[0] == pytest.approx(0.3, abs=0.02)
    assert shares[1] == (shares[0] if hazard == "per_step" else pytest.approx(1 - 0.7**4, abs=0.02))


@pytest.mark.parametrize(("probability", "share"), [(0.05, 0.0), (0.4, 0.4), (0.75, 0.8), (1.0, 1.0)])
def test_rollouts_of_their_own_worlds(probability: float, share: float, generator: torch.Generator) -> None:
    """A contact as likely as the field says, however long the way: no chance is taken anew, nor any drawn."""
    tool = make_tool(F64)
    controls = torch.tensor([1.0, 0.0, 0.0], dtype=F64).expand(3, 6, 3)
    for mini in (1, 4):
        settings = DisplacementSettings(mini_steps=mini, hazard="per_rollout")
        model = DisplacementRollouts(even_field(probability), tool, settings)
        before = generator.get_state()
        rollouts = model.rollout(torch.zeros(3, dtype=F64), controls, rollouts=5, generator=generator)
        assert torch.equal(generator.get_state(), before)
        met = rollouts.contact.double().mean((0, 1))
        torch.testing.assert_close(met, torch.full_like(met, share))
        assert bool((rollouts.contact[0] == rollouts.contact).all())


@pytest.mark.parametrize(("angle", "pushes"), [(40.0, True), (50.0, False), (130.0, False)])
def test_pushes_within_the_angle_only(angle: float, pushes: bool) -> None:
    way = [math.cos(math.radians(angle)), math.sin(math.radians(angle)), 0.0]
    result = drive(even_field(1.0), [0.0, 0.0, 0.0], way, 1)
    moved = result.displacements[0, 0, -1]
    torch.testing.assert_close(moved[:2], 0.08 * torch.tensor(way[:2], dtype=F64) * pushes)
    assert bool(result.configurations[0, 0, -1].any()) == pushes


def test_motion_is_that_of_the_point_that_touches() -> None:
    """A turn on the spot moves each point its own way (the printed line 10 would take -d for it)."""
    tool = make_tool(F64)
    control = torch.tensor([[[0.0, 0.0, 1.0]]], dtype=F64)
    model = DisplacementRollouts(even_field(1.0), tool, DisplacementSettings(mini_steps=1, push_angle=math.pi))
    draws = torch.zeros(1, 1, 1, 1, dtype=F64)
    start = torch.tensor([0.1, 0.2, 0.3], dtype=F64)
    moved = model.rollout_drawn(start, control, draws).displacements[0, 0, 1]
    after = tool.points(start + torch.tensor([0.0, 0.0, 0.5], dtype=F64))[0]
    torch.testing.assert_close(moved, after - tool.points(start)[0])


def test_a_quarter_turn_of_the_world_turns_everything(generator: torch.Generator) -> None:
    turn = se3.from_planar(torch.tensor([0.0, 0.0, 0.5 * math.pi], dtype=F64))
    square = torch.tensor([[-0.4, -0.4, HEIGHT], [0.4, 0.4, HEIGHT]], dtype=F64)
    lattice = Workspace.from_bounds(square, 0.02, planar_height=HEIGHT)
    mug = Mug().double()
    place = torch.randn(8, 3, generator=generator, dtype=F64) * torch.tensor([0.02, 0.02, 0.5])
    poses = se3.from_planar(place)
    tool = make_tool(F64)
    controls = torch.rand(30, 5, 3, generator=generator, dtype=F64) * 2 - 1
    controls[..., 0] += 0.5
    draws = torch.rand(30, 2, 5, 1, generator=generator, dtype=F64)
    start = torch.tensor([-0.15, 0.03, 0.2], dtype=F64)

    def turned(vectors: Tensor) -> Tensor:
        return torch.stack((-vectors[..., 1], vectors[..., 0], vectors[..., 2]), -1)

    here = DisplacementRollouts(belief_field(mug, poses, lattice), tool).rollout_drawn(start, controls, draws)
    quarter = torch.tensor([0.0, 0.0, 0.5 * math.pi], dtype=F64)
    there = DisplacementRollouts(belief_field(mug, turn @ poses, lattice), tool).rollout_drawn(
        turned(start) + quarter, turned(controls), draws
    )
    assert bool(here.displacements.any())
    assert torch.equal(here.contact, there.contact)
    torch.testing.assert_close(there.displacements, turned(here.displacements), atol=1e-9, rtol=0)
    torch.testing.assert_close(there.configurations, turned(here.configurations) + quarter, atol=1e-9, rtol=0)


def test_seeds_and_samples_are_independent(generator: torch.Generator) -> None:
    field, tool = spread_field(torch.float32, generator), make_tool(torch.float32)
    model = DisplacementRollouts(field, tool, DisplacementSettings(hazard="per_step"))
    controls = torch.rand(40, 6, 3, generator=generator) * 2 - 0.8
    start = torch.tensor([0.27, 0.0, 0.0])

    def run(seed: int) -> PushRollouts:
        return model.rollout(start, controls, rollouts=3, generator=torch.Generator().manual_seed(seed))

    first, again, other = run(1), run(1), run(2)
    assert all(torch.equal(a, b) for a, b in zip(first[:3], again[:3], strict=True))
    assert not torch.equal(first.displacements, other.displacements)
    # a sample alone is that sample among others
    draws = model.draw(40, 3, 6, generator=torch.Generator().manual_seed(1))
    alone = model.rollout_drawn(start, controls[7:8], draws[7:8])
    torch.testing.assert_close(alone.configurations[0], first.configurations[7], atol=1e-6, rtol=0)
    torch.testing.assert_close(alone.displacements[0], first.displacements[7], atol=1e-6, rtol=0)


@pytest.mark.parametrize("horizon", [1, 4])
def test_smallest_problems(horizon: int, generator: torch.Generator) -> None:
    model = DisplacementRollouts(even_field(0.5), make_tool(F64), DisplacementSettings(mini_steps=1))
    controls = torch.ones(1, horizon, 3, dtype=F64)
    result = model.rollout(torch.zeros(3, dtype=F64), controls, rollouts=1, generator=generator)
    assert result.configurations.shape == result.displacements.shape == (1, 1, horizon + 1, 3)
    assert result.contact.shape == (1, 1, horizon)
    assert bool(result.configurations.isfinite().all())


@pytest.mark.parametrize("looks", [True, False])
def test_solid_fields_are_looked_up_at_the_tools_height(
    looks: bool, generator: torch.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A field with layers, of which the one at the tool's height is the planar field, gives the same rollouts.

    So it does where the host may not look for the layer, as on a GPU.
    """
    monkeypatch.setattr(tool_lookup, "may_look", lambda *tensors: looks)
    planar = spread_field(F64, generator)
    below, above = torch.zeros_like(planar.probability.values), torch.ones_like(planar.probability.values)
    origin = planar.probability.origin - torch.tensor([0.0, 0.0, 0.01], dtype=F64)
    grid = type(planar.probability)
    solid = ContactField(
        grid(torch.cat((below, planar.probability.values, above), 2), origin, 0.01),
        grid(planar.normal.values.expand(-1, -1, 3, -1), origin, 0.01),
    )
    tool = make_tool(F64)
    controls = torch.rand(20, 5, 3, generator=generator, dtype=F64) * 2 - 0.8
    draws = torch.rand(20, 2, 5, 1, generator=generator, dtype=F64)
    start = torch.tensor([0.27, 0.0, 0.0], dtype=F64)
    a = DisplacementRollouts(planar, tool).rollout_drawn(start, controls, draws)
    b = DisplacementRollouts(solid, tool).rollout_drawn(start, controls, draws)
    assert bool(a.contact.any())
    assert torch.equal(a.contact, b.contact)
    torch.testing.assert_close(a.displacements, b.displacements, atol=1e-9, rtol=0)


def test_normals_of_likely_contacts_are_those_of_all_points(generator: torch.Generator) -> None:
    place = torch.tensor([0.4, 0.0, 0.2]) + torch.randn(9, 3, generator=generator) * torch.tensor([0.02, 0.02, 0.5])
    poses, lattice = se3.from_planar(place.double()), workspace(F64, 0.02)
    some, every = (belief_field(Mug().double(), poses, lattice, least=least) for least in (1e-3, 0.0))
    points = lattice.points + 0.013 * torch.rand(lattice.points.shape, generator=generator, dtype=F64)
    likely = some.probability.interpolate(points) >= 1e-3
    assert 0 < int(likely.sum()) < len(points) / 2
    torch.testing.assert_close(some.normal.interpolate(points)[likely], every.normal.interpolate(points)[likely])
    assert float((some.normal.values == 0).double().mean()) > 0.5


def box_field() -> ContactField:
    """A box 10 cm high about (0.4, 0), known exactly."""
    pose = se3.make(torch.eye(3, dtype=F64), torch.tensor([0.4, 0.0, 0.05], dtype=F64))
    return belief_field(Box((0.05, 0.05, 0.05)).double(), pose[None], Workspace.from_bounds(BOUNDS.double(), 0.02))


@pytest.mark.parametrize(
    ("start", "control", "pushes"),
    [((0.25, 0.0, 0.05, 0.0), (1.0, 0.0, 0.0, 0.0), True), ((0.4, 0.0, 0.19, 0.0), (0.0, 0.0, -1.0, 0.0), False)],
)
def test_gives_way_sideways_alone(start: tuple[float, ...], control: tuple[float, ...], pushes: bool) -> None:
    model = DisplacementRollouts(box_field(), make_tool(F64, spacing=0.01, spatial=True))
    result = model.nominal_rollout(torch.tensor(start, dtype=F64), torch.tensor([control] * 2, dtype=F64))
    assert bool(result.contact.any())
    moved = result.displacements[0, 0, -1]
    if pushes:
        assert float(moved[0]) > 0.05 and abs(float(moved[1])) < 1e-9
    else:
        # it stops on the top, at the height at which the pads and the palm touch it
        assert moved.tolist() == [0.0, 0.0, 0.0]
        assert 0.11 < float(result.configurations[0, 0, -1, 2]) < 0.16


def test_passes_over_what_is_lower() -> None:
    model = DisplacementRollouts(box_field(), make_tool(F64, spacing=0.01, spatial=True))
    over = torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 6, dtype=F64)
    high, low = (torch.tensor([0.1, 0.0, z, 0.0], dtype=F64) for z in (0.20, 0.08))
    assert not bool(model.nominal_rollout(high, over).contact.any())
    assert bool(model.nominal_rollout(low, over).contact.any())
