"""What holds for every signed distance function, tabulated or exact."""

import io
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import pytest
import torch

from scripts.bench.meshes import box
from sdf import se3, so3
from sdf.base import SDF
from sdf.drill import Drill
from sdf.grid_sdf import GridSDF
from sdf.mesh.build import from_mesh
from sdf.mesh.mesh_sdf import MeshSDF
from sdf.primitives import Box, Capsule, Cup, Cylinder, Mug, Placed, Sphere, TorusArc, Union
from sdf.surface import sample_surface


@dataclass(frozen=True)
class Member:
    """One of the family: how to make it, a point inside, its error, its greatest slope, and what it is a table of."""

    make: Callable[[], SDF]
    inside: tuple[float, float, float]
    error: float = 1e-9
    slope: float = 1.0 + 1e-9
    tabulated: Callable[[], SDF] | None = None


def placed() -> SDF:
    turn = so3.exp(torch.tensor((0.5, -0.3, 0.8), dtype=torch.float64))
    return Placed(Box((0.05, 0.1, 0.02)), se3.make(turn, torch.tensor((0.1, 0.2, -0.1), dtype=torch.float64)))


MEMBERS = {
    "sphere": Member(lambda: Sphere(0.07), (0, 0, 0)),
    "box": Member(lambda: Box((0.03, 0.08, 0.1)), (0.02, 0, 0)),
    "cylinder": Member(lambda: Cylinder(0.05, 0.1), (0.01, 0, 0.09)),
    "capsule": Member(lambda: Capsule((0.1, 0, 0), (0, 0.1, 0.05), 0.02), (0.1, 0, 0)),
    "torus arc": Member(lambda: TorusArc((0.1, 0, 0), 0.05, 0.01, 1.2), (0.15, 0, 0)),
    "cup": Member(lambda: Cup(0.04, 0.1, 0.004, 0.01), (0, 0, 0.005)),
    "union": Member(lambda: Union((Sphere(0.05), Capsule((0, 0, 0), (0.1, 0, 0), 0.02))), (0.1, 0, 0)),
    "placed": Member(placed, (0.1, 0.2, -0.1), slope=1.0 + 1e-6),
    "mug": Member(Mug, (0.071, 0, 0.0475)),
    "drill": Member(Drill, (0.03, 0, 0.158), slope=1.0 + 1e-6),
    "large mug": Member(lambda: Mug(tube_radius=0.008, ring_radius=0.035), (0.076, 0, 0.0475)),
    "mesh": Member(lambda: MeshSDF(box((0.03, 0.08, 0.1))), (0.02, 0, 0)),
    # each slope along an axis is at most 1: the gradient at most sqrt 3, in the cells at a sharp edge
    "grid": Member(lambda: GridSDF.from_sdf(Mug()), (0.071, 0, 0.0475), 1.5e-3, 3**0.5, Mug),
    "bare grid": Member(lambda: GridSDF.from_sdf(Mug(), outer=0.0), (0.071, 0, 0.0475), 1.5e-3, 3**0.5, Mug),
    "grid of a mesh": Member(
        lambda: from_mesh(box((0.03, 0.08, 0.1))), (0.02, 0, 0), 1.5e-3, 3**0.5, lambda: Box((0.03, 0.08, 0.1))
    ),
}


EXACT = [name for name, entry in MEMBERS.items() if entry.tabulated is None]


@pytest.fixture(scope="module")
def built() -> dict[str, SDF]:
    return {name: entry.make() for name, entry in MEMBERS.items()}


@pytest.fixture(params=MEMBERS)
def member(request, built) -> tuple[Member, SDF]:
    return MEMBERS[request.param], built[request.param]


@pytest.fixture(params=EXACT)
def exact(request, built) -> SDF:
    return built[request.param]


def around(sdf: SDF, margin: float, count: int, generator: torch.Generator) -> torch.Tensor:
    low, high = sdf.bounds.double()
    return low - margin + (high - low + 2 * margin) * torch.rand(count, 3, generator=generator, dtype=torch.float64)


