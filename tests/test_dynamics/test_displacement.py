"""The displacement model against a loop that spells Alg 7 out, and against what pushing must do."""

import math
from typing import get_args

import pytest
import torch
from torch import Tensor

from rumi.dynamics.base import PushRollouts
from rumi.dynamics.contact import ContactField
from rumi.dynamics.displacement import DisplacementRollouts, DisplacementSettings, Hazard
from rumi.fields.information import information_field
from rumi.fields.workspace import Workspace
from rumi.robot.reach import Reach
from rumi.robot.reach_table import ReachTable
from rumi.robot.tool import Tool
from sdf import backend, se3
from sdf.base import SDF
from sdf.primitives import Mug, Sphere

HEIGHT = 0.045
BOUNDS = torch.tensor([[0.0, -0.4, 0.0], [0.8, 0.4, 0.2]])
FREE = torch.tensor([[-5.0, -5.0], [5.0, 5.0]])


# every test of this file holds for the plain and for the compiled version
pytestmark = pytest.mark.usefixtures("version")


def workspace(dtype: torch.dtype, spacing: float = 0.01) -> Workspace:
    return Workspace.from_bounds(BOUNDS.to(dtype), spacing, planar_height=HEIGHT)


def make_tool(dtype: torch.dtype, *, reaching: bool = False, spacing: float = 0.02) -> Tool:
    """A gripper; one that is `reaching` must stay within 0.5 m of the origin."""
    radius = torch.arange(141.0)[:, None].expand(141, 61) * 0.01
    reach = Reach(ReachTable((radius - 0.5).clamp_min(0), torch.zeros(141, 61)))
    return Tool(
        FREE.to(dtype), reach if reaching else None, height_m=HEIGHT, body_spacing_m=spacing, info_spacing_m=0.02
    )


def belief_field(
    sdf: SDF, poses: Tensor, lattice: Workspace, log_weights: Tensor | None = None, least: float = 1e-3
) -> ContactField:
    if log_weights is None:
        log_weights = torch.zeros(len(poses), dtype=poses.dtype).log_softmax(-1)
    fields = information_field(sdf, poses, log_weights, lattice.points)
    return ContactField.from_belief(sdf, poses, log_weights, lattice, fields, least=least)


def mug_field(dtype: torch.dtype, generator: torch.Generator, count: int = 12) -> ContactField:
    place = torch.tensor([0.4, 0.0, 0.2]) + torch.randn(count, 3, generator=generator) * torch.tensor([0.01, 0.01, 0.5])
    return belief_field(Mug().to(dtype), se3.from_planar(place.to(dtype)), workspace(dtype))


