"""Greedily shortest way to a touch that tells, by someone who knows where the object truly is.

The tool keeps to a plane, and its way is the shortest on a lattice of its places round the object. Of the places where
its pads would touch the object it goes to the nearest one whose touch, as the pose truly is, raises the log probability
that the belief has near the truth by at least half of what any touch would. Where none tells anything it goes to the
nearest. It knows the truth, which no robot does, and nothing of what a push does: where touches have to bring the
object nearer it is no bound.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from torch import Tensor

from rumi.belief.particles import subsample
from rumi.information.resolved_information import pose_kernel
from rumi.planning.policy import Plan, PlanRequest
from rumi.robot.tool import Tool
from sdf import se3
from sdf.object_model import ObjectModel
from sdf.posed import posed_distance

SPACING_M, OUTLINE_M = 0.01, 0.01  # of the tool's places, of its points
NEAR_M, FINE_M = 0.002, 1e-4  # distance that counts as a touch; what it has to be deeper by than one that is there
PARTICLES, RARE = 60, 0.02  # that stand for the belief; share of it that foresees even what none does
POSITION_M, ROTATION_RAD, LEAST = 0.006, 0.12, 1e-3  # what is near the truth; share of the belief that always is
TURNS = (-1.0, 0.0, 1.0)  # of the tool on its way, in parts of what one action may turn it
SHARE, LEAST_NATS = 0.5, 0.1  # of what the best touch tells; what counts as telling
FELT = 1  # places by which two first contacts on one way are the same
_STEPS = ((1, 0), (0, 1), (1, 1), (1, -1))


@dataclass(frozen=True)
class _Lattice:
    """Lattice of the tool's places, how many along x and y, and which are free."""

    nodes: Float[Tensor, "V 2"]
    shape: tuple[int, int]
    free: Bool[np.ndarray, "V"]

    def straight(self, one: Float[Tensor, "3"], other: Float[Tensor, "3"]) -> bool:
        """Whether the places between two are free; the last need not be."""
        between = torch.lerp(one[:2], other[:2], torch.linspace(0.0, 1.0, 10)[1:, None].to(one))
        column, row = ((between - self.nodes[0]) / SPACING_M).round().long().unbind(-1)
        number = column * self.shape[1] + row
        return bool((self.free[number.numpy()] | (number == number[-1]).numpy()).all())


@dataclass(frozen=True)
class _Touch:
    """Touch at the end of a way.

    Attributes:
        nats: that it adds to the log probability near the truth.
        actions: of the way.
        way: places on the lattice.
        lattice: of the tool's places; None for a way of one place.
        step_m: way of an action along an axis, at most.
    """

    nats: float
    actions: int
    way: Float[Tensor, "W 3"]
    lattice: _Lattice | None = None
    step_m: float = 0.0

    def places(self) -> Float[Tensor, "A1 3"]:
        """Places after each action, the present one first: each straight, and as long as may be."""
        places, k = [self.way[0]], 0
        while self.lattice is not None and k + 1 < len(self.way):
            far = (self.way[k + 1 :, :2] - places[-1][:2]).abs().amax(-1)
            near = [k + 1 + j for j in (far <= self.step_m + 1e-6).nonzero()[:, 0].tolist()]
            k = next((j for j in reversed(near) if self.lattice.straight(places[-1], self.way[j])), k + 1)
            places.append(self.way[k])
        return torch.stack(places)


class ShortestTouchPolicy:
    """Goes the shortest way to a touch that tells. A `Policy` that is told the truth.

    Args:
        truth: (4, 4) world_T_object at this instant.
    """

    def __init__(self, truth: Callable[[], Tensor]) -> None:
        self.truth = truth

    @torch.no_grad()
    def act(self, request: PlanRequest) -> Plan:
        """The way there, which is gone on with until something is felt; see `rumi.planning.policy.Policy`."""
        scene, few = request.scene, subsample(request.belief, PARTICLES)
        before, done = request.previous, request.executed
        felt = scene.reading is not None and bool(scene.reading.in_contact.any())
        if before is not None and done < len(before.controls) and not felt:
            return replace(before, controls=before.controls[done:], path=before.path[done:])
        tool, like = scene.tool, scene.workspace.points
        here, poses = scene.configuration.to(like), few.world_T_object.to(like)
        all_poses = torch.cat((self.truth().to(like)[None], poses))
        kernel = pose_kernel(all_poses, scene.model.symmetries, position_m=POSITION_M, rotation_rad=ROTATION_RAD)
        weights, near = few.log_weights.to(like).softmax(-1), kernel[0, 1:]
        found = [
            touch
            for part in TURNS
            for touch in _touches(tool, scene.model, here, part * float(tool.scale[2]), all_poses, weights, near)
        ]
        most = max((touch.nats for touch in found), default=0.0)
        telling = [touch for touch in found if touch.nats >= (SHARE * most if most > LEAST_NATS else -math.inf)]
        nearest = min(telling, key=lambda touch: (touch.actions, -touch.nats), default=_Touch(0.0, 0, here[None]))
        places = torch.cat((here[None], nearest.places()[1:]))  # it turns in the first action
        controls = (torch.diff(places, dim=0) / tool.scale.to(like)).clamp(-1.0, 1.0)
        if len(controls) == 0:
            controls = torch.zeros(1, 3).to(like)
        ends = tool.free_path(here, controls, 1)
        return Plan(controls, torch.cat((here[None], ends)), info={"nats": nearest.nats})


