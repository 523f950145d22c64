"""The object of a task: the built-in one, or the user's own mesh, put upright and on the task's start."""

import functools
import hashlib
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import torch
import tyro
from annotated_types import Interval
from jaxtyping import Float
from torch import Tensor

from rumi.errors import UsageError
from rumi.registry import Table
from rumi.runs.plain import plain
from sdf.bounds import Checked, Finite, Positive

if TYPE_CHECKING:
    from rumi.tasks.rummage.scene_spec import TaskSpec
    from sdf.mesh.mesh_sdf import MeshSDF
    from sdf.object_model import ObjectModel
    from sdf.symmetry import Symmetries

OBJECTS: "Table[Callable[[], ObjectModel]]" = Table("object", "rumi.objects")
"""Objects by name; each makes its model."""

OBJECTS.add("mug", "rumi.tasks.rummage.scenes:large_handled_mug")
OBJECTS.add("box", "sdf.object_model:box_model")
OBJECTS.add("drill", "sdf.drill:drill_model")

_LIKELY = 0.02  # probability of a pose at rest that is worth naming
_ROOM = 0.5  # of the workspace's shorter side: what is wider can hardly be gone round

Pushable = Annotated[float, Interval(ge=1e-4, le=1e3)]
"""Mass of what a hand can push on a table, kg: beyond it the simulator's numbers no longer hold."""


@dataclass(frozen=True)
class ObjectSettings(Checked, refusal=UsageError):
    """What is to be found, where that is not the task's own object.

    Attributes:
        mesh: file of the object's mesh (.obj, .stl, .ply, .off, .glb); None for the task's own object.
        scale: metres that one unit of the file is; 0.001 for millimetres.
        mass_kg: of the object; None for the task's.
        friction: sliding friction of everything; None for the task's.
        upright: "auto" to keep the mesh's z up where it stands so, and else to take the pose that it most likely comes
            to rest in; or roll, pitch and yaw in degrees, by which it is turned about x, y and z in this order.
        symmetry: "auto" to find out what turns leave it as it is; "none"; or in words such as z (any turn about z), z4
            or x2,y2, in the mesh's frame.
        spacing_m: of the table of distances; None for half of the thinnest wall.
        collision: how it collides: by its convex "pieces", its "hull", or "auto": pieces where coacd is installed.
    """

    mesh: Annotated[str | None, tyro.conf.arg(metavar="FILE")] = None
    scale: Positive = 1.0
    mass_kg: Annotated[Pushable | None, tyro.conf.arg(name="mass", metavar="KG")] = None
    friction: Positive | None = None
    upright: Literal["auto"] | tuple[Finite, Finite, Finite] = "auto"
    symmetry: str = "auto"
    spacing_m: Annotated[Positive | None, tyro.conf.arg(name="spacing", metavar="M")] = None
    collision: Literal["auto", "pieces", "hull"] = "auto"

    def __post_init__(self) -> None:
        """Refuse what no object has, and what is said of a mesh that is not given."""
        super().__post_init__()
        if self.mesh is None:
            plain_object = ObjectSettings.__dataclass_fields__
            for name in ("scale", "upright", "symmetry", "spacing_m", "collision"):
                if getattr(self, name) != plain_object[name].default:
                    raise UsageError(f"Expected a mesh with {name.removesuffix('_m')}: give --mesh FILE")


def with_object(
    spec: "TaskSpec", settings: ObjectSettings, *, cache_dir: Path | None = None
) -> "tuple[TaskSpec, ObjectModel]":
    """A task with the object that is asked for, and the object's model.

    Args:
        spec: the task.
        settings: of the object.
        cache_dir: folder that keeps tables of distances; None keeps nothing.

    Raises:
        UsageError: the mesh cannot be used, or does not suit the task.
    """
    physics = replace(
        spec.physics,
        mass_kg=spec.physics.mass_kg if settings.mass_kg is None else settings.mass_kg,
        friction=spec.physics.friction if settings.friction is None else settings.friction,
        collision=settings.collision,
    )
    draw = spec.draw
    if draw is not None:  # what is asked for is not drawn
        mass, friction = settings.mass_kg, settings.friction
        draw = replace(
            draw,
            mass_kg=draw.mass_kg if mass is None else (mass, mass),
            friction=draw.friction if friction is None else (friction, friction),
        )
    spec = replace(spec, physics=physics, draw=draw)
    if settings.mesh is None:
        return spec, spec.object_factory()
    fits = functools.partial(_check_fits, spec)
    model = own_model(settings, fits=fits, cache_dir=cache_dir)
    return replace(spec, object_factory=lambda: model), model


def own_model(
    settings: ObjectSettings,
    *,
    fits: "Callable[[MeshSDF, Tensor], None] | None" = None,
    cache_dir: Path | None = None,
) -> "ObjectModel":
    """The model of a mesh, in a frame in which it stands upright.

    The frame is the mesh's own, turned by no more than it takes to stand; its origin stays where it is unless it lies
    beside the object.

    Args:
        settings: of the object; its mesh must be given.
        fits: looks at the upright object and object_T_mesh before what takes time, and raises if it does not suit it.
        cache_dir: folder that keeps tables of distances; None keeps nothing.

    Raises:
        UsageError: the mesh cannot be used.
    """
    from sdf.mesh.mesh import MeshError, check_size, load_mesh
    from sdf.mesh.mesh_sdf import MeshSDF
    from sdf.object_model import MeshSource, mesh_model

    if settings.mesh is None:
        raise UsageError("Expected a mesh: give --mesh FILE")
    path = Path(settings.mesh)
    try:
        exact = MeshSDF(load_mesh(path, scale=settings.scale))
        object_T_mesh, how = _standing(exact, settings.upright)
        exact = exact.moved(object_T_mesh)
        if settings.spacing_m is None:
            check_size(exact.mesh, settings.scale)
        if fits is not None:
            fits(exact, object_T_mesh)
        model = mesh_model(
            exact,
            name=path.stem,
            spacing=settings.spacing_m,
            symmetries=_declared(settings.symmetry, exact, object_T_mesh),
            cache_dir=cache_dir,
        )
    except MeshError as error:
        raise UsageError(str(error)) from error
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    source = MeshSource(path.name, digest, len(exact.mesh.faces), settings.scale, object_T_mesh, how)
    return replace(model, source=source)