def test_gradient_equals_finite_differences(member, generator):
    _, sdf = member
    points = torch.cat([around(sdf, margin, 2000, generator) for margin in (0.0, 0.1, 0.6)])
    # the table's gradient jumps between cells, a distance's at its medial axis: few points are that near to either
    step = 1e-8
    offsets = step * torch.eye(3, dtype=torch.float64)
    high, low = (sdf.distance(points[:, None] + sign * offsets) for sign in (1, -1))
    error = (sdf(points).gradient - (high - low) / (2 * step)).abs().amax(-1)
    assert (error < 1e-5).double().mean() > 0.999


def test_query_and_distance_agree(member, generator):
    _, sdf = member
    points = around(sdf, 0.5, 500, generator)
    query = sdf(points)
    assert torch.equal(query.distance, sdf.distance(points))
    assert not query.distance.requires_grad and not query.gradient.requires_grad
    attached = points.clone().requires_grad_()
    assert sdf(attached).distance.requires_grad


def test_gradient_has_unit_length_where_the_distance_is_exact(exact, generator):
    points = torch.cat([around(exact, margin, 1000, generator) for margin in (0.0, 0.3)])
    length = exact(points).gradient.norm(dim=-1)
    assert ((length - 1).abs() < 1e-6).double().mean() > 0.999


def test_distance_changes_no_faster_than_points_move(member, generator):
    entry, sdf = member
    first = torch.cat([around(sdf, margin, 3000, generator) for margin in (0.0, 0.05, 0.3, 1.0)])
    for reach in (1e-4, 1e-3, 1e-2, 0.1, 1.0):
        second = first + reach * torch.randn(first.shape, dtype=torch.float64, generator=generator)
        change = (sdf.distance(first) - sdf.distance(second)).abs()
        moved = (first - second).norm(dim=-1)
        assert (change <= entry.slope * moved + 1e-12).all()
        if entry.tabulated is not None:  # a table's steep cells are small
            assert (change <= moved + 2 * entry.error).all()


def test_sign(member):
    entry, sdf = member
    inside = torch.tensor([entry.inside], dtype=torch.float64)
    assert sdf.distance(inside).item() < 0
    corners = torch.cartesian_prod(*(sdf.bounds.double() + torch.tensor([[-0.01], [0.01]])).T)
    assert (sdf.distance(corners) > 0).all()


def test_bounds_are_tight(exact, generator):
    points, _ = sample_surface(exact, 1500, generator=generator)
    low, high = exact.bounds.double()
    assert (points >= low - 1e-6).all() and (points <= high + 1e-6).all()
    size = (high - low).max()
    slack = 0.1 if isinstance(exact, Placed) else 0.04  # only a corner touches a turned box's bounds
    assert (points.amin(0) - low).max() < slack * size and (high - points.amax(0)).max() < slack * size


def test_zero_at_the_surface(member, generator):
    entry, sdf = member
    source = sdf if entry.tabulated is None else entry.tabulated()
    points, normals = sample_surface(source, 300, generator=generator)
    assert sdf.distance(points).abs().max() < max(entry.error, 1e-7)
    # where parts meet, another surface may be nearer already a little way off
    assert ((sdf(points + 1e-4 * normals).gradient * normals).sum(-1) > 0.6).double().mean() > 0.97


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_finite_far_away_and_for_what_is_not_finite(member, dtype):
    _, sdf = member
    nan, inf = math.nan, math.inf
    away = torch.tensor([[1e3, 0, 0], [0, -1e3, 0], [700, 700, -100.0]], dtype=dtype)
    lost = torch.tensor([[nan, nan, nan], [inf, 0, 0], [0, -inf, nan], [1e30, 0, -1e38]], dtype=dtype)
    query = sdf(torch.cat((away, lost)))
    assert query.distance.dtype == query.gradient.dtype == dtype
    assert torch.isfinite(query.distance).all() and torch.isfinite(query.gradient).all()
    assert torch.allclose(query.distance[:3], away.norm(dim=-1), atol=0.5)
    assert (query.distance[3:] > 1e5).all()


