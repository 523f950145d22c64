"""Registration of a pushed object with its tool: against finite differences, known shifts and a least-squares fit."""

import pytest
import torch

from rumi.dynamics.along_path import Pusher
from rumi.dynamics.outline import RectangleOutline, Support
from rumi.dynamics.push_posterior import PushPosterior
from rumi.dynamics.push_registration import Registration, as_tracked, put_right, student_4, touches
from rumi.dynamics.pushed_body import ObservedPush, PushedBody
from rumi.dynamics.sliding import rotated

TRUE = torch.tensor([1.2e-3, -0.8e-3, 0.3e-3, -0.2e-3, 0.008], dtype=torch.float64)


def body():
    axes = [torch.linspace(-half, half, 41, dtype=torch.float64) for half in (0.06, 0.03)]
    base = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)
    return PushedBody(RectangleOutline((0.06, 0.03)), Support.of_base(base, base.mean(0)), Pusher.disc(0.005, base))


def pushes(count=40):
    """From all sides, straight at the sides' middles or nearly, as a tracker that is off by TRUE has them."""
    turn = torch.linspace(0.0, 6.0, count, dtype=torch.float64)
    true = torch.stack((0.1 * turn.cos(), 0.1 * turn.sin(), 2.3 * turn), -1)
    side = torch.arange(count) % 4
    angle = 0.5 * torch.pi * side + 0.15 * torch.cos(7.0 * turn)
    half = torch.where(side % 2 == 0, 0.06, 0.03).double()
    aside = 0.012 * torch.sin(3.0 * turn)
    begin = rotated(torch.stack((-half - 0.006, aside), -1), 0.5 * torch.pi * side) * 1.0
    share = torch.linspace(0.0, 0.04, 17, dtype=torch.float64)[:, None]
    way = torch.stack((angle.cos(), angle.sin()), -1)
    path = true[:, None, :2] + rotated(begin[:, None] + share * way[:, None], true[:, None, 2])
    path = torch.cat((path, torch.zeros_like(path[..., :1])), -1)
    own = body()
    one = PushPosterior(torch.tensor([[-1.6, 0.2, *[0.0] * 6]]).double(), torch.zeros(1).double())
    ends = one.predict(true, path, own).ends[:, 0]
    told = path + torch.cat((TRUE[:2], TRUE.new_zeros(1)))
    shown = [as_tracked(poses, TRUE) for poses in (true, ends)]
    return [ObservedPush(*parts) for parts in zip(shown[0], told, shown[1], strict=True)], own


def test_poses_are_put_right_and_back():
    poses = torch.randn(20, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    torch.testing.assert_close(as_tracked(put_right(poses, TRUE), TRUE), poses)
    torch.testing.assert_close(put_right(as_tracked(poses, TRUE), TRUE), poses)


def test_gaps_change_with_the_shifts_as_told():
    observed, own = pushes(12)
    poses, tools = (torch.stack(part) for part in zip(*((push.end, push.path[-1]) for push in observed), strict=True))
    for known in (torch.zeros_like(TRUE), TRUE + 0.05 * torch.eye(5, dtype=torch.float64)[4]):
        gap, slope = touches(poses, tools, own, known)
        for k in range(5):
            more = 1e-6 * torch.eye(5, dtype=torch.float64)[k]
            after, _ = touches(poses, tools, own, known + more)
            torch.testing.assert_close((gap - after) / 1e-6, slope[:, k], atol=1e-3, rtol=0)
    right, tool = put_right(poses, TRUE), tools - torch.cat((TRUE[:2], TRUE.new_zeros(1)))
    torch.testing.assert_close(touches(right, tool, own)[0], touches(poses, tools, own, TRUE)[0])


def test_shifts_are_learnt_from_touches():
    observed, own = pushes()
    found = Registration().learnt(observed, own)
    mean, spread = torch.tensor(found.mean).double(), torch.tensor(found.root).double().norm(dim=-1)
    assert ((mean - TRUE).abs() < 3.0 * spread + 5e-5).all()
    assert (spread < torch.tensor(found.deviation)).all()
    # predictions are of the frames in which things are tracked
    numbers = torch.tensor([[-1.6, 0.2, *[0.0] * 6]]).double()
    known, unknown = (
        PushPosterior(numbers, torch.zeros(1).double(), registration=own_registration)
        for own_registration in (found, Registration())
    )
    start, path, end = (torch.stack(part) for part in zip(*observed, strict=True))
    off = [(one.predict(start, path, own).mean() - end)[:, :2].norm(dim=-1).mean() for one in (known, unknown)]
    assert float(off[0]) < 3e-4 and float(off[1]) > 3.0 * float(off[0])


def test_a_frame_that_is_turned_by_degrees_is_found():
    observed, own = pushes()
    turned = TRUE.new_tensor([0.0, 0.0, 0.0, 0.0, 0.075])
    shown = [push._replace(start=as_tracked(push.start, turned), end=as_tracked(push.end, turned)) for push in observed]
    found = Registration().learnt(shown, own)
    assert found.mean[4] == pytest.approx(float(TRUE[4]) + 0.075, abs=0.005)


def test_draws_are_student_t():
    """Their quantiles are those of a standard normal one over the root of a mean of four squares."""
    value = student_4(torch.tensor([0.0, 0.6744897501960817, -1.6448536269514722, 40.0], dtype=torch.float64))
    torch.testing.assert_close(value[:3], torch.tensor([0.0, 0.7406970841, -2.1318467863]).double(), atol=1e-6, rtol=0)
    assert bool(value[3].isfinite()) and float(value[3]) > 100.0


def test_what_does_not_touch_tells_nothing():
    observed, own = pushes(3)
    far = torch.tensor([0.5, 0.0, 0.0], dtype=torch.float64)
    apart = [push._replace(start=push.start + far, end=push.end + far) for push in observed]
    found = Registration().learnt(apart, own)
    assert max(map(abs, found.mean)) == 0.0
    torch.testing.assert_close(torch.tensor(found.root).double().norm(dim=-1), torch.tensor(found.deviation).double())


def test_a_start_within_the_object_is_off():
    observed, own = pushes(1)
    push = observed[0]

    def moved(aside):
        off = rotated(torch.tensor([aside, 0.0]).double(), push.start[2])
        return push._replace(start=push.start + torch.cat((off, off.new_zeros(1))), end=push.end + 0.5)

    _, slope = touches(push.start[None], push.path[:1], own)
    shallow, deep = (Registration().learnt([moved(aside)], own) for aside in (0.004, -0.004))
    assert max(map(abs, shallow.mean)) == 0.0
    assert float(slope[0] @ torch.tensor(deep.mean).double()) < -5e-4


@pytest.mark.parametrize("deviation", [(1.0,) * 4, (0.0, *[1.0] * 4), (float("inf"), *[1.0] * 4)])
def test_a_deviation_without_meaning_is_refused(deviation):
    with pytest.raises(ValueError, match="deviation above 0"):
        Registration(deviation)
