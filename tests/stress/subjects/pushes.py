"""Pushes: densities far out in their tails, and paths of none to 10^4 actions with extreme frictions and levers."""

from functools import partial

import torch
from torch import Tensor

from rumi.dynamics.along_path import Pusher
from rumi.dynamics.outline import RectangleOutline, Support
from rumi.dynamics.push_density import PushResidual
from rumi.dynamics.push_parameters import PARAMETERS
from rumi.dynamics.push_posterior import PushPosterior
from rumi.dynamics.pushed_body import PushedBody
from tests.stress import exact, measures
from tests.stress.draws import choice, log_uniform, mixed, normal, uniform
from tests.stress.sweep import Inputs, Sweep, register

F64 = torch.float64
COUNT = 200


def _draw_density(generator: torch.Generator) -> Inputs:
    sizes = log_uniform(generator, 3 * COUNT, low=1e-9, high=100.0)
    way = mixed(generator, [torch.zeros(COUNT, dtype=F64), log_uniform(generator, COUNT, low=1e-9, high=10.0)])
    return {
        "residual": mixed(generator, [torch.zeros(3 * COUNT, dtype=F64), sizes, -sizes]).view(COUNT, 3).float(),
        "way": way.float(),
        "tails": choice(generator, (0.5, 2.0, 100.0)),
    }


def _density(inputs: Inputs) -> Tensor:
    own = PushResidual(tails=inputs["tails"])
    return own.log_density(inputs["residual"], own.scale(inputs["way"]))


def _exact_density(inputs: Inputs) -> Tensor:
    m, own, found = exact.mp(), PushResidual(), []
    nu = m.mpf(inputs["tails"])
    constant = m.loggamma((nu + 3) / 2) - m.loggamma(nu / 2) - m.mpf(1.5) * m.log(nu * m.pi)
    for row, way in zip(inputs["residual"].tolist(), inputs["way"].tolist(), strict=True):
        scale = [m.hypot(m.mpf(f), m.mpf(way) * m.mpf(s)) for f, s in zip(own.floor_m, own.share, strict=True)]
        square = sum((m.mpf(e) / s) ** 2 for e, s in zip(row, scale, strict=True))
        logs = sum(m.log(s) for s in scale)
        found.append(float(constant - logs - (nu + 3) / 2 * m.log(1 + square / nu)))
    return torch.tensor(found, dtype=F64)


register(
    Sweep(
        name="push-density-float32",
        draw=_draw_density,
        operation=_density,
        reference=_exact_density,
        error=lambda got, wanted, inputs: measures.relative(got, wanted),
        limit=3e-5,
        unit="of the log density",
        condition=lambda inputs: inputs["residual"].norm(dim=-1),
        condition_of="residual, m",
    )
)


def _draw_pushes(kind: torch.dtype, generator: torch.Generator) -> Inputs:
    particles, instants, pushes = ((1, 10_000, 2), (10_000, 2, 2), (200, 20, 6))[int(3 * uniform(generator, 1))]
    length = choice(generator, (0.0, 1e-9, 0.05, 1.0))
    start = 0.05 * normal(generator, pushes, 3)
    share = torch.linspace(0.0, length, instants + 1, dtype=F64)[:, None]
    place = torch.cat((-0.08 + share, torch.zeros_like(share), torch.zeros_like(share)), -1)
    middle = torch.tensor(PushPosterior.prior(1).mean, dtype=F64)
    wide = torch.tensor([5.0, 1.5, 5.0, 8.0, 0.5, 0.5, 0.5, 0.5], dtype=F64)
    parameters = middle + wide * normal(generator, particles, len(PARAMETERS))
    return {"start": start.to(kind), "path": place.expand(pushes, -1, 3).to(kind), "parameters": parameters}


def _pushed(inputs: Inputs) -> Tensor:
    """How far objects went, over ten times the way and the depth to come free of, as far as wedged ones may."""
    start, parameters = inputs["start"], inputs["parameters"]
    own = PushPosterior(parameters, parameters.new_zeros(len(parameters)).log_softmax(-1))
    axes = torch.linspace(-1.0, 1.0, 21, dtype=F64)
    base = torch.stack(torch.meshgrid(0.06 * axes, 0.03 * axes, indexing="ij"), -1).reshape(-1, 2)
    body = PushedBody(RectangleOutline((0.06, 0.03)), Support.of_base(base, base.mean(0)), Pusher.disc(0.005, start))
    shown = own.predict(start, inputs["path"], body)
    density = shown.log_density(shown.ends[:, :3])
    far = (shown.ends - start[:, None])[..., :2].norm(dim=-1).amax(-1)
    way = (inputs["path"][:, -1] - inputs["path"][:, 0]).norm(dim=-1)
    numbers = (shown.scale.sum((1, 2)), density.sum(-1), shown.ends.sum((1, 2)))
    return far / (10.0 * (way + 0.04)) + 0.0 * sum(
        part.isfinite().to(far) / part.isfinite().to(far) for part in numbers
    )


for _kind, _name in ((torch.float32, "float32"), (F64, "float64")):
    register(
        Sweep(
            name=f"push-prediction-{_name}",
            draw=partial(_draw_pushes, _kind),
            operation=_pushed,
            reference=lambda inputs: torch.zeros(len(inputs["start"]), dtype=F64),
            error=lambda got, wanted, inputs: measures.absolute(got, wanted),
            limit=2.0,
            unit="of what can be",
            condition=lambda inputs: inputs["start"].norm(dim=-1),
            condition_of="start, m",
        )
    )
