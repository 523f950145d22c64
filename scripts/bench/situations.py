"""Situations that estimates are measured in: what a robot has sensed of a mug after some recorded actions."""

import hashlib
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.initialise import InitialiseSettings, initialise, view_starts
from rumi.belief.particles import PoseBelief
from rumi.belief.pose_filter import FilterSettings, PoseFilter
from rumi.cache import cache_folder
from rumi.registration.descent import Search
from rumi.seeding import split
from rumi.sim.settings import SimSettings
from rumi.tasks.rummage.build import make_task
from rumi.tasks.rummage.scene_spec import TaskSpec
from rumi.tasks.rummage.scenes import find_task, make_tool
from scripts.store import clock
from sdf.grid_sdf import GridSDF
from sdf.object_model import ObjectModel
from sensors.discrepancy import Discrepancy
from sensors.observation import Observation, attach, merge
from sensors.reading import Reading
from sensors.semantics import Semantics

# what `default` did with seed 1000, rounded: the same readings whatever the planner is today
_CONTROLS = {
    "mug-1": """
        1 -1 .45   1 -.06 -.75   1 1 -.97   -1 -.03 .82   .16 -.48 1   1 -.45 1   .59 .84 -.55   1 .6 -1   .9 .47 -.84
        .87 .02 -.44   -.06 .96 .73   -1 1 -.48   -.22 -.23 .85   1 -.92 -1   .46 .32 .13   .17 .96 .98   -.68 .26 1
        1 -.44 -1
    """,
}
STAGES = {"mug-1": {"view": 0, "touch": 12, "handle": 16, "sure": 18}}
"""Actions done at each stage: after the first view, after touches of the wall, after two or more of the handle."""


@dataclass(frozen=True, eq=False)
class Situation:
    """What was sensed of a mug that stands on the floor, at known height and upright.

    Attributes:
        spec: the task.
        stage: its name.
        model: the mug, float64.
        readings: all so far, float32.
        memory: their points, one a lattice cell, in the object-attached frame, float32.
        truth: (4, 4), the object's pose in that frame, float32; for the record, no estimate sees it.
    """

    spec: TaskSpec
    stage: str
    model: ObjectModel
    readings: tuple[Reading, ...]
    memory: Observation
    truth: Float[Tensor, "4 4"]

    @property
    def name(self) -> str:
        """Task and stage."""
        return f"{self.spec.name}/{self.stage}"

    @cached_property
    def digest(self) -> str:
        """Of all points that were sensed: figures of different points do not compare."""
        return hashlib.sha256(self.memory.points.numpy().tobytes()).hexdigest()[:12]


def situation(task: str, stage: str) -> Situation:
    """Carry the recorded actions out in the simulator; seconds.

    Args:
        task: a key of `STAGES`.
        stage: one of the task's.
    """
    spec, settings = find_task(task), SimSettings()
    model = spec.object_factory()
    robot = make_task(spec, settings, tool=make_tool(spec, settings, cache_dir=cache_folder()), model=model)
    lattice = _lattice(FilterSettings())
    results = [robot.reset(0)]
    controls = torch.tensor([float(word) for word in _CONTROLS[task].split()]).reshape(-1, 3)
    results += [robot.step(control) for control in controls[: STAGES[task][stage]]]
    robot.close()
    memory, frame = Observation.empty(), torch.eye(4)
    for result in results:
        assert result.reading.object_motion is not None
        frames = result.reading.object_motion @ frame
        frame = frames[-1]
        memory, _ = merge(memory, attach(result.reading.observation, result.reading.instant, frames), lattice)
    truth = results[-1].truth
    assert truth is not None
    readings = tuple(result.reading for result in results)
    return Situation(spec, stage, model.to(torch.float64), readings, memory, torch.linalg.inv(frame) @ truth)


class Followed(NamedTuple):
    """A belief and what it took.

    Attributes:
        belief: after all readings.
        first_s: seconds for the belief of the first view.
        step_s: seconds of the longest update by a touch; 0 where there was none.
    """

    belief: PoseBelief
    first_s: float
    step_s: float


def follow(
    here: Situation,
    sdf: GridSDF,
    *,
    particles: int,
    seed: int,
    filter_settings: FilterSettings | None = None,
    start: InitialiseSettings | None = None,
) -> Followed:
    """The belief that the filter has in a situation, from the first view on.

    Args:
        here: whose readings.
        sdf: of the object, as the estimate has it; its dtype is the belief's.
        particles: P.
        seed: of all randomness.
        filter_settings: of the filter.
        start: of the first belief.
    """
    settings, start = filter_settings or FilterSettings(), replace(start or InitialiseSettings(), particles=particles)
    dtype = sdf.values.dtype
    begun = clock()
    discrepancy = Discrepancy(sdf, here.model.radius, free_scale=settings.free_scale, tolerance=settings.tolerance_m)
    search: Search = "SE(2)"
    pose_filter = PoseFilter(settings, [discrepancy], search).to(dtype)
    first = here.readings[0].observation.to(dtype=dtype)
    memory, _ = merge(Observation.empty(dtype=dtype), first, pose_filter.lattice)
    surface = memory.points[memory.of_class(Semantics.SURFACE)]
    reach_m = float(here.model.surface_points[:, :2].norm(dim=-1).max())
    starts = view_starts(surface, start.starts, reach_m, 0.0, generator=split(seed, "starts"))
    belief = initialise(
        discrepancy, memory, starts, search, settings.peakiness, start, generator=split(seed, "initialise")
    )
    first_s, steps_s, noise = clock() - begun, [0.0], split(seed, "filter")
    for reading in here.readings[1:]:
        cast = cast_reading(reading, dtype)
        begun = clock()
        belief, memory, _ = pose_filter(belief, memory, cast, generator=noise)
        if bool(reading.in_contact.any()):
            steps_s.append(clock() - begun)
    return Followed(belief, first_s, max(steps_s))


def cast_reading(reading: Reading, dtype: torch.dtype) -> Reading:
    """The reading in another floating dtype."""
    return replace(
        reading,
        observation=reading.observation.to(dtype=dtype),
        tool_pose=reading.tool_pose.to(dtype),
        object_motion=None if reading.object_motion is None else reading.object_motion.to(dtype),
        configuration=reading.configuration.to(dtype),
        clipped=reading.clipped.to(dtype),
    )


def _lattice(settings: FilterSettings) -> Float[Tensor, "3"]:
    return torch.tensor((settings.free_spacing_m, settings.free_spacing_m, settings.surface_spacing_m))
