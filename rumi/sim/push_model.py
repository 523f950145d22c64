"""Push model by MuJoCo: many rollouts at once, equal to the bit with any number of threads."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Self

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rumi.dynamics.along_path import unwrapped
from rumi.dynamics.base import (
    PushDefaults,
    PushModel,
    PushRollouts,
    Stance,
    duplicates,
    representatives,
    rigid_motions,
)
from rumi.dynamics.registry import EngineSettings
from rumi.fields.information import WorkspaceFields
from rumi.fields.workspace import Workspace
from rumi.robot.gripper import GripperShape, gripper_of
from rumi.robot.tool import Tool
from rumi.robot.tool_shape import ToolShape
from rumi.sim.path_push import MujocoPathPush
from rumi.sim.rollout_world import RolloutWorld
from rumi.sim.settings import PhysicsSettings
from rumi.sim.world import World
from sdf import se3
from sdf.check import check_shape
from sdf.object_model import ObjectModel
from sdf.threads import count

# rows that are rolled out at once: MuJoCo keeps every step's state of each
_ROWS = 256
# metres that the tool may overshoot, and that rounding and soft contact may add to its reach
_MARGIN_M = 0.005
# metres of motion within an action below which the object was not touched
_STILL_M = 1e-5
# cosine of the tilt up to which particles count as upright where the tool moves in space, and tilts them
_TILTED = math.cos(math.radians(15.0))


class MujocoRollouts:
    """Rollouts of single poses of the belief in MuJoCo: a `RolloutModel`.

    As in the quasi-static model each rollout pushes one pose of the belief; here the engine that the simulator is made
    of does it, with inertia, soft contacts and servos that lag. Slow: 20 to 100 thousand steps a second and core.

    A tool that moves in space has a drive that gives way; an object that it tilts is taken to be upright at its yaw.

    Skipped, with the same rollouts: actions before the first in which the tool comes near the object. A servo is at
    rest after each action's hold, so that a rollout may begin with any of them.

    Args:
        model: the object; its exact shape is simulated.
        world_T_object: (N, 4, 4), upright poses.
        log_weights: (N), of the poses.
        tool: points and free-space motion.
        settings: of the engine.
    """

    def __init__(
        self,
        model: ObjectModel,
        world_T_object: Float[Tensor, "N 4 4"],
        log_weights: Float[Tensor, "N"],
        tool: Tool,
        settings: EngineSettings | None = None,
    ) -> None:
        self.settings = settings or EngineSettings()
        self.tool = tool
        self.poses = se3.to_planar(world_T_object)
        self.weights = log_weights.softmax(-1)
        self.pivot = self.weights @ self.poses[:, :2]
        own = self.settings
        physics = PhysicsSettings(mass_kg=own.mass_kg, friction=own.friction)
        if tool.spatial:
            # pressed down with more, objects sink into the floor
            physics = replace(physics, max_force_n=25.0, max_lift_n=15.0, max_torque_nm=4.0)
        height = None if tool.spatial else tool.height_m
        self.world = RolloutWorld(model.exact, gripper_of(tool.shape), height, own.time_step_s, physics)
        corners = model.exact.bounds[:, :2].abs().amax(0)
        outline = tool.shape.outline(0.005)
        self.reach = float(corners.norm()) + float(outline.norm(dim=-1).max()) + _MARGIN_M

    def rollout(
        self,
        configuration: Float[Tensor, "Q"],
        controls: Float[Tensor, "K H A"],
        *,
        rollouts: int,
        generator: torch.Generator | None = None,
    ) -> PushRollouts:
        """Roll control sequences out from one configuration, once for each of `rollouts` poses."""
        chosen = representatives(self.poses[:, 2], self.weights, rollouts)
        return self.rollout_poses(configuration, controls, self.poses[chosen])

    def coarse(self) -> Self:
        """Itself: there is no quicker one."""
        return self

    def nominal_rollout(self, configuration: Float[Tensor, "Q"], controls: Float[Tensor, "H A"]) -> PushRollouts:
        """The one rollout (K = M = 1) of the likeliest pose."""
        return self.rollout_poses(configuration, controls[None], self.poses[self.weights.argmax()][None])

    @torch.no_grad()
    def rollout_poses(
        self, configuration: Float[Tensor, "Q"], controls: Float[Tensor, "K H A"], poses: Float[Tensor, "M 3"]
    ) -> PushRollouts:
        """The rollouts in which the object starts at given poses (x, y, yaw)."""
        freedom = len(self.tool.scale)
        check_shape("configuration", configuration, f"({freedom},)", last=(freedom,))
        check_shape("controls", controls, "(K, H, A)")
        (samples, horizon, _), count = controls.shape, len(poses)
        start = configuration.expand(samples, 1, freedom)
        path = torch.cat((start, self.tool.free_path(start[:, 0], controls, 1)), 1)
        first = self._first_near(path, poses).reshape(-1)
        now = poses.expand(samples, count, 3).reshape(-1, 3)
        begun = now
        states = self.world.states(path[:, :1].expand(samples, count, freedom).reshape(-1, freedom), now)
        track, contact = [now], torch.zeros(samples * count, horizon, dtype=torch.bool)
        rows_path = path[:, None].expand(samples, count, horizon + 1, freedom).reshape(-1, horizon + 1, freedom)
        stepped = 0
        for action in range(horizon):
            rows = (first <= action).nonzero()[:, 0]
            if len(rows):
                fresh = first[rows] == action
                states[rows[fresh].numpy()] = self.world.states(rows_path[rows[fresh], action], now[rows[fresh]])
                after = self._act(states, rows, rows_path[:, action], rows_path[:, action + 1])
                contact[rows, action] = (after - now[rows])[:, :2].norm(dim=-1) > _STILL_M
                # who was never touched is where it was, whatever the engine's contacts creep
                unmoved = ~contact[rows].any(-1, keepdim=True)
                now = now.index_copy(0, rows, torch.where(unmoved, now[rows], after))
                stepped += len(rows)
            track.append(now)
        shifts, turns = rigid_motions(begun, torch.stack(track, 1), self.pivot)
        shape = (samples, count, horizon + 1)
        contact = contact.view(samples, count, horizon)
        return PushRollouts(
            rows_path.view(*shape, freedom).clone(),
            shifts.view(*shape, 3),
            contact,
            stepped / max(1, samples * count * horizon),
            duplicates(contact),
            turns.view(shape),
            self.pivot,
        )

    def _first_near(self, path: Float[Tensor, "K T Q"], poses: Float[Tensor, "M 3"]) -> Int[Tensor, "K M"]:
        """The first action in which the tool may touch; the number of actions if none."""
        begin, way = path[:, None, :-1, :2], (path[:, 1:, :2] - path[:, :-1, :2])[:, None]
        apart = poses[None, :, None, :2] - begin
        length = way.square().sum(-1).clamp_min(1e-12)
        share = ((apart * way).sum(-1) / length).clamp(0.0, 1.0)
        near: Bool[Tensor, "K M H"] = (apart - share[..., None] * way).norm(dim=-1) < self.reach
        horizon = path.shape[1] - 1
        if horizon == 0:
            return torch.zeros(near.shape[:2], dtype=torch.long)
        return torch.where(near.any(-1), near.to(torch.uint8).argmax(-1), horizon)

    def _act(self, states: Any, rows: Tensor, begin: Tensor, end: Tensor) -> Float[Tensor, "R 3"]:  # noqa: ANN401
        """Carry out one action in some rows; their states are changed in place."""
        found = []
        own = self.settings
        threads = own.threads or count()
        for part in rows.split(_ROWS):
            index = part.numpy()
            ways = np.stack((begin[part].double().numpy(), end[part].double().numpy()), 1)
            states[index], after = self.world.act(states[index], ways, own.action_s, own.hold_s, threads)
            found.append(after)
        return torch.cat(found).to(begin)


class MujocoMotion:
    """Motion of upright objects in MuJoCo, along the path that a level tool reports; one after the other.

    Args:
        model: the object; its exact shape is simulated.
        shape: of the gripper.
        height_m: of the level tool.
        settings: of the engine.
    """

    def __init__(self, model: ObjectModel, shape: GripperShape, height_m: float, settings: EngineSettings) -> None:
        self.settings = settings
        physics = PhysicsSettings(mass_kg=settings.mass_kg, friction=settings.friction)
        self.world = World(model.exact, shape, height_m, settings.time_step_s, physics)

    @torch.no_grad()
    def __call__(self, start: Float[Tensor, "E 3"], tool: Float[Tensor, "E K 3"]) -> Float[Tensor, "E K 4 4"]:
        """World motion of objects from their start poses (x, y, yaw) up to each instant of a tool's path."""
        if not len(start):
            return start.new_zeros(0, tool.shape[1], 4, 4)
        return torch.stack([self._motion(*row) for row in zip(start, unwrapped(tool), strict=True)]).to(start)

    def _motion(self, start: Float[Tensor, "3"], path: Float[Tensor, "K 3"]) -> Float[Tensor, "K 4 4"]:
        # the way to the first instant is not reported: it is taken to be as long as the one after it
        before = 2.0 * path[0] - path[1] if len(path) > 1 else path[0]
        self.world.reset(before.cpu(), start.cpu())
        stood = self.world.world_T_object()
        track = self.world.move(path.cpu(), self.settings.action_s, self.settings.hold_s)
        return track.world_T_object @ se3.inverse(stood)


