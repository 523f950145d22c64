"""Quasi-static pushing of single particles: each rollout pushes one pose that the belief holds likely."""

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.dynamics.base import (
    PushRollouts,
    duplicates,
    middles_of_shares,
    rigid_motions,
    shares_by_yaw,
)
from rumi.dynamics.outline import GridOutline, Support
from rumi.dynamics.push_parameters import sliding_of
from rumi.dynamics.push_posterior import PushPosterior
from rumi.dynamics.sliding import Sliding, push
from rumi.robot.border import BORDER_GROUP
from rumi.robot.tool import Tool
from rumi.seeding import Generators
from sdf import backend, compiled, gpu, se3, skipped_work
from sdf.bounds import Checked, Count, NotNegative, Positive
from sdf.check import check_shape

_COARSE = 4  # mini steps that are one where samples are only told apart


@dataclass(frozen=True)
class QuasiStaticSettings(Checked):
    """Settings of the quasi-static push model.

    Attributes:
        mini_steps: parts into which every action is cut, one contact problem each.
        friction: coefficient between tool and object.
        lever_ratio: c of the limit surface, as a multiple of the mean distance of the object's base from below its
            centre of mass. 1 is even pressure; what rests on its rim or on corners has more.
        passes: contacts that are settled in a mini step, at most.
        spacing_m: between the points of the tool's border.
    """

    mini_steps: Count = 16
    friction: NotNegative = 0.5
    lever_ratio: Positive = 1.5
    passes: Count = 3
    spacing_m: Positive = 0.005


