"""How far push models are from the simulator, for pushes of a mug whose pose they know.

python -m scripts.push_models                              # 100 random pushes of two actions each
python -m scripts.push_models --lever-ratios 1 1.25 1.5 2   # other limit surfaces of the quasi-static model
"""

import math
import sys
import time
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
import tyro
from torch import Tensor

from rumi.cli import script
from rumi.dynamics.quasi_static import QuasiStaticSettings
from rumi.dynamics.registry import EngineSettings, PushModels, PushSettings
from rumi.fields.information import information_field
from rumi.robot.tool import Tool
from rumi.sim.world import World
from rumi.tasks.rummage.build import workspace_of
from rumi.tasks.rummage.scenes import SCENES
from scripts.reproduce.cells import push_errors
from sdf import se3
from sdf.object_model import ObjectModel

PLACE = (0.4, 0.0)


@dataclass(frozen=True)
class Options:
    """What is compared.

    Attributes:
        pushes: how many that move the mug.
        lever_ratios: limit surfaces of the quasi-static model.
        frictions: coefficients of its contact.
        seed: of the pushes.
    """

    pushes: int = 100
    lever_ratios: tuple[float, ...] = (1.0, 1.5)
    frictions: tuple[float, ...] = (0.5,)
    seed: int = 0


class Push(NamedTuple):
    """One push: yaw of the mug, tool's start, controls (2, 3), and where the simulator's mug ends."""

    yaw: float
    start: Tensor
    controls: Tensor
    end: Tensor


def pushes(options: Options, model: ObjectModel, tool: Tool) -> list[Push]:
    """Random ways into a mug from all sides, carried out in the simulator."""
    spec = SCENES["mug-0"]
    world = World(model.exact, tool.shape, spec.height_m, 0.004)
    random = torch.Generator().manual_seed(options.seed)
    found: list[Push] = []
    while len(found) < options.pushes:
        draw = 2.0 * torch.rand(11, generator=random) - 1.0
        yaw, side = math.pi * float(draw[0]), math.pi * float(draw[1])
        distance = 0.13 + 0.03 * float(draw[2])
        start = torch.tensor(
            [PLACE[0] + distance * math.cos(side), PLACE[1] + distance * math.sin(side), side + math.pi + draw[3]]
        )
        if _overlaps(model, tool, start, yaw):
            continue
        inward = torch.tensor([-math.cos(side), -math.sin(side)])
        controls = 0.3 * draw[4:10].view(2, 3)
        controls[:, :2] += 0.8 * inward
        controls = controls.clamp(-1.0, 1.0)
        pose = torch.tensor([*PLACE, yaw])
        world.reset(start, pose)
        path = tool.free_path(start, controls, 20)
        for action in (path[:20], path[20:]):
            world.move(action, 1.0, 0.1)
        end = se3.to_planar(world.world_T_object()).float()
        if float((end - pose)[:2].norm()) > 0.002:
            found.append(Push(yaw, start, controls, end))
    return found


def _overlaps(model: ObjectModel, tool: Tool, start: Tensor, yaw: float) -> bool:
    pose = se3.from_planar(torch.tensor([*PLACE, yaw]))
    points = se3.apply(se3.inverse(pose), tool.points(start))
    return float(model.exact.distance(points).min()) < 0.004


def errors(family: PushModels, found: list[Push], model: ObjectModel, tool: Tool) -> tuple[Tensor, Tensor, float]:
    """Errors of place (m) and yaw (rad) at the end, and seconds a push."""
    workspace = workspace_of(replace(SCENES["mug-0"], bounds=((0.0, -0.4), (0.8, 0.4))))
    place, turn = [], []
    begun = time.perf_counter()
    for push in found:
        pose = se3.from_planar(torch.tensor([[*PLACE, push.yaw]]))
        weights = torch.zeros(1)
        fields = information_field(model.sdf, pose, weights, workspace.points)
        made = family.rollouts(model, pose, weights, tool, workspace, fields)
        rolled = made.nominal_rollout(push.start, push.controls)
        turned = 0.0 if rolled.turns is None else float(rolled.turns[0, 0, -1])
        predicted = torch.tensor([*PLACE, push.yaw]) + torch.tensor([0.0, 0.0, turned])
        predicted[:2] += rolled.displacements[0, 0, -1, :2]
        apart = predicted - push.end
        place.append(float(apart[:2].norm()))
        turn.append(abs(math.remainder(float(apart[2]), 2.0 * math.pi)))
    return torch.tensor(place), torch.tensor(turn), (time.perf_counter() - begun) / max(1, len(found))


def main() -> None:
    """Print the table."""
    options = tyro.cli(Options, description=__doc__)
    spec = SCENES["mug-0"]
    model = spec.object_factory()
    tool = Tool(torch.tensor([[-5.0, -5.0], [5.0, 5.0]]), height_m=spec.height_m)
    found = pushes(options, model, tool)
    ends = torch.stack([push.end for push in found])
    moved = (ends[:, :2] - torch.tensor(PLACE)).norm(dim=-1)
    turned = torch.tensor([math.remainder(float(p.end[2]) - p.yaw, 2.0 * math.pi) for p in found]).abs()
    sys.stdout.write(f"{len(found)} pushes, seed {options.seed}\n\n")
    apart = {"the mug stays": (moved, turned)}
    families = {"displacement": PushModels(PushSettings("displacement"))}
    for ratio in options.lever_ratios:
        for friction in options.frictions:
            settings = QuasiStaticSettings(lever_ratio=ratio, friction=friction)
            name = f"quasi-static, lever ratio {ratio:g}, friction {friction:g}"
            families[name] = PushModels(PushSettings("quasi-static", quasi_static=settings))
    families["mujoco, 5 ms"] = PushModels(PushSettings("mujoco", engine=EngineSettings(threads=1)))
    for name, family in families.items():
        place, turn, seconds = errors(family, found, model, tool)
        apart[f"{name} ({1e3 * seconds:.0f} ms)"] = place, turn
    sys.stdout.write(push_errors(apart))


if __name__ == "__main__":
    script(main)
