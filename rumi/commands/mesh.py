"""The command `rumi mesh`: what a mesh is like, and what is wrong with it."""

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from rumi.errors import UsageError
from rumi.exit_codes import BAD_INPUT, DONE

_MANY = 200_000
"""Faces from which on it takes long enough to say so."""


@dataclass(frozen=True)
class MeshOptions:
    """Look a mesh over before it is used: size, openings, overlaps, walls, symmetries, and the table that it would get.

    Attributes:
        file: .obj, .stl, .ply, .off or .glb.
        scale: metres that one unit of the file is; 0.001 for millimetres.
        spacing: metres between the table's nodes; by default from the thinnest wall.
        json: print JSON.
    """

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    scale: float = 1.0
    spacing: float | None = None
    json: bool = False


def mesh(arguments: Sequence[str]) -> int:
    """`rumi mesh`: exit code 2 if the mesh cannot be used."""
    options = tyro.cli(MeshOptions, prog="rumi mesh", args=arguments)
    if not options.scale > 0 or (options.spacing is not None and not options.spacing > 0):
        raise UsageError(f"Expected --scale and --spacing above 0, got {options.scale} and {options.spacing}")
    from sdf.mesh.find_symmetry import mesh_symmetries
    from sdf.mesh.mesh import MeshError, load_mesh
    from sdf.mesh.mesh_report import report
    from sdf.mesh.mesh_sdf import MeshSDF

    try:
        loaded = load_mesh(options.file, scale=options.scale)
        if len(loaded.faces) > _MANY:
            sys.stderr.write(f"rumi: looking at {len(loaded.faces)} faces: some {len(loaded.faces) // _MANY * 4} s\n")
            sys.stderr.flush()
        found = report(loaded, spacing=options.spacing, scale=options.scale)
        symmetry = mesh_symmetries(MeshSDF(loaded)).words() if found.usable else None
    except MeshError as error:
        raise UsageError(str(error)) from None
    if options.json:
        sys.stdout.write(json.dumps({"file": str(options.file), **found.to_dict(), "symmetry": symmetry}) + "\n")
    else:
        lines = found.text().splitlines() + ([] if symmetry is None else [f"symmetry   {symmetry}"])
        sys.stdout.write(f"{options.file}\n" + "".join(f"  {line}\n" for line in lines))
    return DONE if found.usable else BAD_INPUT
