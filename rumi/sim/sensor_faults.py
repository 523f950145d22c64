"""Faults of the sensors: hand or camera off, repeating themselves, feeling nothing or what is not the object."""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rumi.dynamics.sliding import rotated
from rumi.sim.fault import Fault, Hand
from rumi.sim.world import World
from sdf import se3
from sdf.base import SDF
from sensors.contact_reading import ContactReading, WrenchTouch
from sensors.observation import Observation, concatenate
from sensors.reading import Reading
from sensors.semantics import Semantics

_FELT = 12  # points of a contact that there is none of
_POST_M, _MET_M = 0.02, 0.003  # radius of a post in the way, and distance from its surface at which it is felt


class HandOff(Fault):
    """The hand is not where it is taken to be."""

    description = "the hand, and all that it feels, is reported off by SIZE"
    unit, usual, bounds = "mm", (6.0, 1), (0.0, 100.0)

    def felt(self, reading: Reading, hand: Hand, step: int) -> Reading:
        """The hand's poses and points, off by a constant in its own frame."""
        tool_T_taken = se3.make(torch.eye(3), self.aside())
        taken = reading.tool_pose @ tool_T_taken
        carried = taken @ se3.inverse(reading.tool_pose)

        def moved(points: Tensor, instant: Tensor) -> Tensor:
            return se3.apply(carried[instant], points[:, None])[:, 0]

        if isinstance(reading, ContactReading):
            wrench = replace(reading.wrench, points=moved(reading.wrench.points, reading.wrench.instant))
            reading = replace(reading, wrench=wrench)
        points = moved(reading.observation.points, reading.instant)
        return replace(reading, tool_pose=taken, observation=replace(reading.observation, points=points))


class CameraOff(Fault):
    """The camera is not where it is taken to be."""

    description = "what the camera sees is reported off by SIZE"
    unit, usual, bounds, steps = "mm", (10.0, 0), (0.0, 200.0), (0, math.inf)

    def seen(self, view: Observation, before: Sequence[Observation]) -> Observation:
        """The view, moved."""
        return replace(view, points=view.points + self.aside())


class Stale(Fault):
    """The camera repeats an old view."""

    description = "the camera repeats what it saw before that action (tasks whose camera looks again)"
    steps = (1, math.inf)

    def seen(self, view: Observation, before: Sequence[Observation]) -> Observation:
        """The last view that was a new one."""
        return before[-1] if before else view


class Dead(Fault):
    """The hand feels nothing any more."""

    description = "the hand feels nothing any more"
    usual = (math.nan, 1)

    def touched(self, felt: bool, hand: Hand) -> bool:
        """Never."""
        return False

    def felt(self, reading: Reading, hand: Hand, step: int) -> Reading:
        """No contact, no felt points, no wrench and no torques."""
        if isinstance(reading, ContactReading):
            signals = None if reading.signals is None else torch.zeros_like(reading.signals)
            reading = replace(reading, wrench=WrenchTouch.none(), signals=signals)
        kept = ~reading.observation.of_class(Semantics.SURFACE)
        return replace(
            reading,
            observation=reading.observation[kept],
            instant=reading.instant[kept],
            in_contact=torch.zeros_like(reading.in_contact),
        )


class FalseContact(Fault):
    """The hand feels what is not there."""

    description = "in a share SIZE of the actions a pad feels something where nothing is"
    unit, usual, bounds = "of the actions", (0.3, 1), (0.0, 1.0)

    def felt(self, reading: Reading, hand: Hand, step: int) -> Reading:
        """A contact of some points near by each other on the pads, at one instant."""
        generator = self.drawn(step)
        chance, when, where = torch.rand(3, generator=generator).tolist()
        if chance >= self.size:
            return reading
        instant = int(when * len(reading.tool_pose))
        places = se3.apply(reading.tool_pose[instant], _together(hand.pads, where))
        in_contact = reading.in_contact.clone()
        in_contact[instant] = True
        return _felt_too(reading, places, torch.full((len(places),), instant, dtype=torch.long), in_contact)


