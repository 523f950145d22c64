"""View of a touch-box run: the box by its belief, the pokes that were weighed, what was felt, and the best grasp."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.dynamics.along_path import Pusher, distance_to
from rumi.dynamics.sliding import Outline, rotated
from rumi.registration.pose_summary import PoseSummary
from rumi.tasks.touch_box.records import TouchStep
from rumi.tasks.touch_box.scene import TouchTask
from rumi.tasks.touch_box.settings import TouchSettings
from rumi.viz import style
from rumi.viz.primitives import Lines, Points, Shape, at_height, block_edges, circle, rgb, shades
from rumi.viz.task_view import ENTROPY, DecisionView, StepView, planar_nll
from sdf import se3

_UNITS = {"max-contact": "probability of a touch", "uninformed": "drawn"}
"""What methods measure a poke by, where it is not information in nats."""


class PokeOdds(NamedTuple):
    """Outcomes of a poke by a belief, as if the box stayed where it is.

    Attributes:
        blocked: probability that the tool cannot come down at the start, since the box stands there.
        touches: probability that it can, and the path meets the box.
        push_m: mean way that is left after the first touch, over those that are touched: the box moves so far at most.
    """

    blocked: float
    touches: float
    push_m: float


def poke_odds(
    path: Float[Tensor, "K1 3"],
    poses: Float[Tensor, "N 3"],
    log_weights: Float[Tensor, "N"],
    pusher: Pusher,
    outline: Outline,
) -> PokeOdds:
    """Outcomes of a poke by a belief.

    Args:
        path: (K + 1, 3), of the tool.
        poses: (N, 3), of the particles.
        log_weights: (N), of them.
        pusher: footprint of the tool.
        outline: of the box.
    """
    number, count = len(poses), len(path)
    apart = distance_to(poses.repeat_interleave(count, 0), path.repeat(number, 1), pusher, outline).view(number, count)
    weight = log_weights.softmax(-1)
    met = apart <= 0
    blocked = met[:, 0]
    touched = ~blocked & met.any(-1)
    length = torch.cat((path.new_zeros(1), path[:, :2].diff(dim=0).norm(dim=-1).cumsum(0)))
    left = length[-1] - length[met.long().argmax(-1)]
    share = float(weight[touched].sum())
    push = float((weight * left)[touched].sum()) / share if share > 0 else 0.0
    return PokeOdds(float(weight[blocked].sum()), share, push)


class TouchView:
    """View of the touch-box task.

    Args:
        task: the scene.
        settings: of belief and pokes.
    """

    plots: Mapping[str, str] = {
        "nll": "nats of the truth, by a normal belief",
        "entropy": ENTROPY,
        "right": "P(right) and P(lift), by the belief",
        "gain": "of the chosen poke, and of the next best",
    }

    def __init__(self, task: TouchTask, settings: TouchSettings) -> None:
        self._task, self._settings = task, settings
        self._height = 0.5 * task.height_m
        places = torch.tensor(task.modes)[:, :2]
        margin = 2.0 * torch.tensor(task.spread[:2]) + max(task.half)
        low, high = places.amin(0) - margin, places.amax(0) + margin
        self.bounds: Float[Tensor, "2 3"] | None = torch.stack(
            (torch.cat((low, low.new_zeros(1))), torch.cat((high, high.new_tensor([task.height_m]))))
        )

    def fixed(self) -> Mapping[str, Shape]:
        """Nothing."""
        return {}

    def body(self) -> Mapping[str, Shape]:
        """The box's edges."""
        return {"edges": Lines(block_edges(self._task.half, self._task.height_m), rgb(style.NLL), 0.0014)}

    def outline(self, world_T_object: Float[Tensor, "4 4"]) -> list[np.ndarray]:
        """The box's base."""
        base = torch.from_numpy(block_edges(self._task.half, 0.0)[0])
        return [se3.apply(world_T_object.double(), base).numpy()]

    def step(self, records: Sequence[TouchStep], pose: PoseSummary | None) -> StepView:
        """Pokes so far with the readings of the last one, the fingers, the best grasp, and the true box."""
        record = records[-1]
        done = [one.touched.path for one in records if one.touched is not None]
        scene: dict[str, Shape] = {
            "tool/path": Lines([self._way(path) for path in done], rgb(style.PATH), 0.0012),
            "grasp": Lines(self._grasp(record.grasp.pose), rgb(style.TOOL), 0.0012),
            "truth": Lines(self.outline(se3.from_planar(record.truth)), rgb(style.TRUTH), 0.0008),
        }
        if record.touched is not None:
            path, contact = record.touched.path, record.touched.contact
            at = torch.from_numpy(self._way(path[1:]))
            scene["contacts"] = Points(at[contact], rgb(style.CONTACT), 0.004)
            scene["readings_without_contact"] = Points(at[~contact], rgb(style.QUIET), 0.002)
            scene["tool/outline"] = Lines(self._fingers(path[-1]), rgb(style.TOOL), 0.0012)
        curves = {"right/lift": record.grasp.probability}
        if pose is not None:
            curves["nll/true"] = planar_nll(pose, record.truth, torch.pi)
        return StepView(scene, curves)

    def decision(self, records: Sequence[TouchStep]) -> DecisionView | None:
        """The pokes that were weighed before the last one was carried out, the better the darker, and why it was."""
        before, record = records[-2], records[-1]
        paths, choice = record.candidates, record.choice
        if paths is None or choice is None:
            return None
        best, value = choice.best, choice.value
        others = torch.arange(len(paths)) != best
        rejected = value[others]
        spread = (rejected - value.amin()) / (value.amax() - value.amin()).clamp_min(1e-12)
        scene: dict[str, Shape] = {
            "path": Lines([self._way(paths[best])], rgb(style.EXPECTED), 0.002),
            "samples": Lines(
                [self._way(path) for path in paths[others]], shades(style.INK, 0.1 + 0.5 * spread), 0.0008
            ),
        }
        curves = {"gain/chosen": float(value[best])}
        unit = _UNITS.get(self._settings.method, "nats")
        gain = f"- **gain** {float(value[best]):.3g} ({unit}, by `{self._settings.method}`)"
        if len(rejected):
            curves["gain/next_best"] = float(rejected.amax())
            worth = f"{float(rejected.amax()):.3g} the next best, {float(rejected.median()):.3g} the median"
            gain += f"; of {len(rejected)} others {worth}"
        odds = poke_odds(paths[best], *before.belief, self._task.fingers, self._task.outline)
        last = int(choice.steps[best])
        cut = "" if last == paths.shape[1] - 1 else f"; worth most if cut after reading {last}"
        begin, end = (", ".join(f"{x:.3f}" for x in paths[best][at, :2].tolist()) for at in (0, -1))
        words = [
            f"**Poke {record.step}**",
            "",
            gain,
            f"- **where** from ({begin}) to ({end}) m{cut}",
            f"- **odds** it touches the box with {odds.touches:.2f}, by the belief",
            f"- **risk** the box stands where the tool comes down with {odds.blocked:.2f}; where it is touched it is "
            f"pushed by {1e3 * odds.push_m:.0f} mm at most, if the poke is not cut",
            f"- **grasp** the best one lifts with {before.grasp.probability:.2f} so far; "
            f"{self._settings.threshold:g} is asked",
        ]
        return DecisionView(scene, "\n".join(words), curves)

    def _way(self, path: Float[Tensor, "K 3"]) -> np.ndarray:
        """Places (K, 3) of the tool, at half of the box's height."""
        return at_height(path[:, :2].double().numpy(), self._height)

    def _fingers(self, pose: Float[Tensor, "3"]) -> list[np.ndarray]:
        """The closed fingers."""
        pusher = self._task.fingers
        places = pose[:2] + rotated(pusher.points.to(pose), pose[2])
        return [circle(place, pusher.thickness, self._height) for place in places.tolist()]

    def _grasp(self, pose: Float[Tensor, "3"]) -> list[np.ndarray]:
        """The open fingers about a box at a pose, and that box's top."""
        task = self._task
        aside = 0.5 * task.opening_m + task.finger_m
        places = [pose[:2] + rotated(pose.new_tensor([sign * aside, 0.0]), pose[2]) for sign in (1.0, -1.0)]
        top = [line + np.array([0.0, 0.0, task.height_m]) for line in self.outline(se3.from_planar(pose))]
        return [*top, *(circle(place.tolist(), task.finger_m, self._height) for place in places)]
