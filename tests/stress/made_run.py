"""Steps of a run that nobody made, as a recorder takes them."""

from collections.abc import Iterator

import torch

from rumi.belief.particles import PoseBelief
from rumi.records import RunResult, StepRecord
from sdf import se3
from sensors.observation import Observation
from sensors.reading import Reading


def made_steps(count: int = 10**6, *, points: int = 300, particles: int = 200) -> Iterator[StepRecord]:
    """Steps with some points and particles each, the same at every call."""
    generator = torch.Generator().manual_seed(0)
    for step in range(count):
        seen = Observation.of(torch.randn(points, 3, generator=generator), 2)
        reading = Reading(
            observation=seen,
            instant=torch.zeros(points, dtype=torch.long),
            tool_pose=se3.identity((1,)),
            in_contact=torch.tensor([True]),
            object_motion=None,
            configuration=torch.zeros(3),
            clipped=torch.tensor(0.0),
            stamp=float(step),
        )
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
            resampled=False,
            converged=False,
            truth=None,
            nll=None,
        )


def made_result(steps: int) -> RunResult:
    """How such a run of some actions ended."""
    return RunResult(
        right=None,
        paper_success=None,
        paper_success_at_start=None,
        min_nll=None,
        final_nll=None,
        cumulative_nll=None,
        steps=steps,
        stopped_by="steps",
        apc=0.1,
        expected_nll=1.0,
        position_error_mm=None,
        rotation_error_deg=None,
        contacts=steps,
        clipped=0,
    )