def record(model: "ObjectModel") -> dict[str, Any]:
    """What a run's folder says of its object: plain values."""
    low, high = model.exact.bounds.tolist()
    return {
        "name": model.name,
        "mesh": None if model.source is None else plain(model.source),
        "size_m": [b - a for a, b in zip(low, high, strict=True)],
        "height_m": 0.0 - low[2],
        "symmetry": model.symmetries.words(),
        "spacing_m": getattr(model.sdf, "spacing", None),
    }


def _standing(exact: "MeshSDF", upright: Literal["auto"] | tuple[Finite, Finite, Finite]) -> tuple[Tensor, str]:
    """object_T_mesh (4, 4), float64, and how it came about."""
    from sdf import se3
    from sdf.mesh.rest import OWN_UP_RAD, center_of_mass, resting_poses
    from sdf.mesh.rest import upright as most_likely

    if upright == "auto":
        pose = most_likely(resting_poses(exact.solid, center_of_mass(exact.solid)))
        turn = pose.rest_R_mesh
        tilt = math.degrees(math.acos(max(-1.0, min(1.0, float(turn[2, 2])))))
        own = tilt <= math.degrees(OWN_UP_RAD)
        how = f"its own z, turned by {tilt:.1f} degrees" if own else "most likely pose at rest"
        how += f" (probability {pose.probability:.2f})"
    else:
        turn, how = _roll_pitch_yaw(upright), "given"
    at = se3.make(turn, torch.zeros(3, dtype=torch.float64))
    low, high = exact.mesh.moved(at).bounds
    beside = (low > 0) | (high < 0)
    if bool(beside[:2].any()):
        at[:2, 3] = -0.5 * (low + high)[:2]
    if bool(beside[2]):
        at[2, 3] = -0.5 * float(low[2] + high[2])
    return at, how


def _roll_pitch_yaw(degrees: tuple[float, float, float]) -> Float[Tensor, "3 3"]:
    from sdf import so3

    roll, pitch, yaw = (
        so3.exp(math.radians(angle) * torch.eye(3, dtype=torch.float64)[axis]) for axis, angle in enumerate(degrees)
    )
    return yaw @ pitch @ roll


def _declared(text: str, exact: "MeshSDF", object_T_mesh: Tensor) -> "Symmetries | None":
    from sdf.mesh.rest import center_of_mass
    from sdf.symmetry import Symmetries

    if text == "auto":
        return None
    center = center_of_mass(exact.solid)
    turn = object_T_mesh[:3, :3]
    try:
        own = Symmetries.parse(text).to(torch.float64)
    except ValueError as error:
        raise UsageError(str(error)) from None
    axis = None if own.axis is None else turn @ own.axis
    return replace(own, rotations=turn @ own.rotations @ turn.mT, center=center, axis=axis)


def _check_fits(spec: "TaskSpec", exact: "MeshSDF", object_T_mesh: Float[Tensor, "4 4"]) -> None:
    """The object is neither larger than the workspace allows nor lower than the tool reaches down."""
    from rumi.tasks.rummage.tool_height import check_height, words

    bounds, room = exact.bounds, _ROOM * min(b - a for a, b in zip(*spec.bounds, strict=True))
    if float((bounds[1] - bounds[0])[:2].max()) > room:
        raise UsageError(
            f"Expected an object at most {1e3 * room:.0f} mm wide, half of the workspace of {spec.name}, so that "
            f"the tool gets round it, got {words(bounds)}: if that is its size, touch it by other means and give the "
            "points to `rumi localize`; if not, say how many metres a unit of the file is (--scale)"
        )
    check_height(spec, bounds, otherwise=lambda least: _stand(exact, object_T_mesh, least))


def _stand(exact: "MeshSDF", object_T_mesh: Float[Tensor, "4 4"], least: float) -> str:
    """Advice to stand an object on another side, by which it is higher than this; none where it would tip over."""
    from sdf.mesh.rest import center_of_mass, resting_poses

    for pose in resting_poses(exact.solid, center_of_mass(exact.solid)):
        along = exact.solid.vertices @ pose.rest_R_mesh[2].to(exact.solid.vertices)
        if pose.probability >= _LIKELY and float(along.max() - along.min()) > least:
            turn = pose.rest_R_mesh @ object_T_mesh[:3, :3].to(pose.rest_R_mesh)
            roll, yaw = torch.atan2(turn[2, 1], turn[2, 2]), torch.atan2(turn[1, 0], turn[0, 0])
            angles = torch.stack((roll, -turn[2, 0].clamp(-1.0, 1.0).asin(), yaw)).rad2deg()
            return f"stand it on another side (--upright {' '.join(f'{a + 0.0:.4g}' for a in angles.tolist())}), or "
    return ""
