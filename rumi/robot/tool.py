"""Tool of a planner: its points at a configuration, and its motion in free space."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from rumi.robot.border import Border, near_groups
from rumi.robot.cover import Cover, covering_discs
from rumi.robot.gripper import GripperShape
from rumi.robot.limited_step import LEGS, PARTS, SLACK_M, limited_step, limited_way
from rumi.robot.reach import Reach
from rumi.robot.tool_shape import ToolShape
from sdf import backend, gpu, se3
from sdf.check import check_shape, is_eager

CHORD_M = 1e-4
"""By how much the straight way between two ends of legs along the limit may be beyond it, metres."""


def level_pose(q: Float[Tensor, "*b Q"], height_m: float | None) -> Float[Tensor, "*b 4 4"]:
    """world_T_tool of a level tool at configurations: x, y and yaw at a height, or x, y, z and yaw where it is None."""
    if height_m is not None:
        return se3.from_planar(q, height_m)
    return se3.from_planar(torch.cat((q[..., :2], q[..., 3:]), -1), q[..., 2])


class Tool(nn.Module):
    """A level gripper: it moves in a plane, configuration (x, y, yaw), or in space, (x, y, z, yaw); metres and radians.

    The executor and the planner move it by the same `free_path`, so that a planner never counts on a motion that
    the arm would refuse.

    Args:
        bounds: (2, 2) or (2, 3), metres, lower and upper corner of where the tool frame may be: x and y for a tool
            that moves in a plane, x, y and z for one that moves in space.
        reach: what the arm can reach; None for a tool that flies freely.
        shape: of the tool; by default the gripper of the paper.
        height_m: height of the plane above the world's floor; not used in space.
        action_scale_m: metres that a control of 1 asks for, along the world's axes.
        action_scale_rad: radians that a control of 1 asks for.
        body_spacing_m: spacing of the body points.
        info_spacing_m: spacing of the information points.
    """

    def __init__(
        self,
        bounds: Float[Tensor, "2 D"],
        reach: Reach | None = None,
        *,
        shape: ToolShape | None = None,
        height_m: float = 0.045,
        action_scale_m: float = 0.08,
        action_scale_rad: float = 0.5,
        body_spacing_m: float = 0.006,
        info_spacing_m: float = 0.005,
    ) -> None:
        super().__init__()
        self.spatial = bounds.shape[-1] == 3
        check_shape("bounds", bounds, "(2, 3)" if self.spatial else "(2, 2)", last=(2, 3 if self.spatial else 2))
        self.shape: ToolShape = shape or GripperShape()
        self.reach = reach
        self.height_m = 0.0 if self.spatial else height_m
        self.register_buffer("bounds", bounds.clone())
        scale = (action_scale_m,) * bounds.shape[-1] + (action_scale_rad,)
        self.register_buffer("scale", bounds.new_tensor(scale))
        for name, points in _points(self.shape, body_spacing_m, info_spacing_m, spatial=self.spatial).items():
            self.register_buffer(name, points.to(bounds))
        self._discs: dict[int, tuple[Tensor, float]] = {}
        self._tables: dict[tuple[torch.dtype, torch.device], tuple[Tensor, Tensor]] = {}
        self._covers: dict[tuple[int, torch.dtype, torch.device], Cover] = {}
        self._borders: dict[tuple[float, int, torch.dtype, torch.device], Border] = {}
        self.bounds: Tensor
        self.scale: Tensor
        self.body: Tensor
        self.info: Tensor

    def pose(self, q: Float[Tensor, "*b Q"]) -> Float[Tensor, "*b 4 4"]:
        """world_T_tool at configurations."""
        return level_pose(q, None if self.spatial else self.height_m)

    def points(self, q: Float[Tensor, "*b Q"]) -> Float[Tensor, "*b n 3"]:
        """World points of the whole body at configurations, metres (RUMI's h)."""
        return self._place(self.body, q)

    def info_points(self, q: Float[Tensor, "*b Q"]) -> Float[Tensor, "*b m 3"]:
        """World points of the part that senses touch, the pads (RUMI's h_I)."""
        return self._place(self.info, q)

    def border(self, spacing: float, size: int, like: Tensor) -> Border:
        """Border of the section, its points in groups of near ones.

        Args:
            spacing: between points, metres.
            size: of a group.
            like: tensor whose dtype and device it is to have.
        """
        # the shape never changes, and every plan asks for the same points
        key = (spacing, size, like.dtype, like.device)
        if key not in self._borders:
            points = self.shape.outline(spacing)
            groups = near_groups(points, size).to(like.device)
            self._borders[key] = Border.of(points.to(self.bounds).to(like), groups)
        return self._borders[key]

    def covering_discs(self, count: int) -> tuple[Float[Tensor, "k D"], float]:
        """Discs, in space balls, of one radius that together cover all body points.

        Args:
            count: how many.

        Returns:
            centres (k, 2), in space (k, 3), in the tool frame and the radius, metres.
        """
        if count < 1:
            raise ValueError(f"Expected count to be at least 1, got {count}")
        # the body never changes, and every plan asks for the same discs
        if count not in self._discs:
            self._discs[count] = covering_discs(self.body if self.spatial else self.body[:, :2], count)
        centers, radius = self._discs[count]
        return centers.to(self.body), radius

    def cover(self, count: int, like: Tensor) -> Cover:
        """Points of the body by `count` discs, in space balls, that cover it; 0 for one disc that holds all there is.

        Args:
            count: how many.
            like: tensor whose dtype and device they are to have.
        """
        key = (count, like.dtype, like.device)
        if key not in self._covers:
            points = (self.body + self.body.new_tensor([0.0, 0.0, self.height_m])).to(like)
            discs = None
            if count:
                centres, radius = self.covering_discs(count)
                discs = centres.to(like), float(radius)
            self._covers[key] = Cover.of(points, discs)
        return self._covers[key]

    def within_limits(self, q: Float[Tensor, "*b Q"]) -> Bool[Tensor, "*b"]:
        """Whether configurations are within the bounds and the arm's reach."""
        boxed = ((q[..., :-1] >= self.bounds[0]) & (q[..., :-1] <= self.bounds[1])).all(-1)
        return boxed if self.reach is None else boxed & self.reach.reachable(q)

    def free_step(
        self, q: Float[Tensor, "*#b Q"], control: Float[Tensor, "*#b Q"]
    ) -> tuple[Float[Tensor, "*#b Q"], Float[Tensor, "*#b"]]:
        """Where a control takes the tool if nothing is in its way.

        The control is (dx, dy, dyaw), in space (dx, dy, dz, dyaw), in [-1, 1], along the world's axes. A step that
        would leave the bounds stops at them. A step that the arm cannot reach is carried out up to the limit; the rest
        is tried without its turn, then along the circle about the arm's base (with the wanted yaw, then turning with
        the circle); if all of that is out of reach the tool stays. From a place already out of reach it may go wherever
        the residual does not grow.

        Args:
            q: (*b, Q), configuration now.
            control: (*b, Q).

        Returns:
            the configuration (*b, Q) after the step and the refused part of the translation (*b), metres.
        """
        wanted = q + control * self.scale
        q = q.expand_as(wanted)
        residual = None if self.reach is None else self.reach.residual(q)
        reached, _ = limited_step(self.bounds, self.reach, q, wanted, residual)
        return reached, (wanted - reached)[..., :-1].norm(dim=-1)

    def free_path(
        self, q: Float[Tensor, "*#b Q"], controls: Float[Tensor, "*#b H Q"], mini_steps: int
    ) -> Float[Tensor, "*#b T Q"]:
        """Configurations after each mini step of some controls, if nothing is in the way: `free_step`s, evenly.

        A control ends at the same place whatever number of mini steps it is carried out in: a plan that counts whole
        actions and a robot that is sent along their parts agree, at the arm's limit too. It goes straight, or leg by
        leg where it meets the limit (`limited_way`). Where the arm cannot reach something in between, the path ends
        before it. A path is the same to the bit whatever others it is asked for with.

        Args:
            q: (*b, Q), configuration now (batch axes broadcast).
            controls: (*b, H, Q), in [-1, 1].
            mini_steps: equal parts that each control is carried out in.

        Returns:
            (*b, H * mini_steps, Q), the start left out.
        """
        if mini_steps < 1:
            raise ValueError(f"Expected mini_steps to be at least 1, got {mini_steps}")
        ends: Tensor = backend.dispatch("free_path", q, controls)(self, q, controls)
        if mini_steps == 1:
            return ends
        steps = controls * self.scale
        limited = (ends != q[..., None, :] + steps.cumsum(-2)).flatten(-2).any(-1)
        even = q[..., None, :] + (steps / mini_steps).repeat_interleave(mini_steps, dim=-2).cumsum(-2)
        if is_eager() and not bool(limited.any()):
            return self._held(q, even)
        begins = torch.cat((q[..., None, :].expand(*ends.shape[:-2], 1, q.shape[-1]), ends[..., :-1, :]), -2)
        residual = None if self.reach is None else self.reach.residual(begins)
        legs = limited_way(self.bounds, self.reach, begins, begins + steps, residual)
        knots = torch.cat((begins[..., None, :], legs), -2)
        place = torch.arange(1, mini_steps + 1, dtype=ends.dtype, device=ends.device) * (LEGS / mini_steps)
        below = (place.ceil().long() - 1).clamp(0, LEGS - 1)
        share = (place - below)[:, None]
        round_limit = knots[..., below, :].lerp(knots[..., below + 1, :], share.expand_as(knots[..., below, :]))
        return self._held(q, torch.where(limited[..., None, None], round_limit.flatten(-3, -2), even))

    def _held(self, q: Float[Tensor, "*#b Q"], path: Float[Tensor, "*b T Q"]) -> Float[Tensor, "*b T Q"]:
        """A path that ends before what the arm cannot reach between two places that it can, as beside its base."""
        if self.reach is None:
            return path
        limit = self.reach.residual(q).clamp_min(self.reach.settings.tolerance_m) + CHORD_M
        reached = self.reach.residual(path) <= limit[..., None]
        if is_eager() and bool(reached.all()):
            return path
        count = reached.to(torch.uint8).cumprod(-1).sum(-1, dtype=torch.long)[..., None]
        last = torch.minimum(torch.arange(1, path.shape[-2] + 1, device=path.device), count)[..., None]
        whole = torch.cat((q[..., None, :].expand(*path.shape[:-2], 1, q.shape[-1]), path), -2)
        return whole.gather(-2, last.expand_as(path))

    def _free_path(self, q: Tensor, controls: Tensor) -> Tensor:
        """Configurations (*b, H, Q) after each control."""
        steps = controls * self.scale
        if not is_eager():
            return self._step_by_step(q.expand(*steps.shape[:-2], q.shape[-1]), steps)
        path = q[..., None, :] + steps.cumsum(-2)
        flat, steps = path.reshape(-1, *path.shape[-2:]), steps.reshape(-1, *steps.shape[-2:])
        # most paths meet no limit: those are done; the rest go step by step from where the first one meets it
        allowed = self.within_limits(flat)
        rows = (~allowed.all(-1)).nonzero()[:, 0]
        if len(rows) == 0:
            return path
        flat = flat.clone()
        # each from its own first step that meets a limit: what a path is must not hang on the others of a batch
        begins = allowed[rows].to(torch.uint8).cumprod(-1).sum(-1)
        start = q.expand(*path.shape[:-2], q.shape[-1]).reshape(-1, q.shape[-1])[rows]
        current = torch.where((begins > 0)[:, None], flat[rows, begins - 1], start)
        residual = None if self.reach is None else self.reach.residual(current)
        for index in range(int(begins.min()), flat.shape[1]):
            held = (begins <= index).nonzero()[:, 0]
            now = current[held]
            own = None if residual is None else residual[held]
            now, left = limited_step(self.bounds, self.reach, now, now + steps[rows[held], index], own)
            flat[rows[held], index] = current[held] = now
            if residual is not None and left is not None:
                residual[held] = left
        return flat.reshape(path.shape)

    def _step_by_step(self, q: Tensor, steps: Tensor) -> Tensor:
        """The path (*b, T, Q) of some steps, none skipped, as `torch.compile` and `torch.func` need it."""
        residual = None if self.reach is None else self.reach.residual(q)
        path = []
        for step in steps.unbind(-2):
            q, residual = limited_step(self.bounds, self.reach, q, q + step, residual)
            path.append(q)
        return torch.stack(path, -2)

    def arm_arrays(self) -> tuple[Any, ...]:
        """What limits a step, for `tool_numba`: reach table, base, bounds, and an array of numbers."""
        bounds = self.bounds.numpy()
        if self.reach is None:
            none = np.zeros((1,) * self.spatial + (1, 3), bounds.dtype)
            return none, none.reshape(-1), bounds, np.array((0.0, 0.0, SLACK_M, PARTS, LEGS))
        left = self.reach.left.contiguous().numpy()
        numbers = (1.0, self.reach.settings.tolerance_m, SLACK_M, PARTS, LEGS, *self.reach.nodes)
        return left, self.reach.base.numpy(), bounds, np.array(numbers)

    def arm_tensors(self, like: Tensor) -> tuple[Any, ...]:
        """What limits a step, for `tool_warp`: reach table, base and bounds like a tensor, and eleven numbers."""
        from rumi.robot.tool_warp import ABOUT_BASE, FREE, IN_BOX

        bounds, none = self.bounds.to(like), [0.0] * 11
        if self.reach is None:
            return bounds.new_empty(1, 1, 1, 1), bounds.new_empty(3), bounds, [float(FREE), *none[1:]]
        left = self._left(like)
        kind = IN_BOX if left.ndim == 4 else ABOUT_BASE
        if kind == ABOUT_BASE:
            left = left.reshape(-1, 1, *left.shape[-2:])
        numbers = [float(kind), self.reach.settings.tolerance_m, SLACK_M, float(PARTS), float(LEGS), *self.reach.nodes]
        return left, self.reach.base.to(like), bounds, [*numbers, *none][:11]

    def _left(self, like: Tensor) -> Tensor:
        """The reach's table like a tensor, made once: every plan asks for the same."""
        assert self.reach is not None
        key, source = (like.dtype, like.device), self.reach.position
        if key not in self._tables or self._tables[key][0] is not source:
            self._tables[key] = source, self.reach.left.to(like)
        return self._tables[key][1]

    def _place(self, points: Tensor, q: Tensor) -> Tensor:
        cosine, sine = q[..., -1].cos()[..., None], q[..., -1].sin()[..., None]
        x = q[..., 0, None] + cosine * points[:, 0] - sine * points[:, 1]
        y = q[..., 1, None] + sine * points[:, 0] + cosine * points[:, 1]
        z = q[..., 2, None] + points[:, 2] if self.spatial else torch.full_like(x, self.height_m)
        return torch.stack((x, y, z), -1)


backend.register("free_path")(Tool._free_path)


@backend.register("free_path", gpu.VERSION, gpu.supports, gpu.suits)
def _free_path_warp(tool: Tool, q: Tensor, controls: Tensor) -> Tensor:
    from rumi.robot.tool_warp import free_path

    batch = torch.broadcast_shapes(q.shape[:-1], controls.shape[:-2])
    starts = q.expand(*batch, q.shape[-1]).reshape(-1, q.shape[-1])
    steps = controls.expand(*batch, *controls.shape[-2:]).reshape(-1, *controls.shape[-2:])
    path: Tensor = free_path(tool.arm_tensors(controls), tool.scale, starts, steps)
    return path[:, 1:].reshape(*batch, -1, q.shape[-1])


def _points(shape: ToolShape, body_m: float, info_m: float, *, spatial: bool) -> dict[str, Float[Tensor, "n 3"]]:
    """Body and sensing points: filling the gripper, or its section at z = 0."""
    if spatial:
        return {"body": shape.solid(body_m), "info": shape.pad_solid(info_m)}
    sections = {"body": shape.section(body_m), "info": shape.pad_section(info_m)}
    return {name: torch.cat((part, torch.zeros_like(part[:, :1])), -1) for name, part in sections.items()}
