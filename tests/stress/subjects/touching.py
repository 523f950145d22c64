"""Touches: rectangles and free ways beside them, wrenches on tools, triangles, and objects that look alike turned."""

import math
from functools import partial

import torch
from torch import Tensor

from rumi.metrics.pose_error import pose_error
from sdf import backend, se3, so3
from sdf.mesh.triangles import Triangles, nearest, winding_number
from sdf.primitives import Box
from sdf.symmetry import Symmetries
from sensors.force.force_torque import WrenchNoise, wrench_contact
from sensors.force.tool_surface import SphereTool
from sensors.touch.rectangle_touch import rectangle_log_likelihoods, way_clearances
from sensors.touch.touch_likelihood import TouchNoise
from tests.fixtures import meshes
from tests.stress import measures
from tests.stress.draws import choice, directions, log_uniform, mixed, normal, poses, rotation_vectors, uniform
from tests.stress.measures import of_numbers, of_touch
from tests.stress.subjects.distances import VERSIONS
from tests.stress.sweep import Inputs, Sweep, register

F64 = torch.float64
HALF = (0.03, 0.05, 0.08)


# rectangles


def _draw_rectangle(generator: torch.Generator) -> Inputs:
    """Touches on sides and corners, inside, and off; ways beside, across and of no length; any heading."""
    planar = torch.cat((uniform(generator, 30, 2, low=-1.0, high=1.0), rotation_vectors(generator, 30)[:, :1]), -1)
    planar[:, :2] += 0.05 * normal(generator, 30, 2)
    half = torch.tensor(HALF[:2], dtype=F64)
    inside = uniform(generator, 20, 2, low=-1.2, high=1.2) * half
    corner = half * torch.where(uniform(generator, 20, 2) < 0.5, -1.0, 1.0)
    points = planar[0, :2] + mixed(generator, [inside, corner, inside * choice(generator, (1e-6, 3.0))])
    ends = points[:, None] + mixed(generator, [0.2 * normal(generator, 20, 2), torch.zeros(20, 2, dtype=F64)])[:, None]
    facing = torch.nn.functional.normalize(normal(generator, 20, 2), dim=-1)
    return {
        "poses": planar.float(),
        "points": points.float(),
        "normals": facing.float(),
        "ways": torch.cat((points[:, None], ends), 1).float(),
        "noise": TouchNoise(float(log_uniform(generator, 1, low=1e-3, high=1e-2)), 0.1),
    }


def _touched(version: str, dtype: torch.dtype, inputs: Inputs) -> Tensor:
    at, points, normals = (inputs[name].to(dtype) for name in ("poses", "points", "normals"))
    half = torch.tensor(HALF[:2]).to(dtype)
    with backend.force(version):
        return rectangle_log_likelihoods(at, points, normals, half, inputs["noise"])


def _clear(version: str, dtype: torch.dtype, inputs: Inputs) -> Tensor:
    at, ways = inputs["poses"].to(dtype), inputs["ways"].to(dtype)
    with backend.force(version):
        return way_clearances(at, torch.tensor(HALF[:2]).to(dtype), ways)


# wrenches


def _draw_wrench(generator: torch.Generator) -> Inputs:
    """Pushes of 1 mN to 1 kN on a ball of 12 mm, head-on, aslant, and on lines that just meet it or pass it by."""
    count = 64
    centre = torch.tensor([0.01, -0.02, 0.1], dtype=F64)
    outward = directions(generator, count)
    aside = torch.linalg.cross(outward, directions(generator, count))
    slant = mixed(generator, [torch.zeros(count, 3, dtype=F64), 0.5 * aside, 0.95 * aside])
    force = -torch.nn.functional.normalize(outward + slant, dim=-1)
    force = force * log_uniform(generator, count, 1, low=1e-3, high=1e3)
    point = centre + 0.012 * outward
    return {"wrench": torch.cat((force, torch.linalg.cross(point, force)), -1).float(), "centre": centre.float()}


def _struck(version: str, dtype: torch.dtype, inputs: Inputs) -> Tensor:
    with backend.force(version):
        found = wrench_contact(
            inputs["wrench"].to(dtype), SphereTool(inputs["centre"], 0.012), WrenchNoise().covariance().to(dtype)
        )
    return found.point_s


def _square_off(got: Tensor, wanted: Tensor, inputs: Inputs) -> Tensor:
    """Metres off, less what a lever that is rounded in float32 does to a line that grazes the ball.

    A line that passes by h below the radius r meets the ball sqrt(2 r h) before its nearest approach.
    """
    force, moment = inputs["wrench"].double().split(3, -1)
    foot = torch.linalg.cross(force, moment) / force.square().sum(-1, keepdim=True)
    apart = foot - inputs["centre"].double()
    along = torch.nn.functional.normalize(force, dim=-1)
    aside = (apart - (apart * along).sum(-1, keepdim=True) * along).norm(dim=-1)
    rounding = 2e-7 * foot.norm(dim=-1)
    depth = (0.012**2 - aside**2).clamp_min(0.0).sqrt()
    slack = torch.minimum(0.012 * rounding / depth.clamp_min(1e-30), (2 * 0.012 * rounding).sqrt())
    return (measures.absolute(got, wanted) - slack).clamp_min(0.0)


