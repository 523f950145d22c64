"""Pushes of a log: the tool's place, the block's pose and the wrench at common instants, in the mapping's world."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from rumi.errors import UsageError
from rumi.rosbag.contacts import wrench_of
from rumi.rosbag.frames import FrameTree
from rumi.rosbag.mapping import BagMap
from rumi.rosbag.streams import role_of
from sensors.log.reader import Log, Stream


class PushRecording(NamedTuple):
    """What a log tells of pushes, at the instants at which the block was tracked and all is known.

    Attributes:
        time_s: (n), from the first instant on.
        tip: (n, 3), place of the tool, metres.
        block: (n, 4, 4), pose of the block.
        wrench: (n, 6), force and moment on the tool as its sensor gives them, turned to the world's axes, N, N m.
    """

    time_s: Float[Tensor, "n"]
    tip: Float[Tensor, "n 3"]
    block: Float[Tensor, "n 4 4"]
    wrench: Float[Tensor, "n 6"]


def read_pushes(path: Path, mapping: BagMap, *, block: str) -> PushRecording:
    """Read the pushes of a log, such as `rumi import` makes of a bag.

    Args:
        path: of the log.
        mapping: what its streams mean; poses are in its world, the tip is the origin of its tool.
        block: frame of the block, whose stamps are the instants.

    Raises:
        UsageError: a frame or the wrench is not in the log, or nothing is known of all three at once.
        LogError: there is no such log.
    """
    with Log(path) as log:
        tree = FrameTree.of_log(log, mapping)
        found = [own for own in log.streams.values() if role_of(own, mapping) == "wrench"]
        if len(found) != 1:
            raise UsageError(
                f"Expected one stream with the role wrench in {path}, found {len(found)}: see `rumi import`"
            )
        stamps, wrench = _wrenches(found[0])
        at = _tracked(log, block)
        at = at[(at >= stamps[:1]) & (at <= stamps[-1:])] if len(stamps) else at[:0]
        # every frame has its say on what is known, and an unknown name is told with those that there are
        tool, sure = tree.at(mapping.frames.tool, at)
        pose, also = tree.at(block, at)
        sensor, third = tree.at(found[0].frame, at)
    known = sure & also & third
    if not bool(known.any()):
        raise UsageError(f"Expected tool, block and wrench at the same time in {path}, got none")
    at = at[known]
    columns = [np.interp((at - stamps[0]).numpy(), (stamps - stamps[0]).numpy(), column) for column in wrench.T.numpy()]
    axes = sensor[known][:, None, :3, :3]
    parts = torch.tensor(np.stack(columns, -1)).view(-1, 2, 3, 1)
    return PushRecording((at - at[0]).double() / 1e9, tool[known][:, :3, 3], pose[known], (axes @ parts).reshape(-1, 6))


def _tracked(log: Log, frame: str) -> Int[Tensor, "n"]:
    """Stamps at which a frame's own transform was recorded, rising."""
    own = (stream for stream in log.streams.values() if stream.kind == "pose" and stream.about.get("child") == frame)
    stamps = [sample.stamp_ns for stream in own for sample in stream.samples()]
    return torch.tensor(stamps, dtype=torch.long).unique()


def _wrenches(stream: Stream) -> tuple[Int[Tensor, "n"], Float[Tensor, "n 6"]]:
    """Stamps and wrenches of a stream that are numbers, in the order of their stamps."""
    samples = sorted(stream.samples(), key=lambda one: one.stamp_ns)
    stamps = torch.tensor([sample.stamp_ns for sample in samples], dtype=torch.long)
    values = torch.stack([wrench_of(sample).double() for sample in samples]) if samples else torch.zeros(0, 6).double()
    kept = values.isfinite().all(-1)
    return stamps[kept], values[kept]
