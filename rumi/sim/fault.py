"""What a fault of a simulated run is: something that goes wrong with object, hand or sensors, from some action on."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.seeding import split
from rumi.sim.world import World
from sdf.base import SDF
from sdf.object_model import ObjectModel
from sensors.observation import Observation
from sensors.reading import Reading


class Hand(NamedTuple):
    """The tool, as faults see it.

    Attributes:
        pads: (n, 3), points of its pads, tool frame.
        body: (m, 3), points in its volume.
        world_T_tool: (4, 4), where it is.
    """

    pads: Float[Tensor, "n 3"]
    body: Float[Tensor, "m 3"]
    world_T_tool: Float[Tensor, "4 4"]


@dataclass(frozen=True)
class Fault:
    """A fault that does nothing; others change what it hands through.

    Attributes:
        size: how large, in `unit`.
        step: the action from which on it holds, 1 the first; 0 the first view.
        seed: of what is drawn of it.
    """

    size: float
    step: int
    seed: int = 0

    description: ClassVar[str] = ""
    unit: ClassVar[str] = ""
    usual: ClassVar[tuple[float, int]] = (math.nan, 3)
    """Size and step where none is given; no number where it has no size."""
    bounds: ClassVar[tuple[float, float]] = (0.0, math.inf)
    """Of the size; the lower one is excluded."""
    steps: ClassVar[tuple[int, float]] = (1, math.inf)
    """Of the step."""

    def shaped(self, model: ObjectModel) -> ObjectModel:
        """The object that is there."""
        return model

    def strike(self, world: World, shape: SDF, hand: Hand) -> None:
        """Change the world before the action `step`."""

    def felt(self, reading: Reading, hand: Hand, step: int) -> Reading:
        """What the hand reports of an action."""
        return reading

    def touched(self, felt: bool, hand: Hand) -> bool:
        """Whether the hand takes itself to touch something at an instant, where it would feel that it does or not."""
        return felt

    def seen(self, view: Observation, before: Sequence[Observation]) -> Observation:
        """What the camera reports, and the views that it gave before."""
        return view

    def drawn(self, step: int = 0) -> torch.Generator:
        """What of it is random, in an action."""
        return split(self.seed, f"fault {type(self).__name__} {step}")

    def aside(self) -> Float[Tensor, "3"]:
        """A level way of `size` millimetres, the same all along."""
        angle = 2.0 * math.pi * float(torch.rand((), generator=self.drawn()))
        return 1e-3 * self.size * torch.tensor([math.cos(angle), math.sin(angle), 0.0])
