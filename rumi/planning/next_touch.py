"""Next-touch selection: the way whose first contact tells most about the pose, for each action that it takes.

A guarded action ends where the tool touches. Where that is on a way, and with what part of the tool, is all that the
way tells, and each particle of the belief says it for itself: no field has to be added up, in which points that tell
the same count again.
"""

import functools
import time
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rumi import seeding
from rumi.belief.particles import subsample
from rumi.clock import Now, Stopwatch
from rumi.errors import UsageError
from rumi.information.resolved_information import outcome_information, pose_kernel, resolved_entropy
from rumi.planning.first_contact import FirstContacts, TouchingSurface, first_contacts
from rumi.planning.policy import Plan, PlanRequest
from rumi.planning.touch_candidates import CandidateSettings, candidate_touches
from rumi.resampling import systematic
from rumi.robot.gripper import GripperShape
from rumi.weights import check_weights
from sdf.bounds import Checked, Count, NotNegative, Positive
from sdf.check import check_finite

_PARTS = 10  # of an action, after each of which its contacts are looked up
_PAD_SPACING_M, _PALM_SPACING_M, _PATCH_M = 0.010, 0.020, 0.015  # between points of the tool; sides of the pads' parts
_NOTHING, _NOW = -1, -2  # outcomes: no touch, and one that there is already
_ASTRAY = 0.005  # metres and radians: where an action ended farther off than this, its plan is not gone on with
_BATCH = 16  # ways that are looked at between two looks at the clock, where time is short


@dataclass(frozen=True)
class NextTouchSettings(Checked):
    """Settings of next-touch selection.

    Attributes:
        candidates: the ways it chooses among.
        particles: that stand for the belief.
        position_m, rotation_rad: deviations of the kernel, by which finer knowledge of the pose is worth nothing.
        felt_m: way of the tool in which two contacts are the same.
        overhead: actions that a touch is taken to cost beside those on its way.
        least_nats: what a way has to tell to be worth anything: a touch pushes, which costs certainty.
        unfelt: times its information that a way loses for each share of the belief that it pushes on without news: met
            first by the palm, which feels nothing, or in touch from the start and not let go of.
    """

    candidates: CandidateSettings = field(default_factory=CandidateSettings)
    particles: Count = 200
    position_m: Positive = 0.006
    rotation_rad: Positive = 0.12
    felt_m: Positive = 0.008
    overhead: NotNegative = 2.0
    least_nats: NotNegative = 0.1
    unfelt: NotNegative = 1.5


