"""Log-likelihood ratios of named faults against the belief of an upright object's trajectories, for each reading.

A fault is a predictive density of its own: where the object may be after what came before, and what the hand then
feels. "No fault" is what the filter adds up itself while it takes the reading in (the marginal likelihood of sequential
Monte Carlo); a displaced object or hand is importance sampling of the belief before the reading, moved about, with the
balance heuristic where one draw serves several faults (Veach and Guibas 1995). All count a point as the independent
readings that it is worth to the filter, so that a ratio is a product of powers of ratios, which have a mean of 1 at
most where the filter's prediction is right.
"""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.misfit import MisfitSettings
from rumi.belief.pose_trajectories import Trajectories
from rumi.belief.pushed_model import Pushed
from rumi.belief.trajectory_history import History, Kind
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.resampling import systematic
from rumi.seeding import normal

TRAJECTORY_FAULTS = ("knocked", "absent", "dead hand", "false contacts", "hand off", "camera off")
"""The object is elsewhere near by; it is gone; the hand feels nothing; it feels what is not there; it is some
millimetres beside where it is taken to be; the camera was, which the first touch tells."""

_DRAWS = 900  # poses to which something may have been moved
_TELLS = 1.0  # nats that a reading is short of what fits best, from which on something can be told from it
_HAND_M, _CAMERA_M, _STRAIGHT_RAD = (0.006, 0.0015), (0.010, 0.003), 0.01  # how far off: mean and deviation; turn
_FALSE = 0.3  # share of the actions with a false contact, where there are such
_BRIEF = 0.8, 0.1  # chance that a false contact, and a true one, lasts for two instants at most
_UNMET_M = 0.012  # from the surface of every particle: what is felt there is felt by none


def new_segments(before: Trajectories, after: Trajectories) -> int:
    """How many segments a reading added to the history; 0 where it was begun anew."""
    added = after.forgotten + len(after.history) - before.forgotten - len(before.history)
    return added if 0 < added <= len(after.history) else 0


@torch.no_grad()
def log_ratios(
    before: Trajectories,
    log_weights: Float[Tensor, "N"],
    after: Trajectories,
    model: Pushed,
    sensed: PoseTrajectorySettings,
    own: MisfitSettings,
    *,
    untouched: bool,
    generator: torch.Generator,
) -> Float[Tensor, "K"]:
    """Log-likelihood ratio of each of `TRAJECTORY_FAULTS` against the belief, nats; 0 where a reading tells nothing.

    Args:
        before: particles before the reading.
        log_weights: of them.
        after: particles that have taken it in.
        model: object and tool.
        sensed: of the motion prior and the sensors.
        own: how far a knock goes, and how often a contact means nothing even so.
        untouched: whether nothing had been felt before, so that the view alone says where the object is.
        generator: of the draws.
    """
    ratios = torch.zeros(len(TRAJECTORY_FAULTS), dtype=torch.float64)
    new = new_segments(before, after)
    if not new:
        return ratios
    history = after.history.since(len(after.history) - new)
    none = after.log_evidence - before.log_evidence
    gone, dead = _without_feeling(history, sensed)
    felt = bool((history.kind == Kind.FELT).any())
    ratios[1:3] = torch.tensor((gone, dead), dtype=torch.float64) - none
    if felt:
        unmet = _unmet(after, new, model)
        lasts = math.log(_BRIEF[0] / _BRIEF[1] if unmet <= 2 else (1.0 - _BRIEF[0]) / (1.0 - _BRIEF[1]))
        ratios[3] = math.log(_FALSE / own.outlier) + lasts if unmet else math.log1p(-_FALSE)
    if none > -_TELLS:
        return ratios.clamp_max(_TELLS)
    camera = felt and untouched
    knock, hand, view = _displaced(before, log_weights, history, model, sensed, own, camera, generator)
    ratios[0] = knock - none
    if felt:
        ratios[4] = hand - none
    if camera:
        ratios[5] = view - none
    return ratios


def _without_feeling(history: History, sensed: PoseTrajectorySettings) -> tuple[float, float]:
    """Log-likelihoods of a reading without an object, and of one by a hand that feels nothing.

    They are the same but for what a camera sees: of what it costs an object that is there nothing is counted.
    """
    never, always = math.log(sensed.outliers), math.log1p(-sensed.outliers)
    worth = history.worth().sum(0)
    each = worth.new_zeros(len(Kind))
    each[Kind.FELT] = each[Kind.PAD_FELT] = never
    each[Kind.PAD_CLEAR] = always
    dead = float(worth @ each)
    return dead + never * float(worth[Kind.SEEN]), dead


