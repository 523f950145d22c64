"""Faults of the object: moved, taken away, of another size, rougher or heavier than it was."""

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.sim.fault import Fault, Hand
from rumi.sim.reshaped import resized
from rumi.sim.world import World
from sdf import se3
from sdf.base import SDF
from sdf.object_model import ObjectModel

_AWAY_M = 1000.0  # where an object that is taken away lies: smaller than a camera's pixel
_TRIES = 64  # of ways to knock an object, until one does not put it into the tool
_RAD_PER_M = math.radians(30.0) / 0.03  # most that a knocked object turns


class Knock(Fault):
    """The object is moved, upright as it was, where the tool is not."""

    description = "the object is moved by SIZE, and turned by up to 1 degree a millimetre"
    unit, usual, bounds = "mm", (30.0, 3), (0.0, 200.0)

    def strike(self, world: World, shape: SDF, hand: Hand) -> None:
        """Move it; no slip sensor sees that."""
        generator, now = self.drawn(), world.world_T_object()
        body = se3.apply(hand.world_T_tool.double(), hand.body.double())
        for _ in range(_TRIES):
            angle, turn = (2.0 * torch.rand(2, generator=generator, dtype=torch.float64) - 1.0).tolist()
            angle, turn = math.pi * angle, 1e-3 * self.size * _RAD_PER_M * turn
            moved = now.clone()
            moved[:3, :3] = se3.from_planar(torch.tensor([0.0, 0.0, turn], dtype=torch.float64))[:3, :3] @ now[:3, :3]
            moved[:2, 3] += 1e-3 * self.size * torch.tensor([math.cos(angle), math.sin(angle)], dtype=torch.float64)
            with torch.no_grad():
                clear = shape.distance(se3.apply(se3.inverse(moved), body).float()).min()
            if float(clear) > 2e-3:
                break
        world.place(moved)

    def struck(self, pose: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
        """Where it puts an object at (x, y, yaw) where nothing tells whether the tool is there."""
        turn = 2.0 * float(torch.rand(2, generator=self.drawn())[1]) - 1.0
        moved = pose.clone()
        moved[:2] += self.aside()[:2].to(moved)
        moved[2] += torch.deg2rad(torch.tensor(self.size * turn)).to(moved)
        return moved


class Absent(Fault):
    """The object is taken away."""

    description = "the object is taken away"

    def strike(self, world: World, shape: SDF, hand: Hand) -> None:
        """Put it out of reach, and out of any camera's sight."""
        away = world.world_T_object().clone()
        away[0, 3] += _AWAY_M
        world.place(away)


class Scale(Fault):
    """The object is of another size than the one that is looked for."""

    description = "the object is larger by SIZE (smaller below 0) than the one that is looked for"
    unit, usual, bounds, steps = "%", (5.0, 0), (-50.0, 100.0), (0, 0)

    def shaped(self, model: ObjectModel) -> ObjectModel:
        """The object in another size; what is looked for stays."""
        exact = resized(model.exact, 1.0 + 0.01 * self.size)
        return replace(model, exact=exact, sdf=exact)


class Friction(Fault):
    """Everything is rougher or more slippery than it was."""

    description = "friction becomes SIZE times what it was"
    unit, usual, bounds = "times", (3.0, 1), (0.0, 100.0)

    def strike(self, world: World, shape: SDF, hand: Hand) -> None:
        """Change it."""
        world.model.geom_friction[:, 0] *= self.size


class Mass(Fault):
    """The object is heavier or lighter than it was."""

    description = "the object's mass becomes SIZE times what it was"
    unit, usual, bounds = "times", (3.0, 1), (0.0, 100.0)

    def strike(self, world: World, shape: SDF, hand: Hand) -> None:
        """Change it, and its inertia with it."""
        world.make_heavier(self.size)
