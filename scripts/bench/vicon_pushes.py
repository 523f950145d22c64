"""Real pushes of blocks with the force at the tip: the ROS 1 bags of github.com/mcubelab/cpush.

`RUMI_DATA/vicon_bags` is read. The blocks' sizes are not stated: they are taken as squares, whose size and place in the
tracked frame are found from where the tip was, in the block's frame, while the block moved (all bags of a block; the
tip's radius is taken to be that of the laboratory's other sets).
"""

import os
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.dynamics.push_registration import put_right
from rumi.dynamics.pushed_body import ObservedPush, PushedBody
from rumi.errors import UsageError
from rumi.rosbag.bag import import_bag
from rumi.rosbag.mapping_file import mapping_of
from scripts.bench.real_pushes import TIP_M, polygon_body
from scripts.bench.recorded_pushes import PushRecording, read_pushes
from sdf import se3

MAP = """
schema = 1
[topics]
"/tip_pose" = { role = "pose", frame = "map", child = "tip" }
"/vicon/*/*" = { role = "pose", child = "slider" }
"/netft_data" = "wrench"
[frames]
world = "map"
tool = "tip"
[scene]
within = [[0, 0, 0], [1, 1, 1]]
"""

BLOCKS = ("Al_block", "Plastic_block", "St_block")
_APART_M = 0.002  # of the tip's way between instants
_MOVED_M = 0.0005  # by which a block has been pushed at all
_TARE_M = 0.0003  # of the tip's way within which nothing is pushed yet
_SPEED = 0.02  # m/s of a block that is pushed
_SHIFTS = (0.003, 0.003, 0.05, 0.03, 0.003, 0.003)  # deviations of the frame (x, y, yaw), the delay, the tip (x, y)
_FITTED_M = 0.35  # of the tip's way from which a block's size is found
_LOST_M = 0.006  # of a gap at which the contact is lost


class Block(NamedTuple):
    """Size of a block and its place in the frame that is tracked.

    Attributes:
        half_m: half of the side.
        shifts: of the tip in the world (x, y), and of the block's middle in that frame (x, y, yaw).
        delay_s: by which the tip's pose is older than the block's.
        rms_m: root mean square of the gaps that are left.
        touches: how many they are.
    """

    half_m: float
    shifts: tuple[float, ...]
    delay_s: float
    rms_m: float
    touches: int

    @property
    def body(self) -> PushedBody:
        """The block with the tip."""
        corners = torch.tensor([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]], dtype=torch.float64)
        return polygon_body(self.half_m * corners, TIP_M)


class ForcePush(NamedTuple):
    """A stretch of a bag, its poses those of the block's middle.

    Attributes:
        name: of the bag.
        block: that it is of.
        push: with instants every 2 mm of the tip's way.
        force: (K, 2), mean force of the tip on the block on the way to each instant after the first, N.
    """

    name: str
    block: str
    push: ObservedPush
    force: Float[Tensor, "K 2"]


@cache
def recordings() -> dict[str, PushRecording]:
    """All bags, by block and name."""
    value = os.environ.get("RUMI_DATA")
    if not value:
        raise UsageError("Expected RUMI_DATA to name the folder of data sets, got nothing")
    found, mapping = {}, mapping_of(MAP)
    with TemporaryDirectory() as folder:
        for bag in sorted((Path(value) / "vicon_bags").glob("*/*.bag")):
            log = Path(folder) / f"{bag.stem}.h5"
            import_bag(bag, mapping, log)
            found[f"{bag.parent.name} {bag.stem}"] = read_pushes(log, mapping, block="slider")
    return found


