"""The command `rumi export`: what a run found out, in the formats of other programs."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from rumi.errors import UsageError
from rumi.exit_codes import DONE
from rumi.runs.progress import say

if TYPE_CHECKING:
    from rumi.runs.folder import Run
    from sdf.mesh.mesh import TriangleMesh


@dataclass(frozen=True)
class ExportOptions:
    """Write what a run found out about the object's pose for other programs.

    Attributes:
        run: folder of the run; or a log, which is replayed for it, by its own settings.
        to: format: json, npz, mjcf, urdf or mcap.
        out: file to write; by default in RUN/export, of a log LOG.h5 in LOG/export.
        step: the last step to take; by default the run's.
        mesh: file of the object's mesh, for mjcf and urdf, where the run's is not there any more.
        scale: metres that one unit of that file is.
    """

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    to: Annotated[str, tyro.conf.arg(metavar="FORMAT")]
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    step: int | None = None
    mesh: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    scale: float = 1.0


def export(arguments: Sequence[str]) -> int:
    """`rumi export`: 0 where the files are written, 2 for bad input."""
    options = tyro.cli(ExportOptions, prog="rumi export", args=arguments)
    from rumi.commands.replayed import run_folder
    from rumi.runs.export import FORMATS, estimates_of
    from rumi.runs.folder import load_run, make_folder
    from rumi.tasks.registry import entry_of

    kind = FORMATS[options.to]
    if options.mesh is not None and not kind.meshed:
        raise UsageError(f"Expected no --mesh with {options.to}, which holds none")
    with run_folder(options.run) as folder:
        run = load_run(folder)
        found = estimates_of(run, entry_of(run).pose, options.step)
        if kind.meshed:
            found = replace(found, mesh=object_mesh(run, options.mesh, options.scale))
    beside = options.run.with_suffix("") if options.run.is_file() else options.run
    path = options.out or beside / "export" / kind.file
    if path.exists() and path.suffix != Path(kind.file).suffix:
        raise UsageError(
            f"Expected --out to be new or a {Path(kind.file).suffix} file, got {path}, which would be lost"
        )
    if options.run.is_dir() and path.resolve().parent == options.run.resolve():
        raise UsageError(f"Expected --out beside the run's own files, got {path}: {options.run / 'export'} is free")
    if options.mesh is not None and options.mesh.resolve() in (path.resolve(), path.with_suffix(".obj").resolve()):
        raise UsageError(f"Expected --out to leave the mesh {options.mesh} as it is: give it another name")
    make_folder(path.parent)
    for written in kind.write(found, path):
        sys.stdout.write(f"{written}\n")
    return DONE


def object_mesh(run: "Run", given: Path | None = None, scale: float = 1.0) -> "TriangleMesh":
    """The mesh of a run's object in its own frame: the file that is given or that the run names, or of the task's own.

    Args:
        run: that was recorded.
        given: file in place of the run's.
        scale: metres that one unit of it is.

    Raises:
        UsageError: the file cannot be used, or the object's shape is in no folder and no file is given.
    """
    import hashlib
    import json

    import torch

    from rumi.tasks.registry import TASKS
    from sdf.mesh.mesh import MeshError, load_mesh
    from sdf.mesh.surface_nets import mesh_of

    about = run.folder / "object.json"
    source = json.loads(about.read_text(encoding="utf-8")).get("mesh") if about.is_file() else None
    asked = run.settings.get("object") or {}
    if given is None and source is not None and asked.get("mesh"):
        given, scale = Path(asked["mesh"]), source["scale"]
    if given is not None:
        try:
            mesh = load_mesh(given, scale=scale)
        except MeshError as error:
            raise UsageError(f"{error}; --mesh FILE says where the object's mesh is") from None
        if source is None:
            return mesh
        if hashlib.sha256(given.read_bytes()).hexdigest() != source["sha256"]:
            say(f"{given} is not the file that the run was made with ({source['file']})")
        return mesh.moved(torch.tensor(source["object_T_mesh"], dtype=torch.float64))
    if run.task in TASKS:
        entry = TASKS[run.task]
        if (block := getattr(entry, "mesh", None)) is not None:
            made: TriangleMesh = block(entry.from_dict(run.settings))
            return made
        spec = getattr(entry, "spec", None)
        agent = entry.agent(entry.from_dict(run.settings)) if spec is None else None
        model = getattr(agent, "model", None) if spec is None else spec.object_factory()
        if model is not None:
            return mesh_of(model.exact)
    raise UsageError(
        f"Expected the object's mesh, which no file of {run.folder} holds: give --mesh FILE, in the object's own "
        "frame, and --scale where it is not in metres"
    )
