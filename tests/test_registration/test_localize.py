"""Poses from touched points: oracles, all modes, and input that cannot be."""

import json
import math
import os
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from rumi.registration.contact_posterior import distinct, gather_modes
from rumi.registration.contact_terms import TouchFit, touch_terms
from rumi.registration.from_contacts import LocalizeSettings, PositionPrior, localize
from rumi.registration.touch_surface import TouchSurface
from rumi.seeding import generator as seeded
from sdf import backend, compiled, se3, so3
from sdf.mesh.mesh import MeshError, TriangleMesh
from sdf.surface import sample_triangles
from sdf.symmetry import Symmetries
from tests.fixtures import meshes

pytest.importorskip("scipy")

F64 = torch.float64


@pytest.fixture(scope="module")
def box():
    # its frame is not in its middle
    return TouchSurface.of(meshes.box((0.03, 0.045, 0.07), center=(0.04, 0.025, 0.1)))


@pytest.fixture(scope="module")
def wedge():
    return TouchSurface.of(meshes.wedge())


@pytest.fixture(scope="module")
def cylinder():
    return TouchSurface.of(meshes.cylinder())


def touches(surface, count, noise=0.0, seed=3):
    """A pose, points on the object there, and their normals."""
    generator = seeded(seed)
    turn = so3.exp(2.0 * torch.randn(3, generator=generator, dtype=F64))
    truth = se3.make(turn, 0.3 * torch.randn(3, generator=generator, dtype=F64))
    points, normals = sample_triangles(surface.triangles, count, generator=generator)
    world = se3.apply(truth, points + surface.middle_o)
    return truth, world + noise * torch.randn(count, 3, generator=generator, dtype=F64), normals @ turn.mT


def off(surface, found, truth, mode=0):
    """Metres and radians from the nearest of the poses that are like the true one."""
    pose = found.world_T_object[mode]
    own = surface.symmetries.nearest(truth, pose)
    place = (surface.centred(own) - surface.centred(pose))[:3, 3].norm()
    return float(place), float(so3.angle(own[:3, :3].mT @ pose[:3, :3]))


FEW = LocalizeSettings(starts=300, polished=40)


@pytest.mark.parametrize("name", ["box", "wedge", "cylinder"])
@pytest.mark.parametrize("with_normals", [False, True])
def test_the_true_pose_comes_back(name, with_normals, request):
    surface = request.getfixturevalue(name)
    truth, points, normals = touches(surface, 50)
    found = localize(surface, points, normals=normals if with_normals else None, settings=FEW, generator=seeded(1))
    place, turn = off(surface, found, truth)
    assert place < 1e-4 and turn < 2e-3
    assert float(found.distance_m[found.best]) < 1e-5
    assert float(found.weights.sum()) == pytest.approx(1.0) and int(found.open_directions[0]) == 0
    assert found.family == (name == "cylinder")


def test_what_it_looks_like_is_put_together(box, cylinder):
    assert len(box.symmetries) == 4 and cylinder.symmetries.axis is not None
    truth, points, _ = touches(cylinder, 60)
    found = localize(cylinder, points, settings=FEW)
    # the family about the axis and its other end up: of all these poses the points are as far
    family = cylinder.centred(found.alike(0, turns=20))
    assert len(family) == 40
    fit = touch_terms(cylinder, family, points, None, TouchFit("absolute", True)).objective / len(points)
    assert float(fit.max()) < 4e-4  # of a polygon with 36 sides, radius (1 - cos 5 degrees) is 0.11 mm
    ends = family[:, :3, 2] @ truth[:3, 2]
    assert bool((ends > 0.99).any()) and bool((ends < -0.99).any())
    # without symmetries the same poses are modes of their own
    plain = localize(replace(box, symmetries=Symmetries.none().to(F64)), touches(box, 60)[1], settings=FEW)
    assert len(plain) == 4
    assert torch.allclose(plain.weights, torch.full((4,), 0.25, dtype=F64), atol=0.08)


def test_rival_modes_are_all_kept(wedge):
    """Touches of one face alone leave where on its plane it is, and which face it was."""
    truth, points, normals = touches(wedge, 400)
    face = normals @ truth[:3, 2] < -0.9  # the foot
    found = localize(wedge, points[face][:12], settings=FEW)
    assert len(found) > 3 and found.found >= len(found)
    assert int(found.open_directions.max()) >= 1
    # the true one is among what is found, up to what its covariance says
    error = [
        (wedge.centred(truth) - wedge.centred(pose))[:3, 3].norm() / spread
        for pose, spread in zip(found.world_T_object, found.spread_m, strict=True)
    ]
    assert float(min(error)) < 3.0


