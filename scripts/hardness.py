"""How hard the tasks are before anything is touched.

    python -m scripts.hardness

Prints for each kind of object the nll of single poses, so that it shows what the paper's threshold lets through, and
for each task the nll at step 0, the share of the initial information where the reachability r(x) is below 0.5,
the share that no reachable pose of the tool can touch, and how far the object may be pushed away from the arm's base
until the tool touches less than a tenth of the information.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import tyro
from jaxtyping import Bool, Float
from torch import Tensor

from rumi.cache import cache_folder
from rumi.cli import script
from rumi.fields.information import information_field
from rumi.fields.workspace import Workspace
from rumi.metrics.likelihood import negative_log_likelihood
from rumi.robot.tool import Tool
from rumi.seeding import split
from rumi.tasks.rummage.build import build, reachability
from rumi.tasks.rummage.first_belief import first_belief
from rumi.tasks.rummage.scenes import SCENES, find_task
from rumi.tasks.rummage.settings import preset
from sdf import se3, so3
from sdf.object_model import ObjectModel


@dataclass(frozen=True)
class Options:
    """Which tasks."""

    tasks: tuple[str, ...] = tuple(SCENES)
    seed: int = 0


def touchable(tool: Tool, workspace: Workspace, step_m: float = 0.01, yaws: int = 72) -> Bool[Tensor, "V"]:
    """Lattice cells that a sensing point of the tool meets at some reachable configuration, obstacles apart."""
    low, high = tool.bounds
    if tool.spatial:
        step_m, yaws = workspace.spacing, 24
    axes = [torch.arange(float(low[k]), float(high[k]) + 1e-6, step_m) for k in range(len(low))]
    axes.append(torch.arange(yaws) * (2 * torch.pi / yaws) - torch.pi)
    met = torch.zeros(workspace.shape, dtype=torch.bool)
    for x in axes[0]:
        q = torch.stack(torch.meshgrid(x[None], *axes[1:], indexing="ij"), -1).flatten(0, -2)
        if tool.reach is not None:
            q = q[tool.reach.reachable(q)]
        for part in q.split(4096):
            cell = ((tool.info_points(part) - workspace.origin) / workspace.spacing).round().long().reshape(-1, 3)
            cell[:, 2] *= not workspace.planar
            inside = ((cell >= 0) & (cell < torch.tensor(workspace.shape))).all(-1)
            met[tuple(cell[inside].unbind(-1))] = True
    return met.reshape(-1)


def slack_m(
    met: Bool[Tensor, "V"], information: Float[Tensor, "V"], workspace: Workspace, tool: Tool, centre: Tensor
) -> float:
    """Metres that the object may be pushed straight away from the base until under a tenth of it can be touched."""
    if tool.reach is None:
        return float("inf")
    away = centre[:2] - tool.reach.base[:2]
    away = away / away.norm()
    points, total = workspace.points, information.sum()
    for push in torch.arange(0.0, 0.4, 0.005):
        moved = points[:, :2] + push * away
        moved = torch.cat((moved, points[:, 2:]), -1)
        cell = ((moved - workspace.origin) / workspace.spacing).round().long()
        inside = ((cell >= 0) & (cell < torch.tensor(workspace.shape))).all(-1)
        cell = cell.clamp_min(0).minimum(torch.tensor(workspace.shape) - 1)
        there = met.reshape(workspace.shape)[tuple(cell.unbind(-1))] & inside
        if float((information * there).sum() / total) < 0.1:
            return float(push)
    return 0.4


def single_poses(names: Sequence[str]) -> None:
    """Print the nll of single poses off the truth, for one task of each kind of object."""
    metres, degrees = (0.003, 0.005, 0.008, 0.010, 0.015), (5, 10, 15, 20, 30, 90, 180)
    print(f"| object | threshold | along | {' | '.join(f'{1e3 * m:.0f} mm' for m in metres)} |")
    print("|---|---|---" + "|---" * len(metres) + "|")
    kinds = {find_task(name).object_factory: find_task(name) for name in names}
    turned = []
    for spec in kinds.values():
        model = spec.object_factory()

        def nll(pose: Tensor, model: ObjectModel = model) -> float:
            sample = (model.surface_points, model.exact)
            return float(negative_log_likelihood(pose[None], torch.zeros(1), torch.eye(4), *sample))

        for axis, name in enumerate("xyz"):
            shifts = [m * torch.eye(3)[axis] for m in metres]
            cells = [f"{nll(se3.make(torch.eye(3), shift)):.0f}" for shift in shifts]
            print(f"| {model.name} | {spec.nll_threshold:.0f} | {name} | {' | '.join(cells)} |")
            turns = [math.radians(angle) * torch.eye(3)[axis] for angle in degrees]
            values = [f"{nll(se3.make(so3.exp(turn), torch.zeros(3))):.0f}" for turn in turns]
            turned.append(f"| {model.name} | {spec.nll_threshold:.0f} | {name} | {' | '.join(values)} |")
    print(f"\n| object | threshold | about | {' | '.join(f'{d} deg' for d in degrees)} |")
    print("|---|---|---" + "|---" * len(degrees) + "|")
    print("\n".join(turned) + "\n")


def main(options: Options) -> None:
    """Print the nll of single poses, then one row a task."""
    single_poses(options.tasks)
    heads = ("task", "threshold", "nll at step 0", "information where r < 0.5", "information out of touch")
    print(f"| {' | '.join(heads)} | slack outward, mm |")
    print("|---|---|---|---|---|---|")
    for name in options.tasks:
        settings = preset("default", task=name)
        parts = build(settings, cache_dir=cache_folder())
        rummager = parts.agent
        first = parts.task.reset(options.seed)
        belief, _ = first_belief(rummager, first.reading, generator=split(options.seed, "initialise"))
        workspace, tool = rummager.workspace, rummager.tool
        field = information_field(
            rummager.model.sdf,
            belief.world_T_object,
            belief.log_weights,
            workspace.points,
            settings.planner.information,
        ).information
        nll = negative_log_likelihood(
            belief.world_T_object, belief.log_weights, first.truth, rummager.model.surface_points, rummager.model.exact
        )
        r, met, total = reachability(tool, workspace), touchable(tool, workspace), field.sum()
        shares = [100 * float((field * part).sum() / total) for part in (r < 0.5, ~met)]
        slack = 1e3 * slack_m(met, field, workspace, tool, belief.mode()[:2, 3])
        cells = (name, f"{rummager.nll_threshold:.0f}", f"{float(nll):.1f}", *(f"{s:.0f} %" for s in shares))
        print(f"| {' | '.join(cells)} | {slack:.0f} |")
        parts.task.close()


if __name__ == "__main__":
    script(lambda: main(tyro.cli(Options, description=__doc__)))
