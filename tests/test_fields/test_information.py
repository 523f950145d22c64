"""Semantics and information of workspace points against golden numbers, definitions and invariances."""

import copy
import math
from collections.abc import Callable
from typing import Any, get_args

import pytest
import torch
from torch import Tensor

from rumi.fields.information import (
    InformationMode,
    InformationSettings,
    WorkspaceFields,
    information_field,
    information_from_distances,
    near_object,
    tail_distance,
)
from rumi.fields.normal import expected_normal
from sdf import backend, se3
from sdf.base import SDF
from sdf.grid_sdf import GridSDF
from sdf.posed import posed_distance
from sdf.primitives import Box, Mug, Sphere
from sdf.threads import using
from sensors.semantics import semantics_probability

MODES = get_args(InformationMode)
GOLDEN_NAMES = {
    "surrogate": "I_surrogate",
    "reverse_kl": "I_reverse_kl",
    "forward_kl": "I_forward_kl",
    "sensor_mi": "MI_sensor",
}


# every test of this file holds for the plain and for the compiled version, but where a graph is kept
pytestmark = pytest.mark.usefixtures("version")

Beliefs = Callable[..., tuple[Tensor, Tensor]]
only_plain = pytest.mark.parametrize("version", ["torch"], indirect=True)


@pytest.mark.parametrize("mode", MODES)
def test_golden(golden: Callable[[str], dict[str, Any]], mode: InformationMode) -> None:
    case = golden("rumi.info_field")
    given, expected = case["inputs"], case["expected"]
    sensor = given["sensor"]
    settings = InformationSettings(
        mode, given["lam"], given["C"], -given["alpha"], sensor["alpha"], sensor["zeta"], tail=0.0
    )
    double = {"dtype": torch.float64}
    fields = information_field(
        Sphere(given["sphere_radius"]).double(),
        torch.tensor(given["W_T_O"], **double),
        torch.tensor(given["w"], **double).log(),
        torch.tensor(given["query"], **double),
        settings,
    )
    tolerance = {"atol": case["atol"], "rtol": 0.0}
    torch.testing.assert_close(fields.semantics, torch.tensor(expected["p_S"], **double), **tolerance)
    torch.testing.assert_close(fields.information, torch.tensor(expected[GOLDEN_NAMES[mode]], **double), **tolerance)


def test_a_sharpness_that_is_not_set_is_100(mug: SDF, beliefs: Beliefs, points: Tensor) -> None:
    given = *beliefs(), points
    unset, hundred, other = (
        information_field(mug, *given, InformationSettings(sharpness=sharpness)).information
        for sharpness in (None, 100.0, 300.0)
    )
    assert torch.equal(unset, hundred) and not torch.equal(unset, other)


def test_golden_outside(golden: Callable[[str], dict[str, Any]], mug: SDF, beliefs: Beliefs) -> None:
    case = golden("rumi.outside")
    fields = information_field(mug, *beliefs(), torch.tensor([case["inputs"]["x"]], dtype=torch.float64))
    assert fields.information.tolist() == [case["expected"]["I"]]
    assert fields.semantics.tolist() == [case["expected"]["p"]]


def by_definition(distance: Tensor, weights: Tensor, mode: InformationMode) -> Tensor:
    """Expected divergence of the belief after seeing each outcome from the belief now, outcome by outcome."""
    scale, tolerance, peakiness = 10.0, 0.001, 2.0
    result = []
    for v in distance.T:
        sensor = semantics_probability(v)
        outcome = weights @ sensor
        costs = torch.stack((scale * (-tolerance - v).clamp_min(0), scale * (v - tolerance).clamp_min(0), v.abs()), -1)
        total = torch.zeros((), dtype=torch.float64)
        for s in range(3):
            if mode == "sensor_mi":
                after = weights * sensor[:, s] / outcome[s] if outcome[s] > 0 else weights
                total += outcome[s] * torch.special.xlogy(after, after / weights).sum()
                continue
            after = weights * torch.exp(-peakiness * costs[:, s])
            after = after / after.sum()
            total += (
                outcome[s]
                * {
                    "surrogate": peakiness * weights @ costs[:, s],
                    "reverse_kl": (weights * (weights / after).log()).sum(),
                    "forward_kl": (after * (after / weights).log()).sum(),
                }[mode]
            )
        result.append(total)
    return torch.stack(result)