def test_three_points_leave_much_open(box):
    _, points, _ = touches(box, 3)
    found = localize(box, points, settings=FEW)
    assert int(found.open_directions[0]) >= 2
    assert float(found.spread_m[0]) > 0.01 or float(found.spread_rad[0]) > 0.3
    assert "directions open" in found.text()


@pytest.mark.parametrize("settings", [{"plausible": 1.0}, {"noise_m": 1e-9}, {"noise_m": 1e3}])
def test_the_best_pose_is_always_a_mode(wedge, settings):
    _, points, _ = touches(wedge, 20, noise=0.001)
    found = localize(wedge, points, settings=LocalizeSettings(starts=100, **settings))
    assert found.found >= len(found) >= 1 and float(found.weights.sum()) == pytest.approx(1.0)
    assert bool(torch.isfinite(found.covariance).all())


def test_noise_is_in_the_spread(wedge):
    truth, points, _ = touches(wedge, 80, noise=0.002)
    found = localize(wedge, points, settings=FEW)
    place, turn = off(wedge, found, truth)
    assert place < 4.0 * float(found.spread_m[0]) and turn < 4.0 * float(found.spread_rad[0])
    assert 1e-4 < float(found.spread_m[0]) < 2e-3
    assert 0.0008 < float(found.distance_m[0]) < 0.002


def test_a_change_of_world_changes_nothing(wedge):
    _, points, _ = touches(wedge, 40, noise=0.001)
    world = se3.make(so3.exp(torch.tensor([0.3, -1.0, 2.0], dtype=F64)), torch.tensor([1.0, 2.0, -3.0], dtype=F64))
    one = localize(wedge, points, settings=FEW)
    two = localize(wedge, se3.apply(world, points), settings=FEW)
    assert float(two.distance_m[0]) == pytest.approx(float(one.distance_m[0]), abs=1e-6)
    assert torch.allclose(world @ one.world_T_object[0], two.world_T_object[0], atol=6e-3)


def test_a_seed_repeats(wedge):
    _, points, _ = touches(wedge, 20, noise=0.001)
    one, two = (localize(wedge, points, settings=FEW, generator=seeded(5)) for _ in range(2))
    assert torch.equal(one.world_T_object, two.world_T_object)


def test_a_prior_seeds_and_clips_only_when_asked(wedge):
    truth, points, _ = touches(wedge, 40)
    place = truth[:3, 3]
    wrong = PositionPrior(place + 0.2, torch.full((3,), 0.05, dtype=F64))
    assert off(wedge, localize(wedge, points, prior=wrong, settings=FEW), truth)[0] < 1e-4
    with pytest.raises(ValueError, match="leave out clip"):
        localize(wedge, points, prior=wrong, clip=True, settings=FEW)
    right = PositionPrior(place, torch.full((3,), 0.01, dtype=F64))
    found = localize(wedge, points, prior=right, clip=True, settings=FEW)
    assert off(wedge, found, truth)[0] < 1e-4
    assert bool(((found.world_T_object[:, :3, 3] - place).abs() <= 0.01).all())
    with pytest.raises(ValueError, match="a prior to clip by"):
        localize(wedge, points, clip=True)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda p, n: (p[:2], None), "3 contact points or more, got 2"),
        (lambda p, n: (p[:1].expand(5, 3), None), "at different places"),
        (lambda p, n: (p[:1] + torch.linspace(0, 0.1, 6, dtype=F64)[:, None] * n[:1], None), "not all on one line"),
        (lambda p, n: (p * 1000, None), "millimetres"),
        (lambda p, n: (p, n * 1.1), "unit normals"),
        (lambda p, n: (p, n * 0.0), "unit normals"),
        (lambda p, n: (p, n[:4]), "a normal for each"),
        (lambda p, n: (p * math.nan, None), "finite points"),
    ],
)
def test_points_that_cannot_be(wedge, no_shape_check, change, words):
    _, points, normals = touches(wedge, 12)
    points, normals = change(points, normals)
    with pytest.raises(ValueError, match=words):
        localize(wedge, points, normals=normals, settings=FEW)


