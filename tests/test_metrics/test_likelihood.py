"""nll, expected nll, APC, pose error and the stopping rule."""

import math

import pytest
import torch

from rumi.belief.particles import PoseBelief
from rumi.information.stopping import StopEvidence, StopSettings, converged
from rumi.metrics import likelihood
from rumi.metrics.likelihood import negative_log_likelihood, self_agreement
from rumi.metrics.pose_error import pose_error
from sdf import backend, se3
from sdf.grid_sdf import GridSDF
from sdf.posed import posed_distance
from sdf.primitives import Box
from sdf.symmetry import Symmetries

F64 = torch.float64


# every test of this file holds for the plain and for the compiled version
pytestmark = pytest.mark.usefixtures("version")


def test_golden_nll(golden):
    case = golden("rumi.nll")
    inputs = case["inputs"]
    nll = negative_log_likelihood(
        torch.tensor(inputs["W_T_O"], dtype=F64),
        torch.tensor(inputs["w"], dtype=F64).log(),
        torch.tensor(inputs["W_T_O_star"], dtype=F64),
        torch.tensor(inputs["x_obj"], dtype=F64),
        Box(inputs["box_half_extents"]).double(),
        inputs["sensor"]["alpha"],
        inputs["sensor"]["zeta"],
    )
    assert float(nll) == pytest.approx(case["expected"]["nll"], abs=1e-11)


def random_belief(count, seed=0, batch=()):
    random = torch.Generator().manual_seed(seed)
    planar = torch.randn(*batch, count, 3, generator=random, dtype=F64) * torch.tensor([0.01, 0.01, 0.3], dtype=F64)
    start = PoseBelief.uniform(se3.from_planar(planar))
    return start.reweighted(torch.randn(*batch, count, generator=random, dtype=F64))


BOX = Box((0.03, 0.02, 0.04)).double()
POINTS = torch.tensor([[0.03, 0.0, 0.0], [-0.03, 0.01, 0.02], [0.0, 0.02, 0.0], [0.0, 0.0, 0.04]], dtype=F64)


def test_self_agreement_against_loops():
    belief = random_belief(6)
    agreement = self_agreement(belief, POINTS, BOX, nll_points=8)
    pose, weights = belief.attached_T_object, belief.weights
    apc, expected = 0.0, 0.0
    for j in range(6):
        apc_points = se3.apply(pose[j], POINTS)
        expected += (
            float(weights[j]) * 2 * float(negative_log_likelihood(pose, belief.log_weights, pose[j], POINTS, BOX))
        )
        for i in range(6):
            apc += float(BOX.distance(se3.apply(se3.inverse(pose[i]), apc_points)).abs().mean()) / 36
    assert float(agreement.apc) == pytest.approx(apc, rel=1e-9)
    assert float(agreement.expected_nll) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("every", [2, 3, 4, 100])
@pytest.mark.parametrize("version", ["torch", "numba"])
def test_in_turns_each_particle_is_compared_by_its_own_points(every, version):
    belief, table = random_belief(7), GridSDF.from_sdf(BOX, 0.002)
    pose, weights = belief.attached_T_object, belief.weights
    turns, apc, expected = min(every, 4), 0.0, 0.0
    for j in range(7):
        own = POINTS[j % turns :: turns]
        nll = negative_log_likelihood(pose, belief.log_weights, pose[j], own, table)
        expected += float(weights[j]) * 500 / len(own) * float(nll)
        away = posed_distance(table, pose, se3.apply(pose[j], own))
        apc += float(away.abs().mean()) / 7
    with backend.force(version):
        agreement = self_agreement(belief, POINTS, table, every=every)
    assert float(agreement.expected_nll) == pytest.approx(expected, rel=1e-9)
    assert float(agreement.apc) == pytest.approx(apc, rel=1e-9)


def test_in_turns_it_is_nearly_what_it_is_by_all():
    table = GridSDF.from_sdf(BOX, 0.002)
    random = torch.Generator().manual_seed(3)
    points = 0.03 * torch.randn(240, 3, generator=random, dtype=F64)
    for seed in range(5):
        belief = random_belief(200, seed=seed)
        whole, part = (self_agreement(belief, points, table, every=every) for every in (1, 8))
        assert float(part.expected_nll) == pytest.approx(float(whole.expected_nll), rel=0.05)
        assert float(part.apc) == pytest.approx(float(whole.apc), rel=0.05)


def test_a_unanimous_belief_expects_nothing_and_spreads_nothing():
    belief = PoseBelief.uniform(se3.from_planar(torch.tensor([[0.4, 0.1, 0.7]] * 5, dtype=F64)))
    agreement = self_agreement(belief, POINTS, BOX)
    assert float(agreement.expected_nll) == pytest.approx(0.0, abs=1e-9)
    assert float(agreement.apc) == pytest.approx(0.0, abs=1e-9)