class QuasiStaticRollouts:
    """A planar tool that goes where it wants and pushes particles of the belief before it: a `RolloutModel`.

    Where the displacement model asks how likely a contact is and moves the object with the point that touches it, here
    every rollout has one pose of the object, and pushes that: it slides along the tool, turns, and slips off. The
    rollouts' poses stand for equal shares of the belief in the order of their yaws, and are the same for every control
    sequence; nothing is random. Motions are told as those of the belief's mean position (`pivot`), and a turn.

    Beliefs of several scenes that hold the object at one height are rolled out in one call; a row is what the scene
    gives alone.

    Skipped, with the same result: mini steps in which the tool is too far off to touch.

    Args:
        outline: what the tool meets of the object.
        support: how the object rests on the floor.
        tool: points and free-space motion.
        world_T_object: (*b, N, 4, 4), upright poses.
        log_weights: (*b, N), of the poses.
        settings: friction, limit surface and mini steps of a push.
        posterior: over friction and limit surface, of which each rollout has a draw; None for the settings' own.
    """

    def __init__(
        self,
        outline: GridOutline,
        support: Support,
        tool: Tool,
        world_T_object: Float[Tensor, "*b N 4 4"],
        log_weights: Float[Tensor, "*b N"],
        settings: QuasiStaticSettings | None = None,
        posterior: PushPosterior | None = None,
    ) -> None:
        self.settings = settings or QuasiStaticSettings()
        self.tool = tool
        self.poses = se3.to_planar(world_T_object)
        self.weights = log_weights.softmax(-1)
        self.pivot = (self.weights.unsqueeze(-2) @ self.poses[..., :2]).squeeze(-2)
        self.border = tool.border(self.settings.spacing_m, BORDER_GROUP, self.poses)
        self.points = self.border.points
        self.outline = outline.to(self.poses)
        numbers = (*support.centre.tolist(), self.settings.lever_ratio * support.spread, self.settings.friction)
        slides = gpu.constant(numbers, self.poses.dtype, self.poses.device)
        self.sliding = Sliding(slides[:2], slides[2], slides[3])
        self.support, self.posterior = support, posterior
        if posterior is not None:
            self.sliding = posterior.middle(support).to(self.poses)
        scenes = self.poses.reshape(-1, *self.poses.shape[-2:]), self.weights.reshape(-1, self.weights.shape[-1])
        self._scenes = []  # poses in the order of their yaws, and the weight up to each of them
        for poses, weights in zip(*scenes, strict=True):
            order, below = shares_by_yaw(poses[:, 2], weights)
            self._scenes.append((poses[order], below))
        self._representatives: dict[int, Tensor] = {}
        self._slides: dict[int, Sliding] = {}
        # a tool farther than this from an object does not touch it
        self.reach = self.border.radius + self.outline.radius

    def coarse(self) -> Self:
        """The same with a quarter of the mini steps."""
        coarse = copy.copy(self)
        coarse.__dict__.pop("compiled", None)
        coarse.settings = replace(self.settings, mini_steps=math.ceil(self.settings.mini_steps / _COARSE))
        return coarse

    @cached_property
    def compiled(self) -> Callable[[Tensor, Tensor, Tensor, Sliding], PushRollouts]:
        """`rollout_poses` in one kernel; made once a model, at its first use."""
        from rumi.dynamics.quasi_static_numba import CompiledRollouts

        kernel: Callable[[Tensor, Tensor, Tensor, Sliding], PushRollouts] = CompiledRollouts(self)
        return kernel

    @cached_property
    def limits(self) -> tuple[Any, ...]:
        """What limits the tool's steps, for the kernels of a GPU; made once a model, at its first use."""
        return self.tool.arm_tensors(self.poses)

    def representatives(self, count: int) -> Float[Tensor, "*b count 3"]:
        """Poses in the middles of `count` equal shares of the belief, in the order of their yaws."""
        if count not in self._representatives:
            drawn = [poses[middles_of_shares(below, count)] for poses, below in self._scenes]
            whole = drawn[0] if len(drawn) == 1 else torch.stack(drawn)
            self._representatives[count] = whole.view(*self.poses.shape[:-2], count, 3)
        return self._representatives[count]

    def rollout(
        self,
        configuration: Float[Tensor, "*b 3"],
        controls: Float[Tensor, "*b K H A"],
        *,
        rollouts: int,
        generator: Generators | None = None,
    ) -> PushRollouts:
        """Roll control sequences out from one configuration (x, y, yaw), once for each of `rollouts` poses."""
        return self.rollout_poses(configuration, controls, self.representatives(rollouts), self._drawn(rollouts))

    def _drawn(self, count: int) -> Sliding | None:
        """How the object slides in each rollout, the same for every control sequence."""
        if self.posterior is None:
            return None
        if count not in self._slides:
            self._slides[count] = sliding_of(self.posterior.draws(count), self.support).to(self.poses)
        return self._slides[count]

    def nominal_rollout(self, configuration: Float[Tensor, "*b 3"], controls: Float[Tensor, "*b H A"]) -> PushRollouts:
        """The one rollout (K = M = 1) of the likeliest pose."""
        likeliest = self.weights.argmax(-1)[..., None, None]
        return self.rollout_poses(configuration, controls.unsqueeze(-3), self.poses.take_along_dim(likeliest, -2))

    @torch.no_grad()
    def rollout_poses(
        self,
        configuration: Float[Tensor, "*b 3"],
        controls: Float[Tensor, "*b K H A"],
        poses: Float[Tensor, "*b M 3"],
        sliding: Sliding | None = None,
    ) -> PushRollouts:
        """The rollouts in which the object starts at given poses (x, y, yaw), and slides as given, or as set."""
        check_shape("configuration", configuration, "(*b, 3)", last=(3,))
        check_shape("controls", controls, "(*b, K, H, A)", last=(3,))
        batch = self.poses.shape[:-2]
        if {configuration.shape[:-1], controls.shape[:-3], poses.shape[:-2]} != {batch}:
            raise ValueError(
                f"Expected the batch of scenes {tuple(batch)} of the belief in front of configuration, controls and "
                f"poses, got {tuple(configuration.shape)}, {tuple(controls.shape)} and {tuple(poses.shape)}"
            )
        version = backend.dispatch("quasi_static_rollouts", configuration, controls, poses, self.points)
        slides = sliding or self.sliding.expand(poses.shape[-2])
        with skipped_work.work("pushes") as work:
            found: PushRollouts = version(self, configuration, controls, poses, slides)
            whole = found.contact.numel() * self.settings.mini_steps
            work.count_share(found.checked, whole)
        return found

    def free_path(
        self, configuration: Float[Tensor, "*b 3"], controls: Float[Tensor, "*b K H A"]
    ) -> Float[Tensor, "*b K T 3"]:
        """Where the tool is after each action, the present configuration first; nothing holds it up."""
        start = configuration[..., None, None, :].expand(*controls.shape[:-2], 1, 3)
        return torch.cat((start, self.tool.free_path(start[..., 0, :], controls, 1)), -2)

    def _rollouts(
        self,
        configuration: Float[Tensor, "*b 3"],
        controls: Float[Tensor, "*b K H A"],
        poses: Float[Tensor, "*b M 3"],
        sliding: Sliding,
    ) -> PushRollouts:
        horizon, rollouts, mini = controls.shape[-2], poses.shape[-2], self.settings.mini_steps
        shape = (*controls.shape[:-2], rollouts)
        path = self.free_path(configuration, controls).unsqueeze(-3).expand(*shape, horizon + 1, 3)
        rows = path.reshape(-1, horizon + 1, 3)
        now = poses.unsqueeze(-3).expand(*shape, 3).reshape(-1, 3)
        start, alike = now, math.prod(shape[:-1])
        sliding = sliding.map(lambda part: part.repeat(alike, *[1] * (part.ndim - 1)))
        track, contact, checked = [now], torch.zeros(len(now), horizon, dtype=torch.bool, device=now.device), 0
        for action in range(horizon):
            way = (rows[:, action + 1] - rows[:, action]) / mini
            for part in range(mini):
                before = rows[:, action] + part * way
                after = rows[:, action] + (part + 1) * way
                near = ((after - now)[:, :2].norm(dim=-1) < self.reach).nonzero()[:, 0]
                if not len(near):
                    continue
                checked += len(near)
                pushed, touched = push(
                    now[near],
                    before[near],
                    after[near],
                    self.points,
                    self.outline,
                    sliding.at(near),
                    passes=self.settings.passes,
                )
                now = now.index_copy(0, near, pushed)
                contact[near, action] |= touched
            track.append(now)
        shifts, turns = rigid_motions(start, torch.stack(track, 1), self.pivots(shape))
        contact = contact.view(*shape, horizon)
        return PushRollouts(
            path.clone(),
            shifts.view(*shape, horizon + 1, 3),
            contact,
            checked / max(1, contact.numel() * mini),
            duplicates(contact),
            turns.view(*shape, horizon + 1),
            self.pivot,
        )

    def pivots(self, shape: Sequence[int]) -> Float[Tensor, "E 2"]:
        """The pivot of each of the rollouts of a shape (*b, K, M)."""
        return self.pivot[..., None, None, :].expand(*shape, 2).reshape(-1, 2)


backend.register("quasi_static_rollouts")(QuasiStaticRollouts._rollouts)


@backend.register("quasi_static_rollouts", "numba", compiled.supports)
def _rollouts_numba(
    model: QuasiStaticRollouts, configuration: Tensor, controls: Tensor, poses: Tensor, sliding: Sliding
) -> PushRollouts:
    return model.compiled(configuration, controls, poses, sliding)


@backend.register("quasi_static_rollouts", gpu.VERSION, gpu.supports, gpu.suits)
def _rollouts_warp(
    model: QuasiStaticRollouts, configuration: Tensor, controls: Tensor, poses: Tensor, sliding: Sliding
) -> PushRollouts:
    from rumi.dynamics.quasi_static_warp import rollouts

    found: PushRollouts = rollouts(model, configuration, controls, poses, sliding)
    return found
