"""The command `rumi localize`: where an object is, from points that were touched on it."""

import json
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from rumi.errors import UsageError
from rumi.exit_codes import DONE

_MUCH_BETTER = 5.0
"""Nats from which on normals that are turned round are taken to be the right ones: a likelihood of 150 to 1."""


@dataclass(frozen=True)
class LocalizeOptions:
    """Where an object is, in all six degrees of freedom, from points that were touched on it.

    Attributes:
        mesh: of the object: .obj, .stl, .ply, .off or .glb.
        contacts: the points, one a line: .csv, .txt, .xyz, .off, .ply, .npz (`points`, `normals`) or .npy.
        center: where the mesh's origin is expected; it seeds some of the starts and rules nothing out.
        radius: half of the box about it, along each axis, metres.
        clip: leave out poses whose origin is outside of that box.
        normals: use the normals of the file (columns 4 to 6, or nx, ny, nz), outward and unit.
        scale: metres that one unit of the mesh is; 0.001 for millimetres.
        points_scale: metres that one unit of the contacts is.
        noise: metres that touches are off; by default what the best pose leaves, 1 mm at least.
        outlier: share of touches that may be bad, such as beside the object; 0 for none.
        starts: poses to start from.
        seed: of the starts.
        symmetries: put poses together that look the same; this takes seconds, once for the mesh.
        json: print JSON.
    """

    mesh: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MESH")]
    contacts: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="CONTACTS")]
    center: tuple[float, float, float] | None = None
    radius: tuple[float, float, float] | None = None
    clip: bool = False
    normals: bool = False
    scale: float = 1.0
    points_scale: float = 1.0
    noise: float | None = None
    outlier: float = 0.05
    starts: int = 800
    seed: int = 0
    symmetries: bool = True
    json: bool = False


def localize(arguments: Sequence[str]) -> int:
    """`rumi localize`: all plausible poses; exit code 2 for input that cannot be."""
    options = tyro.cli(LocalizeOptions, prog="rumi localize", args=arguments)
    if (options.center is None) != (options.radius is None):
        raise UsageError("Expected --center and --radius together, got one of them: a prior needs both")
    if options.clip and options.center is None:
        raise UsageError("Expected --center and --radius with --clip, got none: there is nothing to clip by")
    if not all(math.isfinite(x) and x > 0 for x in (options.scale, options.points_scale)):
        raise UsageError(
            f"Expected --scale and --points-scale above 0 and finite, got {options.scale}, {options.points_scale}"
        )
    if options.center is not None and not all(map(math.isfinite, options.center)):
        raise UsageError(f"Expected --center of three finite numbers, in metres, got {options.center}")
    if options.radius is not None and not all(math.isfinite(x) and x > 0 for x in options.radius):
        raise UsageError(
            f"Expected --radius above 0 along each axis, got {options.radius}: half of the edges of the box that the "
            "mesh's origin is in"
        )
    if not 0 <= options.outlier < 1:
        raise UsageError(f"Expected --outlier, a share of the touches, of 0 or more and below 1, got {options.outlier}")
    if options.starts < 1:
        raise UsageError(f"Expected --starts of 1 or more, got {options.starts}")
    from rumi.registration.contact_terms import NOISE_M
    from rumi.seeding import check_seed

    check_seed(options.seed, "--seed")
    if options.noise is not None and not NOISE_M[0] <= options.noise <= NOISE_M[1]:
        raise UsageError(
            f"Expected --noise above 0 m, from {NOISE_M[0]:g} to {NOISE_M[1]:g}, got {options.noise}: the distance "
            "that touches are off by, or leave it out"
        )
    from rumi.commands.contact_files import read_contacts

    contacts = read_contacts(options.contacts, scale=options.points_scale)
    if options.normals and contacts.normals is None:
        raise UsageError(
            f"Expected normals in {options.contacts}, got points alone: columns 4 to 6 of a CSV, nx, ny, nz of a PLY, "
            "the array `normals` of an NPZ; or leave out --normals"
        )
    import torch

    from rumi.registration.from_contacts import LocalizeSettings, PositionPrior, gain_of_turned_normals
    from rumi.registration.from_contacts import localize as find
    from rumi.registration.touch_surface import TouchSurface
    from rumi.seeding import generator
    from sdf.mesh.mesh import MeshError, check_size, load_mesh
    from sdf.symmetry import Symmetries

    began = time.perf_counter()
    prior = None
    if options.center is not None and options.radius is not None:
        prior = PositionPrior(*(torch.tensor(part, dtype=torch.float64) for part in (options.center, options.radius)))
    try:
        mesh = load_mesh(options.mesh, scale=options.scale)
        check_size(mesh, options.scale)
        surface = TouchSurface.of(mesh, None if options.symmetries else Symmetries.none())
        loaded = time.perf_counter()
        normals = contacts.normals if options.normals else None
        settings = LocalizeSettings(starts=options.starts, noise_m=options.noise, outlier=options.outlier)
        found = find(
            surface,
            contacts.points,
            normals=normals,
            prior=prior,
            clip=options.clip,
            settings=settings,
            generator=generator(options.seed),
        )
        nats = None
        if normals is not None:
            nats = gain_of_turned_normals(surface, contacts.points, normals, found, settings=settings)
    except MeshError as error:
        raise UsageError(str(error)) from None
    except ValueError as error:
        raise UsageError(f"{options.contacts}: {error}") from None
    seconds = {"mesh": loaded - began, "localize": time.perf_counter() - loaded}
    inward = nats is not None and nats > _MUCH_BETTER
    if inward:
        sys.stderr.write(
            f"rumi: the normals of {options.contacts} seem to point into the object: turned round they fit better, by "
            f"{nats:.0f} nats; the poses below are wrong then. Give outward normals, or leave out --normals\n"
        )
    if options.json:
        about: dict[str, Any] = {"mesh": str(options.mesh), "contacts": str(options.contacts), "seconds": seconds}
        if nats is not None:
            about |= {"normals_inward": inward, "turned_normals_gain_nats": nats}
        sys.stdout.write(json.dumps({**about, **found.to_dict()}, allow_nan=False) + "\n")
    else:
        sys.stdout.write(f"{options.contacts} on {options.mesh}\n")
        sys.stdout.write("".join(f"  {line}\n" for line in found.text().splitlines()))
        sys.stdout.write(f"  seconds: {seconds['mesh']:.2f} for the mesh, {seconds['localize']:.2f} to localize\n")
    return DONE