def test_neither_depends_on_where_the_world_is():
    belief = random_belief(5)
    motion = se3.exp(torch.tensor([3.0, -2.0, 1.0, 0.3, 1.0, -0.7], dtype=F64))
    moved = PoseBelief.uniform(motion @ belief.world_T_object).reweighted(belief.log_weights)
    here, there = self_agreement(belief, POINTS, BOX), self_agreement(moved, POINTS, BOX)
    torch.testing.assert_close(here.expected_nll, there.expected_nll)
    torch.testing.assert_close(here.apc, there.apc)


def test_rows_of_a_batch_equal_scenes_alone():
    batch = random_belief(5, batch=(3,))
    together = self_agreement(batch, POINTS, BOX)
    names = ("world_T_attached", "attached_T_object", "log_weights", "discrepancy")
    for row in range(3):
        alone = PoseBelief(*(getattr(batch, n)[row] for n in names))
        torch.testing.assert_close(together.apc[row], self_agreement(alone, POINTS, BOX).apc)


@pytest.mark.parametrize("dtype", [torch.float32, F64], ids=["single", "double"])
@pytest.mark.parametrize("spread", [1.0, 100.0, 0.0])
@pytest.mark.parametrize("points", [POINTS, torch.cat([share * POINTS for share in (0.2, 0.5, 0.8, 1.0, 1.1)])])
def test_versions_agree(dtype, spread, points):
    table = GridSDF.from_sdf(BOX.to(dtype), 0.004)
    belief = random_belief(9, batch=(2,))
    pose = belief.attached_T_object.clone()
    pose[..., :3, 3] *= spread
    belief = PoseBelief.uniform(pose.to(dtype)).reweighted(spread * belief.log_weights.to(dtype))
    found = []
    for name in ("torch", "numba"):
        with backend.force(name):
            found.append(self_agreement(belief, points.to(dtype), table))
    BOX.double()
    single = dtype == torch.float32
    close = {"rtol": 2e-5 if single else 1e-11, "atol": 2e-4 if single else 1e-10}
    torch.testing.assert_close(found[1].expected_nll, found[0].expected_nll, **close)
    torch.testing.assert_close(found[1].apc, found[0].apc, rtol=close["rtol"], atol=1e-7)


def test_no_points_agree_in_everything():
    belief = random_belief(3)
    nothing = self_agreement(belief, POINTS[:0], GridSDF.from_sdf(BOX, 0.004))
    assert float(nothing.expected_nll) == 0.0


@pytest.mark.parametrize("batch", [(), (2,)])
def test_by_chunks_both_are_what_they_are_at_once(batch, monkeypatch):
    belief = random_belief(7, batch=batch)
    truth = belief.world_T_object[..., 2, :, :]

    def both():
        nll = negative_log_likelihood(belief.world_T_object, belief.log_weights, truth, POINTS, BOX)
        return (nll, *self_agreement(belief, POINTS, BOX))

    whole = both()
    monkeypatch.setattr(likelihood, "CHUNK_BYTES", 1)
    for part, expected in zip(both(), whole, strict=True):
        torch.testing.assert_close(part, expected, rtol=1e-12, atol=1e-12)


def test_a_far_belief_has_a_large_finite_nll():
    belief = PoseBelief.uniform(se3.from_planar(torch.tensor([[1000.0, 0.0, 0.0]], dtype=torch.float32)))
    truth = se3.identity((), dtype=torch.float32, device="cpu")
    nll = negative_log_likelihood(belief.world_T_object, belief.log_weights, truth, POINTS.float(), BOX.float())
    BOX.double()
    assert math.isfinite(float(nll))
    assert float(nll) > 1e4


def test_pose_error_modulo_symmetry():
    half_turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0], dtype=F64))
    symmetries = Symmetries(torch.stack((torch.eye(3, dtype=F64), half_turn)))
    truth = se3.from_planar(torch.tensor([0.3, 0.1, 0.2], dtype=F64))
    estimate = se3.from_planar(torch.tensor([0.303, 0.096, 0.25 + math.pi], dtype=F64))
    metres, radians = pose_error(estimate, truth, symmetries)
    assert float(metres) == pytest.approx(0.005)
    assert float(radians) == pytest.approx(0.05)
    _, unsymmetric = pose_error(estimate, truth, Symmetries.none())
    assert float(unsymmetric) == pytest.approx(math.pi - 0.05)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({}, True),
        ({"expected_nll": 5.1}, False),
        ({"fit": 5.4}, True),  # half a unit for the one contact
        ({"fit": 5.6}, False),
        ({"fit": 5.6, "contacts": 2}, True),
        ({"contacts": 0}, False),
        ({"apc": 9.0}, True),
    ],
)
def test_self_rule(change, expected):
    state = {"expected_nll": 4.0, "fit": 1.0, "apc": 0.001, "diagonal": 0.17, "contacts": 1} | change
    assert converged(StopSettings(), StopEvidence(**state)) is expected


def test_apc_rule_and_never():
    state = {"expected_nll": 40.0, "fit": 9.0, "diagonal": 0.17, "contacts": 0}
    assert converged(StopSettings(rule="apc"), StopEvidence(apc=0.005, **state))
    assert not converged(StopSettings(rule="apc"), StopEvidence(apc=0.006, **state))
    assert not converged(StopSettings(rule="never"), StopEvidence(apc=0.0, **state))
