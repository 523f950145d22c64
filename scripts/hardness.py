"""How hard the tasks are before anything is touched.

    python scripts/hardness.py

Prints for each task the nll at step 0, the share of the initial information where the reachability r(x) is below 0.5,
the share that no reachable pose of the tool can touch, and how far the object may be pushed away from the arm's base
until the tool touches less than a tenth of the information.
"""

from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from jaxtyping import Bool, Float
from torch import Tensor

from rumi.assemble import build, reachability
from rumi.config import preset
from rumi.fields.information import information_field
from rumi.fields.workspace import Workspace
from rumi.loop import first_belief
from rumi.metrics.likelihood import negative_log_likelihood
from rumi.planning.tool import Tool
from rumi.seeding import split


@dataclass(frozen=True)
class Options:
    """Which tasks, and where the arm's table of reach is kept."""

    tasks: tuple[str, ...] = ("mug-0", "mug-1", "mug-2")
    seed: int = 0
    cache: Path = Path.home() / ".cache" / "rumi"


def touchable(tool: Tool, workspace: Workspace, step_m: float = 0.01, yaws: int = 72) -> Bool[Tensor, "V"]:
    """Lattice cells that a sensing point of the tool meets at some reachable configuration, obstacles apart."""
    low, high = tool.bounds
    x, y = (torch.arange(float(low[k]), float(high[k]) + 1e-6, step_m) for k in range(2))
    yaw = torch.arange(yaws) * (2 * torch.pi / yaws) - torch.pi
    q = torch.stack(torch.meshgrid(x, y, yaw, indexing="ij"), -1).reshape(-1, 3)
    if tool.reach is not None:
        q = q[tool.reach.reachable(q)]
    met = torch.zeros(workspace.shape, dtype=torch.bool)
    for part in q.split(4096):
        cell = ((tool.info_points(part) - workspace.origin) / workspace.spacing).round().long()[..., :2].reshape(-1, 2)
        inside = ((cell >= 0) & (cell < torch.tensor(workspace.shape[:2]))).all(-1)
        met[cell[inside, 0], cell[inside, 1], 0] = True
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
        cell = ((moved - workspace.origin[:2]) / workspace.spacing).round().long()
        inside = ((cell >= 0) & (cell < torch.tensor(workspace.shape[:2]))).all(-1)
        cell = cell.clamp_min(0).minimum(torch.tensor(workspace.shape[:2]) - 1)
        there = met.reshape(workspace.shape)[cell[:, 0], cell[:, 1], 0] & inside
        if float((information * there).sum() / total) < 0.1:
            return float(push)
    return 0.4


def main(options: Options) -> None:
    """Print one row a task."""
    print("| task | nll at step 0 | information where r < 0.5 | information out of touch | slack outward, mm |")
    print("|---|---|---|---|---|")
    for name in options.tasks:
        settings = preset("default", task=name)
        parts = build(settings, cache_dir=options.cache)
        rummager = parts.rummager
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
        print(
            f"| {name} | {float(nll):.1f} | {100 * float((field * (r < 0.5)).sum() / total):.0f} % | "
            f"{100 * float((field * ~met).sum() / total):.0f} % | "
            f"{1e3 * slack_m(met, field, workspace, tool, belief.mode()[:2, 3]):.0f} |"
        )
        parts.task.close()


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
