"""History of a pushed object: what was done and sensed, segment by segment, in the world's frame."""

import functools
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import NamedTuple, Self

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sdf.compiled import arrays_of

NODES = 2001
"""Distances from the surface that the compiled version's log-likelihoods of a kind are a table over; odd, 0 amid."""


class Kind(IntEnum):
    """Meaning of a point."""

    SEEN = 0
    FREE = 1
    FELT = 2
    PAD_FELT = 3
    PAD_CLEAR = 4
    PAD_SILENT = 5  # clear, as all of its pad was at that instant


class Segment(NamedTuple):
    """Part of an action with what was sensed in it; world frame, float64, never re-attached.

    Attributes:
        tool: (K, 2, T), (x, y, yaw) of the tool before and after each instant; in space its height, too.
        pushes: whether the tool may push the object; else it stands still.
        points: (M, 3), heights counted from the object's origin.
        instant: (M), in ascending order.
        kind: (M), of `Kind`.
        weight: (M), independent readings that a point is worth.
        force: (3), x and y of the tool's mean force on the object, in N or any unit, and the independent readings that
            it is worth; None where none was measured.
        motion: of the object in the world from the segment's beginning to its end; None where none was sensed.
    """

    tool: Float[Tensor, "K 2 T"]
    pushes: bool
    points: Float[Tensor, "M 3"]
    instant: Int[Tensor, "M"]
    kind: Int[Tensor, "M"]
    weight: Float[Tensor, "M"]
    force: Float[Tensor, "3"] | None = None
    motion: Float[Tensor, "4 4"] | None = None


