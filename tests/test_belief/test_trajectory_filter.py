"""The replay filter: its moves keep the posterior, which a brute-force filter with many particles gives."""

import math
from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from rumi.belief.prior import PlanarPrior
from rumi.belief.trajectory_belief import TouchAction, concatenate
from rumi.belief.trajectory_filter import TrajectoryFilter, TrajectorySettings
from rumi.dynamics.along_path import PathOutcome, Pusher
from rumi.dynamics.outline import RectangleOutline
from sdf import backend
from sensors.touch.contact_model import ContactModel

DOUBLE = {"dtype": torch.float64}


@pytest.fixture(autouse=True)
def fused() -> Iterator[None]:
    """The pushing has its own tests; here the quick version of it is enough."""
    with backend.force("numba"):
        yield


def prior(*, modes: int = 1) -> PlanarPrior:
    means = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.4, 1.0]], **DOUBLE)[:modes]
    return PlanarPrior(means, torch.tensor([0.02, 0.02, 0.2], **DOUBLE))


def follow(settings: TrajectorySettings | None = None, *, modes: int = 1) -> TrajectoryFilter:
    return TrajectoryFilter(
        RectangleOutline((0.03, 0.08)),
        torch.zeros(2, **DOUBLE),
        Pusher.disc(0.02, torch.zeros(1, **DOUBLE)),
        ContactModel(0.9, 0.05, 300.0),
        prior(modes=modes),
        settings,
    )


def push(signals: list[bool], start: float = -0.11, step: float = 0.01) -> TouchAction:
    x = start + step * torch.arange(len(signals) + 1, **DOUBLE)
    return TouchAction(torch.stack((x, 0.02 + 0 * x, 0 * x), -1), torch.tensor(signals))


HISTORY = [push([False, False, False]), push([True, True, False, True], -0.08), push([True, True], -0.04, 0.005)]


