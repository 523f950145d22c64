"""Segments of a history from a reading: what pads felt and did not feel, what was seen, what was free."""

import itertools
import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rumi.belief.pushed_model import Pushed
from rumi.belief.sensed_motion import motion_of
from rumi.belief.trajectory_history import History, Kind, Segment
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from sdf import se3
from sdf.posed import posed_distance
from sensors.observation import Observation, observation_keys
from sensors.reading import FORCE, Reading
from sensors.semantics import Semantics

_NEAR_M = 0.012  # of a particle's surface: what is farther from all of them tells none from another
_OWN = 0.6  # of the pads' spacing: a felt point this near is a pad point's own
_STRIDE = 4  # of the pads' points one is looked at, and counts for as many


def standing(
    observation: Observation,
    poses: Float[Tensor, "N D"],
    model: Pushed,
    own: PoseTrajectorySettings,
    taken: History | None = None,
) -> Segment | None:
    """What was seen and free while the object stood still; None where that is nothing new.

    Args:
        observation: points, world frame.
        poses: that the object may have.
        model: object and tool.
        own: of the sensors.
        taken: free cells of this history since its last push are not counted again.
    """
    seen = _from_origin(observation.points[observation.of_class(Semantics.SURFACE)].double(), model)
    near = _about(observation.points, poses, model) & observation.of_class(Semantics.FREE)
    free = _from_origin(observation.points[near].double(), model)
    if taken is not None and len(free):
        since = taken.since_push()
        old = taken.points[since[taken.kind[since] == Kind.FREE]]
        free = free[~torch.isin(_cells(free, own), _cells(old, own))]
    if len(free):
        free = free[_distance(model, poses, free).amin(0) < _NEAR_M]
    if not len(seen) + len(free):
        return None
    share = 1.0 if taken is None else own.later_share
    worth = share * own.seen_points
    if len(seen):  # a view: each cell that it sees through is news of a silhouette
        each_free, most_free = share * min(own.free_weight, own.free_points / max(1, len(free))), own.free_most
    else:  # what the tool went through, which is off by the same all the way
        each_free, most_free = min(own.free_weight, worth / max(1, len(free))), own.most[1]
    parts = []
    for points, kind, each, most in (
        (seen, Kind.SEEN, worth / max(1, len(seen)), own.most[0]),
        (free, Kind.FREE, each_free, most_free),
    ):
        kept, counts = _thinned(len(points), math.ceil(share * most))
        if len(seen):  # the first few of a view's points tell about what all of them do
            kept = kept[_scattered(len(kept))]
        parts.append((points[kept], torch.full((len(kept),), int(kind)), torch.full((len(kept),), each * counts)))
    points, kinds, weights = (torch.cat(part) for part in zip(*parts, strict=True))
    still = torch.zeros(1, 2, model.path(se3.identity((1,))).shape[-1], dtype=torch.float64)
    return Segment(still, False, points, torch.zeros(len(points), dtype=torch.long), kinds, weights.double())


def cut(
    reading: Reading, own: PoseTrajectorySettings, lifted: Bool[Tensor, "K"] | None = None
) -> list[Int[Tensor, "k"]]:
    """Instants of each segment of an action: what is before contact, a few at a time, and what is after it.

    A segment has the tool lifted throughout, or nowhere.
    """
    touched, count = reading.in_contact.nonzero()[:, 0], len(reading.in_contact)
    bounds = {0, count}
    if lifted is not None:
        bounds |= {*(lifted.int().diff().nonzero()[:, 0] + 1).tolist()}
    if len(touched):
        first, last = int(touched[0]), int(touched[-1])
        bounds |= {*range(first, last + 1, own.instants), last + 1}
    ordered = sorted(bounds)
    return [torch.arange(low, high) for low, high in itertools.pairwise(ordered)]


def path_of(reading: Reading, model: Pushed) -> Float[Tensor, "K 2 T"]:
    """Where the tool was before and after each instant; the way to the first one is not reported.

    Nor is that of an instant to which it is lowered: from above it pushes nothing.
    """
    tool, lifted = model.path(reading.tool_pose), model.lifted(reading.tool_pose)
    before = torch.cat((tool[:1], tool[:-1]))
    lowered = torch.cat((lifted[:1], lifted[:-1])) & ~lifted
    return torch.stack((torch.where(lowered[:, None], tool, before), tool), 1)


def felt_pads(reading: Reading, model: Pushed, own: PoseTrajectorySettings) -> Bool[Tensor, "K m"]:
    """Which of the pads' points felt something at each instant, from the felt points that were reported."""
    found = torch.zeros(len(reading.in_contact), len(model.pads), dtype=torch.bool)
    surface, near = reading.observation.of_class(Semantics.SURFACE), _OWN * own.pad_spacing_m
    for instant in reading.in_contact.nonzero()[:, 0].tolist():
        there = reading.observation.points[surface & (reading.instant == instant)].double()
        if len(there):
            back = se3.apply(se3.inverse(reading.tool_pose[instant].double()), there)
            some = _between(model.reported, back, near)
            found[instant, some] = torch.cdist(model.reported[some], back).amin(-1) < near
    return found


