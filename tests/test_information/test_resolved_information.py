"""Information at a resolution: against counts, and its laws."""

import math

import pytest
import torch

from rumi.information.resolved_information import outcome_information, pose_kernel
from sdf import se3
from sdf.symmetry import Symmetries

FLAT = torch.zeros(6)


def test_of_kinds_it_is_the_mutual_information() -> None:
    kinds = torch.tensor([0, 0, 0, 1, 1, 2])
    kernel = (kinds[:, None] == kinds[None]).double()
    outcomes = torch.tensor([[0, 0, 1, 1, 1, 1], [5, 5, 5, 5, 5, 5], [0, 0, 0, 1, 1, 2]])

    def entropy(*counts: int) -> float:
        total = sum(counts)
        return -sum(c / total * math.log(c / total) for c in counts)

    before = entropy(3, 2, 1)
    wanted = [before - (2 / 6 * 0.0 + 4 / 6 * entropy(1, 2, 1)), 0.0, before]
    assert outcome_information(kernel, FLAT, outcomes).tolist() == pytest.approx(wanted, abs=1e-9)


def test_weights_count_as_copies() -> None:
    kernel = torch.tensor([[1.0, 0.3, 0.0], [0.3, 1.0, 0.1], [0.0, 0.1, 1.0]], dtype=torch.float64)
    rows = torch.tensor([0, 0, 1, 2])
    outcomes = torch.tensor([[0, 1, 1]])
    copied = outcome_information(kernel[rows][:, rows], torch.zeros(4), outcomes[:, rows])
    weighed = outcome_information(kernel, torch.tensor([2.0, 1.0, 1.0]).log(), outcomes)
    assert float(weighed) == pytest.approx(float(copied), rel=1e-9)


def test_what_is_finer_than_the_resolution_is_worth_little() -> None:
    places = torch.tensor([[0.0, 0.0, 0.0], [0.0005, 0.0, 0.0], [0.1, 0.0, 0.0], [0.1005, 0.0, 0.0]])
    kernel = pose_kernel(se3.from_planar(places), Symmetries.none(), position_m=0.006, rotation_rad=0.1)
    fine, coarse = outcome_information(kernel, torch.zeros(4), torch.tensor([[0, 1, 0, 1], [0, 0, 1, 1]])).tolist()
    assert fine < 0.01
    assert coarse == pytest.approx(math.log(2.0), abs=0.01)


def test_poses_that_look_alike_are_the_same() -> None:
    poses = se3.from_planar(torch.tensor([[0.0, 0.0, 0.2], [0.0, 0.0, 0.2 + math.pi], [0.0, 0.0, 0.2 + math.pi / 2]]))
    of_box = pose_kernel(poses, Symmetries.parse("x2,y2"), position_m=0.006, rotation_rad=0.1)
    of_none = pose_kernel(poses, Symmetries.none(), position_m=0.006, rotation_rad=0.1)
    assert float(of_box[0, 1]) == pytest.approx(1.0, abs=1e-4)
    assert float(of_none[0, 1]) < 1e-6
    assert float(of_box[0, 2]) < 1e-6
    assert torch.equal(of_box, of_box.T)


def test_one_pose_and_impossible_ones() -> None:
    one = outcome_information(torch.ones(1, 1), torch.zeros(1), torch.tensor([[3]]))
    assert one.tolist() == [0.0]
    kernel = torch.eye(3)
    told = outcome_information(kernel, torch.tensor([0.0, 0.0, -math.inf]), torch.tensor([[0, 1, 2]]))
    assert float(told) == pytest.approx(math.log(2.0), rel=1e-6)