@pytest.mark.parametrize("batch", [(), (0,), (2, 3), (2, 0, 3), (1, 1)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_batch_axes(member, batch, dtype, generator):
    _, sdf = member
    points = torch.randn(*batch, 3, dtype=dtype, generator=generator)
    query = sdf(points)
    assert query.distance.shape == sdf.distance(points).shape == batch
    assert query.gradient.shape == (*batch, 3)
    assert query.distance.dtype == dtype
    flat = sdf.distance(points.reshape(-1, 3))
    assert torch.allclose(query.distance.reshape(-1), flat, atol=1e-6)


def test_float32_is_as_right_as_float32_can_be(member, generator):
    _, sdf = member
    points = around(sdf, 0.3, 2000, generator)
    assert (sdf.distance(points.float()).double() - sdf.distance(points)).abs().max() < 1e-6


def test_shape_error(member, no_shape_check):
    _, sdf = member
    with pytest.raises(ValueError, match=r"Expected points to have shape \(\*b, 3\), got \(5, 2\)"):
        sdf.distance(torch.zeros(5, 2))


def test_module_manners(member):
    _, sdf = member
    assert sdf.bounds.shape == (2, 3)
    assert sdf.diagonal == pytest.approx((sdf.bounds[1] - sdf.bounds[0]).norm().item())
    assert "bounds" in sdf.state_dict()


def mug_surface(mug: Mug, pitch: float) -> torch.Tensor:
    """The mug's surface, densely, from its sizes alone: patches in closed form, less what lies in the other part."""

    def span(a: float, b: float) -> torch.Tensor:
        return torch.linspace(a, b, max(2, math.ceil(abs(b - a) / pitch) + 1), dtype=torch.float64)

    def revolve(r0: float, z0: float, r1: float, z1: float) -> torch.Tensor:
        length = max(2, math.ceil(math.hypot(r1 - r0, z1 - z0) / pitch) + 1)
        r, z = (torch.linspace(a, b, length, dtype=torch.float64) for a, b in ((r0, r1), (z0, z1)))
        angle = span(0.0, 2 * math.pi * mug.outer_radius) / mug.outer_radius
        r, z, angle = r[:, None], z[:, None].expand(-1, len(angle)), angle[None]
        return torch.stack((r * angle.cos(), r * angle.sin(), z), dim=-1).reshape(-1, 3)

    outer, inner, top, base = mug.outer_radius, mug.outer_radius - mug.wall, mug.height, mug.base
    profile = [(0, 0), (outer, 0), (outer, top), (inner, top), (inner, base), (0, base)]
    cup = torch.cat([revolve(*a, *b) for a, b in itertools.pairwise(profile)])
    along = span(-mug.half_angle * mug.ring_radius, mug.half_angle * mug.ring_radius) / mug.ring_radius
    round_ = span(0.0, 2 * math.pi * mug.tube_radius) / mug.tube_radius
    reach = mug.ring_radius + mug.tube_radius * round_[None].cos()
    x, z = outer + reach * along[:, None].cos(), 0.5 * top + reach * along[:, None].sin()
    y = (mug.tube_radius * round_[None].sin()).expand_as(x)
    tube = torch.stack((x, y, z), dim=-1).reshape(-1, 3)
    radius = tube[:, :2].norm(dim=-1)
    tube = tube[(radius > outer) | (radius < inner)]
    # of the cup, what is not within the tube; the joint's outline is covered by the tube's own points
    to_line = torch.stack(
        [
            (cup - torch.tensor((outer + mug.ring_radius * c, 0.0, 0.5 * top + mug.ring_radius * s))).norm(dim=-1)
            for c, s in zip(along.cos().tolist(), along.sin().tolist(), strict=True)
        ]
    ).amin(0)
    return torch.cat((cup[to_line > mug.tube_radius], tube))


def test_mug_distance_equals_that_to_the_nearest_point_of_a_dense_surface(generator):
    mug, pitch = Mug(), 1e-3
    surface = mug_surface(mug, pitch)
    points = torch.cat((around(mug, 0.0, 300, generator), around(mug, 0.05, 300, generator)))
    brute = torch.cdist(points, surface).amin(-1)
    exact = mug.distance(points)
    outside = exact >= 0
    # a sample is at most pitch / sqrt 2 from the nearest surface point, so the brute distance is a bit too large
    assert (brute[outside] >= exact[outside] - 1e-9).all()
    slack = (exact[outside].square() + 0.5 * pitch**2).sqrt() - exact[outside]
    assert (brute[outside] <= exact[outside] + slack + 2e-5).all()
    # inside, the handle's joint apart, the depth is exact too
    depth = -exact[~outside]
    assert (depth <= brute[~outside] + 1e-9).all()
    assert (brute[~outside] - depth < 0.5e-3).double().mean() > 0.9


def test_inference_mode_and_its_tensors(member, generator):
    _, sdf = member
    points = around(sdf, 0.1, 20, generator)
    expected = sdf(points)
    with torch.inference_mode():
        made = points * 1.0
        found = sdf(made)
    for query in (found, sdf(made)):
        assert torch.equal(query.distance, expected.distance)
        assert torch.equal(query.gradient, expected.gradient)


def test_without_grad_no_graph_is_kept(member, generator):
    _, sdf = member
    points = around(sdf, 0.1, 20, generator).requires_grad_()
    with torch.no_grad():
        query = sdf(points)
    assert not query.distance.requires_grad and not query.gradient.requires_grad


class Learnt(SDF):
    """An SDF whose own numbers are trained."""

    def __init__(self) -> None:
        super().__init__(torch.tensor([[-1.0] * 3, [1.0] * 3], dtype=torch.float64))
        self.stretch = torch.nn.Parameter(torch.tensor([1.0, 2.0, 0.5], dtype=torch.float64))

    def distance(self, points_o: torch.Tensor) -> torch.Tensor:
        return (points_o * self.stretch).norm(dim=-1) - 0.5


def test_autograd_reaches_a_members_own_parameters(generator):
    """So that a loss on the slope's length, which a true distance has 1, can be trained on."""
    sdf = Learnt()
    points = around(sdf, 0.0, 50, generator)
    query = sdf(points)
    (slope,) = torch.autograd.grad((query.gradient.norm(dim=-1) - 1).square().mean(), sdf.stretch, retain_graph=True)
    assert float(slope.abs().max()) > 0.01
    (slope,) = torch.autograd.grad(query.distance.sum(), sdf.stretch)
    assert float(slope.abs().min()) > 1.0
    with torch.no_grad():
        assert not sdf(points).gradient.requires_grad


def test_state_goes_into_one_of_the_same_numbers(member):
    entry, sdf = member
    stored = io.BytesIO()
    torch.save(sdf.state_dict(), stored)
    stored.seek(0)
    other = entry.make()
    other.load_state_dict(torch.load(stored, weights_only=True))
    inside = torch.tensor([entry.inside], dtype=torch.float64)
    assert torch.equal(other.distance(inside), sdf.distance(inside))


def ball(x: float, spacing: float = 0.01) -> GridSDF:
    place = se3.make(torch.eye(3), torch.tensor([x, 0.0, 0.0]))
    return GridSDF.from_sdf(Placed(Sphere(0.05), place), spacing, outer=0.0)


@pytest.mark.parametrize(
    ("one", "other", "name"),
    [
        (lambda: ball(0.0), lambda: ball(0.1), "GridSDF with origin"),
        (lambda: Sphere(0.1), lambda: Sphere(0.2), "Sphere with radius"),
        (lambda: Capsule((0, 0, 0), (1, 1, 0), 0.1), lambda: Capsule((0, 1, 0), (1, 0, 0), 0.1), "Capsule with a"),
        (Mug, lambda: Mug(wall=0.003), "(Cup|TorusArc) with"),
    ],
)
def test_state_of_another_size_or_place_is_refused(one, other, name):
    with pytest.raises(ValueError, match=f"Expected the state of a {name}"):
        other().load_state_dict(one().state_dict())