def seen_besides(reading: Reading, model: Pushed, own: PoseTrajectorySettings) -> Observation:
    """Surface points of an action's last instant that the pads are not at: what a camera saw then.

    None where a wrench tells points that may be off the tool.
    """
    there = reading.observation
    if own.lone:
        return there[torch.zeros(0, dtype=torch.long)]
    last = there.of_class(Semantics.SURFACE) & (reading.instant == len(reading.in_contact) - 1)
    return besides(there[last.nonzero()[:, 0]], reading.tool_pose[-1], model, own)


def besides(
    points: Observation, tool_pose: Float[Tensor, "4 4"], model: Pushed, own: PoseTrajectorySettings
) -> Observation:
    """Those points that the pads of a tool are not at."""
    back, near = se3.apply(se3.inverse(tool_pose.double()), points.points.double()), _OWN * own.pad_spacing_m
    apart = torch.ones(len(back), dtype=torch.bool)
    about = _between(back, model.reported, near)
    apart[about] = torch.cdist(back[about], model.reported).amin(-1) >= near
    return points[apart.nonzero()[:, 0]]


def _between(points: Float[Tensor, "M 3"], others: Float[Tensor, "m 3"], near: float) -> Int[Tensor, "k"]:
    """The points in a box about others that is so much larger on every side."""
    low, high = others.amin(0) - near, others.amax(0) + near
    return ((points > low) & (points < high)).all(-1).nonzero()[:, 0]


def pushed(
    reading: Reading,
    instants: Int[Tensor, "k"],
    path: Float[Tensor, "K 2 T"],
    felt: Bool[Tensor, "K m"],
    tracks: Float[Tensor, "N k D"],
    model: Pushed,
    own: PoseTrajectorySettings,
) -> Segment:
    """One segment of an action with contact.

    Args:
        reading: of the action.
        instants: of the segment.
        path: of the tool, of all instants.
        felt: by the pads, at all instants.
        tracks: where the object may be at these instants, for choosing points that tell.
        model: object and tool.
        own: of the sensors.
    """
    stride = _STRIDE if len(model.pads) > 4 * _STRIDE else 1
    some, fresh = model.pads[::stride], _fresh(path, own)[instants]
    places = _from_origin(se3.apply(reading.tool_pose[instants].double(), some), model)
    bits = felt[instants][:, ::stride]
    tells = bits | (_distance(model, tracks.movedim(1, 0), places).amin(1) < _NEAR_M)
    if own.lone:
        tells &= ~reading.in_contact[instants][:, None]
    at, which = tells.nonzero(as_tuple=True)
    kept, counts = _thinned(len(at), own.most[3])
    at, which = at[kept], which[kept]
    kind = torch.where(bits[at, which], int(Kind.PAD_FELT), int(Kind.PAD_CLEAR))
    if own.missed > 0:
        pad = (model.pads[:, 1] > 0).long()  # one lies on either side of the tool's middle
        silent = torch.stack([~felt[instants][:, pad == side].any(-1) for side in (0, 1)], -1)
        kind = torch.where(silent[at, pad[::stride][which]], int(Kind.PAD_SILENT), kind)
    pads = places[at, which], at, kind, own.pad_weight * stride * counts * fresh[at]
    at, which = felt[instants].nonzero(as_tuple=True)
    if own.lone:
        at, there = _touches(reading, instants, path, model)
    else:
        there = _from_origin(
            se3.apply(reading.tool_pose[instants[at]].double(), model.pads[which][:, None])[:, 0], model
        )
    kept, counts = _thinned(len(at), own.most[2])
    each = fresh * own.felt_weight * counts / torch.bincount(at, minlength=len(instants)).clamp_min(1).double()
    at, there = at[kept], there[kept]
    touched = there, at, torch.full((len(at),), int(Kind.FELT)), each[at]
    points, instant, kinds, weights = (torch.cat(part) for part in zip(pads, touched, strict=True))
    order = (2 * instant + (kinds == Kind.PAD_SILENT)).argsort(stable=True)  # what is silent comes last
    force = _mean_force(reading, instants, path, own)
    motion = motion_of(reading, instants)
    return Segment(path[instants], True, points[order], instant[order], kinds[order], weights[order], force, motion)


def _touches(
    reading: Reading, instants: Int[Tensor, "k"], path: Float[Tensor, "K 2 T"], model: Pushed
) -> tuple[Int[Tensor, "M"], Float[Tensor, "M 3"]]:
    """Touched points of some instants, each by its place among them: the middle of a round tool, else as reported.

    They are no higher or lower than the object is.
    """
    _, low, high = model.extent_m
    middle = model.middle(path[instants, 1])
    if middle is not None:
        at = reading.in_contact[instants].nonzero()[:, 0]
        there = middle[at]
    else:
        which = torch.full((len(reading.in_contact),), -1)
        which[instants] = torch.arange(len(instants))
        at = which[reading.instant]
        some = (reading.observation.of_class(Semantics.SURFACE) & (at >= 0)).nonzero()[:, 0]
        some = some[at[some].argsort(stable=True)]
        at, there = at[some], _from_origin(reading.observation.points[some].double(), model)
    return at, torch.cat((there[:, :2], there[:, 2:].clamp(low, high)), -1)


