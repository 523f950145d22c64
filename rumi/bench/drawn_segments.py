"""Segments drawn from the very model that trajectories are weighed by: for benchmarks and simulation-based calibration.

Every reading counts as one: points seen about the surface, and points of pads that feel it or not.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.pose_trajectories import NOISE, PHYSICS, Trajectories
from rumi.belief.pushed_model import Pushed
from rumi.belief.pushed_object import PushedObject
from rumi.belief.systematic_errors import NUMBERS, SystematicErrors
from rumi.belief.trajectory_history import History, Kind, Segment
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.dynamics.sliding import rotated
from rumi.seeding import normal
from sdf import se3

_BEYOND = 4.0  # deviations of the sensor that points about the surface are drawn within


def drawn_view(
    model: PushedObject,
    own: PoseTrajectorySettings,
    pose: Float[Tensor, "3"],
    count: int,
    random: torch.Generator,
) -> Segment:
    """Points that a camera with the model's noise sees of an object at rest, by rejection.

    Args:
        model: the object.
        own: of the camera.
        pose: of the object, as the camera has it.
        count: of points.
        random: of the draws.
    """
    low, high = model.sdf.bounds.double()
    reach = _BEYOND * own.seen_sd_m
    found = low.new_zeros(0, 3)
    while len(found) < count:
        uniform = torch.rand(50 * count, 4, generator=random, dtype=torch.float64)
        points = low - reach + (high - low + 2.0 * reach) * uniform[:, :3]
        distance = model.sdf.distance(points.to(model.sdf.bounds)).double()
        found = torch.cat((found, points[uniform[:, 3] < (-0.5 * (distance / own.seen_sd_m).square()).exp()]))
    found = found[:count]
    place = torch.cat((pose[:2] + rotated(found[:, :2], pose[2]), found[:, 2:]), -1)
    still = torch.zeros(1, 2, 3, dtype=torch.float64)
    kind = torch.full((count,), int(Kind.SEEN))
    return Segment(still, False, place, torch.zeros_like(kind), kind, torch.ones(count, dtype=torch.float64))


def drawn_truth(pose: Float[Tensor, "D"], random: torch.Generator, *, systematic: bool = False) -> Trajectories:
    """One particle with physics, and systematic errors if any, of the prior, to which nothing has been done yet."""
    physics = normal((1, PHYSICS + NUMBERS * systematic), generator=random, dtype=torch.float64)
    none, history = pose.new_zeros(1, 0), History.empty(3 if len(pose) == 3 else 4)
    return Trajectories(physics, none[..., None].expand(1, 0, NOISE), pose[None, None], none, history, pose[None])


def drawn_push(
    model: Pushed,
    own: PoseTrajectorySettings,
    truth: Trajectories,
    path: Float[Tensor, "K 2 T"],
    pads: Float[Tensor, "m 3"],
    random: torch.Generator,
) -> tuple[Segment, Trajectories]:
    """A push of a segment that is an action of its own, with motion and readings of the model; and the truth then.

    Args:
        model: object and tool.
        own: motion prior and sensors.
        truth: one particle.
        path: of the tool.
        pads: points that feel or not, tool frame; in the plane with heights from the object's origin.
        random: of the draws.
    """
    instants, count = len(path), len(pads)
    after = path[:, 1]
    place = after[:, None, :2] + rotated(pads[:, :2], after[:, None, 2])
    height = pads[:, 2] + (after[:, None, 3] if path.shape[-1] == 4 else torch.zeros_like(after[:, :1]))
    points = torch.cat((place, height[..., None]), -1).reshape(-1, 3)
    when = torch.arange(instants).repeat_interleave(count)
    clear = torch.full_like(when, int(Kind.PAD_CLEAR))
    segment = Segment(path, True, points, when, clear, torch.ones(len(when), dtype=torch.float64))
    noise = normal((1, 1, NOISE), generator=random, dtype=torch.float64)
    track = [truth.pose]
    # instant by instant, so that the pose at each is there to draw readings from; they share the segment's noise
    for step in path:
        alone = Segment(step[None], True, points[:0], when[:0], when[:0], points[:0, 0])
        moved = replace(
            truth, noise=noise, poses=track[-1][:, None].repeat(1, 2, 1), log_likelihood=points.new_zeros(1, 1)
        )
        history = History.empty(path.shape[-1]).appended(alone)
        track.append(moved.replayed(model, own, history, torch.zeros(1, dtype=torch.long)).pose)
    taken, errors = track[1:], None
    if own.systematic:
        errors = SystematicErrors.of(own, truth.systematic)
        taken = [errors.felt(pose, tool) for pose, tool in zip(taken, after, strict=True)]
    inverse = se3.inverse(model.world_T_object(torch.cat(taken))).repeat_interleave(count, 0)
    local = se3.apply(inverse, points[:, None])[:, 0]
    local = local if errors is None else errors.of_the_model(local[None], model.resting_m)[0]
    distance = model.sdf.distance(local.to(model.sdf.bounds)).double()
    distance = distance if errors is None else errors.size * distance + errors.worn_m
    feels = own.outliers + (1.0 - 2.0 * own.outliers) * torch.sigmoid((own.pad_m - distance) / own.pad_slope_m)
    felt = torch.rand(len(feels), generator=random, dtype=torch.float64) < feels
    segment = segment._replace(kind=torch.where(felt, int(Kind.PAD_FELT), clear))
    history = truth.history.appended(segment)
    truth = replace(
        truth,
        noise=torch.cat((truth.noise, noise), 1),
        poses=torch.cat((truth.poses, track[-1][:, None]), 1),
        log_likelihood=points.new_zeros(1, len(history)),
        history=history,
    )
    return segment, truth
