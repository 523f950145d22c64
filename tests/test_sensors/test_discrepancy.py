"""RUMI's discrepancy and its gradients."""

import pytest
import torch

from sdf import backend, se3
from sdf.grid_sdf import GridSDF
from sdf.primitives import Box, Mug, Sphere
from sensors.discrepancy import Discrepancy, discrepancy_terms, poses_at_once, residuals
from sensors.observation import Observation, concatenate
from sensors.semantics import Semantics

F64 = torch.float64


# every test of this file holds for the plain and for the compiled version
pytestmark = pytest.mark.usefixtures("version")


def scene(case):
    """Poses and points of a golden case with a sphere."""
    inputs = case["inputs"]
    poses = torch.tensor(inputs["W_T_O"], dtype=F64)
    parts = [
        Observation.of(torch.tensor(inputs[name], dtype=F64).reshape(-1, 3), label)
        for name, label in (("free", 0), ("occupied", 1), ("surface", 2))
        if name in inputs
    ]
    return poses, concatenate(parts), Sphere(inputs["sphere_radius"]).double()


@pytest.mark.parametrize("alpha", ["+0.005", "+0.000"])
def test_golden_terms(golden, alpha):
    case = golden(f"rumi.cost_terms.alpha{alpha}")
    inputs, expected = case["inputs"], case["expected"]
    v = torch.tensor(inputs["sdf"], dtype=F64)
    for label, name, gradient in (
        (0, "c_free", "grad_free_coeff"),
        (1, "c_occ", "grad_occ_coeff"),
        (2, "c_known", "grad_known_coeff"),
    ):
        semantics = torch.full(v.shape, label)
        cost = discrepancy_terms(v, semantics, inputs["C"], inputs["alpha"])
        torch.testing.assert_close(cost, torch.tensor(expected[name], dtype=F64), atol=1e-14, rtol=0)
        residual, weight = residuals(v, semantics, inputs["C"], inputs["alpha"])
        torch.testing.assert_close(weight * residual, torch.tensor(expected[gradient], dtype=F64), atol=1e-14, rtol=0)


def test_golden_total(golden):
    case = golden("rumi.cost_total")
    poses, observation, sphere = scene(case)
    # the low-level hinge takes a signed alpha, the module a tolerance: use the former here
    from sdf.posed import posed_distance

    distance = posed_distance(sphere, poses, observation.points)
    cost = discrepancy_terms(
        distance, observation.semantics.expand(distance.shape), case["inputs"]["C"], case["inputs"]["alpha"]
    ).sum(-1)
    expected = case["expected"]
    torch.testing.assert_close(cost, torch.tensor(expected["l"], dtype=F64), atol=1e-12, rtol=0)
    weights = torch.softmax(-case["inputs"]["lam"] * cost, -1)
    torch.testing.assert_close(weights, torch.tensor(expected["w"], dtype=F64), atol=1e-12, rtol=0)


def test_golden_additivity(golden):
    case = golden("rumi.additivity")
    inputs, expected = case["inputs"], case["expected"]
    new = Observation.of(torch.tensor(inputs["new_surface"], dtype=F64), Semantics.SURFACE)
    module = Discrepancy(Sphere(inputs["sphere_radius"]).double(), inputs["sphere_radius"]).double()
    change = module(torch.tensor(inputs["W_T_O"], dtype=F64), new)
    torch.testing.assert_close(change, torch.tensor(expected["dl"], dtype=F64), atol=1e-12, rtol=0)
    weights = torch.softmax(-inputs["lam"] * (torch.tensor(inputs["l_prev"], dtype=F64) + change), -1)
    torch.testing.assert_close(weights, torch.tensor(expected["w"], dtype=F64), atol=1e-12, rtol=0)