class Stuck(Fault):
    """The hand feels the same at every instant."""

    description = "the hand feels the same all the time, at one place of its pads"
    usual = (math.nan, 3)

    def touched(self, felt: bool, hand: Hand) -> bool:
        """Always."""
        return True

    def felt(self, reading: Reading, hand: Hand, step: int) -> Reading:
        """The same pads' points at every instant, whatever is there."""
        near = _together(hand.pads, float(torch.rand((), generator=self.drawn())))
        instants = len(reading.tool_pose)
        places = se3.apply(reading.tool_pose, near.expand(instants, -1, -1)).reshape(-1, 3)
        kept = ~reading.observation.of_class(Semantics.SURFACE)
        reading = replace(reading, observation=reading.observation[kept], instant=reading.instant[kept])
        when = torch.arange(instants).repeat_interleave(len(near))
        return _felt_too(reading, places, when, torch.ones_like(reading.in_contact))


class SecondObject(Fault):
    """Something else stands in the way: a post beside the object that gives way and stays where it is."""

    description = "a soft post, which the tool goes through, stands SIZE beside the object and is felt as it is"
    unit, usual, bounds = "mm", (120.0, 1), (0.0, 500.0)

    _place: Float[Tensor, "2"] | None = None

    def strike(self, world: World, shape: SDF, hand: Hand) -> None:
        """Put it beside where the object is now, on the tool's side of it."""
        here = world.world_T_object()[:2, 3]
        way = hand.world_T_tool[:2, 3].double() - here
        turn = 0.5 * math.pi * (2.0 * float(torch.rand((), generator=self.drawn())) - 1.0)
        side = rotated(way / way.norm().clamp_min(1e-9), way.new_tensor(turn))
        object.__setattr__(self, "_place", here + 1e-3 * self.size * side)  # a run's own, as the world is

    def touched(self, felt: bool, hand: Hand) -> bool:
        """Where the pads meet it too."""
        return felt or bool(self._met(hand.world_T_tool[None], hand.pads).any())

    def _met(self, world_T_tool: Float[Tensor, "K 4 4"], pads: Float[Tensor, "n 3"]) -> Bool[Tensor, "K n"]:
        """Which of the pads' points meet it."""
        if self._place is None:
            return torch.zeros(len(world_T_tool), len(pads), dtype=torch.bool)
        points = se3.apply(world_T_tool, pads.expand(len(world_T_tool), -1, -1))
        return ((points[..., :2] - self._place.to(points)).norm(dim=-1) - _POST_M).abs() < _MET_M

    def felt(self, reading: Reading, hand: Hand, step: int) -> Reading:
        """What the pads meet of it, beside what they felt."""
        met = self._met(reading.tool_pose, hand.pads)
        when, which = met.nonzero(as_tuple=True)
        if not len(when):
            return reading
        places = se3.apply(reading.tool_pose[when], hand.pads[which][:, None])[:, 0]
        return _felt_too(reading, places, when, reading.in_contact | met.any(-1))


def _together(pads: Float[Tensor, "n 3"], share: float) -> Float[Tensor, "m 3"]:
    """Some points near by each other on the pads, about the one that is as far along as a share in [0, 1)."""
    first = pads[int(share * len(pads))]
    return pads[(pads - first).norm(dim=-1).topk(min(_FELT, len(pads)), largest=False).indices]


def _felt_too(
    reading: Reading, places: Float[Tensor, "m 3"], when: Int[Tensor, "m"], in_contact: Bool[Tensor, "K"]
) -> Reading:
    """A reading with points that were felt at some instants before its own."""
    points = Observation.of(places, Semantics.SURFACE)
    return replace(
        reading,
        observation=concatenate([points, reading.observation]),
        instant=torch.cat((when, reading.instant)),
        in_contact=in_contact,
    )
