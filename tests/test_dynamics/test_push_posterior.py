"""Push parameters learnt from pushes, and the density of a push: against a grid, integrals, symmetry and own draws."""

import json
import math
from dataclasses import replace

import pytest
import torch

from rumi.dynamics.along_path import Pusher
from rumi.dynamics.outline import RectangleOutline, Support
from rumi.dynamics.push_density import PushResidual
from rumi.dynamics.push_parameters import sliding_of
from rumi.dynamics.push_posterior import PushPosterior
from rumi.dynamics.push_registration import Registration, student_4
from rumi.dynamics.pushed_body import ObservedPush, PushedBody
from rumi.dynamics.sliding import contact_twist, quartic_twist, rotated, turned_quartic
from rumi.errors import UsageError
from sdf import backend

HALF = (0.06, 0.03)
SURE = Registration((1e-9,) * 5)


def body(dtype=torch.float64, off=(0.0, 0.0)):
    axes = [torch.linspace(-half, half, 41, dtype=torch.float64) for half in HALF]
    base = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)
    support = Support.of_base(base, torch.tensor(off, dtype=torch.float64))
    return PushedBody(RectangleOutline(HALF), support, Pusher.disc(0.005, base.to(dtype)))


def pushes(count=6, length=0.05, dtype=torch.float64):
    start = torch.zeros(count, 3, dtype=dtype)
    start[:, 2] = torch.linspace(0.0, 6.0, count, dtype=dtype)
    heading = start[:, 2] + torch.linspace(-0.6, 0.6, count, dtype=dtype)
    aside = torch.linspace(-0.025, 0.025, count, dtype=dtype)
    begin = rotated(torch.stack((torch.full_like(aside, -0.07), aside), -1), start[:, 2])
    way = length * torch.stack((heading.cos(), heading.sin()), -1)
    share = torch.linspace(0.0, 1.0, 11, dtype=dtype)[:, None]
    path = begin[:, None] + share * way[:, None]
    return start, torch.cat((path, torch.zeros_like(path[..., :1])), -1)


def observed(start, path, end):
    return [ObservedPush(*parts) for parts in zip(start, path, end, strict=True)]


def generator():
    return torch.Generator().manual_seed(0)


def contacts(count=300):
    own = torch.Generator().manual_seed(1)
    angle, side, at, lever, friction = torch.rand(5, count, generator=own, dtype=torch.float64)
    inward = torch.stack(((6.3 * angle).cos(), (6.3 * angle).sin()), -1)
    across = torch.stack((-inward[:, 1], inward[:, 0]), -1)
    arm = -0.04 * inward + (0.06 * at - 0.03)[:, None] * across
    return arm, inward, inward + (4.0 * side - 2.0)[:, None] * across, 0.02 + 0.04 * lever, 0.05 + 0.6 * friction


def test_a_quartic_of_zeros_is_the_ellipsoid():
    own = contacts()
    zeros = torch.zeros(len(own[0]), 5, dtype=torch.float64)
    torch.testing.assert_close(quartic_twist(*own, zeros), contact_twist(*own), atol=1e-5, rtol=1e-3)


QUARTIC = torch.tensor([0.06, -0.04, 1.2, 1.0, -0.7], dtype=torch.float64)


def test_a_contact_on_a_quartic_sticks_or_slides_with_a_normal_twist():
    arm, inward, wanted, lever, friction = own = contacts()
    twist = quartic_twist(*own, QUARTIC.expand(len(arm), 5))
    moved = twist[:, :2] + twist[:, 2:] * torch.stack((-arm[:, 1], arm[:, 0]), -1)
    torch.testing.assert_close((moved * inward).sum(-1), (wanted * inward).sum(-1))
    across = torch.stack((-inward[:, 1], inward[:, 0]), -1)
    slip = ((moved - wanted) * across).sum(-1)
    stuck = slip.abs() < 1e-3
    assert 0.1 < float(stuck.double().mean()) < 0.9
    # what slides does so against friction: a force on that edge of the cone has this twist as its normal
    force = (inward - (friction * slip.sign())[:, None] * across).requires_grad_()
    size = QUARTIC[:2].norm()
    log_a = torch.tensor([[QUARTIC[0], QUARTIC[1]], [QUARTIC[1], -QUARTIC[0]]], dtype=torch.float64)
    a = torch.linalg.matrix_exp(log_a)
    q = torch.tensor([[QUARTIC[2] + QUARTIC[3], QUARTIC[4]], [QUARTIC[4], QUARTIC[2] - QUARTIC[3]]])
    moment = (arm[:, 0] * force[:, 1] - arm[:, 1] * force[:, 0]) / lever
    square = ((force @ a) * force).sum(-1) + moment.square()
    surface = square.square() + moment.square() * ((force @ q) * force).sum(-1)
    (normal,) = torch.autograd.grad(surface.sum(), force)
    cosine = torch.nn.functional.cosine_similarity(normal, moved)
    assert float(cosine[~stuck].min()) > 1 - 1e-9 and size > 0


