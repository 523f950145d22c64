"""Distances: tables and formulas far away, on cell faces, at thin walls; one object at many poses; discrepancies."""

import math
from collections.abc import Callable
from functools import cache, partial

import torch
from torch import Tensor

from sdf import backend, compiled, se3
from sdf.base import SDF
from sdf.grid_sdf import GridSDF
from sdf.mesh.build import from_mesh
from sdf.mesh.mesh import TriangleMesh
from sdf.mesh.mesh_sdf import MeshSDF
from sdf.posed import posed_distance, posed_query
from sdf.primitives import Box, Capsule, Cup, Cylinder, Mug, Sphere, TorusArc
from sensors.discrepancy import Discrepancy
from sensors.observation import Observation
from tests.stress.draws import choice, directions, integer, log_uniform, mixed, poses, uniform
from tests.stress.measures import of_numbers
from tests.stress.on_device import here
from tests.stress.sweep import Inputs, Sweep, register

COUNT = 2000
SPACINGS = (0.0005, 0.001, 0.002, 0.005, 0.02)
VERSIONS = ("torch", "numba") if compiled.available() else ("torch",)
F64 = torch.float64


def table(spacing: float, dtype: torch.dtype, half: bool = False) -> GridSDF:
    """A mug, or at the least spacing a box of its own size, as a table; the values those of float32 or of half."""
    return here(_table(spacing, dtype, half))


@cache
def _table(spacing: float, dtype: torch.dtype, half: bool) -> GridSDF:
    shape: SDF = Box((0.012, 0.008, 0.01)) if spacing < 0.001 else Mug()
    made = GridSDF.from_sdf(shape, spacing)
    values = made.values.half() if half else made.values.float()
    stored = values if half else values.to(dtype)
    x, y, z = made.origin
    return GridSDF(
        stored, (x, y, z), spacing, made.bounds.to(dtype), outer=made.outer, outer_spacing=made.outer_spacing
    )


def _draw_points(generator: torch.Generator) -> Inputs:
    """Points near the object, on the lattice's nodes and faces, about the ends of the table, and up to 1000 km away."""
    spacing = choice(generator, SPACINGS)
    near = uniform(generator, COUNT, 3, low=-0.15, high=0.2)
    lattice = table(spacing, F64)
    start = torch.tensor(lattice.origin, dtype=F64)
    nodes = start + spacing * torch.round((near - start) / spacing)
    faces = torch.where(uniform(generator, COUNT, 3) < 0.5, nodes, near)
    ends = start - lattice.outer * lattice.outer_spacing * torch.randint(2, (COUNT, 3), generator=generator)
    far = directions(generator, COUNT) * log_uniform(generator, COUNT, 1, low=0.1, high=1e6)
    return {"points": mixed(generator, [near, nodes, faces, ends, far]).float(), "spacing": spacing}


def _looked_up(dtype: torch.dtype, half: bool, inputs: Inputs) -> Tensor:
    return table(inputs["spacing"], dtype, half).distance(inputs["points"].to(dtype))


def _distance_error(got: Tensor, wanted: Tensor, inputs: Inputs) -> Tensor:
    """Metres, and beyond a metre of them."""
    return (got.double() - wanted).abs() / wanted.abs().clamp_min(1.0)


def _off(inputs: Inputs) -> Tensor:
    return inputs["points"].double().norm(dim=-1)


def _draw_broken(generator: torch.Generator) -> Inputs:
    points = uniform(generator, COUNT, 3, low=-0.2, high=0.2).float()
    bad = torch.tensor([math.nan, math.inf, -math.inf, 3e38, -3e38])[torch.randint(5, (COUNT, 3), generator=generator)]
    hit = torch.randint(2, (COUNT, 3), generator=generator).bool()
    hit[:, 0] |= ~hit.any(-1)
    return {"points": torch.where(hit, bad, points), "spacing": choice(generator, SPACINGS), "other": _any(generator)}


def _any(generator: torch.Generator) -> str:
    return sorted(_PRIMITIVES)[integer(generator, 0, len(_PRIMITIVES) - 1)]