def reference(
    field: ContactField, tool: Tool, settings: DisplacementSettings, start: Tensor, controls: Tensor, draws: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """RUMI's Alg 7 as corrected, one rollout, one mini step and one point after the other."""
    samples, rollouts, horizon, parts = draws.shape
    states = torch.zeros(samples, rollouts, horizon + 1, 3, dtype=start.dtype)
    moved = torch.zeros_like(states)
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
                    if math.acos(max(-1.0, min(1.0, cosine))) < settings.push_angle:
                        q, d = ahead, d + motion
                states[k, m, h + 1], moved[k, m, h + 1] = q, d
    return states, moved, contact


@pytest.mark.parametrize("hazard", get_args(Hazard))
@pytest.mark.parametrize("discs", [0, 5])
@pytest.mark.parametrize("reaching", [False, True])
def test_is_the_algorithm(hazard: Hazard, discs: int, reaching: bool, generator: torch.Generator) -> None:
    settings = DisplacementSettings(mini_steps=3, hazard=hazard, discs=discs)
    field, tool = mug_field(torch.float64, generator), make_tool(torch.float64, reaching=reaching)
    start = torch.tensor([0.27, 0.02, 0.1], dtype=torch.float64)
    controls = 1.2 * torch.rand(12, 4, 3, generator=generator, dtype=torch.float64) - 0.5
    model = DisplacementRollouts(field, tool, settings)
    draws = model.draw(12, 3, 4, generator=generator)
    result = model.rollout_drawn(start, controls, draws)
    states, moved, contact = reference(field, tool, settings, start, controls, draws)
    assert torch.equal(result.contact, contact)
    torch.testing.assert_close(result.configurations, states, atol=1e-9, rtol=0)
    torch.testing.assert_close(result.displacements, moved, atol=1e-9, rtol=0)
    # the case is worth its name: there is contact and none, pushing and blocking, and rollouts that differ
    assert 0.1 < float(result.touched.double().mean()) < 0.95
    assert float(moved.norm(dim=-1).max()) > 0.02
    assert bool((result.contact & (moved[:, :, 1:] == moved[:, :, :-1]).all(-1)).any())
    assert result.checked < 0.6 if discs else result.checked > 0.3


@pytest.mark.parametrize("hazard", get_args(Hazard))
@pytest.mark.parametrize("spread", [0.002, 0.04])
def test_bound_changes_nothing_but_the_work(hazard: Hazard, spread: float, generator: torch.Generator) -> None:
    scale = torch.tensor([spread, spread, 1.0])
    place = torch.tensor([0.4, 0.0, 0.2]) + torch.randn(30, 3, generator=generator) * scale
    field = belief_field(Mug(), se3.from_planar(place), workspace(torch.float32))
    tool = make_tool(torch.float32, reaching=True, spacing=0.006)
    controls = torch.rand(150, 10, 3, generator=generator) * 2 - 1
    start = torch.tensor([0.28, 0.0, 0.0])
    every = DisplacementRollouts(field, tool, DisplacementSettings(hazard=hazard, discs=0))
    draws = every.draw(150, 4, 10, generator=generator)
    exact = every.rollout_drawn(start, controls, draws)
    for discs in (1, 8):
        lean = DisplacementRollouts(field, tool, DisplacementSettings(hazard=hazard, discs=discs))
        result = lean.rollout_drawn(start, controls, draws)
        assert torch.equal(result.configurations, exact.configurations)
        assert torch.equal(result.displacements, exact.displacements)
        assert torch.equal(result.contact, exact.contact)
        assert result.checked < 0.7 * exact.checked


def ball_field(dtype: torch.dtype = torch.float64) -> ContactField:
    """A ball of radius 5 cm in the middle of the tool's plane, known exactly."""
    pose = se3.make(torch.eye(3, dtype=dtype), torch.tensor([0.4, 0.0, HEIGHT], dtype=dtype))
    return belief_field(Sphere(0.05).to(dtype), pose[None], workspace(dtype, 0.005))


def drive(
    field: ContactField, start: list[float], control: list[float], steps: int, tool: Tool | None = None
) -> PushRollouts:
    tool = tool or make_tool(torch.float64, spacing=0.006)
    controls = torch.tensor(control, dtype=torch.float64).expand(steps, 3)
    return DisplacementRollouts(field, tool).nominal_rollout(torch.tensor(start, dtype=torch.float64), controls)


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
    tool = make_tool(torch.float64)
    model = DisplacementRollouts(ball_field(), tool)
    controls = 0.2 * torch.rand(5, 6, 3, generator=generator, dtype=torch.float64)
    start = torch.tensor([-2.0, -2.0, 1.0], dtype=torch.float64)
    result = model.rollout(start, controls, rollouts=2, generator=generator)
    free = tool.free_path(start.expand(5, 3), controls, 4)[:, None, 3::4].expand(5, 2, 6, 3)
    torch.testing.assert_close(result.configurations[:, :, 1:], free)
    assert not bool(result.contact.any())
    assert result.checked == 0.0


def even_field(probability: float) -> ContactField:
    """The same contact probability everywhere (a field of one cell), with all surfaces facing -x."""
    lattice = Workspace.from_bounds(torch.zeros(2, 3, dtype=torch.float64), 0.01)
    normal = lattice.points.new_tensor([[-1.0, 0.0, 0.0]])
    return ContactField(lattice.grid(lattice.points.new_tensor([probability])), lattice.grid(normal))


@pytest.mark.parametrize("hazard", ["per_step", "per_mini_step"])
def test_chance_of_contact_and_mini_steps(hazard: Hazard) -> None:
    """One draw a step makes contact as likely as the field says; a draw a mini step adds up, as in the paper."""
    tool = make_tool(torch.float64)
    controls = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64).expand(400, 3, 3)
    shares = []
    for mini in (1, 4):
        model = DisplacementRollouts(even_field(0.3), tool, DisplacementSettings(mini_steps=mini, hazard=hazard))
        random = torch.Generator().manual_seed(3)
        rollouts = model.rollout(torch.zeros(3, dtype=torch.float64), controls, rollouts=5, generator=random)
        shares.append(float(rollouts.contact.double().mean()))
        # all contacts push here, for the whole step or for the mini steps that were drawn
        expected = 3 * 0.08 * 0.3
        assert float(rollouts.displacements[:, :, -1, 0].mean()) == pytest.approx(expected, rel=0.05)
    assert shares[0] == pytest.approx(0.3, abs=0.02)
    assert shares[1] == (shares[0] if hazard == "per_step" else pytest.approx(1 - 0.7**4, abs=0.02))


