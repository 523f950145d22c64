"""The peg task: a block somewhere on a table, and a ball on a force-torque sensor that is then put into a hole."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.clock import SimulatedClock
from rumi.errors import UsageError
from rumi.information.contact_gain import ContactKind
from rumi.seeding import split
from rumi.sim.fault import Fault
from rumi.task import StepResult
from rumi.tasks.peg.cell import Felt, TimedPath, TouchCell
from rumi.tasks.peg.faulty import follow, strike
from rumi.tasks.peg.search import lanes
from rumi.tasks.peg.settings import PegSettings


class Insertion(NamedTuple):
    """What came of lowering the peg.

    Attributes:
        at: (2,), where it was lowered.
        in_hole: whether it was over a hole within the tolerance.
        off_m: distance from the nearer hole there.
        ended_s: on the clock.
    """

    at: Float[Tensor, "2"]
    in_hole: bool
    off_m: float
    ended_s: float


class PegTask:
    """The cell, on a simulated clock that each action sets: thinking before it took time, too.

    Args:
        settings: of the task and the robot.
        faults: what goes wrong.
    """

    def __init__(self, settings: PegSettings, faults: Sequence[Fault] = ()) -> None:
        self.settings, self.faults, self._motions = settings, tuple(faults), 0
        self._cell: TouchCell | None = None

    @property
    def cell(self) -> TouchCell:
        """Table, block and ball of this run.

        Raises:
            UsageError: there was no `reset` yet.
        """
        if self._cell is None:
            raise UsageError("Expected reset(seed) before the first step")
        return self._cell

    def reset(self, seed: int) -> StepResult:
        """Put the block where the seed has it, and the ball beside the table's part."""
        own, self._motions = self.settings, 0
        truth = random_pose(own, generator=split(seed, "pose"))
        tip = torch.cat((lanes(own)[0], torch.tensor([own.low_m], dtype=torch.float64)))
        clock, noise = SimulatedClock(), split(seed, "sensor")
        self._cell = TouchCell(truth, own.block, own.radius_m, own.noise, own.limits, tip, clock, noise)
        nowhere = tip.new_zeros(2)
        still = Felt(
            ContactKind.NOTHING, tip, nowhere, nowhere, tip.new_zeros(0, 2, 2), False, tip[None], clock(), clock()
        )
        return StepResult(still, truth)

    def step(self, action: TimedPath) -> StepResult:
        """Go along a path until something is felt."""
        self.cell.clock = SimulatedClock(action.begins_s)
        self._motions += 1
        strike(self.cell, self.faults, self._motions)
        return StepResult(follow(self.cell, action.points, self.faults, self._motions), self.cell.truth)

    def finish(self, action: TimedPath) -> Insertion:
        """Go over a place and lower the peg there."""
        own, place = self.settings, action.points[-1, :2]
        self.step(action)
        place = self.cell.tip[:2] if self.faults else place
        in_hole, off_m = self.cell.insert(place, own.height_m + own.radius_m, own.tolerance_m)
        return Insertion(place, in_hole, off_m, self.cell.clock())

    def close(self) -> None:
        """No step until the next `reset`."""
        self._cell = None


def random_pose(settings: PegSettings, *, generator: torch.Generator) -> Float[Tensor, "3"]:
    """A pose of the block: anywhere on the table's part, at any yaw of half a turn."""
    drawn = torch.rand(3, generator=generator, dtype=torch.float64) - 0.5
    return drawn * torch.tensor([*settings.table_m, torch.pi], dtype=torch.float64)
