"""Export: what a run found out about an object's pose, in the formats of other programs."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.errors import UsageError
from rumi.records import StepRecord
from rumi.registration.pose_summary import PoseSummary
from rumi.registry import Table
from rumi.runs.folder import Run
from rumi.runs.memory import memory
from sdf.mesh.mesh import TriangleMesh
from sensors.semantics import Semantics


@dataclass(frozen=True, eq=False)
class StepEstimate:
    """The pose estimate after an action.

    Attributes:
        step: number of actions before it.
        stamp: seconds since the start of the run; a second a step where the record has no clock.
        pose: best pose, covariance and modes, world frame.
        world_T_tool: (4, 4), where the tool ended; None where the record does not tell.
    """

    step: int
    stamp: float
    pose: PoseSummary
    world_T_tool: Float[Tensor, "4 4"] | None


@dataclass(frozen=True, eq=False)
class Estimates:
    """Pose estimates of a run, and what the last of them rests on.

    Attributes:
        task: its name.
        steps: the estimates, of the steps that had one; at least one.
        poses: (N, 4, 4), world_T_object of the last belief's particles.
        log_weights: (N,), normalised.
        free: (M, 3), points known to be free, world frame.
        surface: (S, 3), points seen or felt on the object, where it is now.
        answer: how the run ended, as plain values.
        mesh: of the object, in its own frame; None where no format asked for it.
    """

    task: str
    steps: tuple[StepEstimate, ...]
    poses: Float[Tensor, "N 4 4"]
    log_weights: Float[Tensor, "N"]
    free: Float[Tensor, "M 3"]
    surface: Float[Tensor, "S 3"]
    answer: Mapping[str, Any]
    mesh: TriangleMesh | None = None

    @property
    def last(self) -> StepEstimate:
        """The estimate at the end."""
        return self.steps[-1]


class Format(NamedTuple):
    """A format of exports: a member of `FORMATS`.

    Attributes:
        about: what it holds, in a line.
        file: name of its file.
        write: writes the estimates to a file and returns all files that it wrote.
        meshed: whether it needs the object's mesh.
    """

    about: str
    file: str
    write: Callable[[Estimates, Path], list[Path]]
    meshed: bool = False


FORMATS: Table[Format] = Table("format", "rumi.formats")
"""Formats of `rumi export` by name."""

FORMATS.add("json", "rumi.runs.export_files:JSON")
FORMATS.add("npz", "rumi.runs.export_files:NPZ")
FORMATS.add("mjcf", "rumi.runs.export_files:MJCF")
FORMATS.add("urdf", "rumi.runs.export_files:URDF")
FORMATS.add("mcap", "rumi.rosbag.belief_writer:MCAP")


def estimates_of(run: Run, pose_of: Callable[[Run], PoseSummary | None], step: int | None = None) -> Estimates:
    """The pose estimates of a recorded run.

    Args:
        run: as `rumi.runs.folder.load_run` gives it.
        pose_of: the pose that a run knows of, such as `TaskEntry.pose`.
        step: the last one to take; None for the run's last.

    Raises:
        UsageError: there is no such step, or no pose is known yet.
    """
    count = len(run.steps)
    if step is not None and not 0 <= step < count:
        raise UsageError(f"Expected a step of {run.folder}, 0 to {count - 1}, got {step}")
    at_end = step is None or step == count - 1
    known: list[StepEstimate] = []
    upto = run.steps[: count if step is None else step + 1]
    placed = [(at, record) for at, record in enumerate(upto) if record.poses is not None]
    records = [record for _, record in placed]
    clocked = all(b.stamp > a.stamp for a, b in pairwise(records))
    for at, record in placed:
        whole = at_end and at + 1 == count
        pose = pose_of(run if whole else replace(run, steps=run.steps[: at + 1], result=None, ended=None))
        tool = record.reading.tool_pose[-1].double() if isinstance(record, StepRecord) else None
        if pose is not None:
            known.append(StepEstimate(record.step, record.stamp if clocked else float(record.step), pose, tool))
    if not known:
        raise UsageError(f"Expected a run that knows of a pose, got {run.folder}, which does not yet: let it go on")
    poses, log_weights = records[-1].poses
    none = torch.zeros(0, 3)
    seen = memory(records) if isinstance(records[-1], StepRecord) else None
    free = none if seen is None else seen.points[seen.of_class(Semantics.FREE)]
    surface = none if seen is None else seen.points[seen.of_class(Semantics.SURFACE)]
    answer = {"task": run.task, **((run.ended or {}) if at_end else {})}
    return Estimates(run.task, tuple(known), poses.double(), log_weights.double(), free, surface, answer)
