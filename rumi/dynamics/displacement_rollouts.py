"""Rollouts of RUMI's push model (its Alg 7), and their settings."""

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Any, Literal, Self

import torch
from annotated_types import Interval
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rumi.dynamics.base import PushRollouts
from rumi.dynamics.contact import ContactBound, ContactField
from rumi.dynamics.tool_lookup import ToolField, at_height, planar_features
from rumi.dynamics.touched_rollouts import Touched
from rumi.robot.tool import Tool
from sdf import backend, compiled, gpu, skipped_work
from sdf.bounds import Checked, Count, CountOr0
from sdf.check import check_shape

Hazard = Literal["per_rollout", "per_step", "per_mini_step"]

TIE = 1e-5
"""Contact probabilities closer than this are equal: the first point of the tool is taken, whatever rounding says."""


@dataclass(frozen=True)
class DisplacementSettings(Checked):
    """Settings of the displacement model.

    Attributes:
        mini_steps: parts into which every action is cut, so that the tool does not jump through thin walls.
        push_angle: greatest angle between the motion and the inward normal at which a contact pushes, radians.
        hazard: what number decides on contact. `per_rollout`: rollout m of M meets the object wherever that is likelier
            than (m + 1/2) / M, so that the rollouts stand for M equally likely worlds, the same ones for every
            control sequence, and nothing is random. `per_step` draws a number for every rollout and step and reuses
            it for the mini steps, so that the chance of a contact does not grow with their number. `per_mini_step`
            draws anew, as the paper does.
        discs: discs of the bound that settles most contact checks; 0 checks every point at every mini step. The
            rollouts are the same.
        guarded: whether an action ends with the mini step in which it touches the object, as guarded moves do.
    """

    mini_steps: Count = 4
    push_angle: Annotated[float, Interval(gt=0.0, le=math.pi)] = math.radians(45.0)
    hazard: Hazard = "per_rollout"
    discs: CountOr0 = 16
    guarded: bool = False


