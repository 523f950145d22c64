"""Frame tree over time: a recording's transforms, composed along the tree and interpolated between stamps."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rumi.errors import UsageError
from rumi.rosbag.mapping import BagMap
from sdf import se3, so3
from sdf.check import check_near
from sensors.log.reader import Log


@dataclass(frozen=True)
class Edge:
    """Transform of a frame to its parent over time.

    Attributes:
        parent: its name.
        stamps_ns: (n), rising; none for a transform that never changes.
        poses: (n, 4, 4), parent_T_child, float64; one for a transform that never changes.
    """

    parent: str
    stamps_ns: Int[Tensor, "n"]
    poses: Float[Tensor, "m 4 4"]

    def at(self, stamps_ns: Int[Tensor, "K"], gap_ns: int) -> tuple[Float[Tensor, "K 4 4"], Bool[Tensor, "K"]]:
        """Poses at some times, and which of them are known: those between two that are no farther apart than a gap."""
        if len(self.stamps_ns) == 0:
            return self.poses.expand(len(stamps_ns), 4, 4), torch.ones(len(stamps_ns), dtype=torch.bool)
        last = len(self.stamps_ns) - 1
        after = torch.searchsorted(self.stamps_ns, stamps_ns).clamp(0, last)
        before = torch.where(self.stamps_ns[after] == stamps_ns, after, (after - 1).clamp_min(0))
        low, high = self.stamps_ns[before], self.stamps_ns[after]
        # where a recording begins or ends the next pose counts, if it is near
        inside = (low <= stamps_ns) & (stamps_ns <= high) & (high - low <= gap_ns)
        near = torch.minimum((stamps_ns - low).abs(), (stamps_ns - high).abs()) <= gap_ns // 10
        part = ((stamps_ns - low).double() / (high - low).clamp_min(1).double()).clamp(0.0, 1.0)
        start, end = self.poses[before], self.poses[after]
        turn = so3.log(start[:, :3, :3].mT @ end[:, :3, :3])
        rotation = start[:, :3, :3] @ so3.exp(part[:, None] * turn)
        place = start[:, :3, 3] + part[:, None] * (end[:, :3, 3] - start[:, :3, 3])
        return se3.make(rotation, place), inside | near


class FrameTree:
    """Tree of coordinate frames over time.

    Args:
        edges: by child.
        world: the frame that poses are asked in, but for its origin.
        origin_w: (3,), metres in `world`, the origin of the poses that are given.
        longest_gap_s: over which poses are interpolated.

    Attributes:
        gap_ns: the longest gap, in nanoseconds.
        problems: what could not be used of a log.
    """

    def __init__(
        self,
        edges: dict[str, Edge],
        world: str,
        origin_w: Sequence[float] = (0.0, 0.0, 0.0),
        longest_gap_s: float = 0.5,
    ) -> None:
        self._edges, self.world = edges, world
        self.gap_ns = int(longest_gap_s * 1e9)
        self.problems: list[str] = []
        self._rise = se3.identity(dtype=torch.float64)
        self._rise[:3, 3] = -torch.tensor(origin_w, dtype=torch.float64)

    @classmethod
    def of_log(cls, log: Log, mapping: BagMap) -> "FrameTree":
        """The frames of a log's pose streams, with the mapping's fixed ones in the place of recorded ones."""
        edges: dict[str, Edge] = {}
        placed_by: dict[str, str] = {}
        problems: list[str] = []
        fixed = {one.child for one in mapping.fixed}
        for stream in log.streams.values():
            if stream.kind != "pose":
                continue
            if lacking := {"child", "parent"} - set(stream.about):
                raise UsageError(f"Expected stream {stream.name} to name its {min(lacking)} frame, found none")
            samples = stream.samples()
            problems += stream.problems
            child, parent = str(stream.about["child"]), str(stream.about["parent"])
            if not samples:
                continue
            poses = torch.stack([torch.tensor(sample.values["pose"]) for sample in samples])
            stamps = torch.tensor([sample.stamp_ns for sample in samples])
            finite = torch.isfinite(poses).all(-1).all(-1)
            if not bool(finite.all()):
                problems.append(f"stream {stream.name}: {int((~finite).sum())} of {len(finite)} poses are no numbers")
                poses, stamps = poses[finite], stamps[finite]
            if len(poses) == 0:
                continue
            if stream.about.get("static"):
                stamps, poses = stamps[:0], poses[-1:]
            if child in edges and child not in fixed:
                problems.append(
                    f"streams {placed_by[child]} and {stream.name} both place the frame {child}: {stream.name} counts"
                )
            edges[child], placed_by[child] = Edge(parent, stamps, poses), stream.name
        for one in mapping.fixed:
            edges[one.child] = Edge(one.parent, torch.zeros(0, dtype=torch.long), one.pose()[None])
        frames = mapping.frames
        tree = cls(edges, frames.world, (*frames.origin_m, frames.floor_z_m), frames.longest_gap_s)
        tree.problems = problems
        return tree

    def stamps(self, frame: str) -> list[Int[Tensor, "n"]]:
        """Stamps of each moving part of what connects a frame to the world, rising."""
        chain = {*self._chain(frame.strip("/")), *self._chain(self.world)}
        return [edge.stamps_ns for name, edge in self._edges.items() if name in chain and len(edge.stamps_ns)]

    def at(
        self, frame: str, stamps_ns: Sequence[int] | Int[Tensor, "K"]
    ) -> tuple[Float[Tensor, "K 4 4"], Bool[Tensor, "K"]]:
        """world_T_frame at some times, and which of them are known.

        Raises:
            UsageError: nothing connects the frame to the world (the message lists the frames), or it is so far from the
                origin that single precision cannot tell where it is.
        """
        stamps = torch.as_tensor(stamps_ns, dtype=torch.long)
        up, down = self.chains(frame)
        root_T_frame, known = self._to_root(up, stamps)
        root_T_world, also = self._to_root(down, stamps)
        pose = self._rise @ se3.inverse(root_T_world) @ root_T_frame
        try:
            check_near(f"the frame {frame!r} in {self.world!r}", pose[known & also][:, :3, 3], torch.float32)
        except ValueError as error:
            raise UsageError(f"{error}: in the mapping, frames.origin_m does that") from error
        return pose, known & also

    def chains(self, frame: str) -> tuple[list[str], list[str]]:
        """Frames from one up to the root, and from the world.

        Raises:
            UsageError: nothing connects the frame to the world; the message lists the frames.
        """
        up, down = self._chain(frame.strip("/")), self._chain(self.world)
        if up[-1] != down[-1]:
            listed = ", ".join(sorted({*self._edges, *(edge.parent for edge in self._edges.values())})) or "none"
            raise UsageError(
                f"Nothing connects the frame {frame!r} to {self.world!r}; the recording's frames are {listed}: name "
                "others, or add a [[fixed]] transform to the mapping"
            )
        return up, down

    def _chain(self, frame: str) -> list[str]:
        chain = [frame]
        while chain[-1] in self._edges:
            parent = self._edges[chain[-1]].parent
            if parent in chain:
                raise UsageError(f"Expected frames to form a tree, got the circle {' -> '.join([*chain, parent])}")
            chain.append(parent)
        return chain

    def _to_root(self, chain: Iterable[str], stamps: Tensor) -> tuple[Tensor, Tensor]:
        pose = se3.identity((len(stamps),), dtype=torch.float64)
        known = torch.ones(len(stamps), dtype=torch.bool)
        for frame in chain:
            if frame in self._edges:
                own, there = self._edges[frame].at(stamps, self.gap_ns)
                pose, known = own @ pose, known & there
        return pose, known