# triangles


_MESH = meshes.box(HALF)


def _draw_points(generator: torch.Generator) -> Inputs:
    """Points inside, about, on the faces, edges and corners of a box, and up to a kilometre away."""
    half = torch.tensor(HALF, dtype=F64)
    about = uniform(generator, 300, 3, low=-2.0, high=2.0) * half
    on = torch.where(uniform(generator, 300, 3) < 0.4, half * about.sign(), about.clamp(-half, half))
    far = directions(generator, 300) * log_uniform(generator, 300, 1, low=0.2, high=1e3)
    return {"points": mixed(generator, [about, on, far]).float()}


def _gap(version: str, dtype: torch.dtype, inputs: Inputs) -> Tensor:
    points = inputs["points"].to(dtype)
    with backend.force(version):
        return (points - nearest(points, Triangles(_MESH.corners.to(dtype))).point).norm(dim=-1)


def _gap_error(got: Tensor, wanted: Tensor, inputs: Inputs) -> Tensor:
    return (got.double() - wanted).abs() / wanted.abs().clamp_min(1.0)


def _wound(version: str, inputs: Inputs) -> Tensor:
    with backend.force(version):
        return winding_number(inputs["points"].double(), Triangles(_MESH.corners), accuracy=math.inf)


def _winding_error(got: Tensor, wanted: Tensor, inputs: Inputs) -> Tensor:
    """Of points 1e-6 m or more from the surface: on it, half a turn or any other is right."""
    return torch.where(wanted.abs() > 1e-6, (got - (wanted < 0).double()).abs(), 0.0)


def _off(inputs: Inputs) -> Tensor:
    return inputs["points"].double().norm(dim=-1)


# objects that look alike turned

_ALIKE = ("x2,y2", "z4,x2", "z", "z,x2", "z12", "ball", "x3")


def _draw_alike(generator: torch.Generator) -> Inputs:
    """Poses, and the same ones turned by one of the object's own symmetries."""
    own = Symmetries.parse(_ALIKE[int(choice(generator, range(len(_ALIKE))))], torch.tensor([0.02, -0.01, 0.03]))
    at = poses(generator, 64)
    pick = own.rotations.double()[torch.randint(len(own), (64,), generator=generator)]
    if own.axis is not None:
        pick = pick @ so3.exp(uniform(generator, 64, 1, low=-math.pi, high=math.pi) * own.axis.double())
    if own.ball:
        pick = so3.exp(rotation_vectors(generator, 64))
    middle = own.center.double()
    turned = at @ se3.make(pick, middle - (pick @ middle[:, None])[..., 0])
    return {"pose": se3.reproject(at).float(), "other": se3.reproject(turned).float(), "symmetries": own}


def _apart(inputs: Inputs) -> Tensor:
    return torch.stack(pose_error(inputs["pose"], inputs["other"], inputs["symmetries"]), -1)


def _enter() -> None:
    for version in VERSIONS:
        for sweep in (
            Sweep(
                f"touching-rectangle-{version}", _draw_rectangle, partial(_touched, version, torch.float32),
                partial(_touched, "torch", F64), of_touch, 1.0, "of 1e-6 m",
                lambda i: torch.tensor([i["noise"].point_m]), "sigma, m",
            ),
            Sweep(
                f"touching-free-ways-{version}", _draw_rectangle, partial(_clear, version, torch.float32),
                partial(_clear, "torch", F64), of_numbers, 1e-5, "m",
                lambda i: (i["ways"][:, 1] - i["ways"][:, 0]).double().norm(dim=-1), "length of the way, m",
            ),
            Sweep(
                f"touching-wrench-{version}", _draw_wrench, partial(_struck, version, torch.float32),
                partial(_struck, "torch", F64), _square_off, 1e-5, "m",
                lambda i: i["wrench"][:, :3].double().norm(dim=-1), "force, N",
            ),
            Sweep(
                f"touching-nearest-triangle-{version}", _draw_points, partial(_gap, version, torch.float32),
                lambda i: Box(HALF).distance(i["points"].double()).abs(), _gap_error, 1e-6, "m, beyond 1 m of them",
                _off, "metres from the origin",
            ),
            Sweep(
                f"touching-winding-{version}", _draw_points, partial(_wound, version),
                lambda i: Box(HALF).distance(i["points"].double()), _winding_error, 1e-6, "turns", _off,
                "metres from the origin",
            ),
        ):  # fmt: skip
            register(sweep)
    register(Sweep(
        "touching-alike-float32", _draw_alike, _apart, lambda i: torch.zeros(64, 2, dtype=F64), of_numbers, 1e-5,
        "m, rad", lambda i: torch.tensor([float(len(i["symmetries"]))]), "turns of the object",
    ))  # fmt: skip


_enter()
