"""Knots to controls and their shifts, against the checked numbers and against what interpolation must do."""

import pytest
import torch

from kmppi import KERNELS, Changes, KernelKnots, PerStep

SHAPES = [(15, 8, 2.0), (20, 5, 2.0), (12, 12, 1.0), (2, 2, 1.0), (1, 1, 2.0), (8, 5, 1.5)]


def test_golden_matrices(golden):
    case = golden("rumi.kmppi.W.15.8")
    given, expected = case["inputs"], case["expected"]
    knots = KernelKnots(given["H"], given["Hv"], "rbf", given["scale"])
    for got, name in ((knots.matrix, "W"), (knots.shift_matrix(1), "shift1"), (knots.shift_matrix(3), "shift3")):
        torch.testing.assert_close(got, torch.tensor(expected[name], dtype=torch.float64), rtol=0, atol=case["atol"])
    assert knots.matrix.abs().sum(1).max().item() == pytest.approx(expected["max_abs_row_sum"], abs=case["atol"])
    spread = (1.5 * knots.matrix.square().sum(1)).sqrt()
    torch.testing.assert_close(
        spread, torch.tensor(expected["std_u_for_sigma2_1p5"], dtype=torch.float64), rtol=0, atol=case["atol"]
    )


@pytest.mark.parametrize("kernel", sorted(KERNELS))
@pytest.mark.parametrize(("horizon", "count", "scale"), SHAPES)
def test_curve_passes_through_its_knots(kernel, horizon, count, scale):
    knots = KernelKnots(horizon, count, kernel, scale)
    assert (knots.horizon, knots.knots) == (horizon, count)
    assert knots.times[0] == 0 and knots.times[-1] == horizon - 1
    at_knots = knots.times == knots.times.round()
    rows = knots.matrix[knots.times[at_knots].long()]
    torch.testing.assert_close(rows, torch.eye(count, dtype=torch.float64)[at_knots], rtol=0, atol=1e-10)


@pytest.mark.parametrize("kernel", sorted(KERNELS))
def test_interpolates_smooth_curves(kernel):
    # not a property of any full-rank matrix: the steps between the knots must follow the curve
    knots = KernelKnots(29, 15, kernel, 4.0 if kernel != "rbf" else 3.0)
    curve = torch.sin(torch.arange(29, dtype=torch.float64) / 4.0)
    assert (knots.matrix @ curve[::2] - curve).abs().max() < 0.06


@pytest.mark.parametrize("member", [PerStep(9), Changes(9), KernelKnots(9, 5), KernelKnots(9, 9, "rbf", 1.0)])
def test_shift_by_nothing_is_nothing(member):
    torch.testing.assert_close(member.shift_matrix(0), torch.eye(member.knots, dtype=torch.float64), rtol=0, atol=1e-12)


def test_per_step_shift_drops_the_first_and_appends_zeros():
    controls = torch.arange(1.0, 6.0, dtype=torch.float64)
    for steps, expected in ((0, [1, 2, 3, 4, 5]), (2, [3, 4, 5, 0, 0]), (5, [0] * 5), (7, [0] * 5)):
        got = PerStep(5).shift_matrix(steps) @ controls
        torch.testing.assert_close(got, torch.tensor(expected, dtype=torch.float64), rtol=0, atol=0)


def test_per_step_shifts_compose():
    one = PerStep(6).shift_matrix(1)
    torch.testing.assert_close(PerStep(6).shift_matrix(3), one @ one @ one, rtol=0, atol=0)


def test_changes_add_up_and_their_shift_holds_the_last_control():
    member = Changes(4)
    changes = torch.tensor([0.5, -0.25, 1.0, 0.125], dtype=torch.float64)
    controls = member.matrix @ changes
    torch.testing.assert_close(controls, changes.cumsum(0), rtol=0, atol=0)
    for steps in range(7):
        held = torch.cat((controls[steps:], controls[-1:].expand(min(steps, 4))))
        torch.testing.assert_close(member.matrix @ (member.shift_matrix(steps) @ changes), held, rtol=0, atol=1e-15)


def test_bounded_changes_stand_for_the_clipped_controls():
    member, low, high = Changes(5), torch.tensor([-1.0]), torch.tensor([2.0])
    changes = torch.tensor([[1.5], [3.0], [-1.0], [-9.0], [0.5]])
    got = member.bound(changes, low, high)
    controls = changes.cumsum(0).clamp(low, high)  # 1.5, 2, 2, -1, -1
    torch.testing.assert_close(got.cumsum(0), controls)
    torch.testing.assert_close(got, torch.tensor([[1.5], [0.5], [0.0], [-3.0], [0.0]]))
    inside = torch.tensor([[1.0], [0.5], [-2.0], [0.25], [0.25]])
    torch.testing.assert_close(member.bound(inside, low, high), inside, rtol=0, atol=0)


@pytest.mark.parametrize("kernel", sorted(KERNELS))
def test_shift_reads_the_curve_later(kernel):
    """Knot j of a shift by n is the curve at its own time plus n: a row of W wherever that is a step of the horizon."""
    knots = KernelKnots(15, 8, kernel, 2.0)
    for steps in range(15):
        later = (knots.times + steps).long()
        inside = later < 15
        torch.testing.assert_close(knots.shift_matrix(steps)[inside], knots.matrix[later[inside]], rtol=0, atol=1e-10)


def test_shift_by_one_spacing_moves_every_knot_up():
    shifted = KernelKnots(15, 8).shift_matrix(2)
    torch.testing.assert_close(shifted[:-1], torch.eye(8, dtype=torch.float64)[1:], rtol=0, atol=1e-10)


def test_shift_is_no_power_and_fades():
    knots = KernelKnots(15, 8)
    one = knots.shift_matrix(1)
    # numbers of the checked derivation
    assert one[-1].sum().item() == pytest.approx(0.8225, abs=1e-4)
    assert torch.linalg.eigvals(one).abs().max().item() == pytest.approx(0.882, abs=1e-3)
    assert (knots.shift_matrix(3) - torch.linalg.matrix_power(one, 3)).abs().max().item() == pytest.approx(
        0.37, abs=5e-3
    )
    assert torch.linalg.matrix_power(one, 200).abs().max() < 1e-9
    assert knots.shift_matrix(60).abs().max() < 1e-9


@pytest.mark.parametrize("member", [PerStep(4), Changes(4), KernelKnots(4, 3)])
def test_shift_refuses_to_go_back(member):
    with pytest.raises(ValueError, match="steps to be 0 or more, got -1"):
        member.shift_matrix(-1)


def test_ill_conditioned_knots_are_refused():
    with pytest.raises(
        ValueError, match=r"15 knots over a horizon of 15 .* got 3.8e\+06 at kernel_scale 2.0: use fewer"
    ):
        KernelKnots(15, 15, "rbf", 2.0)
    with pytest.raises(ValueError, match="well conditioned"):
        KernelKnots(40, 40, "rbf", 1e4)
    assert KernelKnots(15, 8, "rbf", 4.0).matrix.isfinite().all()