def _unmet(after: Trajectories, new: int, model: Pushed) -> int:
    """Instants of the last segments at which the hand felt something where no particle has a surface."""
    history, count = after.history, 0
    for segment in range(len(history) - new, len(history)):
        first, last = (int(history.ends[at]) if at >= 0 else 0 for at in (segment - 1, segment))
        for instant in range(first, last):
            low, high = (int(history.point_ends[at]) if at >= 0 else 0 for at in (instant - 1, instant))
            points = history.points[low:high][history.kind[low:high] == Kind.FELT]
            if len(points):
                poses = torch.cat((after.poses[:, segment], after.poses[:, segment + 1]))
                off = model.sdf.distance(model.local(poses, points).to(model.sdf.bounds)).abs().median(-1).values
                count += float(off.min()) > _UNMET_M
    return count


def _displaced(
    before: Trajectories,
    log_weights: Tensor,
    history: History,
    model: Pushed,
    sensed: PoseTrajectorySettings,
    own: MisfitSettings,
    camera: bool,
    generator: torch.Generator,
) -> tuple[float, float, float]:
    """Log predictive densities of a reading where the object was knocked, and where hand or camera are off."""
    rings = (_HAND_M, _CAMERA_M) if camera else (_HAND_M,)
    shares = (0.5, 0.25, 0.25) if camera else (0.6, 0.4)
    moves = _moves(own, rings, [round(share * _DRAWS) for share in shares], generator)
    each = torch.stack([_knock_density(moves, own), *(_ring_density(moves, ring) for ring in rings)])
    proposal = torch.logsumexp(each + each.new_tensor(shares).log()[:, None], 0)
    # parents in an order of their own: draws of one fault come one after the other
    parents = systematic(log_weights.double(), 0.5, len(moves))
    start = before.pose[parents[torch.randperm(len(moves), generator=generator)]].clone()
    start[:, :3] += moves
    gained = _replayed(start, history, model, sensed, generator)
    found = torch.logsumexp(each - proposal + gained, -1) - math.log(len(moves))
    return float(found[0]), float(found[1]), float(found[2]) if camera else -math.inf


def _replayed(
    start: Float[Tensor, "M D"],
    history: History,
    model: Pushed,
    sensed: PoseTrajectorySettings,
    generator: torch.Generator,
) -> Float[Tensor, "M"]:
    """Log-likelihood of a reading where the object began at each pose, physics and noise drawn from the prior."""
    drawn = Trajectories.drawn(start, history, generator)
    return drawn.replayed(model, sensed, history, torch.zeros(len(start), dtype=torch.long)).log_likelihood.sum(-1)


def _moves(
    own: MisfitSettings, rings: Sequence[tuple[float, float]], counts: Sequence[int], generator: torch.Generator
) -> Float[Tensor, "M 3"]:
    """Displacements (x, y, yaw): so many knocks, then so many of each ring."""
    drawn = normal((sum(counts), 3), generator=generator, dtype=torch.float64)
    parts = [drawn[: counts[0]] * drawn.new_tensor((own.knock_m, own.knock_m, own.knock_rad))]
    at = counts[0]
    for (middle, spread), count in zip(rings, counts[1:], strict=True):
        some = drawn[at : at + count]
        angle = 2.0 * math.pi * torch.rand(count, generator=generator, dtype=torch.float64)
        far = (middle + spread * some[:, 0]).abs()
        parts.append(torch.stack((far * angle.cos(), far * angle.sin(), _STRAIGHT_RAD * some[:, 2]), -1))
        at += count
    return torch.cat(parts)


def _knock_density(moves: Float[Tensor, "M 3"], own: MisfitSettings) -> Float[Tensor, "M"]:
    scale = moves.new_tensor((own.knock_m, own.knock_m, own.knock_rad))
    return -0.5 * (moves / scale).square().sum(-1) - scale.log().sum() - 1.5 * math.log(2.0 * math.pi)


def _ring_density(moves: Float[Tensor, "M 3"], ring: tuple[float, float]) -> Float[Tensor, "M"]:
    """Log-density of a displacement of about so much in any direction."""
    far = moves[:, :2].norm(dim=-1).clamp_min(1e-9)
    middle, spread = ring
    folded = torch.logaddexp(-0.5 * ((far - middle) / spread).square(), -0.5 * ((far + middle) / spread).square())
    turn = -0.5 * (moves[:, 2] / _STRAIGHT_RAD).square() - math.log(_STRAIGHT_RAD)
    return folded - math.log(spread) + turn - math.log(2.0 * math.pi) - (2.0 * math.pi * far).log()
