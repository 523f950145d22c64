"""Run the mug tasks with meshes in the mug's place and print the table; runs that are done are kept.

    python scripts/mesh_table.py run --jobs 2      # resumes; one line a run in scripts/results/meshes.jsonl
    python scripts/mesh_table.py show              # Markdown

The objects: the tasks' own mug as a formula, to compare with; the same mug meshed, cup and handle overlapping; the
drill of RUMI_DATA, where that is set; and each mesh damaged, without 1 % of its faces and with a hole of 12 mm. `--mesh
FILE` adds others. Tune on seeds of 1000 and more; seeds 0-9 are for the record.
"""

import os
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import tyro
from mug_table import RESULTS, TASKS, carry_out, lines, median, seeds_of, settings_of

from rumi.bench import drill
from rumi.bench.mug_mesh import damaged, mug_mesh, write_obj
from rumi.metrics.intervals import wilson
from rumi.sim.tasks import large_handled_mug
from sdf.mesh import TriangleMesh, load_mesh
from sdf.primitives import Mug

OUT = RESULTS.with_name("meshes.jsonl")


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
    cache: Path = Path(os.environ.get("RUMI_CACHE", Path.home() / ".cache" / "rumi"))


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
    """Do what is missing, and append each run as it ends."""
    os.environ["RUMI_CACHE"] = str(options.cache)
    objects: dict[str, Path | None] = meshes(options.cache / "meshes") | {path.stem: path for path in options.mesh}
    unknown = set(options.objects) - set(objects)
    if unknown:
        raise SystemExit(f"There is no object {sorted(unknown)[0]!r}; there are {', '.join(objects)}")
    wanted: list[tuple[str, Any, dict[str, Any]]] = []
    for seed in seeds_of(options.seeds):
        for name in options.objects or objects:
            for task in options.tasks:
                settings = settings_of(options.column, task, seed, options.set)
                path = objects[name]
                own = settings.object if path is None else replace(settings.object, mesh=str(path))
                about = {"experiment": "meshes", "object": name, "changes": list(options.set)}
                wanted.append((options.column, replace(settings, object=own), about))
    return carry_out(wanted, options.out, options.jobs, options.most)


def show(options: Show) -> None:
    """One row an object."""
    runs = [r for r in lines(options.results)]
    if not runs:
        raise SystemExit(f"There are no runs in {options.results}: do some with `run` first")
    newest = {
        (r["object"] + "".join(f" {change}" for change in r["changes"]), r["task"], r["seed"]): r
        for r in runs
        if r["code"] == runs[-1]["code"]
    }
    heads = ("object", "right", "stopped: right", "steps", "nll at the first view", "nll at the end")
    heads += ("position error, mm", "rotation error, deg", "s a step")
    print("| " + " | ".join(heads) + " |\n" + "|---" * len(heads) + "|")
    for name in dict.fromkeys(key[0] for key in newest):
        rows = [r for key, r in newest.items() if key[0] == name]
        stopped = [r for r in rows if r["stopped_by"] == "converged"]
        right = sum(r["right"] for r in rows)
        low, high = wilson(right, len(rows))
        cells = [
            name,
            f"{right}/{len(rows)} [{low:.2f}, {high:.2f}]",
            f"{len(stopped)}: {sum(r['right'] for r in stopped)}",
            median([r["steps"] for r in rows], 0),
            median([r["nll"][0] for r in rows]),
            median([r["final_nll"] for r in rows]),
            median([r["position_error_mm"] for r in rows], 2),
            median([r["rotation_error_deg"] for r in rows], 2),
            f"{sum(r['wall_s'] for r in rows) / max(1, sum(r['steps'] for r in rows)):.2f}",
        ]
        print("| " + " | ".join(cells) + " |")


if __name__ == "__main__":
    options = tyro.extras.subcommand_cli_from_dict({"run": Run, "show": Show}, description=__doc__)
    if isinstance(options, Show):
        show(options)
    else:
        sys.exit(1 if run(options) else 0)
