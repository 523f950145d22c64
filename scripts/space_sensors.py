"""What readings are worth at the true poses of objects in space, and what each lasting error takes of that.

python -m scripts.space_truth record --task box --seeds 1000-1002      # closed loops, their readings and true poses
python -m scripts.space_sensors --task box --seeds 1000-1002

Log-likelihoods of the pads' points, felt and clear, by the filter's own sensor model (nats an instant of contact), at
the true pose of each instant: with the tool's pose as the robot takes it, with the true one, with the true shape too,
and with what whole pads would have felt, that never miss. Then at a pose that is off the truth by the same in a whole
action, the best of many: a belief may take up a lasting error, but only as far as one shift of the object is like it.
"""

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from jaxtyping import Bool, Float
from torch import Tensor

from rumi.belief.bootstrap_filter import BootstrapFilter
from rumi.belief.segments import felt_pads
from rumi.belief.trajectory_history import Kind
from rumi.belief.trajectory_likelihood import log_likelihood_of
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.cli import script
from rumi.robot.tool import level_pose
from rumi.seeding import generator, normal
from rumi.sim.object_build import Build
from rumi.sim.tool_offset import ToolOffset
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.simulated import SimTask
from scripts.reproduce.seeds import seeds_of
from scripts.space_truth import Options as TruthOptions
from scripts.trajectory_runs import settings_of
from sdf import se3
from sdf.base import SDF
from sensors.reading import Reading

_NEAR_M = 0.012  # of the surface: other points of the pads tell nothing
_SHIFTS, _SHIFT_M, _SHIFT_RAD = 100, 0.001, 0.01  # that are tried, and their deviations


@dataclass(frozen=True)
class Options:
    """What is looked at.

    Attributes:
        task: whose recordings.
        seeds: such as 1000-1009.
        conditions: under which they were recorded.
        folder: of the recorded episodes.
    """

    task: str = "box"
    seeds: str = "1000-1009"
    conditions: str = "lab"
    folder: Path = Path("runs/space_truth")


@dataclass
class Sum:
    """Nats of felt and of clear points, over instants."""

    instants: int = 0
    felt: float = 0.0
    clear: float = 0.0

    def add(self, felt: Bool[Tensor, "K m"], nats: Float[Tensor, "K m"]) -> None:
        """Take in an action's instants of contact."""
        self.instants += len(felt)
        self.felt += float(nats[felt].sum())
        self.clear += float(nats[~felt].sum())


def nats_of(
    own: PoseTrajectorySettings, distance: Float[Tensor, "*b K m"], felt: Bool[Tensor, "K m"]
) -> Float[Tensor, "*b K m"]:
    """Log-likelihood of pads' points at distances from the surface, each for what it is worth."""
    kind = torch.where(felt, int(Kind.PAD_FELT), int(Kind.PAD_CLEAR))
    return own.pad_weight * log_likelihood_of(distance, kind, own)


def distances(
    sdf: SDF, tool: Float[Tensor, "*#b K 4 4"], there: Float[Tensor, "*#b K 4 4"], pads: Float[Tensor, "m 3"]
) -> Float[Tensor, "*b K m"]:
    """Distances (metres) of the pads' points from an object, at instants."""
    local = se3.apply(se3.inverse(there) @ tool, pads.expand(*tool.shape[:-2], -1, 3))
    with torch.no_grad():
        return sdf.distance(local.to(sdf.bounds)).double()


def true_tool(offset: ToolOffset, taken: Float[Tensor, "K 4 4"]) -> Float[Tensor, "K 4 4"]:
    """Where the tool was, of where it was taken to be."""
    yaw = torch.atan2(taken[:, 1, 0], taken[:, 0, 0])
    return level_pose(offset.true(torch.cat((taken[:, :3, 3], yaw[:, None]), -1)), None)


def shifted(there: Float[Tensor, "K 4 4"]) -> Float[Tensor, "S K 4 4"]:
    """True poses, and the same with one shift each of the object along the floor; the first has none."""
    drawn = normal((_SHIFTS, 3), generator=generator(0), dtype=torch.float64)
    shift = drawn * drawn.new_tensor((_SHIFT_M, _SHIFT_M, _SHIFT_RAD))
    shift[0] = 0.0
    middle = there[len(there) // 2, :2, 3]
    move = se3.from_planar(shift)
    move[:, :2, 3] += middle - move[:, :2, :2] @ middle
    return move[:, None] @ there


def look_at(
    sums: Mapping[str, Sum], task: SimTask, follow: BootstrapFilter, reading: Reading, track: Tensor, seed: int
) -> None:
    """Add what an action's readings are worth."""
    settings, model, own = task.settings, follow.model, follow.own
    some = reading.in_contact.nonzero()[:, 0]
    taken, there = reading.tool_pose[some].double(), track[some].double()
    felt = felt_pads(reading, model, own)[some]
    offset = ToolOffset.drawn(settings.tool_off_m, settings.tool_off_rad, spatial=True, seed=seed)
    shape, tool = Build.drawn(settings.build, seed).shape(task.model.exact), true_tool(offset, taken)
    true = distances(shape, tool, there, model.pads)
    near, whole = true < _NEAR_M, true.abs() <= settings.contact_m
    as_sensed = distances(model.sdf, taken, there, model.pads)
    sums["as sensed"].add(felt, nats_of(own, as_sensed, felt) * near)
    sums["tool's pose known"].add(felt, nats_of(own, distances(model.sdf, tool, there, model.pads), felt) * near)
    sums["shape too"].add(felt, nats_of(own, true, felt) * near)
    sums["whole pads too"].add(whole, nats_of(own, true, whole) * near)
    tried = nats_of(own, distances(model.sdf, taken[None], shifted(there), model.pads), felt) * near
    sums["as sensed, best shift"].add(felt, tried[int(tried.sum((-1, -2)).argmax())])


def main() -> None:
    """Print a table."""
    options = tyro.cli(Options, description=__doc__)
    runs = TruthOptions(command="replay", task=options.task, conditions=options.conditions).runs()
    names = "as sensed", "tool's pose known", "shape too", "whole pads too", "as sensed, best shift"
    sums = {name: Sum() for name in names}
    for seed in seeds_of(options.seeds):
        readings, tracks = torch.load(options.folder / f"{options.task}-{seed}.pt", weights_only=False)
        with build(settings_of(runs, "trajectory", seed), cache_dir=Path("runs/cache")) as (task, agent):
            assert isinstance(task, SimTask) and isinstance(agent.filter, BootstrapFilter)
            for reading, track in zip(readings[1:], tracks[1:], strict=True):
                if bool(reading.in_contact.any()):
                    look_at(sums, task, agent.filter, reading, track, seed)
    out = ["| readings | instants | felt | clear |", "|-" * 4 + "|"]
    out += [
        f"| {name} | {own.instants} | {own.felt / own.instants:.2f} | {own.clear / own.instants:.2f} |"
        for name, own in sums.items()
        if own.instants
    ]
    sys.stdout.write("\n".join((*out, "")))


if __name__ == "__main__":
    script(main)
