"""Run the mug tasks with meshes in the mug's place and print the table; runs that are done are kept.

    python -m scripts.mesh_table run --jobs 2      # resumes; one line a run in scripts/results/meshes.jsonl
    python -m scripts.mesh_table show              # Markdown

The objects: the tasks' own mug as a formula, to compare with; the same mug meshed, cup and handle overlapping; the
drill of RUMI_DATA, where that is set; and each mesh damaged, without 1 % of its faces and with a hole of 12 mm. `--mesh
FILE` adds others. Tune on seeds of 1000 and more; seeds 0-9 are for the record.
"""

import os
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import tyro

from rumi.cache import cache_folder
from rumi.cli import script
from rumi.tasks.rummage.scenes import large_handled_mug
from scripts.bench import drill
from scripts.bench.mug_mesh import damaged, mug_mesh, write_obj
from scripts.reproduce.cells import flags, middle, numbers, rate, table
from scripts.reproduce.command import seeds_of
from scripts.reproduce.executors import on_this_machine
from scripts.reproduce.jobs import Job
from scripts.reproduce.records import Record, Records
from scripts.reproduce.worker import Errand, failures
from sdf.mesh.mesh import TriangleMesh, load_mesh
from sdf.primitives import Mug

OUT = Path(__file__).resolve().parent / "results" / "meshes.jsonl"
TASKS = ("mug-0", "mug-1", "mug-2")


@dataclass(frozen=True)
class Run:
    """Do the runs that are missing.

    Attributes:
        objects: which objects; all by default.
        mesh: files of further objects.
        tasks: which tasks.
        seeds: "0-4", or "3,5".
        column: method/preset.
        jobs: processes at once, each with one thread.
        most: runs at most, to be resumed by another call.
        out: file of results, one JSON line a run.
        set: settings on top of the preset, such as object.collision=hull (for tuning).
        cache: folder for the meshes and what is worked out of them.
    """

    objects: tuple[str, ...] = ()
    mesh: tuple[Path, ...] = ()
    tasks: tuple[str, ...] = TASKS
    seeds: str = "0-4"
    column: str = "rumi/default"
    jobs: int = 2
    most: int | None = None
    out: Path = OUT
    set: tuple[str, ...] = ()
    cache: Path = field(default_factory=cache_folder)


@dataclass(frozen=True)
class Show:
    """Print the table of the newest code in a file of results."""

    results: Path = OUT


def meshes(folder: Path) -> dict[str, Path | None]:
    """The objects by name, written to files; None for the tasks' own."""
    made: dict[str, Callable[[], TriangleMesh]] = {"mug mesh": lambda: mug_mesh(_mug())}
    if not drill.missing():
        made["drill"] = lambda: load_mesh(Path(os.environ["RUMI_DATA"]) / drill.MESH)
    found: dict[str, Path | None] = {"mug": None}
    folder.mkdir(parents=True, exist_ok=True)
    for name, make in made.items():
        for hurt in (False, True):
            label = name + (", damaged" if hurt else "")
            path = folder / f"{label.replace(', ', '-').replace(' ', '-')}.obj"
            if not path.is_file():
                mesh = make()
                aside = path.with_suffix(".part")
                write_obj(damaged(mesh) if hurt else mesh, aside)
                aside.replace(path)
            found[label] = path
    return found


def _mug() -> Mug:
    shape = large_handled_mug().exact
    assert isinstance(shape, Mug)
    return shape


def run(options: Run) -> int:
    """Do what is missing, and append each run as it ends; how many are still missing."""
    objects: dict[str, Path | None] = meshes(options.cache / "meshes") | {path.stem: path for path in options.mesh}
    unknown = set(options.objects) - set(objects)
    if unknown:
        raise SystemExit(f"There is no object {sorted(unknown)[0]!r}; there are {', '.join(objects)}")
    method, _, preset = options.column.partition("/")
    jobs = []
    for seed in seeds_of(options.seeds):
        for name in options.objects or objects:
            own = objects[name]
            mesh = () if own is None else (f"object.mesh={own.resolve()}",)
            jobs += [Job("run", task, method, preset, seed, (*mesh, *options.set)) for task in options.tasks]
    records = Records(options.out)
    missing = [job for job in jobs if job.id not in records.by_id]
    now = missing[: options.most]
    if not now:
        return len(missing)
    errand = Errand.of(now, options.out, options.cache)
    on_this_machine(errand, min(options.jobs, len(now)))
    for message in failures(errand).values():
        print(message, file=sys.stderr)
    records.refresh()
    return len(missing) - len(records.done(now))


def show(options: Show) -> None:
    """One row an object."""
    if not options.results.is_file():
        raise SystemExit(f"There are no runs in {options.results}: do some with `run` first")
    objects: dict[str, list[Record]] = {}
    for record in Records(options.results).newest():
        objects.setdefault(_object(record), []).append(record)
    heads = ("object", "right", "stopped: right", "steps", "nll at the first view", "nll at the end")
    heads += ("position error, mm", "rotation error, deg", "s a step")
    rows = []
    for name, runs in objects.items():
        stopped = [record for record in runs if record.figures["stopped_by"] == "sure"]
        seconds = sum(record.timings["wall_s"] for record in runs)
        rows.append(
            [
                name,
                rate(flags(runs, "right")),
                f"{len(stopped)}: {sum(flags(stopped, 'right'))}",
                middle(numbers(runs, "steps"), 0),
                middle([float(record.curves["nll"][0] or 0.0) for record in runs]),
                middle(numbers(runs, "final_nll")),
                middle(numbers(runs, "position_error_mm"), 2),
                middle(numbers(runs, "rotation_error_deg"), 2),
                f"{seconds / max(1, sum(record.figures['steps'] for record in runs)):.2f}",
            ]
        )
    print(table(heads, rows), end="")


def _object(record: Record) -> str:
    """What was to be found, by the name of its file, and the settings on top."""
    mesh = [value.partition("=")[2] for value in record.overrides if value.startswith("object.mesh=")]
    name = Path(mesh[0]).stem if mesh else "mug"
    return " ".join([name, *(value for value in record.overrides if not value.startswith("object.mesh="))])


def main() -> None:
    """Run or show; exit code 1 if a run failed."""
    options = tyro.extras.subcommand_cli_from_dict({"run": Run, "show": Show}, description=__doc__)
    if isinstance(options, Show):
        show(options)
    elif run(options):
        sys.exit(1)


if __name__ == "__main__":
    script(main)
