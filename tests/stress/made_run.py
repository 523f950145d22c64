"""Steps of a run that nobody made, as a recorder takes them."""

from collections.abc import Iterator

import torch

from rumi.belief.particles import PoseBelief
from rumi.records import RunResult, StepRecord
from sdf import se3
from sensors.observation import Observation
from tests.fixtures.readings import make_reading


def made_steps(count: int = 10**6, *, points: int = 300, particles: int = 200) -> Iterator[StepRecord]:
    """Steps with some points and particles each, the same at every call."""
    generator = torch.Generator().manual_seed(0)
    for step in range(count):
        seen = Observation.of(torch.randn(points, 3, generator=generator), 2)
        reading = make_reading(seen, contact=True, stamp=float(step))
        belief = PoseBelief.uniform(se3.exp(torch.randn(particles, 6, generator=generator)))
        yield StepRecord(
            step=step,
            control=None,
            reading=reading,
            added=seen,
            belief=belief,
            plan=None,
            expected_nll=1.0,
            fit=0.0,
            apc=0.1,
            ess=float(particles),
            contacts=step,
        )


def made_result(steps: int) -> RunResult:
    """How such a run of some actions ended."""
    return RunResult(steps=steps, stopped_by="steps", apc=0.1, expected_nll=1.0, contacts=steps, clipped=0)
