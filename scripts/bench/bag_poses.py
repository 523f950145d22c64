"""Poses as a bag's own messages have them, read without the importer, against the frames that it makes."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from rumi.rosbag.frames import FrameTree
from sdf.extras import optional


class Error(NamedTuple):
    """Largest difference of poses.

    Attributes:
        mm: of places.
        degrees: of turns.
        poses: that were compared.
    """

    mm: float
    degrees: float
    poses: int


def error_of(tree: FrameTree, frame: str, rows: dict[int, np.ndarray], world: np.ndarray) -> Error:
    """Largest difference of a frame's poses from those of messages by stamp, moved into the world."""
    found, known = tree.at(frame, torch.tensor(sorted(rows)))
    expected = np.stack([world @ rows[stamp] for stamp in sorted(rows)])[known.numpy()]
    told = found[known].numpy()
    apart = 1e3 * np.linalg.norm(told[:, :3, 3] - expected[:, :3, 3], axis=-1)
    # of a small angle the matrices' difference, not the cosine, which cannot tell it from none
    turned = np.degrees(np.linalg.norm(told[:, :3, :3] - expected[:, :3, :3], axis=(-2, -1)) / np.sqrt(2.0))
    return Error(float(apart.max()), float(turned.max()), int(known.sum()))


def poses_of(bag: Path) -> tuple[dict[int, np.ndarray], dict[int, np.ndarray], np.ndarray]:
    """Poses of tip and block by stamp as the bag's messages have them, and the tracker's frame in the tip's."""
    optional("rosbags", "A bag")
    from rosbags.highlevel import AnyReader

    tip: dict[int, np.ndarray] = {}
    block: dict[int, np.ndarray] = {}
    ties: dict[tuple[str, str], np.ndarray] = {}
    frame = ""
    with AnyReader([bag]) as reader:
        for line, _, raw in reader.messages():
            message: Any  # of its own type
            if line.topic == "/tip_pose":
                message = reader.deserialize(raw, line.msgtype)
                tip[_stamp(message)] = _pose(message.pose.position, message.pose.orientation)
            elif line.topic.startswith("/vicon/") and line.msgtype.endswith("/TransformStamped"):
                message = reader.deserialize(raw, line.msgtype)
                frame = message.header.frame_id.strip("/")
                block[_stamp(message)] = _pose(message.transform.translation, message.transform.rotation)
            elif line.topic == "/tf":
                message = reader.deserialize(raw, line.msgtype)
                for one in message.transforms:
                    name = one.header.frame_id.strip("/"), one.child_frame_id.strip("/")
                    ties.setdefault(name, _pose(one.transform.translation, one.transform.rotation))
    return tip, block, ties["map", "viconworld"] @ ties["viconworld", frame]


def _stamp(message: Any) -> int:  # noqa: ANN401  (a message of any type)
    stamp = message.header.stamp
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def _pose(at: object, turn: object) -> np.ndarray:
    x, y, z, w = (getattr(turn, name) for name in "xyzw")
    x, y, z, w = np.array((x, y, z, w)) / np.sqrt(x * x + y * y + z * z + w * w)
    made = np.eye(4)
    made[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    made[:3, 3] = [getattr(at, name) for name in "xyz"]
    return made