def _not_far_outside(inputs: Inputs) -> Tensor:
    """1 for each point that is not finite for which some distance or gradient is not, or which is not far outside."""
    wrong = torch.zeros(len(inputs["points"]), dtype=torch.bool)
    for shape in (table(inputs["spacing"], torch.float32), _primitive(inputs["other"])):
        query = shape(inputs["points"])
        fine = torch.isfinite(query.distance) & torch.isfinite(query.gradient).all(-1) & (query.distance > 1e5)
        wrong |= ~fine
    return wrong.double()


def _nothing(inputs: Inputs) -> Tensor:
    return torch.zeros(len(inputs["points"]), dtype=F64)


# closed forms

_PRIMITIVES: dict[str, Callable[[], SDF]] = {
    "sphere": lambda: Sphere(0.04),
    "box": lambda: Box((0.03, 0.08, 0.105)),
    "sheet": lambda: Box((0.0002, 0.1, 0.1)),
    "cylinder": lambda: Cylinder(0.03, 0.1),
    "capsule": lambda: Capsule((0.0, 0.0, 0.0), (0.0, 0.0, 1e-9), 0.02),
    "torus": lambda: TorusArc((0.04, 0.0, 0.05), 0.03, 0.006, 1.5),
    "cup": lambda: Cup(0.04, 0.1, 0.0005, 0.0005),
    "mug": Mug,
}


def _primitive(name: str) -> SDF:
    return here(_made(name))


@cache
def _made(name: str) -> SDF:
    return _PRIMITIVES[name]()


def _draw_shape(generator: torch.Generator) -> Inputs:
    name = _any(generator)
    near = uniform(generator, COUNT, 3, low=-0.15, high=0.15)
    distance, gradient = _primitive(name)(near)
    surface = near - distance[:, None] * gradient
    axis = near * torch.tensor((0.0, 0.0, 1.0), dtype=F64)
    far = directions(generator, COUNT) * log_uniform(generator, COUNT, 1, low=0.1, high=1e5)
    return {"points": mixed(generator, [near, surface, axis, far]).float(), "shape": name}


def _closed(dtype: torch.dtype, inputs: Inputs) -> Tensor:
    return _primitive(inputs["shape"]).distance(inputs["points"].to(dtype))


# a thin-walled mesh against its formula


@cache
def _sheet() -> tuple[MeshSDF, GridSDF, Box]:
    half = (0.0005, 0.04, 0.03)
    corners = torch.cartesian_prod(*[torch.tensor([-x, x], dtype=F64) for x in half])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = torch.tensor([(q[0], q[k], q[k + 1]) for q in quads for k in (1, 2)])
    mesh = MeshSDF(TriangleMesh(corners, faces))
    return mesh, from_mesh(mesh, spacing=0.0005), Box(half)


def _draw_thin(generator: torch.Generator) -> Inputs:
    inside = uniform(generator, 200, 3, low=-1.0, high=1.0) * torch.tensor((0.0005, 0.04, 0.03), dtype=F64)
    about = uniform(generator, 200, 3, low=-0.05, high=0.05)
    far = directions(generator, 200) * log_uniform(generator, 200, 1, low=0.1, high=1e3)
    return {"points": mixed(generator, [inside, about, far])}


# one object at many poses

_POSED = 0.002


def _draw_posed(metres: float, generator: torch.Generator) -> Inputs:
    """Poses and points in a world of some metres about its origin; a part of them upright at one height."""
    where = uniform(generator, 1, 3, low=-1.0, high=1.0) * (metres - 0.2)
    at = poses(generator, 24, 0.1)
    if integer(generator, 0, 3) == 0:
        at = se3.from_planar(uniform(generator, 24, 3, low=-0.1, high=0.1), 0.0)
    at[:, :3, 3] += where
    points = where + uniform(generator, 200, 3, low=-0.25, high=0.25)
    if integer(generator, 0, 1) == 0:
        points[:, 2] = where[0, 2] + 0.03
    return {"poses": se3.reproject(at).float(), "points": points.float(), "semantics": _semantics(generator)}


def _semantics(generator: torch.Generator) -> Tensor:
    return torch.randint(3, (200,), generator=generator)


def _posed_in(version: str, dtype: torch.dtype, inputs: Inputs) -> Tensor:
    with backend.force(version):
        return posed_distance(table(_POSED, dtype), inputs["poses"].to(dtype), inputs["points"].to(dtype))


