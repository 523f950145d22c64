"""Families of motions as nominal plans beside noise: straight to what would tell most, round the object, along it.

python -m scripts.plan_families run --seeds 15000-15002     # tuning; the same command goes on
python -m scripts.plan_families show

Whole runs of mugs by what KMPPI may start from (`RummagingPolicy`'s proposals), and by settings of the field that plans
rest on. `mug` is drawn by the seed and run under `lab`; mug-0 to mug-2 are run under `ideal`.
"""

import itertools
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from kmppi import MPPI, MPPISettings
from rumi.agent import Parts
from rumi.cache import cache_folder
from rumi.cli import script
from rumi.dynamics.outline import GridOutline
from rumi.fields.information import WorkspaceFields
from rumi.planning.policy import PlanRequest
from rumi.planning.rummaging import RummagingPolicy
from rumi.robot.tool import Tool
from rumi.tasks.rummage.agent import Rummager
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.settings import Settings, preset
from scripts.experiment import Experiment, Line
from scripts.outcomes import ended, right, won_lost, wrong
from scripts.plan_judging import paired
from scripts.plan_proposals import policy_of
from scripts.reproduce.cells import rate, table
from sdf import se3
from sdf.so3 import wrap

TARGETS, BEYOND_M = 12, (0.02, 0.08)  # of straight ways, and how far past its target one goes
TURNS = (0.6, 1.2, 1.8, 2.4)  # radians round the object, either way
AWAY_M = 0.045  # from what the tool would touch, on the way round
RAYS, PRESSED_M = 72, (0.004, 0.02)  # of an outline about the object's middle; how far into it a way along it leads
PUSHED_M = (0.004, 0.06)  # how far into it a way round it leads

Waypoints = list[Float[Tensor, "W 3"]]


def knots_of(planner: MPPI, tool: Tool, start: Float[Tensor, "3"], ways: Waypoints) -> Float[Tensor, "P S 3"]:
    """Knots whose controls come nearest to those that lead along some ways, each leg as fast as the tool goes."""
    fit = torch.linalg.pinv(planner.parameterization.matrix.to(start))
    return torch.stack([fit @ controls_of(tool, start, way, planner.settings.horizon) for way in ways])


def controls_of(tool: Tool, start: Float[Tensor, "3"], way: Float[Tensor, "W 3"], horizon: int) -> Tensor:
    """Controls (H, 3) along waypoints (x, y, yaw), as many as there are actions for; the tool rests at the last."""
    legs = torch.diff(torch.cat((start[None], way)), dim=0)
    legs = torch.cat((legs[:, :2], wrap(legs[:, 2:])), -1) / tool.scale
    actions = [leg.expand(count, 3) / count for leg in legs if (count := math.ceil(float(leg.abs().max()))) > 0]
    return torch.cat((*actions, start.new_zeros(horizon, 3)))[:horizon]


@dataclass(frozen=True)
class Around:
    """The believed object and where the tool's middle is when it faces and touches it, by direction.

    Attributes:
        middle: (2,), of the object.
        radii: (RAYS,), of the likeliest pose's outline about the middle, by even world angles from 0.
        ahead_m: from the tool's middle to its foremost point.
    """

    middle: Float[Tensor, "2"]
    radii: Float[Tensor, "RAYS"]
    ahead_m: float

    @classmethod
    def of(cls, request: PlanRequest, outline: GridOutline) -> "Around":
        """Of the likeliest pose of a belief."""
        pose = se3.to_planar(request.belief.world_T_object)[request.belief.log_weights.argmax()]
        angles = torch.arange(RAYS) * (2.0 * math.pi / RAYS)
        out = torch.arange(0.0, 0.12, 0.001)
        own = angles[:, None] - pose[2]
        inside = outline(torch.stack((own.cos() * out, own.sin() * out), -1)).distance <= 0.0
        radii = (inside * out).amax(-1)
        return cls(pose[:2], radii, float(request.scene.tool.info[:, 0].max()))

    def stance(self, angle: float, away_m: float) -> Float[Tensor, "3"]:
        """The tool (x, y, yaw) that faces the object's middle from a direction, so far from touching it."""
        across = self.radii[round(angle / (2.0 * math.pi) * RAYS) % RAYS]
        far = float(across) + self.ahead_m + away_m
        place = self.middle + far * torch.tensor([math.cos(angle), math.sin(angle)])
        return torch.cat((place, torch.tensor([angle + math.pi])))

    def angle_of(self, configuration: Float[Tensor, "3"]) -> float:
        """Direction in which the tool is from the object's middle."""
        x, y = (configuration[:2] - self.middle).tolist()
        return math.atan2(y, x)


def straight(request: PlanRequest, fields: WorkspaceFields, around: Around) -> Waypoints:
    """By a pad to the cells of most information that lie apart, as the tool is turned or facing them."""
    scene, ways = request.scene, []
    where, worth = scene.workspace.points[:, :2], fields.information.clone()
    here = scene.configuration
    for _ in range(TARGETS):
        target = where[worth.argmax()]
        worth[(where - target).norm(dim=-1) < 0.02] = 0.0
        gap = target - here[:2]
        facing = float(torch.atan2(gap[1], gap[0]))
        for yaw, pad, past in itertools.product((float(here[2]), facing), pads_of(scene.tool), BEYOND_M):
            cos, sin = math.cos(yaw), math.sin(yaw)
            front = torch.tensor([cos * pad[0] - sin * pad[1], sin * pad[0] + cos * pad[1]])
            beyond = past * gap / gap.norm().clamp_min(1e-6)
            ways.append(torch.cat((target - front + beyond, torch.tensor([yaw])))[None])
    return ways


