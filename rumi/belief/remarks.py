"""Remarks: what a reading tells against what is believed, found in both alone and never in a simulator's state.

An object that resists being pushed, has toppled, is lifted or has left the table, or is not where it is believed to be.
What the cause is, and what to do, is not decided here.
"""

import math
from collections.abc import Collection
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.frictions import Frictions
from rumi.belief.particles import PoseBelief
from rumi.belief.reading_fit import felt_heights, unexplained
from rumi.dynamics.outline import Base
from rumi.dynamics.push_limits import held_twice, tips
from rumi.dynamics.pushed_body import PushedBody
from rumi.dynamics.sliding import rotated
from rumi.resampling import systematic
from sdf import se3
from sdf.object_model import ObjectModel
from sdf.symmetry import Symmetries
from sensors.observation import Observation
from sensors.reading import Reading
from sensors.semantics import Semantics

_ASKED = 9  # poses that stand for equal shares of the belief
_AT_ODDS = {"not there", "elsewhere", "other height", "lost"}
_DRAWN = 64  # the same where frictions differ from one to the next


@dataclass(frozen=True)
class Remark:
    """Something odd that a reading told.

    Attributes:
        name: in one or two words, one of "resists", "toppled", "rolled", "lifted", "dropped", "not there", "elsewhere",
            "other height", "tips", "two contacts", "false touch".
        step: number of the action after which it was noticed first.
        sentence: for people.
    """

    name: str
    step: int
    sentence: str


@dataclass(frozen=True)
class Limits:
    """How much is odd.

    Attributes:
        short_m: by which a tool that presses against an object stops before its goal, at least.
        share: the same, of the way that it was to go.
        held: instants at the end of an action over which it presses.
        tilt_rad: of an object that stands.
        height_m: of an object's lowest point above or below the table.
        apart_m: between a surface that was felt or seen and the nearest that is believed, and how deep in what is
            believed the tool may have been.
        pushed_m: that a tool goes in contact, at least, to have pushed.
        tips: probability that a push tipped the object.
        odds: how many times as likely readings are to be at odds with an upright pose where it was tipped.
    """

    short_m: float = 0.015
    share: float = 0.5
    held: int = 3
    tilt_rad: float = math.radians(45.0)
    height_m: float = 0.010
    apart_m: float = 0.012
    pushed_m: float = 0.002
    tips: float = 0.9
    odds: float = 9.0


def held_up(
    start: Float[Tensor, "Q"], wanted: Float[Tensor, "Q"], reading: Reading, limits: Limits
) -> tuple[float, float | None] | None:
    """How far a tool that pressed against an object stopped short of its goal, and how far it moved the object.

    Args:
        start: configuration before the action.
        wanted: the one that the action would have led to with nothing in its way.
        reading: of the action.
        limits: how much is odd.

    Returns:
        metres along the table, and metres that were measured; None where they were not. None where the tool did not
        touch over the last instants or came nearly as far as it should.
    """
    if not bool(reading.in_contact[-limits.held :].all()):
        return None
    short, asked = (float((wanted - place)[:2].norm()) for place in (reading.configuration, start))
    if short <= max(limits.short_m, limits.share * asked):
        return None
    if reading.object_motion is None:
        return short, None
    place = reading.tool_pose[-1, :3, 3]
    return short, float((se3.apply(se3.inverse(reading.object_motion[-1]), place[None])[0] - place).norm())


def least_tilt(world_T_object: Float[Tensor, "N 4 4"], symmetries: Symmetries | None = None) -> float:
    """Angle off upright of the particle that is nearest to it, radians, as that of its poses that look the same.

    Args:
        world_T_object: of the particles.
        symmetries: turns after which the object looks the same; a ball is upright always.
    """
    up = world_T_object[:, 2, :3]  # in the object's frame
    own = (symmetries or Symmetries.none()).to(up)
    if own.ball:
        return 0.0
    alike = own.rotations[:, :, 2]
    cosine = up @ alike.mT
    if own.axis is not None:  # an axis that looks like z may go anywhere on a cone
        along = (up @ own.axis)[:, None] * (alike @ own.axis)
        across = (1.0 - (up @ own.axis).square()).clamp_min(0.0).sqrt()[:, None]
        cosine = along + across * (1.0 - (alike @ own.axis).square()).clamp_min(0.0).sqrt()
    return math.acos(max(-1.0, min(1.0, float(cosine.max()))))


