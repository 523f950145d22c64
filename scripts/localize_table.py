"""Localise the recorded touches of RUMI_DATA from many seeds and print the table; seeds that are done are kept.

    python scripts/localize_table.py run --seeds 0-99 --threads 1    # one line a seed in scripts/results/localize.jsonl
    python scripts/localize_table.py show                            # Markdown

Reached is what is within 0.3 mm of the least mean distance known. Tune on seeds of 1000 and more.
"""

import hashlib
import os
import statistics
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from tqdm import tqdm

from rumi.cli import script
from rumi.commands.contact_files import read_contacts
from rumi.metrics.intervals import wilson
from rumi.registration.from_contacts import localize
from rumi.registration.touch_surface import TouchSurface
from rumi.runs.jsonlines import append_line, read_lines
from rumi.seeding import generator
from scripts.reproduce.code import bare
from scripts.reproduce.seeds import seeds_of

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "scripts" / "results" / "localize.jsonl"
SETS = {
    "Cylinder_exp": ("cylinder.off", 5.44),
    "Lego_exp": ("legoBox.off", 6.73),
    "Box100_sim": ("box.off", 0.0001),
    "Tetra30_sim": ("tetrahedron.off", 0.002),
    "Cleaner_sim": ("cleaner.off", 0.88),
}
"""Mesh, and the least mean distance in millimetres that the data's README knows."""

NEAR_MM = 0.3
CODE = sorted(
    path
    for pattern in (
        "rumi/registration/touch_*.py",
        "rumi/registration/localize*.py",
        "rumi/registration/descent.py",
        "sdf/touched*.py",
        "sdf/tr*.py",
        "sdf/*symmetry.py",
    )
    for path in ROOT.glob(pattern)
)


@dataclass(frozen=True)
class Run:
    """Do the seeds that are missing.

    Attributes:
        seeds: "0-99", or "3,5".
        sets: which sets.
        threads: of torch and of the kernels.
        seconds: stop before the next seed after so long.
        out: where the lines go.
    """

    seeds: str = "0-99"
    sets: tuple[str, ...] = tuple(SETS)
    threads: int = 1
    seconds: float = float("inf")
    out: Path = RESULTS


@dataclass(frozen=True)
class Show:
    """Print the table of the code as it is.

    Attributes:
        out: where the lines are.
        seeds: only these.
    """

    out: Path = RESULTS
    seeds: str | None = None


def run(options: Run) -> None:
    """Localise, and keep a line a seed."""
    torch.set_num_threads(options.threads)
    folder, code, end = data(), fingerprint(), time.monotonic() + options.seconds
    done = {(x["set"], x["seed"], x["threads"]) for x, _ in read_lines(options.out) if x["code"] == code}
    for name in options.sets:
        missing = [seed for seed in seeds_of(options.seeds) if (name, seed, options.threads) not in done]
        if not missing:
            continue
        began = time.perf_counter()
        surface = TouchSurface.of(folder / SETS[name][0])
        loading = time.perf_counter() - began
        points = read_contacts(folder / f"meas{name}.off").points
        localize(surface, points, generator=generator(1))  # compiles
        for seed in tqdm(missing, desc=name, disable=None):
            if time.monotonic() > end:
                return
            began, worked = time.perf_counter(), time.process_time()
            found = localize(surface, points, generator=generator(seed))
            seconds, cpu = time.perf_counter() - began, time.process_time() - worked
            line = {
                "set": name,
                "seed": seed,
                "code": code,
                "threads": options.threads,
                "best_mm": 1e3 * float(found.distance_m[found.best]),
                "modes_mm": [round(1e3 * float(x), 3) for x in found.distance_m],
                "weights": [round(float(x), 6) for x in found.weights],
                "spread_mm": round(1e3 * float(found.spread_m[found.best]), 3),
                "family": found.family,
                "alike": len(found.symmetries),
                "seconds": round(seconds, 4),
                "cpu": round(cpu, 4),
                "loading": round(loading, 2),
            }
            append_line(options.out, line)


def show(options: Show) -> None:
    """Markdown."""
    code = fingerprint()
    wanted = None if options.seeds is None else set(seeds_of(options.seeds))
    rows = [x for x, _ in read_lines(options.out) if x["code"] == code and (wanted is None or x["seed"] in wanted)]
    heads = ("set", "floor", "least, median and largest (mm)", "within 0.3 mm", "modes", "seconds, median and worst")
    print("| " + " | ".join([*heads, "CPU seconds", "threads"]) + " |")
    print("|---" * (len(heads) + 2) + "|")
    for name, (_, floor) in SETS.items():
        for threads in sorted({x["threads"] for x in rows}):
            own = [x for x in rows if x["set"] == name and x["threads"] == threads]
            if not own:
                continue
            best, seconds = [x["best_mm"] for x in own], [x["seconds"] for x in own]
            near = sum(x <= floor + NEAR_MM for x in best)
            low, high = wilson(near, len(own))
            modes = statistics.median(len(x["modes_mm"]) for x in own)
            print(
                f"| {name} | {floor:g} | {min(best):.4g}, {statistics.median(best):.4g}, {max(best):.4g} | "
                f"{near}/{len(own)} [{low:.2f}, {high:.2f}] | {modes:g} | "
                f"{statistics.median(seconds):.2f}, {max(seconds):.2f} | "
                f"{statistics.median(x['cpu'] for x in own):.2f} | {threads} |"
            )


def data() -> Path:
    """The folder of the recorded touches."""
    root = os.environ.get("RUMI_DATA")
    if not root or not (Path(root) / "icub_touch").is_dir():
        sys.exit("Expected RUMI_DATA to name the folder of recorded data, with icub_touch in it")
    return Path(root) / "icub_touch"


def fingerprint() -> str:
    """Of the code that the figures depend on, without its comments."""
    digest = hashlib.sha256()
    for path in CODE:
        digest.update(bare(path.read_text(encoding="utf-8")).encode())
    return digest.hexdigest()[:12]


def main() -> None:
    """Run or show."""
    options = tyro.extras.subcommand_cli_from_dict({"run": Run, "show": Show}, description=__doc__)
    {Run: run, Show: show}[type(options)](options)


if __name__ == "__main__":
    script(main)
