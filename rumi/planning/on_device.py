"""A policy that plans on another device than the belief is followed on."""

import copy
from dataclasses import replace
from typing import TypeVar, cast

import torch

from rumi.fields.workspace import Workspace
from rumi.planning.policy import Plan, PlanRequest, Policy, Scene
from rumi.robot.tool import Tool
from sdf.object_model import ObjectModel

M = TypeVar("M", ObjectModel, Workspace, Tool)


class PolicyOnDevice:
    """Policy whose plans are made on a device, such as a GPU, from a belief on the CPU, and come back to the CPU.

    A plan is thousands of rollouts, which a GPU takes side by side; a belief is followed by a few hundred particles,
    one reading after the other, which a CPU does sooner. What crosses is small: particles, points and a plan.

    Args:
        policy: that plans, with its own tensors on the device.
        device: where it does.
    """

    def __init__(self, policy: Policy, device: torch.device) -> None:
        self.policy, self.device = policy, device
        self._kept: dict[int, tuple[object, object]] = {}  # what stays the same for a run, by the host's

    def act(self, request: PlanRequest) -> Plan:
        """Plan from the belief; see `rumi.planning.policy.Policy`."""
        scene, previous = request.scene, request.previous
        there = replace(
            request,
            belief=request.belief.to(self.device),
            scene=self._scene(scene),
            previous=None if previous is None else moved(replace(previous, fields={}, samples=None), self.device),
        )
        return moved(self.policy.act(there), scene.configuration.device)

    def _scene(self, scene: Scene) -> Scene:
        return replace(
            scene,
            model=self._once(scene.model),
            workspace=self._once(scene.workspace),
            tool=self._once(scene.tool),
            configuration=scene.configuration.to(self.device),
            observed=None if scene.observed is None else scene.observed.to(self.device),
            reading=None if scene.reading is None else scene.reading.to(self.device),
        )

    def _once(self, own: M) -> M:
        """What is the same for a whole run, moved once."""
        if id(own) not in self._kept:
            self._kept[id(own)] = own, copy.deepcopy(own).to(self.device)
        return cast(M, self._kept[id(own)][1])


def moved(plan: Plan, device: torch.device) -> Plan:
    """A plan with its tensors on a device."""
    samples = plan.samples
    return replace(
        plan,
        controls=plan.controls.to(device),
        path=plan.path.to(device),
        warm_start=None if plan.warm_start is None else plan.warm_start.to(device),
        fields={name: values.to(device) for name, values in plan.fields.items()},
        samples=None if samples is None else replace(samples, found=lambda: samples.found().to(device)),
    )