def moments(values: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    mean = weights @ values
    return mean, (weights @ (values - mean).square()).sqrt()


def brute_force(settings: TrajectorySettings, count: int = 40000) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Moments of start poses and of poses now under the posterior, by weighing draws of the prior."""
    own = follow(replace(settings, resampling="none"))
    random = torch.Generator().manual_seed(9)
    belief = own.initial(1, count, generator=random)
    for t in range(len(HISTORY)):
        belief, _ = own.step(belief, HISTORY[: t + 1], generator=random)
    weights = belief.log_weights[0].exp()
    assert float(belief.ess()) > 500
    return *moments(belief.start[0], weights), *moments(belief.pose[0], weights)


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_replay_follows_the_exact_posterior(noise: float) -> None:
    """Means and widths of 40 runs of 200 particles, which resample more than once, are those of 40000 weighed draws."""
    settings = TrajectorySettings(trigger=0.7, noise=noise, friction=(0.1, 0.6), lever_m=(0.03, 0.06))
    own, random = follow(settings), torch.Generator().manual_seed(1)
    belief, resampled = own.initial(40, 200, generator=random), 0.0
    for t in range(len(HISTORY)):
        belief, info = own.step(belief, HISTORY[: t + 1], generator=random)
        resampled += float(info.resampled.double().mean())
    assert resampled > 0.9
    weights = (belief.log_weights.exp() / 40).flatten()
    found = (*moments(belief.start.flatten(0, 1), weights), *moments(belief.pose.flatten(0, 1), weights))
    scale = torch.tensor([0.02, 0.02, 0.2], **DOUBLE)
    for a, b in zip(found, brute_force(settings), strict=True):
        assert float(((a - b) / scale).abs().max()) < 0.12


def test_moves_without_readings_keep_the_prior() -> None:
    own, random = follow(TrajectorySettings(noise=0.05), modes=2), torch.Generator().manual_seed(2)
    belief = own.initial(1, 20000, generator=random)
    silent = [TouchAction(torch.full((3, 3), 5.0, **DOUBLE), torch.zeros(2, dtype=torch.bool))]
    belief, _ = own.step(belief, silent, generator=random, resample=False)
    before = belief
    for _ in range(3):
        belief, accepted = own._sweep(belief, silent, random)
        assert 0.3 < accepted < 1.0
    first = before.start[0, :, 1] < 0.2
    again = belief.start[0, :, 1] < 0.2
    assert float(again.double().mean()) == pytest.approx(0.5, abs=0.02)
    for mask, source in ((first, before), (again, belief)):
        spread = (source.start[0, mask] - prior().means[0]).std(0)
        torch.testing.assert_close(spread, torch.tensor([0.02, 0.02, 0.2], **DOUBLE), atol=1e-9, rtol=0.04)
    for name, (low, high) in (("friction", own.settings.friction), ("lever", own.settings.lever_m)):
        share = (getattr(belief, name) - low) / (high - low)
        assert float(share.min()) >= 0
        assert float(share.max()) <= 1
        assert float(share.mean()) == pytest.approx(0.5, abs=0.02)
        assert float(share.std()) == pytest.approx(math.sqrt(1 / 12), abs=0.01)
    assert float(belief.noise[0].std()) == pytest.approx(1.0, abs=0.02)


def test_a_replay_is_what_happened(generator: torch.Generator) -> None:
    """Poses and likelihood that the filter has worked out step by step come again from the start."""
    for noise in (0.0, 0.2):
        own = follow(TrajectorySettings(resampling="none", noise=noise))
        belief = own.initial(3, 20, generator=generator)
        for t in range(len(HISTORY)):
            belief, _ = own.step(belief, HISTORY[: t + 1], generator=generator)
        pose, total = own.replay(belief.start, belief.friction, belief.lever, belief.noise, HISTORY)
        torch.testing.assert_close(pose, belief.pose, atol=1e-9, rtol=0)
        torch.testing.assert_close(total, belief.log_likelihood, atol=1e-9, rtol=0)
        expected = (belief.log_likelihood + math.log(1 / 20)).log_softmax(-1)
        torch.testing.assert_close(belief.log_weights, expected, atol=1e-9, rtol=0)
        moved = (belief.pose - belief.start)[..., :2].norm(dim=-1)
        assert float(moved.max()) > 0.01


def test_a_concatenated_history_is_one_action() -> None:
    whole = concatenate(HISTORY)
    assert whole.path.shape == (10, 3)
    assert whole.contact.tolist() == [s for action in HISTORY for s in action.contact.tolist()]
    # one path for all runs, signals of each
    many = concatenate([HISTORY[0], TouchAction(HISTORY[1].path, HISTORY[1].contact.expand(5, 4))])
    assert many.contact.shape == (5, 7)
    assert many.path.shape == (8, 3)


def test_runs_of_a_batch_are_weighed_by_their_own_readings(generator: torch.Generator) -> None:
    own = follow(TrajectorySettings(resampling="none"))
    belief = own.initial(2, 30, generator=generator)
    both = TouchAction(HISTORY[1].path, torch.stack((HISTORY[1].contact, ~HISTORY[1].contact)))
    together, _ = own.step(belief, [both], generator=torch.Generator().manual_seed(0))
    for run in range(2):
        alone, _ = own.step(
            belief.at(torch.tensor([run])),
            [TouchAction(both.path, both.contact[run])],
            generator=torch.Generator().manual_seed(0),
        )
        torch.testing.assert_close(alone.log_weights[0], together.log_weights[run])
    paths = TouchAction(both.path.expand(2, -1, -1) + torch.tensor([[[0.0]], [[0.05]]]), both.contact)
    shifted, _ = own.step(belief, [paths], generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(shifted.log_weights[0], together.log_weights[0])
    assert not torch.allclose(shifted.log_weights[1], together.log_weights[1])


def test_importance_copies_and_replay_makes_new() -> None:
    for replaying in (False, True):
        own = follow(TrajectorySettings(resampling="replay" if replaying else "importance", trigger=1.0))
        random = torch.Generator().manual_seed(0)
        belief = own.initial(1, 200, generator=random)
        before = {tuple(s) for s in belief.start[0].tolist()}
        belief, info = own.step(belief, HISTORY[1:2], generator=random)
        assert bool(info.resampled.all())
        fresh = sum(tuple(s) not in before for s in belief.start[0].tolist())
        assert fresh > 50 if replaying else fresh == 0
        assert float(belief.ess()) == pytest.approx(200)


def test_newcomers_come_near_the_robot_where_contact_was_felt(generator: torch.Generator) -> None:
    settings = TrajectorySettings(resampling="newcomers", trigger=1.0, newcomers=0.25, newcomer_mass=0.3)
    own = follow(settings)
    belief = own.initial(2, 40, generator=generator)
    signals = torch.tensor([[True, True], [False, False]])
    action = TouchAction(torch.tensor([[-0.3, 0.5, 0.0]] * 3, **DOUBLE), signals)
    after, _ = own.resample(belief, [action], generator=generator)
    tool = action.path[-1, :2]
    reach = math.sqrt(2) * (own.outline.radius + own.pusher.radius)
    near = (after.pose[..., :2] - tool).norm(dim=-1) < reach
    assert int(near[0].sum()) == 10
    assert int(near[1].sum()) == 0
    assert float(after.log_weights[0].exp()[near[0]].sum()) == pytest.approx(0.3, abs=1e-6)
    # those that fit the contact weigh most
    assert float(after.log_weights[0][near[0]].max() - after.log_weights[0][near[0]].min()) > 1.0


def test_newcomers_that_replace_all_particles_share_all_of_the_weight(generator: torch.Generator) -> None:
    own = follow(TrajectorySettings(resampling="newcomers", newcomers=1.0, newcomer_mass=0.0))
    belief = own.initial(1, 40, generator=generator)
    action = TouchAction(torch.tensor([[-0.3, 0.5, 0.0]] * 3, **DOUBLE), torch.tensor([True, True]))
    after, _ = own.resample(belief, [action], generator=generator)
    assert float(after.log_weights.exp().sum()) == pytest.approx(1.0)


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_where_the_tool_came_down_tells_of_the_object(noise: float) -> None:
    """Blocked, the box stands where the tool came down; not blocked, it does not; and replay keeps what that told."""
    place = torch.tensor([[0.06, 0.0, 0.0]], **DOUBLE)
    shares = {}
    for blocked in (True, False):
        settings = TrajectorySettings(noise=noise, trigger=1.0, overlap_error=0.02)
        own, random = follow(settings), torch.Generator().manual_seed(3)
        history = [TouchAction(place, torch.zeros(0, dtype=torch.bool), blocked)]
        belief, info = own.step(own.initial(1, 4000, generator=random), history, generator=random)
        assert bool(info.resampled[0])
        _, told = own.replay(belief.start, belief.friction, belief.lever, belief.noise, history)
        torch.testing.assert_close(told, belief.log_likelihood)
        x = belief.pose[0, :, 0]
        # the finger's border reaches to x = 0.04, and the box's side is 0.03 ahead of its middle
        shares[blocked] = [float((x > limit).double().mean()) for limit in (0.004, 0.016)]
    assert shares[True][0] > 0.88
    assert shares[False][1] < 0.05


def test_tempered_readings_tell_a_share() -> None:
    whole, half = (follow(TrajectorySettings(temper=power)) for power in (1.0, 0.5))
    random = torch.Generator().manual_seed(3)
    belief = whole.initial(1, 50, generator=random)
    gained = [own.roll(belief.pose, belief.friction, belief.lever, None, HISTORY[1])[1] for own in (whole, half)]
    torch.testing.assert_close(0.5 * gained[0], gained[1])


def test_heavy_tails_throw_farther() -> None:
    plain, heavy = (follow(TrajectorySettings(noise=0.1, noise_tails=h)) for h in (0.0, 0.3))
    before, after = torch.zeros(1, 2, 3, **DOUBLE), torch.zeros(1, 2, 3, **DOUBLE)
    after[..., 0] = 0.05
    noise = torch.tensor([[[0.5, 0.0, 0.0], [3.0, 0.0, 0.0]]], **DOUBLE)
    near, far = (own._disturbed(before, after, noise)[0, :, 0] - 0.05 for own in (plain, heavy))
    torch.testing.assert_close(near, 0.005 * torch.tensor([0.5, 3.0], **DOUBLE))
    torch.testing.assert_close(far / near, (0.15 * torch.tensor([0.25, 9.0], **DOUBLE)).exp())


def test_another_physics_may_carry_the_particles() -> None:
    """Where nothing is ever moved, only the distances tell."""

    def still(poses: Tensor, path: Tensor, pusher: Pusher, *rest: object, **options: object) -> PathOutcome:
        count, parts = len(poses), path.shape[1] - 1
        return PathOutcome(poses[:, None].expand(count, parts, 3).clone(), torch.full((count, parts), 1.0, **DOUBLE))

    own = follow()
    frozen = TrajectoryFilter(own.outline, own.centre, own.pusher, own.model, own.prior, own.settings, still)
    random = torch.Generator().manual_seed(3)
    belief = frozen.initial(1, 10, generator=random)
    after, _ = frozen.step(belief, [HISTORY[1]], generator=random, resample=False)
    torch.testing.assert_close(after.pose, belief.pose)
    torch.testing.assert_close(after.log_weights, belief.log_weights)


@pytest.mark.parametrize("rule", ["newcomers", "importance", "none"])
def test_other_rules_take_in_a_tool_that_could_not_come_down(rule: str) -> None:
    place = torch.tensor([[0.04, 0.0, 0.0]], **DOUBLE)
    own, random = follow(TrajectorySettings(resampling=rule, trigger=1.0)), torch.Generator().manual_seed(3)  # type: ignore[arg-type]
    history = [TouchAction(place, torch.zeros(0, dtype=torch.bool), True)]
    belief, _ = own.step(own.initial(1, 500, generator=random), history, generator=random)
    mean = float((belief.log_weights[0].exp() * belief.pose[0, :, 0]).sum())
    assert mean > 0.005