class NextTouchPolicy:
    """Chooses the next touch of a gripper that moves in space. A `Policy`; holds settings only.

    Of candidate ways, and what is left of the last plan, it follows the one with the greatest information about the
    pose, less what a touch costs, for each action that the way takes. An action later it chooses anew.

    Args:
        settings: of the candidates and of what they are worth.
        now: the clock that budgets are held against.
    """

    def __init__(self, settings: NextTouchSettings | None = None, *, now: Now = time.perf_counter) -> None:
        self.settings, self.now = settings or NextTouchSettings(), now

    @torch.no_grad()
    def act(self, request: PlanRequest) -> Plan:
        """Choose a way; see `rumi.planning.policy.Policy`.

        Raises:
            ValueError: the tool moves in the plane, or a pose or weight is not finite.
            UsageError: it is no gripper of a palm and two pads.
        """
        own, scene, begun = self.settings, request.scene, self.now()
        tool, model, like = scene.tool, scene.model, scene.workspace.points
        if not tool.spatial:
            raise ValueError("Expected a tool that moves in space, got one that keeps to a plane")
        if not isinstance(tool.shape, GripperShape):
            raise UsageError(
                "Expected a gripper of a palm and two pads, whose next touch is chosen, got a "
                f"{type(tool.shape).__name__}: plan with --planner.next-touch False"
            )
        watch, here = Stopwatch(self.now), scene.configuration.to(like)
        generator = seeding.on_device(request.generator, like.device)
        few = subsample(request.belief, own.particles)
        poses = few.world_T_object.to(like)
        check_finite("world_T_object", poses)
        check_finite("configuration", here)
        check_weights(few.log_weights)
        surface = _surface(tool.shape, like.device)
        drawn = poses[systematic(few.log_weights, 0.5)]
        controls, lengths = candidate_touches(drawn, model, tool, surface, here, own.candidates, generator=generator)
        controls, lengths = _with_previous(request, here, controls, lengths)
        # the first place of each is where the tool is
        ways = torch.cat((here.expand(len(controls), 1, -1), tool.free_path(here, controls, _PARTS)), 1)
        watch.lap("planner")
        kernel = pose_kernel(poses, model.symmetries, position_m=own.position_m, rotation_rad=own.rotation_rad)
        watch.lap("fields")
        contacts, looked = list[FirstContacts](), 0
        size = len(controls) if request.budget_s is None else _BATCH
        steps = _PARTS * lengths + 1
        for part, some in zip(ways.split(size), steps.split(size), strict=True):
            contacts.append(first_contacts(model.sdf, poses, part, some, surface))
            looked += len(part)
            if request.budget_s is not None and self.now() - begun > request.budget_s:
                break
        step, point = (torch.cat([getattr(found, name) for found in contacts]) for name in ("step", "point"))
        watch.lap("dynamics")
        met = step < steps[:looked, None]
        phase = seeding.uniform((1,), generator=generator, dtype=like.dtype, device=like.device)
        outcomes = self._outcomes(step, surface.patch[point], met, _far(ways[:looked], surface), phase)
        gained = outcome_information(kernel, few.log_weights, outcomes)
        weights = few.log_weights.to(like).softmax(-1)
        unfelt = (met & ((surface.patch[point] < 0) | (step == 0))).to(like) @ weights
        last = torch.where(met, step, steps[:looked, None] - 1)
        actions = ((last - 1).clamp_min(0) // _PARTS + 1).to(like) @ weights
        worth = self._worth(gained, unfelt, actions)
        best = int(worth.argmax())
        watch.lap("costs")
        count = int(lengths[best])
        gain, expected = float(gained[best]), float(actions[best])
        by_action = [0.0] * count
        by_action[min(round(expected), count) - 1] = gain
        info: dict[str, Any] = {
            "predicted_information": by_action,
            "information_total": float(resolved_entropy(kernel, few.log_weights)),
            "actions": expected,
            "unfelt": float(unfelt[best]),
            "samples": looked,
        }
        checked = sum(
            found.checked * float(some.sum()) for found, some in zip(contacts, steps.split(size), strict=False)
        )
        skipped = {"contact_checks": 1.0 - checked / float(steps[:looked].sum())}
        return Plan(
            controls[best, :count],
            ways[best, ::_PARTS][: count + 1],
            skipped=skipped,
            timings_s=watch.laps,
            info=info,
        )

    def _worth(
        self, gained: Float[Tensor, "K"], unfelt: Float[Tensor, "K"], actions: Float[Tensor, "K"]
    ) -> Float[Tensor, "K"]:
        """Information of each way above the least, for each action; what tells less is worse the longer it takes.

        Args:
            gained: information, nats.
            unfelt: share of the belief that a way pushes on without news.
            actions: that it takes, in the mean.
        """
        own = self.settings
        net = gained * (1.0 - own.unfelt * unfelt) - own.least_nats
        takes = actions + own.overhead
        return torch.where(net > 0, net / takes, net * takes)

    def _outcomes(
        self,
        step: Int[Tensor, "K N"],
        patch: Int[Tensor, "K N"],
        met: Bool[Tensor, "K N"],
        far: Float[Tensor, "K S"],
        phase: Float[Tensor, "1"],
    ) -> Int[Tensor, "K N"]:
        """Number of what the tool would feel: how far on its way, and with what of it."""
        place = far.gather(1, step.clamp_max(far.shape[1] - 1)) / self.settings.felt_m + phase
        outcome = place.long() * (int(patch.max()) + 2) + patch + 1
        outcome = torch.where(step == 0, torch.full_like(outcome, _NOW), outcome)
        return torch.where(met, outcome, torch.full_like(outcome, _NOTHING))


@functools.cache
def _surface(shape: GripperShape, device: torch.device) -> TouchingSurface:
    """Surface of a gripper."""
    made = TouchingSurface.of(shape, pad_spacing_m=_PAD_SPACING_M, palm_spacing_m=_PALM_SPACING_M, patch_m=_PATCH_M)
    return made.to(device)


def _far(ways: Float[Tensor, "K S 4"], surface: TouchingSurface) -> Float[Tensor, "K S"]:
    """How far the tool has gone by each place of its way; a turn counts as the way of its outermost point."""
    moved = torch.diff(ways, dim=1, prepend=ways[:, :1])
    return (moved[..., :3].norm(dim=-1) + surface.radius_m * moved[..., 3].abs()).cumsum(-1)


def _with_previous(
    request: PlanRequest, here: Float[Tensor, "4"], controls: Float[Tensor, "K H 4"], lengths: Int[Tensor, "K"]
) -> tuple[Float[Tensor, "K1 H1 4"], Int[Tensor, "K1"]]:
    """Candidates, and as the first of them what is left of the last plan, where the tool is where that has it."""
    previous, done = request.previous, request.executed
    if previous is None or done >= len(previous.controls) or previous.controls.shape[-1] != controls.shape[-1]:
        return controls, lengths
    if float((previous.path[done].to(here) - here).abs().max()) > _ASTRAY:
        return controls, lengths
    rest = previous.controls[done:].to(controls)
    most = max(len(rest), controls.shape[1])
    padded = controls.new_zeros(len(controls) + 1, most, controls.shape[-1])
    padded[0, : len(rest)], padded[1:, : controls.shape[1]] = rest, controls
    return padded, torch.cat((lengths.new_tensor([len(rest)]), lengths))
