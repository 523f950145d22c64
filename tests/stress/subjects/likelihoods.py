"""Likelihoods: sensor models at zero distance, inside, far away and at the ends of what chances can be."""

from functools import partial

import torch
from torch import Tensor

from rumi.metrics.likelihood import negative_log_likelihood
from sdf import backend, se3
from sdf.mesh.triangles import Triangles
from sdf.primitives import Box
from sensors.semantics import log_surface_probability, semantics_probability
from sensors.touch.contact_model import ContactModel
from sensors.touch.touch_likelihood import TouchNoise, box_log_likelihoods, touch_log_likelihoods
from tests.fixtures import meshes
from tests.stress import exact
from tests.stress.draws import choice, directions, log_uniform, log_weights, mixed, normal, poses, uniform
from tests.stress.measures import of_numbers, of_touch
from tests.stress.subjects.distances import VERSIONS, table
from tests.stress.sweep import Inputs, Sweep, register

F64 = torch.float64
COUNT = 200
HALF = torch.tensor([0.03, 0.05, 0.08], dtype=F64)


def _distances(generator: torch.Generator, count: int) -> Tensor:
    """Metres: 0, inside, touching, near and far."""
    sizes = log_uniform(generator, count, low=1e-12, high=100.0)
    return mixed(generator, [torch.zeros(count, dtype=F64), -sizes, sizes, 1e-3 * uniform(generator, count)])


# binary contact


def _draw_contact(generator: torch.Generator) -> Inputs:
    high = choice(generator, (0.5, 0.9, 1.0, 1.0 - 1e-9, 1.0 - float(log_uniform(generator, 1, low=1e-12, high=0.5))))
    low = choice(generator, (0.1, 0.0, float(log_uniform(generator, 1, low=1e-12, high=0.1))))
    return {
        "distance": _distances(generator, COUNT).float(),
        "contact": torch.randint(2, (COUNT,), generator=generator).bool(),
        "true_positive": high,
        "false_positive": min(low, high),
        "decay": float(log_uniform(generator, 1, low=10.0, high=1e5)),
    }


def _contact(inputs: Inputs) -> Tensor:
    model = ContactModel(inputs["true_positive"], inputs["false_positive"], inputs["decay"])
    return model.log_likelihood(inputs["distance"], inputs["contact"])


def _exact_contact(inputs: Inputs) -> Tensor:
    m = exact.mp()
    high, low, decay = (m.mpf(inputs[name]) for name in ("true_positive", "false_positive", "decay"))
    found = []
    for d, contact in zip(inputs["distance"].double().tolist(), inputs["contact"].tolist(), strict=True):
        chance = low + (high - low) * m.exp(-decay * max(m.mpf(d), 0))
        found.append(float(m.log(max(chance if contact else 1 - chance, m.mpf("1e-12")))))
    return torch.tensor(found, dtype=F64)


# semantics


def _draw_semantics(generator: torch.Generator) -> Inputs:
    return {
        "distance": _distances(generator, COUNT).float(),
        "sharpness": float(log_uniform(generator, 1, low=1.0, high=1e4)),
        "tolerance": choice(generator, (0.0, 0.001, 0.003)),
    }


def _semantics(inputs: Inputs) -> Tensor:
    """Logs of the probabilities, none below that of 1e-6, as a belief takes them."""
    found = semantics_probability(inputs["distance"], inputs["sharpness"], inputs["tolerance"])
    return found.clamp_min(1e-6).log()


def _exact_semantics(inputs: Inputs) -> Tensor:
    m = exact.mp()
    sharpness = m.mpf(inputs["sharpness"])
    # the tolerance as float32 has it, since the distances are in float32
    tolerance = m.mpf(float(torch.tensor(inputs["tolerance"])))
    rows = []
    for d in inputs["distance"].double().tolist():
        on = m.exp(-sharpness * max(abs(m.mpf(d)) - tolerance, 0))
        off = 1 - on
        row = (off, m.mpf(0), on) if d > 0 else (m.mpf(0), off, on)
        rows.append([float(m.log(max(p, m.mpf("1e-6")))) for p in row])
    return torch.tensor(rows, dtype=F64)


def _log_surface(dtype: torch.dtype, inputs: Inputs) -> Tensor:
    return log_surface_probability(inputs["distance"].to(dtype), inputs["sharpness"], inputs["tolerance"])


# touches


_MESH = meshes.box(HALF.tolist())