def _world(inputs: Inputs) -> Tensor:
    return inputs["points"].double().norm(dim=-1).amax()[None]


def _gradient_in(version: str, dtype: torch.dtype, inputs: Inputs) -> Tensor:
    with backend.force(version):
        return posed_query(table(_POSED, dtype), inputs["poses"].to(dtype), inputs["points"].to(dtype)).gradient


def _on_faces(inputs: Inputs) -> Tensor:
    """(poses, points), whether a point is as good as on a face of a cell, where either side's gradient is right."""
    lattice = table(_POSED, F64)
    own = se3.apply(se3.inverse(inputs["poses"].double()), inputs["points"].double())
    fine = (own - torch.tensor(lattice.origin, dtype=F64)) / lattice.spacing
    wide = (own - torch.tensor(lattice.origin, dtype=F64)) / lattice.outer_spacing
    near = torch.minimum((fine - fine.round()).abs(), (wide - wide.round()).abs()).amin(-1)
    return near < 1e-3


def _gradient_error(got: Tensor, wanted: Tensor, inputs: Inputs) -> Tensor:
    near = _on_faces(inputs)
    return torch.where(near[..., None], 0.0, (got.double() - wanted).abs()).amax((-2, -1))


def _observation(inputs: Inputs, dtype: torch.dtype) -> Observation:
    made = Observation.of(inputs["points"].to(dtype), 0)
    return Observation(made.points, inputs["semantics"], made.attached, made.valid)


def _discrepancy_in(version: str, dtype: torch.dtype, inputs: Inputs) -> Tensor:
    module = Discrepancy(table(_POSED, dtype), 0.12, free_scale=80.0, tolerance=0.001)
    with backend.force(version):
        return module(inputs["poses"].to(dtype), _observation(inputs, dtype))


def _enter() -> None:
    metres, off = "m, beyond 1 m of them", "metres from the origin"
    for half in (False, True):
        register(Sweep(
            f"distances-table-{'half' if half else 'float32'}", _draw_points,
            partial(_looked_up, torch.float32, half), partial(_looked_up, F64, half), _distance_error, 1e-5, metres,
            _off, off,
        ))  # fmt: skip
    for sweep in (
        Sweep(
            "distances-closed-forms", _draw_shape, partial(_closed, torch.float32), partial(_closed, F64),
            _distance_error, 1e-5, metres, _off, off,
        ),
        Sweep(
            "distances-not-finite", _draw_broken, _not_far_outside, _nothing, of_numbers, 0.0, "wrong", _nothing,
            "nothing",
        ),
        Sweep(
            "distances-mesh-of-1-mm", _draw_thin, lambda i: _sheet()[0].distance(i["points"]),
            lambda i: _sheet()[2].distance(i["points"]), _distance_error, 1e-9, metres, _off, off,
        ),
        Sweep(
            "distances-mesh-table-of-1-mm", _draw_thin, lambda i: _sheet()[1].distance(i["points"].float()),
            lambda i: _sheet()[1].to(F64).distance(i["points"].float().double()), _distance_error, 1e-5, metres,
            _off, off,
        ),
    ):  # fmt: skip
        register(sweep)
    for version in VERSIONS:
        for about, world in (("", 1.0), ("-20m", 20.0)):
            limit = 1e-5
            register(Sweep(
                f"distances-posed{about}-{version}", partial(_draw_posed, world),
                partial(_posed_in, version, torch.float32), partial(_posed_in, "torch", F64), of_numbers, limit,
                "m", _world, off,
            ))  # fmt: skip
        register(Sweep(
            f"distances-posed-gradient-{version}", partial(_draw_posed, 1.0),
            partial(_gradient_in, version, torch.float32), partial(_gradient_in, "torch", F64), _gradient_error,
            1e-3, "1", _world, off,
        ))  # fmt: skip
        register(Sweep(
            f"distances-discrepancy-{version}", partial(_draw_posed, 1.0),
            partial(_discrepancy_in, version, torch.float32), partial(_discrepancy_in, "torch", F64),
            lambda got, wanted, i: (got.double() - wanted).abs() / wanted.amax(), 1e-5, "of the greatest",
            _world, off,
        ))  # fmt: skip


_enter()