@pytest.mark.parametrize("mode", MODES)
def test_is_the_expected_divergence_of_posterior_and_prior(mode: InformationMode, generator: torch.Generator) -> None:
    distance = 0.03 * torch.randn(7, 40, generator=generator, dtype=torch.float64)
    weights = torch.rand(7, generator=generator, dtype=torch.float64).softmax(-1)
    fields = information_from_distances(distance, weights.log(), mode=mode, tolerance=0.001)
    torch.testing.assert_close(fields.information, by_definition(distance, weights, mode), atol=1e-12, rtol=1e-9)
    mean = (weights[:, None, None] * semantics_probability(distance)).sum(0)
    torch.testing.assert_close(fields.semantics, mean)
    torch.testing.assert_close(fields.contact, 1 - mean[..., 0])


def test_mutual_information_of_two_poses_in_closed_form() -> None:
    """One pose has the point deep inside, the other far outside: the outcome names the pose, which is worth log 2."""
    distance = torch.tensor([[-0.5], [0.5]], dtype=torch.float64)
    fields = information_from_distances(distance, torch.tensor([0.5, 0.5], dtype=torch.float64).log())
    torch.testing.assert_close(fields.information, torch.tensor([math.log(2)], dtype=torch.float64))


@pytest.mark.parametrize("mode", MODES)
def test_only_the_surrogate_is_drawn_to_what_all_poses_agree_on(mode: InformationMode) -> None:
    distance = torch.tensor([0.004, -0.01, 0.0, 0.3], dtype=torch.float64).expand(5, 4)
    fields = information_from_distances(distance, torch.full((5,), 0.2, dtype=torch.float64).log(), mode=mode)
    if mode == "surrogate":
        assert bool((fields.information[:2] > 1e-3).all())
    else:
        assert float(fields.information.abs().max()) < 1e-12


def close(a: WorkspaceFields, b: WorkspaceFields, atol: float = 1e-12) -> None:
    torch.testing.assert_close(a.semantics, b.semantics, atol=atol, rtol=1e-9)
    torch.testing.assert_close(a.information, b.information, atol=atol, rtol=1e-9)


@pytest.mark.parametrize("mode", MODES)
def test_a_scene_of_a_batch_is_that_scene_alone(
    mode: InformationMode, mug: SDF, beliefs: Beliefs, points: Tensor
) -> None:
    poses, log_weights = beliefs(2, 3)
    poses[0, 1, :, :3, 3] += 0.25  # so that scenes skip different points
    settings = InformationSettings(mode, tail=1e-3)
    together = information_field(mug, poses, log_weights, points, settings)
    assert together.information.shape == (2, 3, 80)
    for i, j in ((0, 0), (0, 1), (1, 2)):
        alone = information_field(mug, poses[i, j], log_weights[i, j], points, settings)
        close(WorkspaceFields(together.semantics[i, j], together.information[i, j]), alone)


def test_chunks_change_nothing(mug: SDF, beliefs: Beliefs, points: Tensor, monkeypatch: pytest.MonkeyPatch) -> None:
    poses, log_weights = beliefs()
    whole = information_field(mug, poses, log_weights, points)
    normal = expected_normal(mug, poses, log_weights, points)
    monkeypatch.setattr("rumi.fields.information.CHUNK_BYTES", 3000)
    monkeypatch.setattr("rumi.fields.normal.CHUNK_BYTES", 9000)
    close(information_field(mug, poses, log_weights, points), whole)
    torch.testing.assert_close(expected_normal(mug, poses, log_weights, points), normal)