@pytest.mark.parametrize(("probability", "share"), [(0.05, 0.0), (0.4, 0.4), (0.75, 0.8), (1.0, 1.0)])
def test_rollouts_of_their_own_worlds(probability: float, share: float, generator: torch.Generator) -> None:
    """A contact as likely as the field says, however long the way: no chance is taken anew, nor any drawn."""
    tool = make_tool(torch.float64)
    controls = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64).expand(3, 6, 3)
    for mini in (1, 4):
        settings = DisplacementSettings(mini_steps=mini, hazard="per_rollout")
        model = DisplacementRollouts(even_field(probability), tool, settings)
        before = generator.get_state()
        rollouts = model.rollout(torch.zeros(3, dtype=torch.float64), controls, rollouts=5, generator=generator)
        assert torch.equal(generator.get_state(), before)
        met = rollouts.contact.double().mean((0, 1))
        torch.testing.assert_close(met, torch.full_like(met, share))
        assert bool((rollouts.contact[0] == rollouts.contact).all())


@pytest.mark.parametrize(("angle", "pushes"), [(40.0, True), (50.0, False), (130.0, False)])
def test_pushes_within_the_angle_only(angle: float, pushes: bool) -> None:
    way = [math.cos(math.radians(angle)), math.sin(math.radians(angle)), 0.0]
    result = drive(even_field(1.0), [0.0, 0.0, 0.0], way, 1)
    moved = result.displacements[0, 0, -1]
    torch.testing.assert_close(moved[:2], 0.08 * torch.tensor(way[:2], dtype=torch.float64) * pushes)
    assert bool(result.configurations[0, 0, -1].any()) == pushes


def test_motion_is_that_of_the_point_that_touches() -> None:
    """A turn on the spot moves each point its own way (the printed line 10 would take -d for it)."""
    tool = make_tool(torch.float64)
    control = torch.tensor([[[0.0, 0.0, 1.0]]], dtype=torch.float64)
    model = DisplacementRollouts(even_field(1.0), tool, DisplacementSettings(mini_steps=1, push_angle=math.pi))
    draws = torch.zeros(1, 1, 1, 1, dtype=torch.float64)
    start = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
    moved = model.rollout_drawn(start, control, draws).displacements[0, 0, 1]
    after = tool.points(start + torch.tensor([0.0, 0.0, 0.5], dtype=torch.float64))[0]
    torch.testing.assert_close(moved, after - tool.points(start)[0])


def test_a_quarter_turn_of_the_world_turns_everything(generator: torch.Generator) -> None:
    turn = se3.from_planar(torch.tensor([0.0, 0.0, 0.5 * math.pi], dtype=torch.float64))
    square = torch.tensor([[-0.4, -0.4, HEIGHT], [0.4, 0.4, HEIGHT]], dtype=torch.float64)
    lattice = Workspace.from_bounds(square, 0.02, planar_height=HEIGHT)
    mug = Mug().double()
    place = torch.randn(8, 3, generator=generator, dtype=torch.float64) * torch.tensor([0.02, 0.02, 0.5])
    poses = se3.from_planar(place)
    tool = make_tool(torch.float64)
    controls = torch.rand(30, 5, 3, generator=generator, dtype=torch.float64) * 2 - 1
    controls[..., 0] += 0.5
    draws = torch.rand(30, 2, 5, 1, generator=generator, dtype=torch.float64)
    start = torch.tensor([-0.15, 0.03, 0.2], dtype=torch.float64)

    def turned(vectors: Tensor) -> Tensor:
        return torch.stack((-vectors[..., 1], vectors[..., 0], vectors[..., 2]), -1)

    here = DisplacementRollouts(belief_field(mug, poses, lattice), tool).rollout_drawn(start, controls, draws)
    quarter = torch.tensor([0.0, 0.0, 0.5 * math.pi], dtype=torch.float64)
    there = DisplacementRollouts(belief_field(mug, turn @ poses, lattice), tool).rollout_drawn(
        turned(start) + quarter, turned(controls), draws
    )
    assert bool(here.displacements.any())
    assert torch.equal(here.contact, there.contact)
    torch.testing.assert_close(there.displacements, turned(here.displacements), atol=1e-9, rtol=0)
    torch.testing.assert_close(there.configurations, turned(here.configurations) + quarter, atol=1e-9, rtol=0)


