"""View of a peg run: the block with its holes by its belief, the motions that were weighed, and what was touched."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.information.contact_gain import ContactKind
from rumi.planning.anytime import Selection
from rumi.registration.pose_summary import PoseSummary
from rumi.tasks.peg.moves import Motion, outcomes
from rumi.tasks.peg.records import PegStep
from rumi.tasks.peg.settings import PegSettings
from rumi.viz import style
from rumi.viz.primitives import Arrows, Lines, Points, Shape, at_height, block_edges, circle, rgb, shades
from rumi.viz.task_view import ENTROPY, DecisionView, StepView, planar_nll
from sdf import se3

_NORMAL_M = 0.03  # that a touch's normal is long
_PLACES = 500  # of the search's belief, that are drawn
_RIM_M = 0.015  # of a hole, as figures draw it
_LANES = "nothing is weighed until the block is met"


class PegView:
    """View of the peg task.

    Args:
        settings: of the task and the robot.
    """

    plots: Mapping[str, str] = {
        "nll": "nats of the truth, by a normal belief",
        "entropy": ENTROPY,
        "right": "P(right) and P(both holes within the tolerance), by the belief",
        "gain": "nats, of the chosen motion and of the best rejected one",
        "time": "seconds of reasoning and of motion",
    }

    def __init__(self, settings: PegSettings) -> None:
        self._settings = settings
        length, width = settings.table_m
        self.bounds: Float[Tensor, "2 3"] | None = 0.5 * torch.tensor(
            [[-length, -width, 0.0], [length, width, 2.0 * settings.lift_m]]
        )

    def fixed(self) -> Mapping[str, Shape]:
        """Border of the table's part on which the block is."""
        half = [0.5 * side for side in self._settings.table_m]
        return {"table": Lines(block_edges(half, 0.0)[:1], rgb(style.QUIET), 0.0012)}

    def body(self) -> Mapping[str, Shape]:
        """The block's edges and holes."""
        own = self._settings
        at_home = torch.zeros(3, dtype=torch.float64)
        holes = [circle(place, _RIM_M, own.height_m) for place in own.block.holes(at_home).tolist()]
        edges = block_edges(own.block.half_m, own.height_m)
        return {"edges": Lines([*edges, *holes], rgb(style.NLL), 0.0014)}

    def outline(self, world_T_object: Float[Tensor, "4 4"]) -> list[np.ndarray]:
        """The block's base."""
        base = torch.from_numpy(block_edges(self._settings.block.half_m, 0.0)[0])
        return [se3.apply(world_T_object.double(), base).numpy()]

    def step(self, records: Sequence[PegStep], pose: PoseSummary | None) -> StepView:
        """The ball, its ways and what it touched so far, where the holes are thought to be, and the true block."""
        own, record = self._settings, records[-1]
        moved = [one.felt for one in records[1:]]
        touches, tops, nothing = (
            [felt for felt in moved if felt.kind == kind]
            for kind in (ContactKind.TOUCH, ContactKind.TOP, ContactKind.NOTHING)
        )
        at = torch.tensor([[*felt.point.tolist(), own.low_m] for felt in touches]).reshape(-1, 3)
        normals = torch.tensor([[*felt.normal.tolist(), 0.0] for felt in touches]).reshape(-1, 3)
        above = torch.tensor([[*felt.point.tolist(), own.height_m] for felt in tops]).reshape(-1, 3)
        missed = torch.tensor([felt.tip.tolist() for felt in nothing]).reshape(-1, 3)
        holes = [] if record.aim is None else record.aim.points.tolist()
        scene: dict[str, Shape] = {
            "places": self._places(record),
            "tool/path": Lines([felt.path.double().numpy() for felt in moved], rgb(style.PATH), 0.0012),
            "tool/ball": Points(record.felt.tip[None], rgb(style.TOOL), own.radius_m),
            "contacts": Points(at, rgb(style.CONTACT), 0.004),
            "contacts/normals": Arrows(at, _NORMAL_M * normals, rgb(style.CONTACT)),
            "contacts/tops": Points(above, rgb(style.EXPECTED), 0.004),
            "contacts/missed": Points(missed, rgb(style.QUIET), 0.004),
            "holes": Lines([circle(hole, own.tolerance_m, own.height_m) for hole in holes], rgb(style.CONTACT), 0.001),
            "truth": Lines(self.outline(se3.from_planar(record.truth)), rgb(style.TRUTH), 0.0008),
        }
        curves = {"time/motion": record.felt.ended_s - record.felt.begun_s}
        if record.probability is not None:
            curves["right/holes"] = record.probability
        if pose is not None:
            curves["nll/true"] = planar_nll(pose, record.truth, math.pi)
        return StepView(scene, curves)

    def decision(self, records: Sequence[PegStep]) -> DecisionView | None:
        """The motions that were weighed before the last one was carried out, the better the darker, and why it was.

        A lane of the search, where it was one; None of a replay, which decides nothing.
        """
        before, record = records[-2], records[-1]
        if before.belief.states.shape[-1] == 2:
            lane = Lines([record.felt.path.double().numpy()], rgb(style.EXPECTED), 0.002)
            return DecisionView({"path": lane}, f"**Motion {record.step}**\n\n- a lane of the search: {_LANES}")
        if record.thought is None:
            return None
        selection = record.thought.selection
        if selection.candidate is None:
            return None
        chosen: Motion = selection.candidate.action
        at = max((place for place, row in enumerate(selection.history) if row.taken), default=None)
        rejected = [row for place, row in enumerate(selection.history) if place != at]
        shown = [(row.action.path, row.gain) for row in rejected if row.action is not None]
        share = torch.tensor([gain for _, gain in shown]) / max(selection.gain, 1e-12)
        ways = [path.double().numpy() for path, _ in shown]
        scene: dict[str, Shape] = {
            "path": Lines([chosen.path.double().numpy()], rgb(style.EXPECTED), 0.002),
            "samples": Lines(ways, shades(style.INK, 0.1 + 0.5 * share.clamp(0.0, 1.0)), 0.0008),
        }
        gains = sorted((row.gain for row in rejected), reverse=True)
        curves = {"gain/chosen": selection.gain, "time/reasoning": selection.thinking_s}
        if gains:
            curves["gain/best_rejected"] = gains[0]
        return DecisionView(scene, self._words(before, record.step, selection, gains), curves)

    def _words(self, before: PegStep, number: int, selection: Selection[Motion], rejected: Sequence[float]) -> str:
        """Why a motion was chosen."""
        own = self._settings
        assert selection.candidate is not None
        motion, took = selection.candidate.action, selection.candidate.execution_s
        kinds, weight = outcomes(motion, before.belief.states, own).kind, before.belief.log_weights.softmax(-1)
        odds = {kind: float(weight[kinds == kind].sum()) for kind in ContactKind}
        others = ", ".join(f"{gain:.3g}" for gain in rejected)
        gain = f"- **gain** {selection.gain:.3g} nats" + (f"; of the rejected {others}" if rejected else "")
        place = ", ".join(f"{x:.3f}" for x in motion.path[-1, :2].tolist())
        way = "straight there, low" if motion.direct else "over the top"
        thinking = f"{selection.thinking_s:.1f} s of reasoning and {took:.1f} s of motion in {own.action_budget_s:g} s"
        known = before.probability or 0.0
        asked = f"; {own.probability:g} is asked" if own.stop == "mass" else ""
        return "\n".join(
            (
                f"**Motion {number}**",
                "",
                gain,
                f"- **where** it presses on to ({place}) m, {way}",
                f"- **odds** it touches a side with {odds[ContactKind.TOUCH]:.2f}, by the belief",
                f"- **risk** it meets the top with {odds[ContactKind.TOP]:.2f}, nothing with "
                f"{odds[ContactKind.NOTHING]:.2f}; the block is fixed, so that nothing is lost but time",
                f"- **time** {thinking}; {selection.evaluated} motions weighed of {selection.generated} made",
                f"- **holes** both within {1e3 * own.tolerance_m:g} mm with {known:.2f} so far{asked}",
            )
        )

    def _places(self, record: PegStep) -> Points:
        """The search's belief, over places alone, the heavier the darker; none of a belief that knows a yaw."""
        belief, low = record.belief, self._settings.low_m
        if belief.states.shape[-1] != 2:
            return Points(torch.zeros(0, 3), rgb(style.NLL), 0.003)
        kept = torch.topk(belief.log_weights, min(_PLACES, len(belief.log_weights))).indices
        share = (belief.log_weights[kept] - belief.log_weights.max()).exp()
        places = torch.from_numpy(at_height(belief.states[kept].double().numpy(), low))
        return Points(places, shades(style.NLL, 0.1 + 0.9 * share), 0.003)