@cache
def block_of(name: str) -> Block:
    """A block's size, its place, and the tip's delay and shift, by least squares of the gaps (Huber's loss)."""
    from scipy.optimize import least_squares

    rows = []
    for bag, told in recordings().items():
        if bag.split()[0] != name:
            continue
        pose, force = se3.to_planar(told.block), _force(told).norm(dim=-1)
        moves = (pose[:-1, :2] - pose[1:, :2]).norm(dim=-1) > _SPEED * told.time_s.diff()
        pushes = moves & (force[1:] > 0.4 * force.quantile(0.9)) & (_way(told)[1:] < _FITTED_M)
        some = pushes.nonzero()[::4, 0]
        rows.append(torch.cat((pose, told.tip[:, :2], _velocity(told)), -1)[some])
    touches = torch.cat(rows).numpy()

    def gaps(numbers: np.ndarray) -> np.ndarray:
        half, x, y, yaw, delay, *shift = numbers
        off = touches[:, 3:5] + delay * touches[:, 5:] + shift - touches[:, :2]
        at = _turned(_turned(off, touches[:, 2]) - (x, y), np.full(len(off), yaw))
        beyond = np.abs(at) - half
        gap: np.ndarray = np.hypot(*np.maximum(beyond, 0.0).T) + np.minimum(beyond.max(1), 0.0) - TIP_M
        # gaps of one push err together; what no touch tells stays near the tracked frames
        return np.concatenate((gap / 0.0025, numbers[1:] / _SHIFTS))

    off = _turned(touches[:, 3:5] - touches[:, :2], touches[:, 2])
    first = np.array((np.median(np.abs(off).max(1)) - TIP_M, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    found = least_squares(gaps, first, loss="huber")
    half, x, y, yaw, delay, *shift = found.x.tolist()
    left = 2.5 * gaps(found.x)[: len(touches)]
    return Block(half, (*shift, x, y, yaw), delay, 1e-3 * float(np.sqrt(np.mean(left**2))), len(touches))


def _force(told: PushRecording) -> Float[Tensor, "n 2"]:
    """Of the tip on the block: the sensor feels the block's on the tip, and what it has before any push."""
    return told.wrench[_way(told) < _TARE_M, :2].mean(0) - told.wrench[:, :2]


def _way(told: PushRecording) -> Float[Tensor, "n"]:
    """Of the tip so far."""
    steps = (told.tip[1:, :2] - told.tip[:-1, :2]).norm(dim=-1)
    return torch.cat((torch.zeros_like(steps[:1]), steps.cumsum(0)))


def _velocity(told: PushRecording) -> Float[Tensor, "n 2"]:
    return torch.gradient(told.tip[:, :2], spacing=(told.time_s,), dim=0)[0]


def _turned(places: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    """Places in a frame turned by a yaw each."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.stack((cos * places[:, 0] + sin * places[:, 1], cos * places[:, 1] - sin * places[:, 0]), -1)


@cache
def force_pushes(way_m: float) -> list[ForcePush]:
    """The first stretch of each bag in which the tip pushes over a length of its way, without losing the block."""
    found = []
    for name, told in recordings().items():
        block = block_of(name.split()[0])
        pose = put_right(se3.to_planar(told.block), torch.tensor(block.shifts, dtype=torch.float64))
        tip = told.tip[:, :2] + block.delay_s * _velocity(told) + torch.tensor(block.shifts[:2], dtype=torch.float64)
        way, force = _way(told), _force(told)
        begin = int(((pose[:, :2] - pose[0, :2]).norm(dim=-1) > _MOVED_M).nonzero()[0])
        last = int(torch.searchsorted(way, way[begin] + way_m))
        if last >= len(way) or float(_gaps(pose[begin:last], tip[begin:last], block.half_m).max()) > _LOST_M:
            continue
        wanted = way[begin] + torch.linspace(0.0, way_m, round(way_m / _APART_M) + 1, dtype=torch.float64)
        at = torch.searchsorted(way, wanted).clamp(begin, last)
        path = torch.cat((tip[at], torch.zeros_like(tip[at, :1])), -1)
        total = torch.cat((torch.zeros_like(force[:1]), force.cumsum(0)))
        low, high = torch.minimum(at[:-1] + 1, at[1:]), at[1:] + 1
        mean = (total[high] - total[low]) / (high - low)[:, None]
        found.append(ForcePush(name, name.split()[0], ObservedPush(pose[begin], path, pose[last]), mean))
    return found


def _gaps(pose: Tensor, tip: Tensor, half_m: float) -> Tensor:
    off, cos, sin = tip - pose[:, :2], pose[:, 2].cos(), pose[:, 2].sin()
    local = torch.stack((cos * off[:, 0] + sin * off[:, 1], cos * off[:, 1] - sin * off[:, 0]), -1)
    return (local.abs() - half_m).clamp_min(0.0).norm(dim=-1) - TIP_M