def test_seeds_and_samples_are_independent(generator: torch.Generator) -> None:
    field, tool = mug_field(torch.float32, generator), make_tool(torch.float32)
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
    model = DisplacementRollouts(even_field(0.5), make_tool(torch.float64), DisplacementSettings(mini_steps=1))
    controls = torch.ones(1, horizon, 3, dtype=torch.float64)
    result = model.rollout(torch.zeros(3, dtype=torch.float64), controls, rollouts=1, generator=generator)
    assert result.configurations.shape == result.displacements.shape == (1, 1, horizon + 1, 3)
    assert result.contact.shape == (1, 1, horizon)
    assert bool(result.configurations.isfinite().all())


def test_solid_fields_are_looked_up_at_the_tools_height(generator: torch.Generator) -> None:
    """A field with layers, of which the one at the tool's height is the planar field, gives the same rollouts."""
    planar = mug_field(torch.float64, generator)
    below, above = torch.zeros_like(planar.probability.values), torch.ones_like(planar.probability.values)
    origin = planar.probability.origin - torch.tensor([0.0, 0.0, 0.01], dtype=torch.float64)
    grid = type(planar.probability)
    solid = ContactField(
        grid(torch.cat((below, planar.probability.values, above), 2), origin, 0.01),
        grid(planar.normal.values.expand(-1, -1, 3, -1), origin, 0.01),
    )
    tool = make_tool(torch.float64)
    controls = torch.rand(20, 5, 3, generator=generator, dtype=torch.float64) * 2 - 0.8
    draws = torch.rand(20, 2, 5, 1, generator=generator, dtype=torch.float64)
    start = torch.tensor([0.27, 0.0, 0.0], dtype=torch.float64)
    a = DisplacementRollouts(planar, tool).rollout_drawn(start, controls, draws)
    b = DisplacementRollouts(solid, tool).rollout_drawn(start, controls, draws)
    assert bool(a.contact.any())
    assert torch.equal(a.contact, b.contact)
    torch.testing.assert_close(a.displacements, b.displacements, atol=1e-9, rtol=0)


def test_normals_of_likely_contacts_are_those_of_all_points(generator: torch.Generator) -> None:
    place = torch.tensor([0.4, 0.0, 0.2]) + torch.randn(9, 3, generator=generator) * torch.tensor([0.02, 0.02, 0.5])
    poses, lattice = se3.from_planar(place.double()), workspace(torch.float64, 0.02)
    some, every = (belief_field(Mug().double(), poses, lattice, least=least) for least in (1e-3, 0.0))
    points = lattice.points + 0.013 * torch.rand(lattice.points.shape, generator=generator, dtype=torch.float64)
    likely = some.probability.interpolate(points) >= 1e-3
    assert 0 < int(likely.sum()) < len(points) / 2
    torch.testing.assert_close(some.normal.interpolate(points)[likely], every.normal.interpolate(points)[likely])
    assert float((some.normal.values == 0).double().mean()) > 0.5


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mini_steps": 0}, "mini_steps"),
        ({"push_angle": 0.0}, "push_angle"),
        ({"hazard": "never"}, "per_step, per_mini_step"),
        ({"discs": -1}, "discs"),
    ],
)
def test_refuses_settings_without_meaning(change: dict[str, object], message: str, no_shape_check: None) -> None:
    with pytest.raises(ValueError, match=message):
        DisplacementSettings(**change)  # type: ignore[arg-type]


@pytest.mark.parametrize("hazard", get_args(Hazard))
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_versions_agree(hazard: Hazard, dtype: torch.dtype, generator: torch.Generator) -> None:
    field, tool = mug_field(dtype, generator), make_tool(dtype, reaching=True, spacing=0.006)
    model = DisplacementRollouts(field, tool, DisplacementSettings(hazard=hazard))
    controls = (2.0 * torch.rand(200, 10, 3, generator=generator) - 1.0).to(dtype)
    start = torch.tensor([0.28, 0.0, 0.1], dtype=dtype)
    draws = model.draw(200, 5, 10, generator=generator)
    found = model.rollout_drawn(start, controls, draws)
    with backend.force("torch"):
        plain = model.rollout_drawn(start, controls, draws)
    same = (found.contact == plain.contact).all(-1)
    same &= (found.displacements - plain.displacements).abs().amax((-1, -2)) < 1e-5
    same &= (found.configurations - plain.configurations).abs().amax((-1, -2)) < 1e-5
    # in float32 the last digit of a probability may fall on the other side of a number that was drawn
    assert float(same.double().mean()) > (0.995 if dtype == torch.float32 else 0.9999)
    assert 0.2 < float(found.touched.double().mean()) < 0.98
