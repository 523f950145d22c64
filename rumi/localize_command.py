"""The command `rumi localize`: where an object is, from points that were touched on it."""

import json
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from rumi.cli import DONE
from rumi.errors import UsageError


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
    if not (options.scale > 0 and options.points_scale > 0):
        raise UsageError(f"Expected --scale and --points-scale above 0, got {options.scale}, {options.points_scale}")
    if options.radius is not None and not all(math.isfinite(x) and x > 0 for x in options.radius):
        raise UsageError(
            f"Expected --radius above 0 along each axis, got {options.radius}: half of the edges of the box that the "
            "mesh's origin is in"
        )
    if options.noise is not None and not options.noise > 0:
        raise UsageError(f"Expected --noise above 0 m, got {options.noise}")
    if options.starts < 1:
        raise UsageError(f"Expected --starts of 1 or more, got {options.starts}")
    from rumi.touch_files import read_contacts

    contacts = read_contacts(options.contacts, scale=options.points_scale)
    if options.normals and contacts.normals is None:
        raise UsageError(
            f"Expected normals in {options.contacts}, got points alone: columns 4 to 6 of a CSV, nx, ny, nz of a PLY, "
            "the array `normals` of an NPZ; or leave out --normals"
        )
    import torch

    from rumi.registration.localize import LocalizeSettings, PositionPrior
    from rumi.registration.localize import localize as find
    from rumi.registration.touch_surface import TouchSurface
    from rumi.seeding import generator
    from sdf.mesh import MeshError, load_mesh
    from sdf.symmetry import Symmetries

    began, threads = time.perf_counter(), torch.get_num_threads()
    prior = None
    if options.center is not None and options.radius is not None:
        prior = PositionPrior(torch.tensor(options.center).double(), torch.tensor(options.radius).double())
    try:
        # tensors are small, and threads that wait for each other lose much where the cores are shared
        torch.set_num_threads(1)
        mesh = load_mesh(options.mesh, scale=options.scale)
        surface = TouchSurface.of(mesh, None if options.symmetries else Symmetries.none())
        loaded = time.perf_counter()
        found = find(
            surface,
            contacts.points,
            normals=contacts.normals if options.normals else None,
            prior=prior,
            clip=options.clip,
            settings=LocalizeSettings(starts=options.starts, noise_m=options.noise),
            generator=generator(options.seed),
        )
    except MeshError as error:
        raise UsageError(str(error)) from None
    except ValueError as error:
        raise UsageError(f"{options.contacts}: {error}") from None
    finally:
        torch.set_num_threads(threads)
    seconds = {"mesh": loaded - began, "localize": time.perf_counter() - loaded}
    if options.json:
        about = {"mesh": str(options.mesh), "contacts": str(options.contacts), "seconds": seconds}
        sys.stdout.write(json.dumps({**about, **found.to_dict()}) + "\n")
    else:
        sys.stdout.write(f"{options.contacts} on {options.mesh}\n")
        sys.stdout.write("".join(f"  {line}\n" for line in found.text().splitlines()))
        sys.stdout.write(f"  seconds: {seconds['mesh']:.2f} for the mesh, {seconds['localize']:.2f} to localize\n")
    return DONE