def _touches(
    tool: Tool,
    model: ObjectModel,
    here: Float[Tensor, "3"],
    turn: float,
    poses: Float[Tensor, "N1 4 4"],
    weights: Float[Tensor, "N"],
    near: Float[Tensor, "N"],
) -> list[_Touch]:
    """Touches that the tool gets to with one turn.

    Args:
        tool: that keeps to a plane.
        model: of the object.
        here: configuration now.
        turn: of the tool on its way, rad.
        poses: the true one, then those of the belief.
        weights: of the latter.
        near: how near these are to the true one, 1 for the same.
    """
    nodes, shape = _lattice(tool, here)
    places = torch.cat((nodes, (here[2] + turn).expand(len(nodes), 1)), -1)
    start = int((nodes - here[:2]).norm(dim=-1).argmin())
    allowed = tool.within_limits(places)

    def met(outline: Tensor, poses: Tensor) -> Tensor:
        apart = _distances(tool, model, outline, places, poses)
        # what is touched now may be let go of, but not by a turn
        return apart < ((apart[start] - FINE_M).clamp_max(NEAR_M) if turn == 0 else NEAR_M)

    blocked, felt = met(tool.shape.outline(OUTLINE_M), poses[:1])[:, 0], met(tool.shape.pad_section(OUTLINE_M), poses)
    if bool(blocked[start]):
        return []
    lattice = _Lattice(nodes, shape, (allowed & ~blocked).numpy())
    lengths, before = _shortest(lattice, (allowed & felt[:, 0]).numpy(), start)
    step_m, found = float(tool.scale[0]), list[_Touch]()
    for end in np.flatnonzero(allowed.numpy() & felt[:, 0].numpy() & np.isfinite(lengths)):
        way = _back(before, start, int(end))
        told = felt[way]
        first = torch.where(told.any(0), told.byte().argmax(0), len(way) + FELT)
        left = weights * ((first[1:] - first[0]).abs() <= FELT)
        share = float(left @ near) / max(float(left.sum()), RARE)
        actions = max(math.ceil(float(lengths[end]) * SPACING_M / step_m - 1e-6), 1)
        found.append(
            _Touch(math.log((share + LEAST) / (float(weights @ near) + LEAST)), actions, places[way], lattice, step_m)
        )
    return found


def _lattice(tool: Tool, here: Float[Tensor, "3"]) -> tuple[Float[Tensor, "V 2"], tuple[int, int]]:
    """Places of the tool about its present one within its bounds, and how many along x and y."""
    low, high = tool.bounds.to(here)
    axes = [
        here[k]
        + SPACING_M
        * torch.arange(
            -math.floor(float(here[k] - low[k]) / SPACING_M), math.floor(float(high[k] - here[k]) / SPACING_M) + 1
        )
        for k in range(2)
    ]
    grid = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)
    return grid.reshape(-1, 2).to(here), (len(axes[0]), len(axes[1]))


def _distances(
    tool: Tool,
    model: ObjectModel,
    outline: Float[Tensor, "P 2"],
    places: Float[Tensor, "V 3"],
    poses: Float[Tensor, "N 4 4"],
) -> Float[Tensor, "V N"]:
    """Distance of points of the tool at each place from the object at each pose, metres."""
    level = torch.cat((outline, torch.zeros(len(outline), 1)), -1).to(places)
    points = se3.apply(tool.pose(places), level.expand(len(places), -1, 3))
    apart = posed_distance(model.sdf, poses, points.reshape(-1, 3))
    return apart.reshape(len(poses), len(places), -1).amin(-1).T


def _shortest(
    lattice: _Lattice, touches: Bool[np.ndarray, "V"], start: int
) -> tuple[Float[np.ndarray, "V"], Int[np.ndarray, "V"]]:
    """Length of the shortest way to each place, in places, and the place before it; ways end where they touch.

    A control bounds each axis of its own, so that a step across is as long as one along an axis.
    """
    free, shape = lattice.free, lattice.shape
    number = np.arange(free.size).reshape(shape)
    rows, columns = list[np.ndarray](), list[np.ndarray]()
    for dx, dy in _STEPS:
        one = number[: shape[0] - dx, max(0, -dy) : shape[1] - max(0, dy)].ravel()
        other = one + dx * shape[1] + dy
        for first, second in ((one, other), (other, one)):
            kept = free[first] & (free[second] | touches[second])
            rows.append(first[kept])
            columns.append(second[kept])
    row, column = np.concatenate(rows), np.concatenate(columns)
    # a little dearer across, so that of equally long ways the straight one is found
    across = (np.abs(row - column) != 1) & (np.abs(row - column) != shape[1])
    graph = csr_array((1.0 + 1e-3 * across, (row, column)), shape=(free.size, free.size))
    lengths, before = dijkstra(graph, indices=start, return_predecessors=True)
    return lengths, before


def _back(before: Int[np.ndarray, "V"], start: int, end: int) -> list[int]:
    """Places of the way from the start to an end."""
    way = [end]
    while way[-1] != start:
        way.append(int(before[way[-1]]))
    return way[::-1]
