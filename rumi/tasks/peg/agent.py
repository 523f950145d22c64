"""The whole task: search, refine, and put the peg into a hole."""

from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.static_filter import StaticBelief
from rumi.clock import SimulatedClock
from rumi.information.contact_gain import NOTHING, TOUCH
from rumi.information.stopping import Aim
from rumi.seeding import split
from rumi.tasks.peg.cell import Felt, TouchCell
from rumi.tasks.peg.search import joined, lanes, search
from rumi.tasks.peg.selection import Chooser, Thought, aim_of, block_filter, confirmed, evidence_of, sure, updated
from rumi.tasks.peg.settings import PegSettings
from sensors.touch.rectangle_touch import RectangleTouches


@dataclass(frozen=True)
class PegRun:
    """How a run went.

    Attributes:
        seed: of it.
        settings: of it.
        truth: (3,), pose of the block.
        searched: motions of the first stage; the last one met the block.
        thoughts: decisions of the second stage.
        felt: what each of them led to.
        aim: where the holes were thought to be at the end.
        inserted_at: (2,), where the peg was lowered.
        in_hole: whether it was over a hole within the tolerance.
        off_m: distance from the nearer hole there.
        hole_error_m: greatest distance of a hole from where it was thought to be.
        middle_error_m: of the middle between them.
        stopped_by: "sure", "actions", "time" where there was none for any motion, or "stay" where nothing that there
            was time to weigh would tell anything.
        total_s: on the clock, the peg included.
        probabilities: of both holes within the tolerance, after each reading since the first touch.
        contact_times_s: when each side was touched.
    """

    seed: int
    settings: PegSettings
    truth: Float[Tensor, "3"]
    searched: list[Felt]
    thoughts: list[Thought]
    felt: list[Felt]
    aim: Aim
    inserted_at: Float[Tensor, "2"]
    in_hole: bool
    off_m: float
    hole_error_m: float
    middle_error_m: float
    stopped_by: str
    total_s: float
    probabilities: list[float] = field(default_factory=list)

    @property
    def contact_times_s(self) -> list[float]:
        """When each side was touched."""
        return [felt.ended_s for felt in (*self.searched, *self.felt) if felt.kind == TOUCH]

    def as_dict(self) -> dict[str, Any]:
        """Plain values of how it ended."""
        thinking = sum(thought.ended_s - thought.begun_s for thought in self.thoughts)
        times = self.contact_times_s
        late = [thought.selection.late_s for thought in self.thoughts if thought.selection.candidate is not None]
        return {
            "in_hole": self.in_hole,
            "right": self.hole_error_m < self.settings.tolerance_m,
            "off_mm": 1e3 * self.off_m,
            "hole_error_mm": 1e3 * self.hole_error_m,
            "middle_error_mm": 1e3 * self.middle_error_m,
            "stopped_by": self.stopped_by,
            "probability": self.aim.probability,
            "touches": len(times),
            "actions": len(self.felt),
            "misses": sum(felt.kind == NOTHING for felt in self.felt),
            "tops": sum(felt.kind not in (NOTHING, TOUCH) for felt in self.felt),
            "total_s": self.total_s,
            "search_s": self.searched[-1].ended_s,
            "thinking_s": thinking,
            "contact_s": times,
            "evaluated": sum(thought.selection.evaluated for thought in self.thoughts),
            "doublings": sum(thought.selection.doublings for thought in self.thoughts),
            "direct": sum(t.selection.candidate.action.direct for t in self.thoughts if t.selection.candidate),
            "late_s": max(late, default=0.0),
            "evaluation_s": _median([s for t in self.thoughts for _, s in t.selection.measured]),
        }


def random_pose(settings: PegSettings, *, generator: torch.Generator) -> Float[Tensor, "3"]:
    """A pose of the block: anywhere on the table's part, at any yaw of half a turn."""
    drawn = torch.rand(3, generator=generator, dtype=torch.float64) - 0.5
    return drawn * torch.tensor([*settings.table_m, torch.pi], dtype=torch.float64)


def run_peg(settings: PegSettings, seed: int) -> PegRun:
    """Do the task once, on a simulated clock.

    Args:
        settings: of the task and the robot.
        seed: of the pose, the noise, the belief and the choices.
    """
    truth = random_pose(settings, generator=split(seed, "pose"))
    clock = SimulatedClock()
    first = torch.cat((lanes(settings)[0], torch.tensor([settings.low_m], dtype=torch.float64)))
    cell = TouchCell(
        truth,
        settings.block,
        settings.radius_m,
        settings.noise,
        settings.limits,
        first,
        clock,
        split(seed, "sensor"),
    )
    draws = split(seed, "belief")
    found = search(cell, settings, generator=draws)
    follow = block_filter(settings)
    every = RectangleTouches.none(settings.block.half(), settings.noise, settings.radius_m)
    for felt in found.felt:
        every = every.joined(evidence_of(felt, settings))
    belief = joined(found, follow, every, settings, generator=draws)
    chooser = Chooser(settings, clock, split(seed, "choice"), [])
    thoughts: list[Thought] = []
    done: list[Felt] = []
    aim = aim_of(belief, settings)
    probabilities = [aim.probability]
    last, stopped_by = found.felt[-1], "actions"
    while True:
        if sure(belief, every, aim, settings) and settings.stop == "mass":
            belief, aim = confirmed(belief, every, aim, settings, generator=draws)
        if sure(belief, every, aim, settings):
            stopped_by = "sure"
            break
        if len(done) == settings.most_actions:
            break
        thoughts.append(chooser.choose(belief, cell.tip, _away(last)))
        choice = thoughts[-1].selection.candidate
        if choice is None:
            stopped_by = "stay" if thoughts[-1].selection.evaluated else "time"
            break
        last = cell.follow(choice.action.path)
        done.append(last)
        new = evidence_of(last, settings)
        every = every.joined(new)
        belief = updated(follow, belief, new, every, settings, generator=draws)
        clock.advance(settings.update_s)
        aim = aim_of(belief, settings)
        probabilities.append(aim.probability)
    place = _better_hole(belief, aim, settings)
    lift = place.new_tensor([settings.lift_m])
    cell.follow(torch.stack((cell.tip, torch.cat((cell.tip[:2], lift)), torch.cat((place, lift)))))
    in_hole, off = cell.insert(place, settings.height_m + settings.radius_m, settings.tolerance_m)
    holes = settings.block.holes(truth)
    errors = [(aim.points - order).norm(dim=-1).max() for order in (holes, holes.flip(0))]
    return PegRun(
        seed,
        settings,
        truth,
        found.felt,
        thoughts,
        done,
        aim,
        place,
        in_hole,
        off,
        float(min(errors)),
        float((aim.points.mean(0) - truth[:2]).norm()),
        stopped_by,
        clock(),
        probabilities,
    )


def _away(felt: Felt) -> Float[Tensor, "2"] | None:
    """Normal of the side that the ball rests against."""
    return felt.normal if felt.kind == TOUCH else None


def _better_hole(belief: StaticBelief, aim: Aim, settings: PegSettings) -> Float[Tensor, "2"]:
    """The hole that is more probably where it is thought to be."""
    holes = settings.block.holes(belief.states)
    near = (holes[:, None] - aim.points[:, None]).norm(dim=-1).amin(-1) < settings.tolerance_m
    return aim.points[(near.to(holes) * belief.log_weights.exp()[:, None]).sum(0).argmax()]


def _median(values: list[float]) -> float | None:
    return sorted(values)[len(values) // 2] if values else None
