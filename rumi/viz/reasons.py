"""Reasons of an action: what a plan expects of it, where it goes, and what it risks, from the plan's own records."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.planning.policy import Plan
from rumi.runs.scene_geometry import SceneGeometry


@dataclass(frozen=True)
class Reason:
    """Expected outcome of a plan's next action, and of the whole plan.

    A value is None where the plan does not tell it.

    Attributes:
        gain: information that the next action gathers anew, and the whole plan; in the unit of the plan's field.
        total: information that there is, in the same unit.
        best: number of the action that gathers most, 1 for the next, and where the tool is after it (x, y, z or yaw).
        shift_m: how far the object is expected to move by the next action, and by the whole plan.
        beyond: share of the information that the robot does not reach, now, after the next action, and after the plan,
            by the object's shift alone.
        costs: of the samples, the least and the worst that were kept.
    """

    gain: tuple[float, float] | None
    total: float | None
    best: tuple[int, tuple[float, ...]] | None
    shift_m: tuple[float, float] | None
    beyond: tuple[float, float, float] | None
    costs: tuple[float, float] | None

    def lines(self) -> list[str]:
        """What is known, a line of Markdown each."""
        said = []
        if self.gain is not None:
            share = f" of {self.total:.3g}" if self.total is not None else ""
            said.append(f"**gain** {self.gain[0]:.3g}, of the whole plan {self.gain[1]:.3g}{share}, as information")
        if self.best is not None:
            at = ", ".join(f"{value:.3f}" for value in self.best[1][:2])
            said.append(f"**where** most by action {self.best[0]} from now, tool at ({at}) m")
        if self.shift_m is not None:
            by, whole = (1000 * value for value in self.shift_m)
            said.append(f"**risk** the object moves {by:.1f} mm, by the whole plan {whole:.1f} mm")
        if self.beyond is not None:
            now, after, end = (f"{100 * value:.0f} %" for value in self.beyond)
            said.append(f"**risk** {now} of the information is beyond reach, {after} after it, {end} after the plan")
        if self.costs is not None:
            said.append(f"**costs** of the samples {self.costs[0]:.3g} to {self.costs[1]:.3g}")
        return said


def reason_of(plan: Plan, executed: int = 0, geometry: SceneGeometry | None = None) -> Reason:
    """Reason of a plan's next action.

    Args:
        plan: as it was made or recorded.
        executed: how many of its actions were carried out before.
        geometry: of the scene, which knows what is within reach; None where nobody does.
    """
    gathered = _after(plan, "predicted_information", executed)
    moves = _after(plan, "predicted_displacement", executed)
    gain = total = best = shift = beyond = costs = None
    if gathered is not None:
        gain, most = (float(gathered[0]), float(gathered.sum())), int(gathered.argmax())
        if gain[1] > 0:
            best = most + 1, tuple(plan.path[min(executed + most + 1, len(plan.path) - 1)].tolist())
        known = plan.info.get("information_total")
        total = None if known is None else float(known)
    if moves is not None:
        shift = float(moves[0].norm()), float(moves.sum(0).norm())
        beyond = _beyond_reach(plan, moves, geometry)
    if plan.samples is not None and len(plan.samples.costs):
        costs = float(plan.samples.costs[0]), float(plan.samples.costs[-1])
    return Reason(gain, total, best, shift, beyond, costs)


def _after(plan: Plan, name: str, executed: int) -> Float[Tensor, "T *c"] | None:
    """What a plan predicts of each of its actions that are left; None where it does not, or none is left."""
    values = plan.info.get(name)
    if not values or executed >= len(values):
        return None
    return torch.tensor(values, dtype=torch.float64)[executed:]


def _beyond_reach(
    plan: Plan, moves: Float[Tensor, "T 3"], geometry: SceneGeometry | None
) -> tuple[float, float, float] | None:
    """Share of the information beyond reach now, after the next action and at the end."""
    if geometry is None or geometry.reachability is None or "information" not in plan.fields:
        return None
    information = plan.fields["information"].double()
    total = float(information.sum())
    if not total > 0:
        return None
    workspace = geometry.workspace
    reach = workspace.grid(geometry.reachability.double())
    points = workspace.points.double()

    def beyond(shift: Tensor) -> float:
        at, inside = reach.nearest_index(points + shift)
        within = reach.values[at[:, 0], at[:, 1], at[:, 2]] * inside
        return 1.0 - float((information * within).sum()) / total

    none = torch.zeros(3, dtype=torch.float64)
    return beyond(none), beyond(moves[0]), beyond(moves.sum(0))
