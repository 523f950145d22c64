"""A made-up run: everything that a real one records, without simulator and planner, in a second."""

from collections.abc import Callable
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from rumi.belief.particles import PoseBelief
from rumi.fields.workspace import Workspace
from rumi.planning.policy import Plan
from rumi.records import RunResult, StepRecord
from rumi.robot.gripper import GripperShape
from rumi.runs.sketch import SceneSketch, sketch
from sdf import se3
from sdf.object_model import mug_model
from sensors.observation import Observation, concatenate
from sensors.reading import Reading
from sensors.semantics import Semantics


@dataclass
class MadeUp:
    steps: list[StepRecord]
    sketch: SceneSketch
    result: RunResult


HEIGHT = 0.0475


def ray_points(model, truth: Tensor, eye: Tensor) -> Observation:
    """What a camera at `eye` sees: the near half of the surface, and free points on the way there."""
    surface = se3.apply(truth, model.surface_points)
    normals = se3.rotate(truth, model.surface_normals)
    near = ((eye - surface) * normals).sum(-1) > 0.02
    # the handle lies behind the body
    near &= surface[:, 0] < truth[0, 3] + 0.02
    seen = surface[near]
    along = torch.linspace(0.55, 0.95, 8)[:, None, None]
    free = (eye + along * (seen[::6] - eye)).reshape(-1, 3)
    return concatenate([Observation.of(seen, Semantics.SURFACE), Observation.of(free, Semantics.FREE)])


def make_up(count: int = 9, particles: int = 100, seed: int = 0) -> MadeUp:
    """A tool that goes round the mug, touches the handle at the fourth step and drags the mug from then on."""
    random = torch.Generator().manual_seed(seed)
    model = mug_model()
    workspace = Workspace.from_bounds(
        torch.tensor([[0.0, -0.4, HEIGHT], [0.8, 0.4, HEIGHT]]), 0.01, planar_height=HEIGHT
    )
    start = se3.from_planar(torch.tensor([0.45, 0.02, 0.35]))
    section = GripperShape().section(0.002).float()
    tool_points = torch.cat((section, torch.zeros(len(section), 1)), -1)
    path = torch.tensor(
        [[0.15, 0.0, 0.0], [0.22, 0.1, 0.4], [0.32, 0.17, 0.2], [0.42, 0.2, -0.3], [0.5, 0.15, -1.0], [0.49, 0.1, -1.3]]
        + [[0.49 - 0.03 * k, 0.1 - 0.02 * k, -1.4] for k in range(1, 40)]
    )
    at = se3.identity((), dtype=torch.float32)
    eye = torch.tensor([-0.25, 0.0, 0.3])
    reach = (1.25 - (workspace.points[:, :2] - torch.tensor([-0.45, 0.0])).norm(dim=-1) / 0.95).clamp(0, 1)
    steps: list[StepRecord] = []
    plan = None
    information = None
    for k in range(count):
        touched = k >= 4
        if k >= 5:
            at = se3.from_planar(torch.tensor([-0.018, -0.012, 0.05])) @ at
        truth = at @ start
        spread = 0.8 if not touched else 0.35 * 0.3 ** (k - 4)
        yaw = 0.35 + spread * (2 * torch.rand(particles, generator=random) - 1)
        xy = 0.001 * torch.randn(particles, 2, generator=random) + torch.tensor([0.45, 0.02])
        poses = se3.from_planar(torch.cat((xy, yaw[:, None]), -1))
        log_weights = torch.log_softmax(-(((yaw - 0.35) / (0.25 + spread)) ** 2) * 4, -1)
        belief = PoseBelief(at, poses, log_weights, log_weights.neg() / 2)
        moments = torch.linspace(0, 1, 5)[1:, None] if k else torch.ones(1, 1)
        tool = se3.from_planar(path[max(k - 1, 0)] * (1 - moments) + path[k] * moments)
        if k == 0:
            added = ray_points(model, start, eye)
        elif touched:
            grip = se3.apply(truth, model.surface_points)
            near = (grip - tool[-1, :3, 3]).norm(dim=-1) < 0.06
            added = Observation.of(se3.apply(se3.inverse(at), grip[near]), Semantics.SURFACE)
        else:
            added = Observation.of(se3.apply(tool[-1], tool_points[::29]), Semantics.FREE)
        world = torch.where(added.attached[:, None], se3.apply(at, added.points), added.points)
        reading = Reading(
            observation=Observation(world, added.semantics, added.attached, added.valid),
            instant=torch.zeros(len(added), dtype=torch.long),
            tool_pose=tool,
            in_contact=torch.full((len(tool),), touched and k > 0),
            object_motion=se3.identity((len(tool),), dtype=torch.float32),
            configuration=path[k],
            clipped=torch.tensor(0.0),
            stamp=float(k),
        )
        if k and (k - 1) % 3 == 0:
            centre = belief.world_T_object[:, None, :2, 3] + 0.06 * torch.stack(((yaw).cos(), (yaw).sin()), -1)[:, None]
            away = (workspace.points[:, None, :2] - centre[:, 0]).norm(dim=-1)
            information = (torch.exp(-((away / 0.012) ** 2)) @ belief.weights).clamp_min(0)
            plan = Plan(
                controls=torch.zeros(15, 3),
                path=torch.stack([path[min(k - 1 + j, len(path) - 1)] for j in range(16)]),
                fields={"information": information},
                info={"ess": 1.5},
            )
        nll = 22.0 * min(1.0, spread / 0.8) + 0.4 * k % 1.3
        steps.append(
            StepRecord(
                step=k,
                control=torch.zeros(3) if k else None,
                reading=reading,
                added=added,
                belief=belief,
                plan=plan if k else None,
                expected_nll=0.9 * nll + 1.0,
                fit=0.1 + 0.05 * k,
                apc=0.0008 + 0.0015 * spread,
                ess=float(belief.ess()),
                contacts=max(0, k - 3),
                resampled=k == 5,
                converged=k == count - 1,
                truth=truth,
                nll=nll,
                timings_s={"simulate": 0.02, "belief": 0.1, "plan": 0.2},
            )
        )
    values = [step.nll for step in steps]
    result = RunResult(
        right=True,
        paper_success=True,
        paper_success_at_start=False,
        min_nll=min(values),
        final_nll=values[-1],
        cumulative_nll=sum(values),
        steps=count - 1,
        stopped_by="sure",
        apc=steps[-1].apc,
        expected_nll=steps[-1].expected_nll,
        position_error_mm=0.4,
        rotation_error_deg=float("nan"),
        contacts=steps[-1].contacts,
        clipped=0,
        timings_s={"simulate": 0.2},
    )
    return MadeUp(
        steps,
        sketch(
            model, workspace, tool_points, height_m=0.0, reachability=reach, thresholds={"nll": 20.0, "apc": 0.00513}
        ),
        result,
    )


@pytest.fixture(scope="session")
def made_up() -> Callable[..., MadeUp]:
    """Makes up a run; see `make_up`."""
    return make_up