def nearest_to_floor(world_T_object: Float[Tensor, "N 4 4"], surface_points: Float[Tensor, "S 3"]) -> float:
    """Height of an object's lowest point, metres, by the particle that is nearest to resting on z = 0."""
    heights = world_T_object[:, 2, :3] @ surface_points.mT + world_T_object[:, 2, 3:]
    lowest = heights.amin(-1)
    return float(lowest[lowest.abs().argmin()])


def tipping(
    reading: Reading,
    belief: PoseBelief,
    surface_points: Float[Tensor, "S 3"],
    base: Base,
    frictions: Frictions,
    limits: Limits,
) -> tuple[float, float] | None:
    """Height above what the object stands on at which it was pushed, and the probability that this tipped it.

    Over poses and frictions of the belief, in quasi-statics: it tips or rolls where that takes less than sliding.

    Args:
        reading: of the action.
        belief: of upright poses.
        surface_points: of the object.
        base: of the object.
        frictions: of it, by the belief.
        limits: how much is a push.

    Returns:
        metres, and a number in [0, 1]; None where it was not pushed.
    """
    met = reading.in_contact.nonzero()[:, 0]
    if not len(met):
        return None
    places = reading.tool_pose[:, :3, 3]
    way = (places[met[-1]] - places[max(int(met[0]) - 1, 0)])[:2]
    if float(way.norm()) < limits.pushed_m:
        return None
    some = systematic(belief.log_weights, 0.5, _DRAWN)
    poses = belief.world_T_object[some].double()
    rests_at = (poses[:, 2, :3] @ surface_points.to(poses).mT + poses[:, 2, 3:]).amin(-1).median()
    height = float(places[met[0], 2] - rests_at)
    yaw = se3.to_planar(poses)[:, 2]
    here = reading.observation.of_class(Semantics.SURFACE) & (reading.instant == met[-1])
    felt = reading.observation.points[here][:, :2].to(poses)
    touched = rotated(felt.mean(0) - poses[:, :2, 3], -yaw) if len(felt) else None
    tool = frictions.tool[some]
    over = [tips(yaw, way, height, base, touched, friction=floor, tool_friction=tool) for floor in frictions.floor]
    return height, float(torch.stack(over).double().mean())


def gripped(reading: Reading, belief: PoseBelief, body: PushedBody, limits: Limits) -> bool:
    """Whether a tool that pushed touches the object at two sides at the end, by most of the belief.

    A wedge, a second finger or a grasp: contacts are pushed one after the other, and forces between them are unknown.

    Args:
        reading: of the action.
        belief: of upright poses.
        body: the object at the tool's height, and the level tool.
        limits: how much is a push.
    """
    met = reading.in_contact.nonzero()[:, 0]
    places = reading.tool_pose[:, :3, 3]
    if (
        not bool(reading.in_contact[-1])
        or float((places[-1] - places[max(int(met[0]) - 1, 0)]).norm()) < limits.pushed_m
    ):
        return False
    some = systematic(belief.log_weights, 0.5, _ASKED)
    poses = se3.to_planar(belief.world_T_object[some])
    tool = se3.to_planar(reading.tool_pose[-1:]).to(poses).expand(len(poses), 3)
    return 2 * int(held_twice(poses, tool, body).sum()) > _ASKED