def test_priors_and_meshes_that_cannot_be(wedge):
    _, points, _ = touches(wedge, 12)
    with pytest.raises(ValueError, match="radius above 0"):
        localize(wedge, points, prior=PositionPrior(torch.zeros(3), torch.zeros(3)))
    with pytest.raises(MeshError, match="millimetres"):
        TouchSurface.of(TriangleMesh(meshes.wedge().vertices * 1000, meshes.wedge().faces))
    line = TriangleMesh(torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]], dtype=F64), torch.tensor([[0, 1, 2]]))
    with pytest.raises(MeshError):
        TouchSurface.of(line)


def test_a_sheet_can_be_touched_too():
    corners = torch.tensor([[0.0, 0, 0], [0.2, 0, 0], [0.2, 0.1, 0], [0.05, 0.1, 0.05]], dtype=F64)
    surface = TouchSurface.of(TriangleMesh(corners, torch.tensor([[0, 1, 2], [0, 2, 3]])))
    assert surface.symmetries.trivial
    _, points, _ = touches(surface, 40)
    found = localize(surface, points, settings=FEW)
    assert float(found.distance_m[found.best]) < 1e-5


@pytest.mark.parametrize("exact", [False, True])
@pytest.mark.parametrize(("loss", "outlier"), [("square", 0.0), ("absolute", 0.0), ("absolute", 0.05)])
@pytest.mark.parametrize("reach", [0.0, 0.05])
def test_terms_are_the_derivatives(version, wedge, exact, loss, outlier, reach):
    truth, points, normals = touches(wedge, 20, noise=0.004)
    poses = wedge.centred(se3.exp(0.02 * torch.randn(4, 6, generator=seeded(2), dtype=F64)) @ truth)
    fit = TouchFit(loss, exact, reach, smooth_m=1e-3, outlier=outlier)
    given = normals if reach else None
    terms = touch_terms(wedge, poses, points, given, fit)
    for k in range(6):
        step = torch.zeros(6, dtype=F64)
        step[k] = 1e-7
        ends = []
        for sign in (1.0, -1.0):
            shift, turn = sign * step[:3], so3.exp(sign * step[3:])
            moved = se3.make(turn @ poses[:, :3, :3], poses[:, :3, 3] + shift)
            ends.append(touch_terms(wedge, moved, points, given, fit).objective)
        assert torch.allclose((ends[0] - ends[1]) / 2e-7, terms.gradient[:, k], rtol=1e-4, atol=1e-6)
    assert bool((torch.linalg.eigvalsh(terms.hessian) > -1e-9).all())


def test_a_distance_is_not_that_of_the_smoothed_loss(version, box):
    """Points on the box: what is left is what rounding leaves of them."""
    truth, points, _ = touches(box, 30)
    pose = box.centred(truth)[None]
    assert (
        0.0
        <= float(gather_modes(box, pose, points, None, LocalizeSettings(), generator=seeded(0)).distance_m[0])
        < 2e-15
    )
    on = box.triangles.corners[:, 0]
    middle = torch.eye(4, dtype=F64)[None]
    terms = touch_terms(box, middle, on, None, TouchFit("absolute", True, smooth_m=0.0))
    assert float(terms.objective) == 0.0
    assert all(bool(torch.isfinite(part).all()) for part in terms)


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_versions_agree(dtype, box):
    if not compiled.available():
        pytest.skip("without numba")
    _, points, normals = touches(box, 30, noise=0.003)
    poses = torch.eye(4, dtype=F64).repeat(9, 1, 1)
    poses[:, :3] = se3.make(so3.exp(torch.randn(9, 3, generator=seeded(0), dtype=F64)), points.mean(0))[:, :3]
    poses[8, :3, 3] += 1e6  # far outside of the table
    for fit in (
        TouchFit(),
        TouchFit("absolute", True),
        TouchFit("square", True, 0.04),
        TouchFit("absolute", False, 0.04),
        TouchFit("absolute", True, smooth_m=0.0),
        TouchFit("absolute", True, 0.04, outlier=0.02),
        TouchFit("square", True, outlier=0.02),
    ):
        for some in (poses, poses[:0]):
            results = []
            for name in ("torch", "numba"):
                with backend.force(name):
                    given = normals.to(dtype) if fit.reach_m else None
                    results.append(touch_terms(box, some.to(dtype), points.to(dtype), given, fit))
            near = slice(0, 8)
            for one, two in zip(*results, strict=True):
                scale = float(one[near].abs().max()) if len(one) else 1.0
                rough = 2e-3 if dtype == torch.float32 else 1e-9
                assert one.dtype == two.dtype == dtype
                assert torch.allclose(one[near], two[near], rtol=rough, atol=rough * scale)
                assert bool(torch.isfinite(two).all())


