"""Lines that suggest a rod on a force sensor: the tool, the sensor's surface, and the frame at its far end."""

import json
import math

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.rosbag.suggest_geometry import Rod

ROD_END = "rod_end"
"""Frame at the far end of a rod that has none there."""

_OFF_M = 0.0055  # along each axis, between an arm and a tracker, as in recorded bags
_UPRIGHT = math.cos(math.radians(15.0))  # of a rod's axis
_OFF = (
    "# arm and tracker, which tells the first place, are usually registered no better: put in 0, or the value you know",
    f"off_m = {_OFF_M:g}  # TODO standard deviation along each axis of where the tool is for the tracker",
)


def lines_of_end(tool: str, rod: Rod) -> list[str]:
    """Lines of the frame at the far end."""
    return [
        f"[[fixed]]  # the far end of the rod that touches: {rod.length_m:.3f} m from the force sensor, by where its "
        "forces act or a frame on it",
        f"parent = {json.dumps(tool)}",
        f"child = {json.dumps(ROD_END)}",
        f"position_m = {_vector(rod.end_t)}",
        "",
    ]


def lines_of_rod(rod: Rod, *, off: bool) -> list[str]:
    """Lines of the tool and of the force sensor's surface.

    Args:
        rod: which is both.
        off: whether the belief asks how far it may be off, of a first place that another system told.
    """
    start = torch.zeros(3) if rod.ends_at_tool else rod.end_t
    radius = "radius_m = 0.005  # TODO half of the rod's thickness"
    return [
        "[tool]  # a rod from its end to the force sensor",
        radius,
        f"rod_m = [[0.0, 0.0, 0.0], {_vector(rod.sensor_t - start)}]",
        *(_OFF if off else ()),
        "",
        "[wrench]  # the same rod in the sensor's frame",
        radius,
        f"rod_m = [[0.0, 0.0, 0.0], {_vector(rod.end_s)}]",
        "tare_s = 0.3  # seconds at the start in which nothing touches",
    ]


def is_upright(rod: Rod, poses: Float[Tensor, "n 4 4"]) -> bool:
    """Whether the rod stands on end all the time."""
    axis = torch.nn.functional.normalize(rod.sensor_t - rod.end_t, dim=-1)
    return bool(len(poses)) and float((poses[:, 2, :3] @ axis.to(poses)).abs().median()) > _UPRIGHT


def _vector(values: Float[Tensor, "3"]) -> str:
    return json.dumps([round(value, 4) + 0.0 for value in values.tolist()])