def test_golden_move_invariance(golden):
    case = golden("rumi.move_invariance")
    inputs = case["inputs"]
    poses, observation, sphere = scene(case)
    motion = torch.tensor(inputs["M"], dtype=F64)
    tolerance = -inputs["alpha"]
    if tolerance < 0:
        pytest.fail("the golden case uses a tolerance of 0 or more")
    module = Discrepancy(sphere, inputs["sphere_radius"], free_scale=inputs["C"], tolerance=tolerance).double()
    expected = torch.tensor(case["expected"]["l"], dtype=F64)
    torch.testing.assert_close(module(poses, observation), expected, atol=1e-12, rtol=0)
    moved = Observation.of(se3.apply(motion, observation.points), 0)
    moved = Observation(moved.points, observation.semantics, moved.attached, moved.valid)
    torch.testing.assert_close(module(motion @ poses, moved), expected, atol=1e-12, rtol=0)


def random_scene(seed, count=40, batch=()):
    random = torch.Generator().manual_seed(seed)
    poses = se3.exp(0.3 * torch.randn(*batch, 5, 6, generator=random, dtype=F64))
    points = 0.15 * torch.randn(*batch, count, 3, generator=random, dtype=F64)
    semantics = torch.randint(0, 3, (*batch, count), generator=random)
    observation = Observation.of(points, 0)
    return poses, Observation(points, semantics, observation.attached, observation.valid)


def test_leaving_out_far_free_points_changes_nothing():
    poses, observation = random_scene(0, 400)
    poses = se3.make(poses[:, :3, :3], 0.1 * poses[:, :3, 3])
    box = Box((0.03, 0.05, 0.02)).double()
    module = Discrepancy(box, 0.0617, free_scale=7.0, tolerance=0.001).double()
    from sdf.posed import posed_distance

    full = discrepancy_terms(
        posed_distance(box, poses, observation.points), observation.semantics.expand(5, 400), 7.0, -0.001
    )
    torch.testing.assert_close(module(poses, observation), full.sum(-1), atol=1e-12, rtol=0)
    assert len(module.within_reach(poses, observation)) < 400


def test_a_batch_row_equals_the_scene_alone():
    poses, observation = random_scene(3, 60, (3,))
    observation = Observation(
        observation.points,
        observation.semantics,
        observation.attached,
        torch.rand(3, 60, generator=torch.Generator().manual_seed(0)) < 0.7,
    )
    module = Discrepancy(Box((0.1, 0.15, 0.08)).double(), 0.2).double()
    together = module(poses, observation)
    for row in range(3):
        keep = observation.valid[row]
        alone = Observation.of(observation.points[row][keep], 0)
        alone = Observation(alone.points, observation.semantics[row][keep], alone.attached, alone.valid)
        torch.testing.assert_close(together[row], module(poses[row], alone), atol=1e-12, rtol=0)


def test_no_points_cost_nothing():
    poses, _ = random_scene(4)
    module = Discrepancy(Sphere(0.1).double(), 0.1).double()
    assert module(poses, Observation.empty(dtype=F64)).tolist() == [0.0] * 5


def test_negative_tolerance_is_refused():
    with pytest.raises(ValueError, match="tolerance"):
        Discrepancy(Sphere(0.1), 0.1, tolerance=-0.01)


@pytest.mark.parametrize("tolerance", [0.001, 0.0])
@pytest.mark.parametrize(
    ("dtype", "close"),
    [(torch.float32, {"atol": 2e-4, "rtol": 2e-5}), (F64, {"atol": 1e-11, "rtol": 1e-10})],
    ids=["single", "double"],
)
@pytest.mark.parametrize("outer", [0.25, 0.0])
def test_versions_agree(dtype, close, outer, tolerance):
    table = GridSDF.from_sdf(Mug().to(dtype), 0.004, outer=outer)
    module = Discrepancy(table, 0.085, free_scale=80.0, tolerance=tolerance).to(dtype)
    random = torch.Generator().manual_seed(5)
    axis = torch.linspace(-0.15, 0.15, 13, dtype=dtype)
    lattice = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    cloud = 0.08 * torch.randn(900, 3, generator=random, dtype=dtype)
    for batch, points in (
        ((), torch.cat((lattice, cloud))),
        ((2,), cloud.reshape(2, 450, 3)),
        ((), cloud[:0]),
        ((), 30.0 * cloud),
    ):
        count = points.shape[-2]
        semantics = torch.randint(0, 3, (*batch, count), generator=random)
        valid = torch.rand(*batch, count, generator=random) < 0.9
        poses = se3.exp(torch.randn(*batch, 7, 6, generator=random, dtype=dtype) * 0.3)
        observation = Observation(points, semantics, torch.ones_like(valid), valid)
        found = []
        for name in ("torch", "numba"):
            with backend.force(name):
                found.append(module(poses, observation))
        plain, compiled = found
        size = float(plain.abs().max()) if plain.numel() else 0.0
        torch.testing.assert_close(compiled, plain, rtol=close["rtol"], atol=close["atol"] * max(size, 1e-3))


