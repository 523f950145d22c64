"""What touches say of a pose, and objects that look alike turned, under tensors of any value."""

from collections.abc import Iterable

import torch
from torch import Tensor

from rumi.information.contact_gain import divergence, expected_divergence
from rumi.metrics.pose_error import pose_error
from sdf.mesh.triangles import Triangles, nearest, winding_number
from sdf.symmetry import Symmetries
from sensors.force.force_torque import WrenchNoise, WrenchSettings, wrench_contact
from sensors.force.tool_load import calibrate_load
from sensors.force.tool_surface import SphereTool
from sensors.touch.rectangle_touch import rectangle_log_likelihoods, way_clearances
from sensors.touch.touch_likelihood import TouchNoise
from tests.stress.fuzz.draw import Draw, choice, log_weights, number, poses, sizes, tensor
from tests.stress.fuzz.entered import out, target


def _size(draw: Draw) -> float:
    return draw.integer(1, 100) * 1e-3 if draw.integer(0, 9) else number(draw, wild=True)


@target
def _rectangles(draw: Draw) -> Iterable[Tensor]:
    at, points = tensor(draw, sizes(draw), 3).double(), tensor(draw, sizes(draw), 2).double()
    normals = torch.nn.functional.normalize(tensor(draw, len(points), 2).double(), dim=-1)
    half = torch.tensor([draw.integer(1, 100) * 1e-3 for _ in range(2)], dtype=torch.float64)
    noise = TouchNoise(_size(draw), _size(draw), choice(draw, (0.0, 0.3)))
    ways = tensor(draw, sizes(draw), 2, 2).double()
    corners = draw.integer(0, 1) == 1
    told = rectangle_log_likelihoods(at, points, normals, half, noise, corners=corners)
    return out((at, points, ways), told, way_clearances(at, half, ways))


@target
def _wrenches(draw: Draw) -> Iterable[Tensor]:
    wrench = tensor(draw, sizes(draw), 6, wild=draw.integer(0, 3) == 0).double()
    tool = SphereTool(tensor(draw, 3).double(), _size(draw))
    noise = WrenchNoise(abs(number(draw)), abs(number(draw)), choice(draw, (None, 1, 100)))
    settings = WrenchSettings(_size(draw), abs(number(draw)), abs(number(draw)), draw.integer(1, 5))
    found = wrench_contact(wrench, tool, noise.covariance(), settings)
    return out((wrench,), found.point_s, found.normal_s, found.covariance, found.normal_sd_rad)


@target
def _loads(draw: Draw) -> Iterable[Tensor]:
    turns = poses(draw, sizes(draw, 8))[..., :3, :3].double()
    found = calibrate_load(tensor(draw, len(turns), 6, wild=draw.integer(0, 3) == 0).double(), turns)
    return found.load.bias, found.load.mass_kg, found.load.center_s


@target
def _divergences(draw: Draw) -> Iterable[Tensor]:
    count, readings = draw.integer(1, 5), draw.integer(1, 4)
    log, likelihood = log_weights(draw, count).float(), log_weights(draw, readings, count).float()
    log[0] = 0.0
    return divergence(log, likelihood), expected_divergence(log, likelihood)


@target
def _triangles(draw: Draw) -> Iterable[Tensor]:
    corners = tensor(draw, sizes(draw), 3, 3)
    if draw.integer(0, 3) == 0 and len(corners):
        corners[0, 1] = corners[0, 0]  # of no area
    points = tensor(draw, sizes(draw), 3).to(corners)
    made = Triangles(corners)
    return out((corners, points), nearest(points, made).point, winding_number(points, made))


@target
def _alike(draw: Draw) -> Iterable[Tensor]:
    words = ("x", "y2", "z", "z4", "x3", "ball", "none", "z1", "w", "", "z99999", "x2")
    text = ",".join(choice(draw, words) for _ in range(draw.integer(1, 3)))
    if text.count("99999"):
        text = "z12"
    own = Symmetries.parse(text, tensor(draw, 3).float())
    one, two = poses(draw, sizes(draw)).float(), poses(draw).float()
    return pose_error(one, two.expand_as(one), own)