class DisplacementRollouts:
    """RUMI's Alg 7 for a level tool, all rollouts at once: a `RolloutModel`.

    A mini step moves the tool to q', an equal part of the straight way on which its free motion would take it in a
    whole action (so that its limits are asked once an action). Contact happens with the greatest contact probability
    of its points, h(q') - d, of which x is the point. If the angle between the mean outward normal at x and the
    opposite of the point's motion d' = h(q')[x] - h(q)[x] is below the push angle, the object moves by d'; if not, the
    tool stays at q. Differs from the printed algorithm: d' is a motion in the world, not against the displaced point
    (line 10); normals are turned into the world frame before they are summed (line 11); what decides on contact is
    set by `hazard`. A contact without normal or motion does not push. The object stands on a floor: of d' it takes the
    level part, and where the surface faces up or down rather than sideways, it does not give way.

    What is skipped, with the same result: a contact needs u < p, so p is looked up only where a bound on it is above
    the number u that decides; and until its first contact a rollout follows the free path of its controls, so that
    all rollouts of a control sequence share these look-ups.

    Args:
        field: where contact is likely, and the normals.
        tool: points and free-space motion.
        settings: of contact, sliding and mini steps.
    """

    def __init__(self, field: ContactField, tool: Tool, settings: DisplacementSettings | None = None) -> None:
        self.tool = tool
        self.settings = settings or DisplacementSettings()
        self.field = field
        self.cover = tool.cover(self.settings.discs, field.probability.values)
        self.points = self.cover.points
        probability, normal = field.probability, field.normal
        if not tool.spatial and self.cover.height is not None:
            probability, normal = (at_height(grid, self.cover.height) for grid in (probability, normal))
        self.grids = (probability, normal)
        self.bound: ContactBound | None = None
        if self.settings.discs:
            centres = self.cover.centres if tool.spatial else self.cover.centres[:, :2]
            self.bound = ContactBound(probability, centres, self.cover.radius)

    @cached_property
    def _probability(self) -> ToolField:
        return ToolField(self.grids[0], self.points, spatial=self.tool.spatial)

    @cached_property
    def _normal(self) -> ToolField:
        return ToolField(self.grids[1], self.points, spatial=self.tool.spatial)

    @cached_property
    def limits(self) -> tuple[Any, ...]:
        """What limits the tool's steps, for the kernels of a GPU; made once a model, at its first use."""
        return self.tool.arm_tensors(self.points)

    @cached_property
    def compiled(self) -> Callable[[Tensor, Tensor, Tensor], PushRollouts]:
        """`rollout_drawn` in one kernel; made once a model, at its first use."""
        from rumi.dynamics.displacement_numba import CompiledRollouts

        kernel: Callable[[Tensor, Tensor, Tensor], PushRollouts] = CompiledRollouts(self, TIE)
        return kernel

    def draw(
        self, samples: int, rollouts: int, horizon: int, *, generator: torch.Generator
    ) -> Float[Tensor, "K M H S"]:
        """The numbers that decide on contact: S is 1, or the mini steps with `per_mini_step`."""
        if self.settings.hazard == "per_rollout":
            numbers = tuple((index + 0.5) / rollouts for index in range(rollouts))
            level = gpu.constant(numbers, self.points.dtype, self.points.device)
            return level[:, None, None].expand(samples, rollouts, horizon, 1)
        parts = 1 if self.settings.hazard == "per_step" else self.settings.mini_steps
        shape = (samples, rollouts, horizon, parts)
        drawn = torch.rand(shape, generator=generator, dtype=self.points.dtype, device=generator.device)
        return drawn.to(self.points.device)

    def rollout(
        self,
        configuration: Float[Tensor, "Q"],
        controls: Float[Tensor, "K H A"],
        *,
        rollouts: int,
        generator: torch.Generator,
    ) -> PushRollouts:
        """Roll control sequences out `rollouts` times each from one configuration of the tool."""
        uniforms = self.draw(controls.shape[0], rollouts, controls.shape[1], generator=generator)
        return self.rollout_drawn(configuration, controls, uniforms)

    def coarse(self) -> Self:
        """The same with half of the mini steps."""
        coarse = copy.copy(self)
        coarse.__dict__.pop("compiled", None)
        coarse.settings = replace(self.settings, mini_steps=math.ceil(self.settings.mini_steps / 2))
        return coarse

    def nominal_rollout(self, configuration: Float[Tensor, "Q"], controls: Float[Tensor, "H A"]) -> PushRollouts:
        """The one rollout (K = M = 1) in which contact happens where it is more likely than not."""
        return self.rollout_drawn(configuration, controls[None], controls.new_full((1, 1, len(controls), 1), 0.5))

    @torch.no_grad()
    def rollout_drawn(
        self,
        configuration: Float[Tensor, "Q"],
        controls: Float[Tensor, "K H A"],
        uniforms: Float[Tensor, "K M H S"],
    ) -> PushRollouts:
        """The rollouts that given uniform numbers lead to; nothing else is random."""
        size = len(self.tool.scale)
        check_shape("configuration", configuration, f"({size},)", last=(size,))
        check_shape("controls", controls, "(K, H, A)")
        version = backend.dispatch("push_rollouts", configuration, controls, uniforms, self.points)
        with skipped_work.work("contact_checks") as work:
            found: PushRollouts = version(self, configuration, controls, uniforms)
            whole = found.contact.numel() * self.settings.mini_steps
            work.count_share(found.checked, whole)
        return found

    def _rollouts(
        self, configuration: Float[Tensor, "Q"], controls: Float[Tensor, "K H A"], uniforms: Float[Tensor, "K M H S"]
    ) -> PushRollouts:
        (samples, horizon, _), rollouts, mini = controls.shape, uniforms.shape[1], self.settings.mini_steps
        steps = horizon * mini
        draws = uniforms.expand(samples, rollouts, horizon, mini).reshape(samples, rollouts, steps)
        path = self._free_path(configuration, controls)
        start, checked = self._first_contact(path[:, 1:], draws)  # (K, M), `steps` if none

        states = path[:, None, ::mini].expand(samples, rollouts, horizon + 1, path.shape[-1]).clone()
        moved = torch.zeros_like(states[..., :3])
        contact = torch.zeros(samples, rollouts, horizon, dtype=torch.bool, device=controls.device)
        rows = (start.flatten() < steps).nonzero()[:, 0]
        if len(rows):
            # by first contact, so that those under way at any time are the first rows
            rows = rows[start.flatten()[rows].sort(stable=True).indices]
            touched = Touched.at_first_contact(path, controls, draws.reshape(-1, steps), start.flatten(), rows)
            flat = (states.view(-1, *states.shape[2:]), moved.view(-1, horizon + 1, 3), contact.view(-1, horizon))
            out = (flat[0][rows], flat[1][rows], flat[2][rows])
            checked += self._follow(path, touched, out)
            for whole, part in zip(flat, out, strict=True):
                whole[rows] = part
        own = torch.arange(rollouts, device=controls.device).expand(samples, rollouts)
        untouched = start == steps
        duplicate_of = torch.where(untouched, untouched.to(torch.uint8).argmax(-1, keepdim=True), own)
        return PushRollouts(states, moved, contact, checked / max(1, samples * rollouts * steps), duplicate_of)

    def _free_path(
        self, configuration: Float[Tensor, "Q"], controls: Float[Tensor, "K H A"]
    ) -> Float[Tensor, "K S1 Q"]:
        """Where each mini step leads if there is no contact, the present configuration first."""
        mini, start = self.settings.mini_steps, configuration.expand(len(controls), 1, len(configuration))
        ends = self.tool.free_path(start[:, 0], controls, 1)
        begins = torch.cat((start, ends[:, :-1]), 1)
        parts = torch.arange(1, mini + 1, dtype=ends.dtype, device=ends.device)[:, None] / mini
        between = begins[:, :, None] + parts * (ends - begins)[:, :, None]
        return torch.cat((start, between.flatten(1, 2)), 1)

    def _first_contact(
        self, path: Float[Tensor, "K S Q"], draws: Float[Tensor, "K M S"]
    ) -> tuple[Int[Tensor, "K M"], int]:
        """Mini step of each rollout's first contact on the free path, S where there is none; checks done."""
        samples, steps = path.shape[:2]
        features = planar_features(path)
        possible = torch.ones_like(draws, dtype=torch.bool)
        if self.bound is not None:
            possible = draws < self.bound(features.flatten(0, 1)).view(samples, 1, steps)
        start = torch.full(draws.shape[:2], steps, dtype=torch.long, device=draws.device)
        checked = 0
        for first in range(0, steps, self.settings.mini_steps):
            part = slice(first, first + self.settings.mini_steps)
            needed = (possible[..., part] & (start == steps)[..., None]).any(1)
            at = needed.nonzero(as_tuple=True)
            if not len(at[0]):
                continue
            checked += len(at[0])
            probability = torch.zeros_like(needed, dtype=draws.dtype)
            probability[at] = self._probability(features[:, part][at])[0].amax(-1)
            hit = draws[..., part] < probability[:, None]
            here = first + hit.to(torch.uint8).argmax(-1)
            start = torch.where(hit.any(-1) & (start == steps), here, start)
        return start, checked

    def _follow(
        self,
        path: Float[Tensor, "K S1 Q"],
        touched: Touched,
        out: tuple[Float[Tensor, "R H1 Q"], Float[Tensor, "R H1 3"], Bool[Tensor, "R H"]],
    ) -> int:
        """Carry touched rollouts from their first contact on; gives the number of checks."""
        states, moved, contact = out
        mini, horizon = self.settings.mini_steps, contact.shape[1]
        last = torch.arange(horizon * mini, device=path.device)
        under_way = torch.searchsorted(touched.start, last, right=True).tolist()
        checked = 0
        for index in range(int(touched.start[0]) // mini, horizon):
            begun, count = under_way[index * mini], under_way[(index + 1) * mini - 1]
            touched.stuck[:begun] = False
            touched.way[:begun] = self._ways(path, touched, begun, index)
            for step in range(index * mini, (index + 1) * mini):
                rows = (~touched.stuck[:count] & (touched.start[:count] <= step)).nonzero()[:, 0]
                if len(rows):
                    checked += self._mini_step(touched, rows, touched.draws[:, step], contact[:, index])
            states[:count, index + 1] = touched.now[:count]
            moved[:count, index + 1] = touched.offset[:count]
        return checked

    def _ways(
        self, path: Float[Tensor, "K S1 Q"], touched: Touched, count: int, index: int
    ) -> Float[Tensor, "count Q"]:
        """Free motion of a mini step of action `index` for the first `count` rollouts."""
        mini, now = self.settings.mini_steps, touched.now[:count]
        ends = path[touched.sample[:count], (index + 1) * mini]
        strayed = touched.strayed[:count].nonzero()[:, 0]
        if len(strayed):
            ends[strayed] = self.tool.free_step(now[strayed], touched.controls[strayed, index])[0]
        return (ends - now) / mini

    def _mini_step(
        self,
        touched: Touched,
        rows: Int[Tensor, "E"],
        draws: Float[Tensor, "R"],
        contact: Bool[Tensor, "R"],
    ) -> int:
        """One mini step of some rollouts, in place; gives the number of checks."""
        before = touched.now[rows]
        free = before + touched.way[rows]
        touched.now[rows] = free
        features = planar_features(free, touched.offset[rows])
        possible = torch.arange(len(rows), device=rows.device)
        if self.bound is not None:
            possible = (draws[rows] < self.bound(features)).nonzero()[:, 0]
        if not len(possible):
            return 0
        probability = self._probability(features[possible])[0]
        most = probability.amax(-1)
        hit = (draws[rows[possible]] < most).nonzero()[:, 0]
        if len(hit):
            # argmax gives the first of equals
            point = (probability[hit] >= most[hit, None] - TIE).to(torch.uint8).argmax(-1)
            at = possible[hit]
            motion = self._motion(before[at], free[at], point)
            pushes = self._pushes(self._normal.at(features[at], point).mT, motion)
            contact[rows[at]] = True
            pushed, blocked = at[pushes], at[~pushes]
            touched.offset[rows[pushed], :2] += motion[pushes, :2]
            touched.now[rows[blocked]] = before[blocked]
            touched.strayed[rows[blocked]] = True
            # nothing that decides on the next mini step has changed
            touched.stuck[rows[blocked]] = self.settings.hazard != "per_mini_step"
            if self.settings.guarded:
                touched.strayed[rows[at]] = touched.stuck[rows[at]] = True
        return len(possible)

    def _motion(
        self, before: Float[Tensor, "E Q"], after: Float[Tensor, "E Q"], point: Int[Tensor, "E"]
    ) -> Float[Tensor, "E 3"]:
        """World motion of one point of the tool for each row, metres."""
        x, y = self.points[point, 0], self.points[point, 1]
        cos = after[:, -1].cos() - before[:, -1].cos()
        sin = after[:, -1].sin() - before[:, -1].sin()
        shift = after - before
        rise = shift[:, 2] if self.tool.spatial else torch.zeros_like(x)
        return torch.stack((cos * x - sin * y + shift[:, 0], sin * x + cos * y + shift[:, 1], rise), -1)

    def _pushes(self, normal: Float[Tensor, "E 3"], motion: Float[Tensor, "E 3"]) -> Bool[Tensor, "E"]:
        """Whether the motion goes into the surface within the push angle; never without a normal or a motion."""
        length, way = normal.norm(dim=-1), motion.norm(dim=-1)
        tiny = 1e-6
        inward = -(normal * motion).sum(-1)
        pushes = (inward > math.cos(self.settings.push_angle) * length * way) & (length > tiny) & (way > tiny)
        # what is met from above or below stands on the floor, or hangs on what does
        return pushes & (normal[:, :2].norm(dim=-1) >= normal[:, 2].abs()) if self.tool.spatial else pushes


backend.register("push_rollouts")(DisplacementRollouts._rollouts)


@backend.register("push_rollouts", "numba", compiled.supports)
def _rollouts_numba(
    model: DisplacementRollouts, configuration: Tensor, controls: Tensor, uniforms: Tensor
) -> PushRollouts:
    x, y, z = model.grids[0].shape
    if min(x, y) == 1 or (z > 1) != model.tool.spatial:
        # points of several heights in a plane, or a field constant along an axis: the plain version knows how
        return model._rollouts(configuration, controls, uniforms)
    return model.compiled(configuration, controls, uniforms)


@backend.register("push_rollouts", gpu.VERSION, gpu.supports, gpu.suits)
def _rollouts_warp(
    model: DisplacementRollouts, configuration: Tensor, controls: Tensor, uniforms: Tensor
) -> PushRollouts:
    from rumi.dynamics.displacement_warp import rollouts

    found: PushRollouts = rollouts(model, configuration, controls, uniforms, TIE)
    return found