def _draw_touches(generator: torch.Generator) -> Inputs:
    """Touches on the faces, edges and corners of a box, inside it, and far off; with normals of any direction."""
    inside = uniform(generator, 40, 3, low=-1.0, high=1.0) * HALF
    query = Box(HALF.tolist())(inside)
    on = inside - query.distance[:, None] * query.gradient
    corner = HALF * torch.where(uniform(generator, 40, 3) < 0.5, -1.0, 1.0)
    far = directions(generator, 40) * log_uniform(generator, 40, 1, low=0.1, high=1.0)
    points = mixed(generator, [inside, on, corner, far])
    outlier = choice(generator, (0.0, 0.05))
    noise = TouchNoise(float(log_uniform(generator, 1, low=1e-4, high=1e-2)), 0.1, outlier)
    return {
        "points": points.float(),
        "normals": directions(generator, 40).float(),
        "poses": se3.reproject(poses(generator, 8, 0.5)).float(),
        "noise": noise,
    }


def _touches(version: str, dtype: torch.dtype, inputs: Inputs) -> Tensor:
    triangles = Triangles(_MESH.corners.to(dtype))
    at, points, normals = (inputs[name].to(dtype) for name in ("poses", "points", "normals"))
    with backend.force(version):
        return touch_log_likelihoods(at, points, normals, triangles, inputs["noise"])


def _box_touches(dtype: torch.dtype, inputs: Inputs) -> Tensor:
    half = HALF.float().to(dtype)
    points, normals = inputs["points"].to(dtype), inputs["normals"].to(dtype)
    return box_log_likelihoods(points, normals, half, inputs["noise"])


def _box_error(got: Tensor, wanted: Tensor, inputs: Inputs) -> Tensor:
    return (got.double() - wanted).abs() / wanted.abs().clamp_min(1.0)


# the nll that runs are judged by


def _draw_nll(generator: torch.Generator) -> Inputs:
    count = int(choice(generator, (1, 30)))
    truth = se3.reproject(poses(generator, 1, 0.8)[0])
    size = float(log_uniform(generator, 1, low=1e-6, high=0.3))
    off = normal(generator, count, 6) * torch.tensor([size] * 3 + [min(3.0, 10 * size)] * 3, dtype=F64)
    surface = uniform(generator, COUNT, 3, low=-0.05, high=0.09)
    query = table(0.002, F64)(surface)
    return {
        "poses": (truth @ se3.exp(off)).float(),
        "log_weights": torch.log_softmax(log_weights(generator, 1, count)[0], -1).float(),
        "truth": truth.float(),
        "surface": (surface - query.distance[:, None] * query.gradient).float(),
        "size": size,
    }


def _nll(version: str, dtype: torch.dtype, inputs: Inputs) -> Tensor:
    names = ("poses", "log_weights", "truth", "surface")
    at, log, truth, surface = (inputs[name].to(dtype) for name in names)
    with backend.force(version):
        return negative_log_likelihood(at, log, truth, surface, table(0.002, dtype))[None]


def _nll_error(got: Tensor, wanted: Tensor, inputs: Inputs) -> Tensor:
    return (got.double() - wanted).abs() / wanted.abs().clamp_min(1.0)


def _enter() -> None:
    def size(inputs: Inputs) -> Tensor:
        return inputs["distance"].double().abs()

    if exact.available():
        register(Sweep(
            "likelihoods-contact", _draw_contact, _contact, _exact_contact, of_numbers, 1e-4, "nats", size,
            "distance, m",
        ))  # fmt: skip
        register(Sweep(
            "likelihoods-semantics", _draw_semantics, _semantics, _exact_semantics, of_numbers, 1e-4, "nats", size,
            "distance, m",
        ))  # fmt: skip
    register(Sweep(
        "likelihoods-log-surface", _draw_semantics, partial(_log_surface, torch.float32),
        partial(_log_surface, F64), _box_error, 1e-5, "nats, beyond 1 of them", size, "distance, m",
    ))  # fmt: skip
    register(Sweep(
        "likelihoods-box-touches", _draw_touches, partial(_box_touches, torch.float32), partial(_box_touches, F64),
        _box_error, 1e-3, "nats, beyond 1 of them", lambda i: i["points"].double().norm(dim=-1), "distance, m",
    ))  # fmt: skip
    for version in VERSIONS:
        register(Sweep(
            f"likelihoods-touches-{version}", _draw_touches, partial(_touches, version, torch.float32),
            partial(_touches, "torch", F64), of_touch, 1.0, "of 1e-6 m",
            lambda i: torch.tensor([i["noise"].point_m]), "sigma, m",
        ))  # fmt: skip
        register(Sweep(
            f"likelihoods-nll-{version}", _draw_nll, partial(_nll, version, torch.float32),
            partial(_nll, "torch", F64), _nll_error, 1e-4, "nats, beyond 1 of them",
            lambda i: torch.tensor([i["size"]]), "size of the errors, m",
        ))  # fmt: skip


_enter()