def pads_of(tool: Tool) -> list[tuple[float, float]]:
    """Middle of each pad's front, tool frame."""
    sides = [tool.info[tool.info[:, 1] * side > 0] for side in (1.0, -1.0)]
    return [(float(side[:, 0].max()), float(side[:, 1].mean())) for side in sides if len(side)]


def round_it(request: PlanRequest, fields: WorkspaceFields, around: Around) -> Waypoints:
    """Clear of the object round it by some angle, then in until it is touched, or pushed."""
    return [_turned(request, around, turn, AWAY_M, [-deep]) for turn in _either_way() for deep in PUSHED_M]


def along_it(request: PlanRequest, fields: WorkspaceFields, around: Around) -> Waypoints:
    """In touch with the object along its outline by some angle."""
    return [_turned(request, around, turn, -deep, []) for turn in _either_way() for deep in PRESSED_M]


def _either_way() -> list[float]:
    return [side * turn for turn in (0.0, *TURNS) for side in (1.0, -1.0) if turn or side > 0]


def _turned(request: PlanRequest, around: Around, turn: float, away_m: float, then_m: list[float]) -> Tensor:
    """Waypoints (W, 3) round the object, so far from touching it, and at the last angle other distances after that."""
    begin = around.angle_of(request.scene.configuration)
    parts = max(1, math.ceil(abs(turn) / 0.3))
    way = [around.stance(begin + turn * part / parts, away_m) for part in range(parts + 1)]
    return torch.stack([*way, *(around.stance(begin + turn, away) for away in then_m)])


FAMILIES: Mapping[str, Callable[[PlanRequest, WorkspaceFields, Around], Waypoints]] = {
    "straight": straight,
    "round": round_it,
    "along": along_it,
}
ALL = "all three"


class Families:
    """The `PlanProposals` of some families.

    Args:
        names: keys of `FAMILIES`.
        planner: settings of the planner that the knots are for.
        outline: of the object at the height of the tool.
    """

    def __init__(self, names: tuple[str, ...], planner: MPPISettings, outline: GridOutline) -> None:
        self.names, self.planner, self.outline = names, MPPI(planner, 3), outline

    def __call__(self, request: PlanRequest, fields: WorkspaceFields) -> Float[Tensor, "P S 3"]:
        """Knots of all of the families."""
        around, scene = Around.of(request, self.outline), request.scene
        ways = [way for name in self.names for way in FAMILIES[name](request, fields, around)]
        return knots_of(self.planner, scene.tool, scene.configuration, ways)


VARIANTS = ("as it is", "sensed left out", *FAMILIES, ALL)
TASKS = ("mug", "mug-0", "mug-1", "mug-2")


def settings_of(task: str, variant: str, seed: int) -> Settings:
    """Settings of a run."""
    own = preset(task=task, seed=seed, conditions="lab" if task == "mug" else "ideal")
    if variant == "sensed left out":
        own = replace(own, planner=replace(own.planner, sensed_here=True))
    return own


def with_variant(parts: Parts[Any, Rummager], variant: str) -> Parts[Any, Rummager]:
    """Parts whose policy plans as a variant says, as far as settings do not say it."""
    agent = parts.agent
    own = policy_of(agent)
    proposals = families_of(variant, agent)
    if proposals is None:
        return parts
    policy = RummagingPolicy(own.reachability, own.settings, proposals=proposals)
    return replace(parts, agent=replace(agent, policy=policy))


def families_of(variant: str, agent: Rummager) -> Families | None:
    """What a variant of plans starts from beside noise; None for nothing."""
    names = tuple(FAMILIES) if variant == ALL else (variant,)
    if names[0] not in FAMILIES:
        return None
    outline = GridOutline.of_slice(agent.model.sdf, agent.tool.height_m - agent.height_m)
    return Families(names, policy_of(agent).settings.mppi, outline)


def measure(task: str, variant: str, seed: int) -> dict[str, Any]:
    """How a run ended."""
    begun = time.process_time()
    with build(settings_of(task, variant, seed), cache_dir=cache_folder()) as parts:
        found = ended(with_variant(parts, variant), seed, more=("steps", "contacts"))
    return found | {"cpu_s": round(time.process_time() - begun, 2)}


def show(lines: list[Line], chosen: object) -> str:
    """A row for each task and variant, paired by seed with plans as they are."""
    rows = []
    for task in TASKS:
        by = {name: {x["seed"]: x for x in lines if x["task"] == task and x["variant"] == name} for name in VARIANTS}
        rows += [[task, name, *_row(by[name], by[VARIANTS[0]])] for name in VARIANTS if by[name]]
    heads = ("task", "plans", "right", "sure and wrong", "actions, mean", "more actions, paired", "won; lost (p)")
    return table((*heads, "seconds of a run"), rows)


def _row(runs: Mapping[int, Line], own: Mapping[int, Line]) -> list[str]:
    found, both = list(runs.values()), sorted(runs.keys() & own.keys())
    steps = [x["steps"] for x in found if x["steps"] is not None]
    gone = [(runs[seed]["steps"], own[seed]["steps"]) for seed in both]
    more = [a - b for a, b in gone if a is not None and b is not None]
    told = "" if runs is own else "{mean:+.2f} [{low:+.2f}, {high:+.2f}]".format(**paired(more))
    return [
        rate([right(x) for x in found]),
        rate([wrong(x) for x in found]),
        f"{sum(steps) / len(steps):.2f}",
        told,
        "" if runs is own else won_lost(runs, own),
        f"{sum(x['cpu_s'] for x in found) / len(found):.1f}",
    ]


EXPERIMENT = Experiment(
    __doc__,
    "plan_families.jsonl",
    {"task": TASKS, "variant": VARIANTS},
    measure,
    show,
    seeds="15000-15029",
)

if __name__ == "__main__":
    script(EXPERIMENT.main)