def test_chunks_of_poses_change_nothing(monkeypatch: pytest.MonkeyPatch, generator: torch.Generator) -> None:
    poses = se3.exp(0.05 * torch.randn(2, 7, 6, generator=generator, dtype=torch.float64))
    points = 0.1 * torch.randn(2, 40, 3, generator=generator, dtype=torch.float64)
    semantics = torch.randint(0, 3, (2, 40), generator=generator)
    seen = Observation(points, semantics, torch.ones_like(semantics, dtype=torch.bool), semantics >= 0)
    module = Discrepancy(Sphere(0.06).double(), 0.06)
    whole = module(poses, seen)
    monkeypatch.setattr("sensors.discrepancy.CHUNK_BYTES", 8 * 6 * 80 * 3)
    assert poses_at_once(poses, 40) == 3
    torch.testing.assert_close(module(poses, seen), whole, atol=1e-12, rtol=0)
    assert module(poses[:, :0], seen).shape == (2, 0)


def test_padding_that_is_no_number_changes_nothing():
    poses, observation = random_scene(6)
    valid = torch.rand(observation.valid.shape, generator=torch.Generator().manual_seed(0)) < 0.7
    points = observation.points.masked_fill(~valid[..., None], torch.nan)
    grid = GridSDF.from_sdf(Box((0.1, 0.15, 0.08)), 0.02).double()
    module = Discrepancy(grid, 0.2).double()
    slopes = []
    for x in (observation.points, points):
        moved = poses.clone().requires_grad_()
        with backend.force("torch"):
            module(moved, Observation(x, observation.semantics, observation.attached, valid)).sum().backward()
        slopes.append(moved.grad)
    torch.testing.assert_close(slopes[1], slopes[0], atol=1e-12, rtol=1e-12)


@pytest.mark.parametrize("shape", [(8, 3, 3), (4, 4), (8, 4, 3)])
def test_poses_of_another_shape_are_refused(no_shape_check, shape):
    module = Discrepancy(GridSDF.from_sdf(Box((0.1, 0.15, 0.08)), 0.02), 0.2)
    with pytest.raises(ValueError, match=r"Expected frame_T_object to have shape \(\*b, N, 4, 4\), got \("):
        module(torch.zeros(shape), Observation.of(torch.zeros(5, 3), Semantics.SURFACE))


def test_points_of_another_shape_are_refused(no_shape_check):
    module = Discrepancy(GridSDF.from_sdf(Box((0.1, 0.15, 0.08)), 0.02), 0.2)
    points = torch.zeros(5, 2)
    flat = Observation(points, points[:, 0].long(), points[:, 0] == 0, points[:, 0] == 0)
    with pytest.raises(ValueError, match=r"Expected points to have shape \(\*b, M, 3\), got \(5, 2\)"):
        module(torch.eye(4).expand(8, 4, 4), flat)


def test_points_of_another_float_type_are_refused():
    module = Discrepancy(GridSDF.from_sdf(Box((0.1, 0.15, 0.08)), 0.02), 0.2)
    seen = Observation.of(torch.zeros(5, 3, dtype=F64), Semantics.SURFACE)
    with pytest.raises(ValueError, match=r"Expected points of torch.float32 as the poses are, got torch.float64: use"):
        module(torch.eye(4).expand(8, 4, 4), seen)
    assert module(torch.eye(4).expand(8, 4, 4), Observation.empty(dtype=F64)).shape == (8,)
