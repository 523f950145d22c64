"""The command `rumi check`: a log's observations drawn over the model, to see whether calibrations are right."""

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import torch
import tyro
from jaxtyping import Float
from torch import Tensor

from rumi.cache import cache_folder
from rumi.errors import UsageError
from rumi.exit_codes import DONE
from sdf import se3

if TYPE_CHECKING:
    from rumi.tasks.rummage.agent import Rummager
    from sensors.log.reader import Taken
    from sensors.observation import Observation

_SUFFIXES = (".png", ".pdf", ".svg", ".jpg", ".jpeg")


@dataclass(frozen=True)
class CheckOptions:
    """Draw what was observed over the model, and say how well it lies there.

    Put the object where you know its pose, record, and give that pose: what is then off is the calibration. Without one
    the likeliest pose of the belief is taken, which shows errors of shape and scale, but has adapted to others.

    Attributes:
        log: the log, or the run's folder that it lies in.
        step: reading to draw; 0 is the first view.
        pose: of the object in the world with its floor at 0: x, y, z in metres, roll, pitch, yaw in degrees.
        map: mapping file of an imported recording, in place of its own.
        out: the picture, or the folder for it; by default check.png beside the log, or in the run's folder.
    """

    log: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="LOG")]
    step: int = 0
    pose: Annotated[tuple[float, ...], tyro.conf.arg(metavar="X Y Z ROLL PITCH YAW")] = ()
    map: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    out: Annotated[Path | None, tyro.conf.arg(metavar="PNG")] = None


def check(arguments: Sequence[str]) -> int:
    """`rumi check`: 0 where it could be drawn, 2 for bad input."""
    options = tyro.cli(CheckOptions, prog="rumi check", args=arguments)
    six = len(options.pose) == 6 and all(map(math.isfinite, options.pose))
    if not six and (options.pose or "--pose" in arguments):
        raise UsageError(f"Expected --pose to be six numbers, got {' '.join(map(str, options.pose)) or 'none'}")
    beside = options.log if options.log.is_dir() else options.log.parent
    out = _picture(beside / "check.png" if options.out is None else options.out)
    from rumi.commands.replay import agent_of_imported, made_readings, mapping_of_log, opened, recorded_settings
    from rumi.metrics.alignment import align
    from rumi.rosbag.mapping import Fixed
    from rumi.tasks.rummage.settings import Settings
    from rumi.viz.overlay import draw_overlay

    with opened(options.log, options.map) as log:
        mapping = mapping_of_log(log, options.map)
        entry, settings = recorded_settings(log, mapping)
        if not isinstance(settings, Settings):
            raise UsageError(f"Expected a recording of points in space, got {options.log}, which is of another task")
        taken = log.taken() if mapping is None else made_readings(log, mapping, settings)
        for problem in log.problems:
            sys.stderr.write(f"rumi: {problem}\n")
    if not taken:
        raise UsageError("Expected a log with a first reading at least, got none: there is nothing to draw")
    if not 0 <= options.step < len(taken):
        raise UsageError(f"Expected --step 0 to {len(taken) - 1}, the readings of {options.log}, got {options.step}")
    if mapping is None:
        agent = entry.agent(settings, cache_dir=cache_folder())
    else:
        agent = agent_of_imported(mapping, settings, taken, cache_folder())
    rummager = cast("Rummager", agent)
    if options.pose:
        x, y, z, roll, pitch, yaw = options.pose
        pose, whose = Fixed("", "", (x, y, z), (roll, pitch, yaw)).pose(), "the pose that was given"
    else:
        pose, whose = _likeliest(taken[: options.step + 1], rummager, settings.seed), "the belief's likeliest pose"
    seen = at_the_end(taken[options.step])
    model = rummager.model.to("cpu", torch.float32)
    found = align(seen, pose, rummager.model.exact)
    title = f"{options.log}, reading {options.step}, at {whose}"
    path = draw_overlay(seen, pose.float(), model, found, out, title=title)
    x, y, z = pose[:3, 3].tolist()
    yaw = math.degrees(math.atan2(float(pose[1, 0]), float(pose[0, 0])))
    sys.stdout.write(f"{title}: ({x:.4f}, {y:.4f}, {z:.4f}) m, yaw {yaw:.1f} degrees\n")
    sys.stdout.write("".join(f"  {line}\n" for line in found.text().splitlines()))
    sys.stdout.write(f"  picture  {path}\n")
    return DONE


def _picture(path: Path) -> Path:
    """The file to write: a PNG, or another kind of picture that matplotlib writes, by its suffix."""
    if path.is_dir():
        return path / "check.png"
    if path.suffix.lower() not in _SUFFIXES:
        if path.suffix:
            raise UsageError(f"Expected --out to end in {', '.join(_SUFFIXES)}, got {path}")
        return path.with_name(f"{path.name}.png")
    return path


def at_the_end(taken: "Taken") -> "Observation":
    """The points of a reading, carried with the object to where it was at the reading's end, where that is known."""
    reading = taken.reading
    if reading.object_motion is None or len(reading.observation) == 0:
        return reading.observation
    carry = reading.object_motion[-1] @ se3.inverse(reading.object_motion)
    own = carry[reading.instant]
    moved = (own[:, :3, :3] @ reading.observation.points[..., None])[..., 0] + own[:, :3, 3]
    attached = reading.observation.attached[:, None]
    return replace(reading.observation, points=torch.where(attached, moved, reading.observation.points))


def _likeliest(taken: "Sequence[Taken]", rummager: "Rummager", seed: int) -> Float[Tensor, "4 4"]:
    from rumi.runs.replay import replay

    # all of the readings, sure or not
    rummager = replace(rummager, stop_rule=replace(rummager.stop_rule, rule="never"))
    return replay(taken, rummager, seed=seed).last.belief.mode().cpu()
