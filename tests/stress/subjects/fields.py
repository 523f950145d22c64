"""Semantics and information of workspace points, in all modes and versions."""

from functools import partial

import torch
from torch import Tensor

from rumi.fields.information import InformationSettings, WorkspaceFields, information_field, information_from_distances
from sdf import backend, se3
from tests.stress import measures
from tests.stress.draws import choice, integer, log_uniform, log_weights, normal, uniform
from tests.stress.subjects.distances import VERSIONS, table
from tests.stress.sweep import Inputs, Sweep, register

MODES = ("sensor_mi", "surrogate", "reverse_kl", "forward_kl")
F64 = torch.float64
AGREED = 0.1
"""Nats: fields below this say that all poses agree, and are held to it instead of to their own maximum."""


def _draw(generator: torch.Generator) -> Inputs:
    """A mug at poses that agree, nearly agree or do not, under weights of any kind, about 300 points."""
    count = int(choice(generator, (1, 2, 10, 100)))
    spread = float(log_uniform(generator, 1, low=1e-9, high=0.1))
    centre = se3.exp(normal(generator, 6) * torch.tensor([0.5] * 3 + [1.0] * 3, dtype=F64))
    scale = torch.tensor([spread] * 3 + [min(10 * spread, 3.0)] * 3, dtype=F64)
    at = centre @ se3.exp(normal(generator, count, 6) * scale)
    points = centre[:3, 3] + uniform(generator, 300, 3, low=-0.15, high=0.15)
    log = torch.log_softmax(log_weights(generator, 1, count)[0], -1)
    return {
        "poses": at.float(),
        "log_weights": log.float(),
        "points": points.float(),
        "peakiness": float(log_uniform(generator, 1, low=1e-3, high=1e3)),
        "sharpness": float(log_uniform(generator, 1, low=10.0, high=1000.0)),
        "tolerance": choice(generator, (0.0, 0.001)),
        "spread": spread,
    }


def _fields(version: str, mode: str, dtype: torch.dtype, inputs: Inputs) -> WorkspaceFields:
    settings = InformationSettings(
        mode=mode,  # type: ignore[arg-type]
        peakiness=inputs["peakiness"],
        sharpness=inputs["sharpness"],
        tolerance=inputs["tolerance"],
        tail=0.0,
    )
    at, log, points = (inputs[name].to(dtype) for name in ("poses", "log_weights", "points"))
    with backend.force(version):
        return information_field(table(0.002, dtype), at, log, points, settings)


def _information_error(got: WorkspaceFields, wanted: WorkspaceFields, inputs: Inputs) -> Tensor:
    greatest = wanted.information.abs().amax().clamp_min(AGREED)
    return (measures.absolute(got.information[None], wanted.information[None]) / greatest).reshape(1)


def _semantics_error(got: WorkspaceFields, wanted: WorkspaceFields, inputs: Inputs) -> Tensor:
    sums = (got.semantics.double().sum(-1) - 1.0).abs().amax()
    return torch.maximum(measures.absolute(got.semantics[None], wanted.semantics[None]), sums)


def _draw_agreed(generator: torch.Generator) -> Inputs:
    """The same distances under all poses, of any size; equal or extreme weights."""
    count = integer(generator, 1, 50)
    distance = log_uniform(generator, 1, 200, low=1e-9, high=1.0) * torch.where(
        uniform(generator, 1, 200) < 0.5, -1.0, 1.0
    )
    log = torch.log_softmax(log_weights(generator, 1, count)[0], -1)
    return {"distance": distance.expand(count, 200).float(), "log_weights": log.float()}


def _agreed(mode: str, inputs: Inputs) -> Tensor:
    fields = information_from_distances(inputs["distance"], inputs["log_weights"], mode=mode)  # type: ignore[arg-type]
    return fields.information


def _enter() -> None:
    def spread(inputs: Inputs) -> Tensor:
        return torch.tensor([inputs["spread"]])

    for version in VERSIONS:
        register(Sweep(
            f"fields-semantics-{version}", _draw, partial(_fields, version, "sensor_mi", torch.float32),
            partial(_fields, "torch", "sensor_mi", F64), _semantics_error, 1e-5, "1", spread, "spread of poses, m",
        ))  # fmt: skip
        for mode in MODES:
            register(Sweep(
                f"fields-{mode.replace('_', '-')}-{version}", _draw, partial(_fields, version, mode, torch.float32),
                partial(_fields, "torch", mode, F64), _information_error, 1e-5, "of the greatest", spread,
                "spread of poses, m",
            ))  # fmt: skip
    for mode in MODES[:1] + MODES[2:]:
        # the surrogate is not 0 where all poses agree
        register(Sweep(
            f"fields-{mode.replace('_', '-')}-of-agreement", _draw_agreed, partial(_agreed, mode),
            lambda i: torch.zeros(200, dtype=F64), lambda got, wanted, i: measures.absolute(got, wanted), 1e-6,
            "nats", lambda i: i["distance"][0].abs(), "distance, m",
        ))  # fmt: skip


_enter()