class MujocoPush(PushModel):
    """The simulator's physics: a `PushModel` of objects that stay upright, or nearly so.

    Args:
        settings: of the engine.
    """

    # the quasi-static model's: not tuned by themselves
    defaults = PushDefaults(reachability_scale=4.0, rollouts=8, least_share=0.03)
    objects = "upright"

    def __init__(self, settings: EngineSettings) -> None:
        self.settings = settings

    @classmethod
    def make(cls, settings: Any) -> Self:  # noqa: ANN401
        """The model that settings describe."""
        return cls(settings.engine)

    def fits(self, world_T_object: Float[Tensor, "N 4 4"], tool: Tool) -> bool:
        """Whether a tool in space has toppled nothing, or a level tool meets objects upright at one height."""
        if tool.spatial:
            return bool((world_T_object[:, 2, 2] >= _TILTED).all())
        return Stance.of(world_T_object).rests

    def rollouts(
        self,
        model: ObjectModel,
        world_T_object: Float[Tensor, "N 4 4"],
        log_weights: Float[Tensor, "N"],
        tool: Tool,
        workspace: Workspace,
        fields: WorkspaceFields,
    ) -> MujocoRollouts:
        """Rollouts under one belief.

        Raises:
            ValueError: particles do not stand upright at one height, where the tool is level.
        """
        if not tool.spatial:
            Stance.of(world_T_object).checked()
        return MujocoRollouts(model, world_T_object, log_weights, tool, self.settings)

    def path(self, scene: Callable[[], Any] | None = None) -> MujocoPathPush:
        """Pushes along given paths, in the scene of a task.

        Raises:
            ValueError: no scene is given.
        """
        if scene is None:
            raise ValueError("Expected the scene of a simulator to push along paths in, got None: give what makes it")
        return MujocoPathPush(scene(), self.settings.threads)

    def motion(self, model: ObjectModel, shape: ToolShape, height_m: float, resting_m: float) -> MujocoMotion:
        """Motion along the path of a level tool."""
        return MujocoMotion(model, gripper_of(shape), height_m, self.settings)