def test_a_rod_pushed_across_gives_way_sooner():
    own = PushPosterior.prior(1, mean=[-1.6, 0.1, 1.0, 4.0, 0, 0, 0, 0], deviation=[1e-6] * 8)
    quartic = sliding_of(own.parameters, body().support).quartic[0]
    assert float(quartic[3]) < -0.5 and abs(float(quartic[4])) < 1e-9  # Q is greater along y, across the length
    torch.testing.assert_close(turned_quartic(quartic, torch.tensor(0.5 * math.pi).double())[3], -quartic[3])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_compiled_pushes_are_the_plain_ones(dtype):
    start, path = pushes(dtype=dtype)
    own, prior = body(dtype), PushPosterior.prior(16)
    found = prior.predict(start, path, own)
    with backend.force("torch"):
        plain = prior.predict(start, path, own)
    atol = 1e-9 if dtype == torch.float64 else 2e-4
    torch.testing.assert_close(found.ends, plain.ends, atol=atol, rtol=0)
    assert float((found.ends - start[:, None]).abs().amax()) > 0.01
    rows = [prior.predict(start[i : i + 1], path[i : i + 1], own).ends[0] for i in range(len(start))]
    assert torch.equal(torch.stack(rows), found.ends)


def test_the_density_integrates_to_one_and_regions_hold_their_share():
    start, path = pushes(3)
    shown = PushPosterior.prior(8).predict(start, path, body(off=(0.01, 0.004)))
    drawn = shown.sample(20_000, generator())
    middle, scale = shown.ends[:, 3:4], torch.tensor([0.002, 0.002, 0.05], dtype=torch.float64)
    off = (drawn - middle) / scale
    other = -0.5 * off.square().sum(-1) - 1.5 * math.log(2 * math.pi) - scale.log().sum()
    whole = (other - shown.log_density(drawn)).exp().mean(-1)  # of another density over this one, drawn from this one
    torch.testing.assert_close(whole, torch.ones(3, dtype=torch.float64), atol=0.08, rtol=0)
    anew = generator()  # each level is by draws of its own, whose errors average out
    held = [shown.level(drawn[:, i], anew, draws=200) for i in range(0, 400)]
    for share in (0.5, 0.9):
        assert float((torch.stack(held) <= share).double().mean()) == pytest.approx(share, abs=0.05)


def test_a_turned_scene_has_the_same_density():
    start, path = pushes(3)
    own, prior = body(off=(0.01, 0.0)), PushPosterior.prior(8, registration=SURE)
    end = prior.predict(start, path, own).ends[:, 2]
    turn = torch.tensor(2.1, dtype=torch.float64)

    def turned(poses):
        return torch.cat((rotated(poses[..., :2], turn) + 0.3, poses[..., 2:] + turn), -1)

    before = prior.predict(start, path, own).log_density(end)
    after = prior.predict(turned(start), turned(path), own).log_density(turned(end) + torch.tensor([0, 0, 2 * math.pi]))
    torch.testing.assert_close(after, before, atol=1e-5, rtol=0)


def test_the_posterior_is_that_of_a_grid():
    own, residual = body(), replace(PushResidual(), power=1.0, spread=0.0)
    mean, deviation = [-1.5, 0.2, 1.0, 3.0, 0, 0, 0, 0], [0.5, 0.4, *[1e-6] * 6]
    prior = PushPosterior.prior(512, mean=mean, deviation=deviation, residual=residual, registration=SURE)
    start, path = pushes(6)
    truth = PushPosterior.prior(1, mean=[-1.1, 0.45, *mean[2:]], deviation=[1e-9] * 8, registration=SURE)
    end = truth.predict(start, path, own).ends[:, 0]
    found = prior.update(observed(start, path, end), own, generator())
    assert not torch.equal(found.parameters, prior.parameters)  # it was resampled
    grid = torch.cartesian_prod(
        *(m + d * torch.linspace(-3, 3, 61).double() for m, d in zip(mean[:2], deviation[:2], strict=True))
    )
    grid = torch.cat((grid, torch.tensor(mean[2:]).expand(len(grid), 6)), -1)
    exact = replace(found, parameters=grid, log_weights=torch.zeros(len(grid)).double(), white=None)
    weights = exact._log_target(torch.cat((grid, grid.new_zeros(len(grid), 6)), -1), own).softmax(-1)
    centre = weights @ grid[:, :2]
    spread = (weights @ (grid[:, :2] - centre).square()).sqrt()
    assert (spread < torch.tensor([0.25, 0.2])).all()
    off = found.log_weights.exp() @ found.parameters[:, :2] - centre
    assert (off.abs() < 0.35 * spread).all()
    assert float(found.predict(start, path, own).log_density(end).mean()) > float(
        prior.predict(start, path, own).log_density(end).mean()
    )