def _fresh(path: Float[Tensor, "K 2 T"], own: PoseTrajectorySettings) -> Float[Tensor, "K"]:
    """Share by which each instant's pads tell something new: that of a way of the tool after which they tell all.

    The way to the first instant is not reported, and taken to be that to the second.
    """
    if not own.fresh_m or len(path) < 2:
        return torch.ones(len(path), dtype=torch.float64)
    step = path[:, 1] - path[:, 0]
    way = step[:, [0, 1, *range(3, step.shape[1])]].norm(dim=-1) + own.m_per_rad * step[:, 2].abs()
    return (torch.cat((way[1:2], way[1:])) / own.fresh_m).clamp_max(1.0)


def _mean_force(
    reading: Reading, instants: Int[Tensor, "k"], path: Float[Tensor, "K 2 T"], own: PoseTrajectorySettings
) -> Float[Tensor, "3"] | None:
    """Mean force on the object along the tool's way in contact, and what it is worth; None where it tells nothing.

    The force's own error adds to that of its direction, so that a faint one is worth little.
    """
    if FORCE not in reading.measurements or own.force_per_m == 0:
        return None
    on_tool = reading.measurements[FORCE][instants].double()
    known = on_tool.isfinite().all(-1) & reading.in_contact[instants]
    way = (path[instants, 1] - path[instants, 0])[:, :2].norm(dim=-1) * known
    force = -(way @ on_tool.nan_to_num()) / way.sum().clamp_min(1e-12)
    size = float(force[:2].norm())
    if not size > 0:
        return None
    sure = 1.0 / (1.0 + (own.force_n / (size * own.force_rad)) ** 2)
    return torch.cat((force[:2], own.force_per_m * sure * way.sum()[None]))


def above(path: Float[Tensor, "k 2 T"]) -> Segment:
    """Instants at which a lifted tool neither pushes nor senses."""
    none = torch.zeros(0, dtype=torch.long)
    points: Float[Tensor, "0 3"] = torch.zeros(0, 3, dtype=torch.float64)
    return Segment(path, False, points, none, none, points[:, 0])


def until_felt(segment: Segment) -> Segment | None:
    """What a segment's pads sensed up to the first instant in which they felt something, as of an object at rest."""
    felt = segment.instant[segment.kind == Kind.PAD_FELT]
    if not len(felt):
        return None
    some = segment.instant <= felt.min()
    points, kind, weight = segment.points[some], segment.kind[some], segment.weight[some]
    return Segment(segment.tool[:1], False, points, torch.zeros_like(kind), kind, weight)


def _from_origin(points: Float[Tensor, "*b 3"], model: Pushed) -> Float[Tensor, "*b 3"]:
    """The same with heights counted from the object's origin."""
    return points - points.new_tensor((0.0, 0.0, model.resting_m))


def _distance(
    model: Pushed, poses: Float[Tensor, "*b N D"], points: Float[Tensor, "*b M 3"]
) -> Float[Tensor, "*b N M"]:
    like = model.sdf.bounds
    with torch.no_grad():
        return posed_distance(model.sdf, model.world_T_object(poses).to(like), points.to(like)).double()


def _about(points: Float[Tensor, "M 3"], poses: Float[Tensor, "N D"], model: Pushed) -> Bool[Tensor, "M"]:
    """Which points, world frame, may be near a pose's surface: those in a box about all poses, whatever their yaw."""
    far, low, high = model.extent_m
    beside, up = far + _NEAR_M, poses.new_tensor([model.resting_m])
    lower = torch.cat((poses[:, :2].amin(0) - beside, up + low - _NEAR_M)).to(points)
    upper = torch.cat((poses[:, :2].amax(0) + beside, up + high + _NEAR_M)).to(points)
    near = torch.ones(len(points), dtype=torch.bool)
    for axis in range(3):
        near &= (points[:, axis] >= lower[axis]) & (points[:, axis] <= upper[axis])
    return near


def _cells(points: Float[Tensor, "M 3"], own: PoseTrajectorySettings) -> Int[Tensor, "M"]:
    spacing = torch.full((3,), own.free_cell_m, dtype=torch.float64)
    return observation_keys(Observation.of(points, Semantics.FREE), spacing)


def _thinned(count: int, most: int) -> tuple[Int[Tensor, "k"], float]:
    """Every so many of some points, and what each of them then stands for."""
    kept = min(count, most)
    index = ((torch.arange(kept, dtype=torch.float64) + 0.5) * (count / max(1, kept))).long()
    return index, count / max(1, kept)


def _scattered(count: int) -> Int[Tensor, "count"]:
    """An order in which the first of any number lie evenly among all: by multiples of the golden ratio."""
    return (torch.arange(count, dtype=torch.float64) * (0.5 * (math.sqrt(5.0) - 1.0)) % 1.0).argsort()
