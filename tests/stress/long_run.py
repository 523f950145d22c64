"""One belief over ten thousand readings: what it holds, how sure it is, and whether it drifts from the truth."""

import math
import resource
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from rumi.belief.particles import PoseBelief
from rumi.belief.pose_filter import FilterSettings, PoseFilter
from rumi.seeding import split
from sdf import se3
from sdf.object_model import mug_model
from sensors.discrepancy import Discrepancy
from sensors.observation import Observation
from sensors.reading import Reading

PARTICLES = 60
POINTS = 30


@dataclass
class LongRun:
    """What a long run was like, at moments spread over it.

    Attributes:
        step: readings so far.
        memory_mb: the most that the process ever held.
        points: that the belief's memory holds.
        ess: effective sample size.
        metres, radians: of the best mode from the truth.
        orthogonality: largest entry of R^T R - 1 over all particles in the world.
    """

    step: list[int] = field(default_factory=list)
    memory_mb: list[float] = field(default_factory=list)
    points: list[int] = field(default_factory=list)
    ess: list[float] = field(default_factory=list)
    metres: list[float] = field(default_factory=list)
    radians: list[float] = field(default_factory=list)
    orthogonality: list[float] = field(default_factory=list)


def long_run(steps: int, *, seed: int = 0, moments: int = 20, said: Callable[[int], None] | None = None) -> LongRun:
    """Follow a mug that is pushed to and fro, in float32, by a few points of its true surface and about it a reading.

    The motion is measured exactly but for float32; the particles start about the truth. Readings are consistent, so
    that the belief has no reason to leave the truth, and nothing to learn after a while: its memory should not grow.

    Args:
        steps: readings.
        seed: of all that is drawn.
        moments: at how many steps the belief is looked at.
        said: called with each such step.
    """
    generator = split(seed, "long run")
    model = mug_model(spacing=0.004)
    tolerance, settings = 0.002, FilterSettings(free_scale=80.0, tolerance_m=0.002, trigger=2.0)
    discrepancy = Discrepancy(model.sdf, model.radius, free_scale=settings.free_scale, tolerance=tolerance)
    follower = PoseFilter(settings, [discrepancy], "SE(2)")
    truth = se3.from_planar(torch.tensor([0.4, 0.1, 0.3]))
    around = torch.randn(PARTICLES, 3, generator=generator) * torch.tensor([0.005, 0.005, 0.1])
    belief = PoseBelief.uniform(truth @ se3.from_planar(around))
    memory, found = Observation.empty(), LongRun()
    wide = se3.compose(truth.double(), se3.identity(dtype=torch.float64))
    for step in range(1, steps + 1):
        motion = _push(step)
        wide = se3.compose(motion.double(), wide)
        belief, memory, _ = follower(belief, memory, _reading(model, wide, motion, generator), generator=generator)
        if step == steps or step % max(1, steps // moments) == 0:
            _look(found, step, belief, memory, wide)
            if said is not None:
                said(step)
    return found


def _push(step: int) -> Tensor:
    """World motion of a reading: every tenth a push of some millimetres and degrees, there and back again."""
    if step % 10:
        return se3.identity()
    there = 1.0 if (step // 10) % 2 else -1.0
    turn = se3.from_planar(there * torch.tensor([0.004, -0.002, 0.05]))
    middle = se3.from_planar(torch.tensor([0.4, 0.1, 0.0]))
    return middle @ turn @ se3.inverse(middle)


def _reading(model: object, truth: Tensor, motion: Tensor, generator: torch.Generator) -> Reading:
    surface = model.surface_points  # type: ignore[attr-defined]
    chosen = torch.randint(len(surface), (POINTS,), generator=generator)
    pose = truth.float()
    touched = se3.apply(pose, surface[chosen])
    normals = se3.rotate(pose, model.surface_normals[chosen])  # type: ignore[attr-defined]
    outside = touched + 0.02 * normals
    points = torch.cat((touched, outside))
    seen = Observation.of(points, 2)
    semantics = torch.cat((seen.semantics[:POINTS], torch.zeros(POINTS, dtype=torch.long)))
    free = model.sdf.distance(se3.apply(se3.inverse(pose), outside)) > 0.005  # type: ignore[attr-defined]
    valid = torch.cat((torch.ones(POINTS, dtype=torch.bool), free))
    return Reading(
        observation=Observation(seen.points, semantics, seen.attached, valid),
        instant=torch.zeros(2 * POINTS, dtype=torch.long),
        tool_pose=se3.identity((1,)),
        in_contact=torch.tensor([True]),
        object_motion=motion[None],
        configuration=torch.zeros(3),
        clipped=torch.tensor(0.0),
    )


def _look(found: LongRun, step: int, belief: PoseBelief, memory: Observation, truth: Tensor) -> None:
    metres, radians = se3.distance(belief.mode().double(), truth)
    rotation = belief.world_T_object[..., :3, :3].double()
    off = rotation.mT @ rotation - torch.eye(3, dtype=torch.float64)
    found.step.append(step)
    found.memory_mb.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
    found.points.append(len(memory))
    found.ess.append(float(belief.ess()))
    found.metres.append(float(metres))
    found.radians.append(float(radians))
    found.orthogonality.append(float(off.abs().max()))


def text(found: LongRun) -> str:
    """The moments as a table."""
    lines = [f"{'reading':>8} {'points':>7} {'ess':>6} {'mm off':>7} {'deg off':>8} {'orthogonal':>10} {'MB':>7}"]
    for k, step in enumerate(found.step):
        lines.append(
            f"{step:>8} {found.points[k]:>7} {found.ess[k]:>6.1f} {1e3 * found.metres[k]:>7.2f} "
            f"{math.degrees(found.radians[k]):>8.2f} {found.orthogonality[k]:>10.1e} {found.memory_mb[k]:>7.0f}"
        )
    return "\n".join(lines) + "\n"