@pytest.mark.parametrize("mode", MODES)
def test_moves_with_the_world(mode: InformationMode, mug: SDF, beliefs: Beliefs, points: Tensor) -> None:
    poses, log_weights = beliefs()
    motion = se3.exp(torch.tensor([0.3, -1.0, 0.2, 0.5, 2.0, -0.7], dtype=torch.float64))
    moved = se3.apply(motion, points)
    settings = InformationSettings(mode, tail=0.0)
    here = information_field(mug, poses, log_weights, points, settings)
    close(information_field(mug, motion @ poses, log_weights, moved, settings), here)
    turned = expected_normal(mug, motion @ poses, log_weights, moved)
    torch.testing.assert_close(turned, se3.rotate(motion, expected_normal(mug, poses, log_weights, points)))


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("tail", [1e-2, 1e-6])
def test_what_is_skipped_is_within_its_bound(mode: InformationMode, tail: float, beliefs: Beliefs) -> None:
    shape = GridSDF.from_sdf(Box((0.03, 0.05, 0.02)), spacing=0.005).double()
    poses, log_weights = beliefs(spread=0.05)
    axis = torch.linspace(-0.5, 0.5, 21, dtype=torch.float64)
    points = torch.cartesian_prod(axis, axis, 0.1 * axis[::10])
    exact = information_field(shape, poses, log_weights, points, InformationSettings(mode, tail=0.0))
    lean = information_field(shape, poses, log_weights, points, InformationSettings(mode, tail=tail))
    near = near_object(shape, poses, points, tail_distance(100.0, 0.003, tail))
    assert 0.05 < float(near.double().mean()) < 0.9
    close(
        WorkspaceFields(lean.semantics[near], lean.information[near]),
        WorkspaceFields(exact.semantics[near], exact.information[near]),
    )
    assert float(lean.information[~near].abs().max()) == 0.0
    assert float((lean.semantics - exact.semantics).abs().max()) <= tail
    bound = tail * (1 + math.log(1 / tail)) if mode == "sensor_mi" else 2.0 * tail * 1.0  # E|v| is below 1 m here
    assert float((lean.information - exact.information).abs().max()) <= bound


@pytest.mark.parametrize("count", [1, 4])
@pytest.mark.parametrize("reach", [0.0, 0.05])
def test_no_point_within_reach_is_left_out(
    count: int, reach: float, beliefs: Beliefs, generator: torch.Generator
) -> None:
    shape = Box((0.03, 0.15, 0.03)).double()
    poses, _ = beliefs(count=count, spread=0.05)
    points = 0.15 * torch.randn(8000, 3, generator=generator, dtype=torch.float64)
    within = posed_distance(shape, poses, points).amin(0) <= reach
    near = near_object(shape, poses, points, reach)
    assert int(within.sum()) > 10
    assert bool(near[within].all())
    assert float(near.double().mean()) < 0.9


def test_nothing_near_needs_no_lookup(beliefs: Beliefs) -> None:
    poses, log_weights = beliefs()
    far = torch.full((4, 3), 9.0, dtype=torch.float64)
    fields = information_field(Sphere(0.05).double(), poses, log_weights, far)
    assert float(fields.information.sum()) == 0.0
    assert torch.equal(fields.semantics[:, 0], torch.ones(4, dtype=torch.float64))


@only_plain
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("upright", [False, True])
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(("batch", "count"), [((), 1), ((), 37), ((2, 3), 8), ((0,), 5)])
def test_versions_agree(
    dtype: torch.dtype,
    upright: bool,
    mode: InformationMode,
    batch: tuple[int, ...],
    count: int,
    mug: SDF,
    beliefs: Beliefs,
    generator: torch.Generator,
) -> None:
    table = copy.deepcopy(mug).to(dtype)
    poses, log_weights = beliefs(*batch, count=count)
    points = 0.6 * torch.rand(500, 3, generator=generator, dtype=torch.float64) - 0.3
    if upright:
        points[:, 2] = 0.03
        poses = se3.from_planar(poses[..., :3, 3], 0.01)
    else:  # not finite, and on a pose's own origin
        points[5] = math.nan
        points[6, 1] = math.inf
        points[7] = poses.reshape(-1, 4, 4)[0, :3, 3] if poses.numel() else 0.0
    poses, points = poses.to(dtype), points.to(dtype)
    # one pose that counts for nothing
    log_weights = (log_weights - 1e9 * (torch.arange(count) == 1)).log_softmax(-1).to(dtype)
    where = torch.rand(*batch, 500, generator=generator) < 0.5
    settings = InformationSettings(mode, tolerance=0.001, tail=1e-4)
    plain = information_field(table, poses, log_weights, points, settings)
    plain_normal = expected_normal(table, poses, log_weights, points, where)
    with backend.force("numba"):
        found = information_field(table, poses, log_weights, points, settings)
        normal = expected_normal(table, poses, log_weights, points, where)
    single = dtype == torch.float32
    close(found, plain, atol=5e-6 if single else 1e-13)
    assert found.semantics.dtype == found.information.dtype == normal.dtype == dtype
    apart = (normal - plain_normal).abs()
    assert normal.shape == plain_normal.shape
    # in single precision a point may be rounded to the other side of a node, and takes the slope there
    assert float((apart > (1e-4 if single else 1e-11)).double().sum()) <= (0.002 * apart.numel() if single else 0)
    assert bool((normal[~where] == 0).all())


