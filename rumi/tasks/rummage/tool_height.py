"""Height of a tool above the table: where it meets the object, as low as it may go, or the reason why it meets none."""

from collections.abc import Callable
from dataclasses import replace

from jaxtyping import Float
from torch import Tensor

from rumi.dynamics.outline import slice_of
from rumi.errors import UsageError
from rumi.robot.gripper import GripperShape
from rumi.tasks.rummage.scene_spec import TaskSpec
from sdf.base import SDF

CLEARANCE_M = 0.001
"""Between the tool and the table, at least."""


def lowest_height(shape: GripperShape) -> float:
    """Height of the tool frame at which the gripper all but touches the table, metres."""
    return max(0.5 * shape.palm_m[2], shape.pad_m[2]) + CLEARANCE_M


def check_height(
    spec: TaskSpec,
    bounds: Float[Tensor, "2 3"],
    shape: GripperShape | None = None,
    otherwise: Callable[[float], str] = lambda least: "",
) -> None:
    """Refuse an object that the pads all but pass over.

    A level tool has to meet it with the middle of its pads, which its section is of; one that moves in space, whose
    whole pads count, with the lower quarter at least.

    Args:
        spec: the task.
        bounds: of the object as it stands.
        shape: of the gripper.
        otherwise: advice on how else to put an object down so that it is at least so high, metres.

    Raises:
        UsageError: with what can be done.
    """
    shape = shape or GripperShape()
    least = lowest_height(shape) - spec.spatial * 0.5 * shape.pad_m[2]
    if float(bounds[1, 2] - bounds[0, 2]) > least:
        return
    raise UsageError(
        f"Expected an object more than {1e3 * least:.0f} mm high, got {words(bounds)}, which the tool's pads, "
        f"{2e3 * shape.pad_m[2]:.0f} mm thick, would all but pass over: {otherwise(least)}touch it from above and give "
        "the points to `rumi localize`"
    )


def at_tool_height(
    spec: TaskSpec, sdf: SDF, exact: SDF, asked_m: float | None = None, shape: GripperShape | None = None
) -> TaskSpec:
    """The task with its tool at a height at which it meets the object.

    The task's own height where the object reaches that, else the lowest: an object so low is met nearest to its middle
    there, where it is widest if it is round and topples least. A tool that moves in space may come down as far.

    Args:
        spec: the task.
        sdf: of the object as it stands, tabulated.
        exact: the same, exact.
        asked_m: height that is asked for; None to choose.
        shape: of the gripper.

    Raises:
        UsageError: the object is too low, the tool would scrape the table or moves in space and is given a height, or
            the table of distances has lost what there is at that height.
    """
    shape = shape or GripperShape()
    check_height(spec, exact.bounds, shape)
    lowest, rises = lowest_height(shape), float(exact.bounds[1, 2] - exact.bounds[0, 2])
    if spec.heights_m is not None:
        if asked_m is not None:
            raise UsageError(f"Expected no tool_height for {spec.name}, whose tool moves in space, got {asked_m:g} m")
        return spec if rises >= spec.heights_m[0] else replace(spec, heights_m=(lowest, spec.heights_m[1]))
    if asked_m is not None and not lowest <= asked_m < rises:
        raise UsageError(
            f"Expected tool_height from {lowest:g} m, where the pads all but touch the table, to below {rises:.3g} m, "
            f"the height of the object, got {asked_m:g} m"
        )
    height = asked_m or (spec.height_m if rises > spec.height_m else lowest)
    check_slice(sdf, exact.bounds, height, "another --tool-height")
    return spec if height == spec.height_m else replace(spec, height_m=height)


def check_slice(sdf: SDF, bounds: Float[Tensor, "2 3"], height_m: float, otherwise: str) -> None:
    """Refuse a tool that works where its object has no section.

    Args:
        sdf: of the object as it stands, tabulated.
        bounds: of the object.
        height_m: of the tool above the table.
        otherwise: how to give another height.

    Raises:
        UsageError: the tool is above the object, or the table of distances has lost what there is at that height.
    """
    bottom, top = bounds[:, 2].tolist()
    if height_m >= top - bottom:
        raise UsageError(
            f"Expected an object that reaches up to the middle of the tool, {1e3 * height_m:.0f} mm above the table, "
            f"got {words(bounds)}: give {otherwise}"
        )
    if slice_of(sdf, height_m + bottom) is None:
        spacing = getattr(sdf, "spacing", None)
        table = "the table of distances" if spacing is None else f"a table with a node every {1e3 * spacing:.2g} mm"
        raise UsageError(
            f"Expected the object to have walls {1e3 * height_m:.0f} mm above the table, where the tool is, but they "
            f"are too thin for {table}: give half of the thinnest wall as --spacing, or {otherwise}"
        )


def words(bounds: Float[Tensor, "2 3"]) -> str:
    """Length, width and height in millimetres, to a tenth where they are small."""
    sides = [1e3 * side for side in (bounds[1] - bounds[0]).double().tolist()]
    return " x ".join(f"{side:.0f}" if side >= 9.95 else f"{side:.2g}" for side in sides) + " mm"