def remarks(
    step: int,
    reading: Reading,
    belief: PoseBelief,
    added: Observation,
    model: ObjectModel,
    *,
    moved: tuple[Float[Tensor, "Q"], Float[Tensor, "Q"]] | None,
    upright: bool,
    pads: Float[Tensor, "P 3"] | None = None,
    base: Base | None = None,
    frictions: Frictions | None = None,
    body: PushedBody | None = None,
    before: Collection[str] = (),
    limits: Limits | None = None,
) -> tuple[Remark, ...]:
    """What is odd after an action.

    Args:
        step: number of the action.
        reading: of the action.
        belief: after it.
        added: points that the reading added, in the frame that rides with the object.
        model: the object.
        moved: configurations from which the tool went, and to which it would have gone with nothing in its way; None
            where nobody knows.
        upright: whether the object is expected to stand as it did at first.
        pads: points of the pads' surface, tool frame; None where heights at which they feel are not looked at.
        base: of the object, where it should stand upright; None where pushes that tip it are not looked for.
        frictions: of the object by the belief, for the same.
        body: object and level tool, where the object should stand upright; None where it is not looked for contacts at
            two sides.
        before: names of what was remarked before; readings at odds with the belief make it likelier that a push tips.
        limits: how much is odd.
    """
    limits, found = limits or Limits(), []
    pressed = None if moved is None else held_up(*moved, reading, limits)
    if pressed is not None:
        short, went = (None if metres is None else 1e3 * metres for metres in pressed)
        by = "" if went is None else f", which moved by {went:.0f} mm"
        found.append(("resists", f"the tool stopped {short:.0f} mm before its goal, pressed against the object{by}"))
    poses = belief.world_T_object
    turned, tilt = least_tilt(poses), least_tilt(poses, model.symmetries)
    height = 1e3 * nearest_to_floor(poses, model.surface_points)
    if upright and tilt > limits.tilt_rad:
        found.append(("toppled", f"by its motion the object is {math.degrees(tilt):.0f} degrees off upright"))
    elif upright and turned > limits.tilt_rad:
        said_so = f"by its motion the object turned {math.degrees(turned):.0f} degrees about a level axis"
        found.append(("rolled", f"{said_so}, and looks as it did"))
    if abs(height) > 1e3 * limits.height_m:
        name, where = ("lifted", "above") if height > 0 else ("dropped", "below")
        found.append((name, f"by its motion the object's lowest point is {abs(height):.0f} mm {where} the table"))
    if body is not None and tilt <= limits.tilt_rad and gripped(reading, belief, body, limits):
        found.append(
            ("two contacts", "the tool touches the object at two sides: how it moves then, no push model knows")
        )
    off, deep = (1e3 * metres for metres in unexplained(belief, added, model.sdf, limits.apart_m))
    if deep > 1e3 * limits.apart_m:
        inside = f"the tool went {deep:.0f} mm deep into where the object is believed to be"
        found.append(("not there", f"{inside}, and felt nothing"))
    if off > 1e3 * limits.apart_m:
        found.append(("elsewhere", f"a surface was met {off:.0f} mm from the nearest one that is believed"))
    felt = None if pads is None else felt_heights(reading, poses, pads, model.sdf)
    if felt is not None:
        bottom, top, low, high = (1e3 * metres for metres in felt)
        if max(abs(bottom - low), abs(top - high)) > 1e3 * limits.apart_m:
            heights = f"{bottom:.0f} to {top:.0f} mm above the table, where every pose believed differs (the nearest is"
            found.append(("other height", f"the object was felt {heights} felt at {low:.0f} to {high:.0f} mm)"))
    tipped = None
    # a motion that is measured tells by itself whether it fell
    if base is not None and frictions is not None and reading.object_motion is None and tilt <= limits.tilt_rad:
        tipped = tipping(reading, belief, model.surface_points, base, frictions, limits)
    if tipped is not None:
        odds = limits.odds if _AT_ODDS & {name.split(":")[0] for name in (*before, *dict(found))} else 1.0
        share = tipped[1] * odds / (1.0 + tipped[1] * (odds - 1.0))
        if share > limits.tips:
            where = (
                f"pushed {1e3 * tipped[0]:.0f} mm above what it stands on, the object tips or rolls before it slides"
            )
            found.append(("tips", f"{where} with probability {share:.2f}: nothing measures how it lies now"))
    return tuple(Remark(name, step, sentence) for name, sentence in found)