@pytest.mark.parametrize("mode", MODES)
def test_the_same_for_any_number_of_threads(
    mode: InformationMode, mug: SDF, beliefs: Beliefs, points: Tensor, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sdf.threads.team", lambda threads, work_s: threads)  # however little work it is
    poses, log_weights = beliefs(count=20)
    settings = InformationSettings(mode)
    found = []
    for threads in (1, 2, 3):
        with using(threads):
            fields = information_field(mug, poses, log_weights, points, settings)
            found.append((fields.semantics, fields.information, expected_normal(mug, poses, log_weights, points)))
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], other, strict=True))


def test_certainty_and_points_far_off_leave_nothing_undefined(mug: SDF) -> None:
    """One pose, points deep inside, on and beyond every tail: the logarithms meet 0 and 1."""
    pose = torch.eye(4, dtype=torch.float64)[None]
    points = torch.tensor([[0.0, 0.0, 0.003], [0.045, 0.0, 0.05], [3.0, 0.0, 0.0], [1e7, 0.0, 0.0]]).double()
    for mode in MODES:
        for dtype in (torch.float32, torch.float64):
            fields = information_field(
                copy.deepcopy(mug).to(dtype),
                pose.to(dtype),
                torch.zeros(1, dtype=dtype),
                points.to(dtype),
                InformationSettings(mode, tail=0.0),
            )
            assert bool(fields.semantics.isfinite().all())
            assert bool(fields.information.isfinite().all())
            torch.testing.assert_close(fields.semantics.sum(-1), torch.ones(4, dtype=dtype))
            if mode != "surrogate":
                assert float(fields.information.abs().max()) < 2e-6


@pytest.mark.parametrize("mode", ["reverse_kl", "forward_kl"])
@only_plain
def test_poses_that_agree_tell_nothing_however_far_the_point(mode):
    distance = torch.linspace(-1.0, 1.0, 41)[None].expand(30, 41)
    log_weights = torch.linspace(0.0, 3.0, 30).log_softmax(-1)
    fields = information_from_distances(distance, log_weights, mode=mode, peakiness=1000.0)
    assert float(fields.information.abs().max()) < 1e-6


@pytest.mark.parametrize("mode", MODES)
def test_float32_holds_to_a_hundred_thousandth_of_the_greatest(mode, beliefs, generator):
    poses, log_weights = beliefs(count=60)
    away = torch.tensor([1.5, -2.0, 0.7], dtype=torch.float64)
    poses[..., :3, 3] += away
    points = away + 0.1 * torch.randn(300, 3, generator=generator, dtype=torch.float64)
    table = GridSDF.from_sdf(Mug(), 0.004)
    settings = InformationSettings(mode=mode, peakiness=300.0, sharpness=1000.0, tail=0.0)
    small = [tensor.float() for tensor in (poses, log_weights, points)]
    found = information_field(table, *small, settings).information
    with backend.force("torch"):
        wanted = information_field(table.double(), *[tensor.double() for tensor in small], settings).information
    assert float((found.double() - wanted).abs().max() / wanted.max()) < 1e-5


def test_scenes_far_apart_are_as_right_as_alone(beliefs, generator):
    poses, log_weights = beliefs(2, count=8)
    poses[1, :, :3, 3] += 3.0
    points = torch.cat((0.1 * torch.randn(50, 3, generator=generator, dtype=torch.float64),) * 2)
    points[50:] += 3.0
    table = GridSDF.from_sdf(Mug(), 0.004).double()
    both = information_field(table, poses, log_weights, points)
    for scene in range(2):
        alone = information_field(table, poses[scene], log_weights[scene], points)
        torch.testing.assert_close(both.information[scene], alone.information)
        torch.testing.assert_close(both.semantics[scene], alone.semantics)


def test_refuses_beliefs_that_are_none(mug: SDF, beliefs: Beliefs, points: Tensor) -> None:
    poses, log_weights = beliefs()
    with pytest.raises(ValueError, match="Expected one state or more"):
        information_field(mug, poses[:0], log_weights[:0], points)
    with pytest.raises(ValueError, match="Expected a finite log-weight"):
        information_field(mug, poses, torch.full_like(log_weights, -math.inf), points)
    poses[2, 0, 3], log_weights[2] = math.nan, -math.inf
    with pytest.raises(ValueError, match="Expected world_T_object to be finite"):
        information_field(mug, poses, log_weights, points)
