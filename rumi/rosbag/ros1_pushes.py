"""Pushes of a ROS 1 bag: the tip, the block and the wrench at common instants, in one frame."""

from collections import defaultdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.errors import UsageError
from rumi.rosbag.frames import Edge
from rumi.rosbag.source import BagError, BagSource
from sdf import se3, so3

_GAP_NS = 300_000_000  # over which transforms are interpolated


class PushRecording(NamedTuple):
    """What a bag tells of pushes, at the instants at which the block was tracked and all is known.

    Attributes:
        time_s: (n), from the first instant on.
        tip: (n, 3), place of the fingertip, metres.
        block: (n, 4, 4), pose of the block.
        wrench: (n, 6), force and moment on the tip as its sensor gives them, turned to the axes of the frame, N, N m.
    """

    time_s: Float[Tensor, "n"]
    tip: Float[Tensor, "n 3"]
    block: Float[Tensor, "n 4 4"]
    wrench: Float[Tensor, "n 6"]


def read_pushes(
    bag: Path, *, frame: str = "map", tip: str = "/tip_pose", block: str = "/vicon/", wrench: str = "/netft_data"
) -> PushRecording:
    """Read a ROS 1 bag.

    Args:
        bag: file.
        frame: in which poses are given; what names no frame of its own is in it.
        tip: topic of the fingertip's PoseStamped.
        block: topic of the block's TransformStamped, or how it begins.
        wrench: topic of the WrenchStamped.

    Raises:
        UsageError: there is no such bag, a topic is not in it, or nothing ties its frame to `frame`.
        ModuleNotFoundError: rosbags is not installed.
    """
    source = BagSource(bag)
    wanted = {"PoseStamped": tip, "TransformStamped": block, "WrenchStamped": wrench}
    rows: dict[str, list[tuple[int, str, list[float]]]] = defaultdict(list)
    moves: dict[tuple[str, str], list[tuple[int, list[float]]]] = defaultdict(list)
    try:
        for found in source.messages():
            kind = found.kind.rsplit("/", 1)[-1]
            if kind == "TFMessage":
                for told in source.unpack(found).transforms:
                    pair = _name(told.child_frame_id), _name(told.header.frame_id)
                    moves[pair].append((_stamp(told), _numbers(told.transform)))
            elif found.topic.startswith(wanted.get(kind, "\0")):
                message = source.unpack(found)
                value = getattr(message, {"PoseStamped": "pose", "TransformStamped": "transform"}.get(kind, "wrench"))
                rows[kind].append((_stamp(message), _name(message.header.frame_id) or frame, _numbers(value)))
    except BagError as error:
        raise UsageError(f"Expected a ROS 1 bag in {bag}, got: {error}") from None
    lacking = [f"{wanted[kind]} ({kind})" for kind in wanted if not rows[kind]]
    if lacking:
        raise UsageError(f"Expected {', '.join(lacking)} in {bag}: name the bag's own topics")
    edges = {child: _edge(parent, told) for (child, parent), told in moves.items()}
    times = {kind: torch.tensor([row[0] for row in own]) for kind, own in rows.items()}
    low, high = (max(int(t[0]) for t in times.values()), min(int(t[-1]) for t in times.values()))
    at = times["TransformStamped"].unique()
    at = at[(at >= low) & (at <= high)]
    if not len(at):
        raise UsageError(f"Expected tip, block and wrench at the same time in {bag}, got none")
    known = torch.ones(len(at), dtype=torch.bool)
    ties = {}
    for kind, own in rows.items():
        ties[kind], sure = _to_frame(own[0][1], frame, edges, at)
        known &= sure
    tips, turned = (_between(rows[kind], at) for kind in ("PoseStamped", "WrenchStamped"))
    order = times["TransformStamped"].argsort()
    blocks = torch.tensor([row[2] for row in rows["TransformStamped"]], dtype=torch.float64)[order]
    block_edge = Edge("", times["TransformStamped"][order], _poses(blocks))
    poses, sure = block_edge.at(at, _GAP_NS)
    known &= sure
    axes = ties["WrenchStamped"][:, None, :3, :3]
    turned = (axes @ turned.view(-1, 2, 3)[..., None])[..., 0].reshape(-1, 6)
    whole = (
        (at - at[0]).double() / 1e9,
        se3.apply(ties["PoseStamped"], tips[:, None, :3])[:, 0],
        se3.compose(ties["TransformStamped"], poses),
        turned,
    )
    return PushRecording(*(part[known] for part in whole))


def _name(frame: str) -> str:
    return frame.lstrip("/")


def _stamp(message: Any) -> int:  # noqa: ANN401  (a message's class is made when a bag is read)
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)


def _numbers(value: Any) -> list[float]:  # noqa: ANN401
    """Place and quaternion (x, y, z, w), or force and moment."""
    if hasattr(value, "force"):
        return [float(getattr(part, axis)) for part in (value.force, value.torque) for axis in "xyz"]
    place, turn = (
        (value.position, value.orientation) if hasattr(value, "position") else (value.translation, value.rotation)
    )
    return [float(getattr(place, axis)) for axis in "xyz"] + [float(getattr(turn, axis)) for axis in "xyzw"]


def _poses(rows: Float[Tensor, "n 7"]) -> Float[Tensor, "n 4 4"]:
    turn = rows[:, 3:] / rows[:, 3:].norm(dim=-1, keepdim=True).clamp_min(1e-12)
    vector, scalar = turn[:, :3], turn[:, 3:]
    size = vector.norm(dim=-1, keepdim=True)
    angle = 2.0 * torch.atan2(size, scalar)
    return se3.make(so3.exp(torch.where(size > 1e-12, angle / size.clamp_min(1e-12), 2.0) * vector), rows[:, :3])


def _edge(parent: str, told: list[tuple[int, list[float]]]) -> Edge:
    told = sorted({stamp: numbers for stamp, numbers in told}.items())
    return Edge(parent, torch.tensor([row[0] for row in told]), _poses(torch.tensor([r[1] for r in told]).double()))


def _to_frame(name: str, frame: str, edges: dict[str, Edge], at: Tensor) -> tuple[Tensor, Tensor]:
    """Transforms from a frame to another that is above it, and which are known."""
    whole, known = torch.eye(4, dtype=torch.float64).expand(len(at), 4, 4), torch.ones(len(at), dtype=torch.bool)
    for _ in range(len(edges) + 1):
        if name == frame:
            return whole, known
        if name not in edges:
            break
        poses, sure = edges[name].at(at, _GAP_NS)
        whole, known, name = se3.compose(poses, whole), known & sure, edges[name].parent
    raise UsageError(f"Expected transforms that tie all to the frame {frame}, got none from {name}")


def _between(rows: list[tuple[int, str, list[float]]], at: Tensor) -> Float[Tensor, "n c"]:
    stamps = np.array([row[0] for row in rows])
    order = np.argsort(stamps, kind="stable")
    values = np.array([row[2] for row in rows])[order]
    seconds, base = at.numpy() - stamps[order][0], stamps[order][0]
    columns = [np.interp(seconds, stamps[order] - base, column) for column in values.T]
    return torch.tensor(np.stack(columns, -1))
