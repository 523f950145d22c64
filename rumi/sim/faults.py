"""Faults of simulated runs: what goes wrong with the object, the hand and the sensors, from some action on."""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, NamedTuple

import torch
import tyro
from jaxtyping import Float
from torch import Tensor

from rumi.errors import UsageError
from rumi.registry import Table
from rumi.seeding import split
from rumi.sim.reshaped import resized
from rumi.sim.world import World
from sdf import se3
from sdf.base import SDF
from sdf.object_model import ObjectModel
from sensors.contact_reading import ContactReading, WrenchTouch
from sensors.observation import Observation, concatenate
from sensors.reading import Reading
from sensors.semantics import Semantics

_TRIES = 64  # of ways to knock an object, until one does not put it into the tool
_FELT = 12  # points of a contact that there is none of
_RAD_PER_M = math.radians(30.0) / 0.03  # most that a knocked object turns


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


class Absent(Fault):
    """The object is taken away."""

    description = "the object is taken away"

    def strike(self, world: World, shape: SDF, hand: Hand) -> None:
        """Put it out of reach."""
        away = world.world_T_object().clone()
        away[0, 3] += 5.0
        world.place(away)


class Scale(Fault):
    """The object is of another size than the one that is looked for."""

    description = "the object is larger by SIZE (smaller below 0) than the one that is looked for"
    unit, usual, bounds, steps = "%", (5.0, 0), (-50.0, 100.0), (0, 0)

    def shaped(self, model: ObjectModel) -> ObjectModel:
        """The object in another size; what is looked for stays."""
        exact = resized(model.exact, 1.0 + 0.01 * self.size)
        return replace(model, exact=exact, sdf=exact)


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
            own = carried[instant]
            return (own[:, :3, :3] @ points[..., None])[..., 0] + own[:, :3, 3]

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
        first = hand.pads[int(where * len(hand.pads))]
        near = (hand.pads - first).norm(dim=-1).topk(min(_FELT, len(hand.pads)), largest=False).indices
        points = Observation.of(se3.apply(reading.tool_pose[instant], hand.pads[near]), Semantics.SURFACE)
        in_contact = reading.in_contact.clone()
        in_contact[instant] = True
        return replace(
            reading,
            observation=concatenate([points, reading.observation]),
            instant=torch.cat((torch.full((len(points),), instant, dtype=torch.long), reading.instant)),
            in_contact=in_contact,
        )


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


Faults = Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="KIND[:SIZE][@STEP]")]
"""Of settings: one text for each fault."""

FAULTS: Table[type[Fault]] = Table("fault", "rumi.faults")
"""Faults by name, as `--fault` has them."""
for _name, _kind in (
    ("knock", Knock),
    ("absent", Absent),
    ("scale", Scale),
    ("hand", HandOff),
    ("camera", CameraOff),
    ("stale", Stale),
    ("dead", Dead),
    ("false-contact", FalseContact),
    ("friction", Friction),
    ("mass", Mass),
):
    FAULTS.add(_name, _kind)


def parse_fault(text: str, *, steps: int, seed: int = 0) -> Fault:
    """The fault that KIND[:SIZE][@STEP] names.

    Args:
        text: such as "knock:30@4".
        steps: actions of the run at most.
        seed: of what is drawn of it.

    Raises:
        UsageError: there is no such fault, it has no such size, or its step is past the end.
    """
    rest, at, step_text = text.partition("@")
    name, colon, size_text = rest.partition(":")
    kind = FAULTS[name]
    size, step = kind.usual
    if colon:
        if math.isnan(size):
            raise UsageError(f"Expected --fault {name} without a size, got {text!r}")
        size = _number(text, size_text, f"SIZE ({kind.unit})")
        low, high = kind.bounds
        if not low < size <= high or size == 0:
            raise UsageError(f"Expected SIZE of {name} above {low:g} {kind.unit} and up to {high:g}, got {text!r}")
    if at:
        if not step_text.isdecimal():
            raise UsageError(f"Expected STEP as a whole number, the action from which on it holds, got {text!r}")
        step = int(step_text)
    first, last = kind.steps[0], min(kind.steps[1], steps)
    if not first <= step <= last:
        if step > steps:
            raise UsageError(
                f"Expected --fault {name} at an action up to {steps}, the run's last, got {step} ({text!r})"
            )
        raise UsageError(f"Expected --fault {name} at an action from {first} to {last:g}, got {step} ({text!r})")
    return kind(size, step, seed)


def chosen_faults(
    texts: Sequence[str], kinds: Collection[str], *, task: str, steps: int, seed: int = 0
) -> tuple[Fault, ...]:
    """The faults that texts name, of the kinds that a task can have.

    Args:
        texts: such as "knock:30@4".
        kinds: names of faults.
        task: its name, for people.
        steps: actions of the run at most.
        seed: of what is drawn of them.

    Raises:
        UsageError: there is no such fault, or not in this task; or as `parse_fault` has it.
    """
    found = tuple(parse_fault(text, steps=steps, seed=seed) for text in texts)
    for text in texts:
        name = text.partition("@")[0].partition(":")[0]
        if name not in kinds:
            raise UsageError(f"Expected --fault of {task} to be one of {', '.join(kinds)}, got {text!r}")
    return found


def _number(text: str, part: str, what: str) -> float:
    try:
        value = float(part)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise UsageError(f"Expected {what} as a number, got {text!r}")
    return value