def test_it_is_saved_and_read_again(tmp_path):
    start, path = pushes(2)
    own = body()
    end = PushPosterior.prior(1).predict(start, path, own).ends[:, 0]
    found = PushPosterior.prior(32).update(observed(start, path, end), own, generator())
    found.save(tmp_path / "mug.json")
    again = PushPosterior.load(tmp_path / "mug.json")
    assert torch.equal(again.parameters, found.parameters) and torch.equal(again.log_weights, found.log_weights)
    assert all(
        torch.equal(a, b) for x, y in zip(again.pushes, found.pushes, strict=True) for a, b in zip(x, y, strict=True)
    )
    assert again.registration == found.registration and torch.equal(again.white, found.white)
    assert again.residual == found.residual and (again.mean, again.deviation) == (found.mean, found.deviation)
    assert [file.name for file in tmp_path.iterdir()] == ["mug.json"]


def test_a_file_of_normal_shifts_and_one_scale_for_all_objects_is_read(tmp_path):
    prior = PushPosterior.prior(4)
    prior.save(tmp_path / "new.json")
    data = json.loads((tmp_path / "new.json").read_text())
    normal = student_4(prior.white[:, :5])
    data |= {"format": "rumi push parameters 2", "white": normal.tolist()}
    del data["residual"]["spread"]
    (tmp_path / "old.json").write_text(json.dumps(data))
    old = PushPosterior.load(tmp_path / "old.json")
    assert old.residual == replace(prior.residual, spread=0.0)
    torch.testing.assert_close(old.white[:, :5], prior.white[:, :5], atol=1e-9, rtol=0)
    assert not old.white[:, 5].any()
    start, path = pushes(2)
    same = replace(prior, residual=old.residual)
    torch.testing.assert_close(old.predict(start, path, body()).scale, same.predict(start, path, body()).scale)


@pytest.mark.parametrize("times", [0.4, 2.5])
def test_how_far_off_pushes_of_an_object_are_is_learnt(times):
    own, residual = body(), replace(PushResidual(), power=1.0, spread=1.0)
    known = {"mean": [-1.5, 0.2, 1.0, 3.0, 0, 0, 0, 0], "deviation": [1e-6] * 8, "registration": SURE}
    prior = PushPosterior.prior(256, residual=residual, **known)
    start, path = pushes(24)
    shown = PushPosterior.prior(1, residual=replace(residual, spread=0.0), **known).predict(start, path, own)
    end = shown._replace(scale=times * shown.scale).sample(1, generator())[:, 0]
    found = prior.update(observed(start, path, end), own, generator())
    scale = found.predict(start, path, own).scale
    middle = (found.log_weights.exp()[:, None] * (scale[0] / shown.scale[0]).log()).sum(0)
    assert float(middle[0]) == pytest.approx(math.log(times), abs=0.35)
    torch.testing.assert_close(middle, middle[:1].expand(3))


@pytest.mark.parametrize("text", ["", "{}", "[1]", '{"format": "rumi push parameters 2", "names": []}'])
def test_another_file_is_refused(tmp_path, text):
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(UsageError, match="push parameters"):
        PushPosterior.load(tmp_path / "a.json")
    with pytest.raises(UsageError, match="push parameters"):
        PushPosterior.load(tmp_path / "none.json")


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("count", "length"), [(1, 0.05), (1, 0.0), (300, 0.0), (40, 0.2)])
def test_no_push_makes_what_is_not_a_number(dtype, count, length):
    """Zero-length pushes, and frictions and levers from next to nothing to beyond all objects."""
    start, path = pushes(4, length, dtype)
    prior = PushPosterior.prior(count, deviation=[6.0, 3.0, 5.0, 8.0, 0.5, 0.5, 0.5, 0.5])
    own = body(dtype)
    shown = prior.predict(start, path, own)
    assert shown.ends.isfinite().all() and shown.log_density(shown.ends[:, 0]).isfinite().all()
    still = prior.update(observed(start, path, start), own, generator())
    assert still.parameters.isfinite().all() and still.log_weights.isfinite().all()
    assert shown.mean().isfinite().all() and shown.sample(50, generator()).isfinite().all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_tool_that_stands_in_the_object_moves_it_by_the_depth(dtype):
    """Extreme ways of sliding, and a tool that does not move: as pushes of it, some would go more than a metre."""
    own, middle = body(dtype), PushPosterior.prior(1).mean
    prior = PushPosterior.prior(
        2000, mean=middle, deviation=[5.0, 1.5, 5.0, 8.0, 0.5, 0.5, 0.5, 0.5], registration=SURE
    )
    start = torch.tensor([[0.0, 0.0, 0.0], [0.01, 0.02, 2.0], [-0.02, -0.02, 4.0]], dtype=dtype)
    path = torch.tensor([0.02, -0.01, 0.0], dtype=dtype).expand(3, 3, 3)
    shown = prior.predict(start, path, own)
    local = rotated(path[:, 0, :2] - start[:, :2], -start[:, 2])
    depth = own.pusher.thickness - own.outline(local).distance
    assert float(depth.min()) > 0.01
    gone = (shown.ends - start[:, None])[..., :2].norm(dim=-1)
    torch.testing.assert_close(gone, depth[:, None].expand_as(gone), atol=1e-4, rtol=0)
    with backend.force("torch"):
        plain = prior.predict(start, path, own)
    torch.testing.assert_close(shown.ends[..., :2], plain.ends[..., :2], atol=1e-4, rtol=0)
