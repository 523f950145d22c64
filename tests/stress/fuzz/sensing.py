"""Observations, discrepancies and what sensors say under tensors of any value."""

from collections.abc import Iterable

import torch
from torch import Tensor

from rumi.registration.descent import DescentSettings, descend
from sdf import se3
from sdf.mesh.triangles import Triangles
from sensors.discrepancy import Discrepancy
from sensors.observation import Observation, merge
from sensors.semantics import semantics_probability
from sensors.touch.contact_model import ContactModel
from sensors.touch.tactile import swept_points
from sensors.touch.touch_likelihood import TouchNoise, touch_log_likelihoods
from sensors.vision.camera import depth_observation, pinhole
from tests.stress.fuzz.draw import Draw, choice, number, poses, sizes, tensor
from tests.stress.fuzz.entered import TABLE, out, target


def _observed(draw: Draw, wild: bool) -> Observation:
    parts = [Observation.of(tensor(draw, sizes(draw), 3, wild=wild).float(), kind) for kind in range(3)]
    spacing = torch.tensor([0.005, 0.005, 0.002])
    total = parts[0]
    for part in parts[1:]:
        total, _ = merge(total, part, spacing)
    return total


@target
def _observations(draw: Draw) -> Iterable[Tensor]:
    seen = _observed(draw, wild=True)
    return (seen.points,)


@target
def _discrepancies(draw: Draw) -> Iterable[Tensor]:
    at, seen = poses(draw, sizes(draw)).float(), _observed(draw, wild=False)
    module = Discrepancy(TABLE, 0.1, free_scale=abs(number(draw)), tolerance=abs(number(draw)) * 0.01)
    settings = DescentSettings(method=choice(draw, ("gauss-newton", "adam")), iterations=2)
    moved = descend(module, at, seen, choice(draw, ("SE(2)", "SE(3)")), settings)
    return (module(at, seen), moved)


@target
def _sensor_models(draw: Draw) -> Iterable[Tensor]:
    distance = tensor(draw, sizes(draw), wild=draw.integer(0, 1) == 1)
    chances = semantics_probability(distance, abs(number(draw)), abs(number(draw)))

    def rate() -> float:
        return number(draw, wild=True) if draw.integer(0, 7) == 0 else draw.integer(0, 100) / 100

    decay = choice(draw, (None, 10.0 ** draw.integer(-3, 6), 10.0 ** draw.integer(-3, 6), number(draw, wild=True)))
    model = ContactModel(rate(), rate(), decay)
    contact = torch.arange(len(distance)) % 2 == 0
    return out((distance,), chances, model(distance), model.log_likelihood(distance, contact))


_BOX = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])[
    torch.tensor([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
]


@target
def _touches(draw: Draw) -> Iterable[Tensor]:
    sigmas = [10.0 ** draw.integer(-6, 1) if draw.integer(0, 9) else number(draw, wild=True) for _ in range(3)]
    noise = TouchNoise(sigmas[0], sigmas[1], choice(draw, (0.0, 0.0, 0.3, number(draw))), sigmas[2])
    at, points = poses(draw, draw.integer(1, 3)).double(), tensor(draw, draw.integer(1, 4), 3).double()
    normals = torch.nn.functional.normalize(tensor(draw, len(points), 3).double(), dim=-1)
    corners = _BOX.double() * (0.0 if draw.integer(0, 9) == 0 else 0.1)
    return (touch_log_likelihoods(at, points, normals, Triangles(corners), noise),)


@target
def _depth_images(draw: Draw) -> Iterable[Tensor]:
    depth = tensor(draw, draw.integer(1, 5), draw.integer(1, 5), wild=True).float()
    camera = poses(draw, wild=draw.integer(0, 3) == 0).float()
    intrinsics = (
        pinhole(depth.shape[0], depth.shape[1], 1.0) if draw.integer(0, 2) else tensor(draw, 3, 3, wild=True).float()
    )
    bounds = choice(draw, (None, torch.tensor([[-0.05] * 3, [0.05] * 3])))
    seen = depth_observation(depth, intrinsics, camera, depth > 0, bounds=bounds, free_spacing=0.02)
    return (seen.points,)


@target
def _swept(draw: Draw) -> Iterable[Tensor]:
    instants = draw.integer(1, 3)
    region = torch.tensor([[-1.0] * 3, [1.0] * 3])
    path = se3.exp(0.05 * tensor(draw, instants, 6)).float()
    body = 0.1 * tensor(draw, sizes(draw), 3).float()
    points, _ = swept_points(path, body, choice(draw, (0.02, 0.1)), region=region)
    return (points.points,)