@pytest.mark.parametrize("with_normals", [False, True])
def test_a_bad_touch_is_named_and_does_no_harm(wedge, with_normals):
    """One beside the object, and one of another thing, which cannot be on it."""
    truth, points, normals = touches(wedge, 20, noise=0.0005)
    points[3] += 0.05 * normals[3]
    points[8] += 0.5
    found = localize(wedge, points, normals=normals if with_normals else None, settings=FEW)
    place, turn = off(wedge, found, truth)
    assert place < 0.004 and turn < 0.1 and float(found.weights[0]) > 0.9
    assert found.suspects[:2] == [8, 3] and found.left_out.nonzero().tolist() == [[8]] and found.points == 20
    assert found.noise_m < 0.0015
    told = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert [one["touch"] for one in told["suspects"][:2]] == [9, 4] and told["suspects"][0]["left_out"]
    assert "suspect touches" in found.text() and "9 (" in found.text()


def test_the_covariance_of_the_origin(wedge):
    """What a small shift and turn of the middle do to the mesh's origin."""
    _, points, _ = touches(wedge, 30, noise=0.001)
    found = localize(wedge, points, settings=FEW)
    draw = 1e-4 * torch.randn(4000, 6, generator=seeded(0), dtype=F64)
    spread = torch.linalg.cholesky(found.covariance[0])
    moved = draw @ spread.mT
    middle = wedge.centred(found.world_T_object[0])
    turn = so3.exp(moved[:, 3:]) @ middle[:3, :3]
    origin = wedge.uncentred(se3.make(turn, middle[:3, 3] + moved[:, :3]))[:, :3, 3] - found.world_T_object[0, :3, 3]
    own = torch.cat((origin, moved[:, 3:]), -1) / 1e-4
    expected = spread @ (draw.mT @ draw / len(draw) / 1e-8) @ spread.mT
    across = torch.eye(6, dtype=F64)
    across[:3, 3:] = so3.hat(middle[:3, :3] @ wedge.middle_o)
    assert torch.allclose(own.mT @ own / len(own), across @ expected @ across.mT, rtol=1e-3, atol=1e-9)
    assert torch.allclose(found.mode(0).covariance, across @ found.covariance[0] @ across.mT)


def test_distinct_counts_what_looks_the_same_once(box):
    pose = torch.eye(4, dtype=F64)[None]
    own = box.symmetries
    turned = se3.make(own.rotations, own.center - (own.rotations @ own.center[:, None])[..., 0])
    moved = pose.clone()
    moved[:, 0, 3] = 0.05
    poses = box.centred(torch.cat((turned, moved, pose)))
    assert distinct(box, poses, 0.01, 0.1, 10).tolist() == [0, 4]
    assert distinct(box, poses, 0.01, 0.1, 1).tolist() == [0]
    assert distinct(box, poses[:0], 0.01, 0.1, 1).tolist() == []


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "mesh", "floor"),
    [
        ("Cylinder_exp", "cylinder", 5.44),
        ("Lego_exp", "legoBox", 6.73),
        pytest.param("Box100_sim", "box", 0.0001, marks=pytest.mark.slow),
        pytest.param("Tetra30_sim", "tetrahedron", 0.002, marks=pytest.mark.slow),
        pytest.param("Cleaner_sim", "cleaner", 0.88, marks=pytest.mark.slow),
    ],
)
def test_recorded_touches(name, mesh, floor):
    from rumi.commands.contact_files import read_contacts

    pytest.importorskip("trimesh")
    folder = Path(os.environ["RUMI_DATA"]) / "icub_touch"
    surface = TouchSurface.of(folder / f"{mesh}.off")
    points = read_contacts(folder / f"meas{name}.off").points
    for seed in (1000, 1001):
        found = localize(surface, points, generator=seeded(seed))
        assert 1e3 * float(found.distance_m[found.best]) < floor + 0.3
        if name == "Cylinder_exp":
            assert found.family and len(found.symmetries) == 2
        if name == "Lego_exp":
            assert len(found) >= 2 and float(found.distance_m[1:].min()) < 0.009