@dataclass(frozen=True, eq=False)
class History:
    """Segments one after the other: S of them, T instants, M points.

    Attributes:
        tool: (T, 2, 3), in space (T, 2, 4).
        pushes: (T).
        ends: (S), instant behind each segment's last.
        action: (S), the first segment of each one's action.
        points: (M, 3).
        kind: (M).
        weight: (M).
        point_ends: (T), point behind each instant's last.
        force: (S, 3), mean force of each segment and what it is worth; 0 where none was measured.
        motion: (S, 4, 4), sensed motion of each segment; the identity where none was sensed.
        motion_power: (S), the power to which that is raised, 0 where none was sensed.
        power: to which the last segment's readings are raised; weights have it in them.
    """

    tool: Float[Tensor, "T 2 C"]
    pushes: Bool[Tensor, "T"]
    ends: Int[Tensor, "S"]
    action: Int[Tensor, "S"]
    points: Float[Tensor, "M 3"]
    kind: Int[Tensor, "M"]
    weight: Float[Tensor, "M"]
    point_ends: Int[Tensor, "T"]
    force: Float[Tensor, "S 3"]
    motion: Float[Tensor, "S 4 4"]
    motion_power: Float[Tensor, "S"]
    power: float = 1.0

    @classmethod
    def empty(cls, numbers: int = 3) -> Self:
        """Nothing yet; of a tool's pose by 3 numbers, in space by 4."""
        none, flat = torch.zeros(0, dtype=torch.long), torch.zeros(0, dtype=torch.float64)
        tool, points, motion = flat.view(0, 2, numbers), flat.view(0, 3), flat.view(0, 4, 4)
        return cls(tool, none.bool(), none, none, points, none, flat, none, points, motion, flat)

    def __len__(self) -> int:
        """Number of segments."""
        return len(self.ends)

    @functools.cached_property
    def arrays(self) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
        """What was done and what was sensed, as the compiled version takes them: points by coordinate, float32."""
        done = self.tool, self.pushes, self.ends, self.action, self.point_ends
        sensed = self.points.T.float().flatten(), self.weight.float(), (NODES * self.kind).int()
        return arrays_of(*done), arrays_of(*sensed)

    def appended(self, segment: Segment, *, opens: bool = True) -> Self:
        """With one more segment.

        Args:
            segment: what came.
            opens: whether it is the first of its action.
        """
        count, instants = len(self), len(segment.tool)
        action = count if opens or not count else int(self.action[-1])
        counts = torch.bincount(segment.instant, minlength=instants)
        force = self.force.new_zeros(3) if segment.force is None else segment.force.to(self.force)
        sensed = segment.motion is not None
        motion = torch.eye(4).to(self.motion) if segment.motion is None else segment.motion.to(self.motion)
        return replace(
            self,
            tool=torch.cat((self.tool, segment.tool)),
            pushes=torch.cat((self.pushes, torch.full((instants,), segment.pushes))),
            ends=torch.cat((self.ends, torch.tensor([len(self.tool) + instants]))),
            action=torch.cat((self.action, torch.tensor([action]))),
            points=torch.cat((self.points, segment.points)),
            kind=torch.cat((self.kind, segment.kind)),
            weight=torch.cat((self.weight, segment.weight)),
            point_ends=torch.cat((self.point_ends, len(self.points) + counts.cumsum(0))),
            force=torch.cat((self.force, force[None])),
            motion=torch.cat((self.motion, motion[None])),
            motion_power=torch.cat((self.motion_power, self.motion_power.new_full((1,), float(sensed)))),
        )

    def tempered(self, power: float) -> Self:
        """The last segment's readings raised to a power."""
        if power == 1.0 or not len(self):
            return self
        weight, force, motion_power = self.weight.clone(), self.force.clone(), self.motion_power.clone()
        weight[self._points_before(len(self) - 1) :] *= power
        force[-1, 2] *= power
        motion_power[-1] *= power
        return replace(self, weight=weight, force=force, motion_power=motion_power, power=power)

    def unsensed(self) -> Self:
        """The same where no motion was sensed."""
        return replace(self, motion_power=torch.zeros_like(self.motion_power))

    def last(self) -> Self:
        """The last segment alone, as an action of its own."""
        alone = self.since(len(self) - 1)
        return replace(alone, action=torch.zeros_like(alone.action))

    def since(self, segment: int) -> Self:
        """The same from a segment on, which must be the first of its action."""
        first, point = (int(self.ends[segment - 1]) if segment else 0), self._points_before(segment)
        return replace(
            self,
            tool=self.tool[first:],
            pushes=self.pushes[first:],
            ends=self.ends[segment:] - first,
            action=self.action[segment:] - segment,
            points=self.points[point:],
            kind=self.kind[point:],
            weight=self.weight[point:],
            point_ends=self.point_ends[first:] - point,
            force=self.force[segment:],
            motion=self.motion[segment:],
            motion_power=self.motion_power[segment:],
        )

    def segment(self, number: int) -> Segment:
        """One of the segments, as it came."""
        first, last = (int(self.ends[at]) if at >= 0 else 0 for at in (number - 1, number))
        low, high = (int(self.point_ends[at - 1]) if at else 0 for at in (first, last))
        counts = self.point_ends[first:last].diff(prepend=torch.tensor([low]))
        return Segment(
            self.tool[first:last],
            bool(self.pushes[last - 1]),
            self.points[low:high],
            torch.arange(last - first).repeat_interleave(counts),
            self.kind[low:high],
            self.weight[low:high],
            self.force[number],
            self.motion[number] if bool(self.motion_power[number] > 0) else None,
        )

    def moving(self) -> Int[Tensor, "s"]:
        """The segments in which the object may have been pushed."""
        return self.pushes[self.ends - 1].nonzero()[:, 0]

    def pushing_yaw(self) -> float:
        """Yaw of the tool in the last instant in which it may have pushed; 0 where there is none."""
        pushing = self.pushes.nonzero()[:, 0]
        return float(self.tool[pushing[-1], 1, 2]) if len(pushing) else 0.0

    def shown(self) -> int:
        """Number of segments at the beginning of which a camera alone told."""
        begins = torch.cat((self.ends.new_zeros(1), self.point_ends[self.ends - 1]))
        told = begins[1:] > begins[:-1]
        alone = told & ~self.pushes[self.ends - 1]
        alone[told] &= self.kind[begins[:-1][told]] == Kind.SEEN
        return int(alone.long().cumprod(0).sum())

    def met(self) -> Float[Tensor, "p 2"]:
        """Middles of what was seen, and of what was felt in the first segment in which something was; world frame."""
        segment = self._segments()
        felt, seen = (self.kind == Kind.FELT) | (self.kind == Kind.PAD_FELT), self.kind == Kind.SEEN
        first = felt & (segment == (segment[felt].min() if bool(felt.any()) else 0))
        some = [self.points[part, :2].mean(0) for part in (seen, first) if bool(part.any())]
        return torch.stack(some) if some else self.points.new_zeros(0, 2)

    def since_push(self) -> Int[Tensor, "m"]:
        """The points that were sensed after the last push."""
        moving = self.moving()
        return torch.arange(self._points_before(int(moving[-1]) + 1) if len(moving) else 0, len(self.points))

    def worth(self) -> Float[Tensor, "S kinds"]:
        """Independent readings of each kind that each segment's points are worth; a force errs as felt points do."""
        segment = self._segments()
        flat = torch.zeros(len(self) * len(Kind), dtype=torch.float64)
        flat = flat.index_add_(0, len(Kind) * segment + self.kind, self.weight.double())
        flat[int(Kind.FELT) :: len(Kind)] += self.force[:, 2]
        return flat.view(len(self), len(Kind))

    def _segments(self) -> Int[Tensor, "M"]:
        """The segment of each point."""
        instant = torch.searchsorted(self.point_ends, torch.arange(len(self.points)), right=True)
        return torch.searchsorted(self.ends, instant, right=True)

    def _points_before(self, segment: int) -> int:
        """Number of points of the segments before one."""
        first = int(self.ends[segment - 1]) if segment else 0
        return int(self.point_ends[first - 1]) if first else 0
