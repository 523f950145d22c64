"""Compare contact models and resampling rules on one push of a box (touch-only paper, Table II).

python scripts/touch_filters.py                                # 1000 runs of 100 particles
python scripts/touch_filters.py --exact-count 3000             # and what a next to exact filter gets
python scripts/touch_filters.py --place-m 0.015 --turn-rad 0.15 --json table2.json
"""

import json
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import tyro

from rumi.bench.touch_filters import PushSetup, Scores, Variant, compare, wide


@dataclass(frozen=True)
class Options:
    """What is compared.

    Attributes:
        runs: how many pushes.
        count: particles.
        exact_count: particles of a filter that is next to exact, for comparison; 0 for none.
        variants: filters, in the order in which neighbours are compared.
        place_m: standard deviation of the box's place.
        turn_rad: of its yaw.
        readings: contact signals of a push.
        rates: true and false positive rate that the filters count on.
        exact: signals are the truth; otherwise they are drawn at the rates.
        seed: of all randomness.
        json: file for all figures.
    """

    runs: int = 1000
    count: int = 100
    exact_count: int = 0
    variants: tuple[Variant, ...] = ("binary", "smooth", "smooth+replay")
    place_m: float = 0.02
    turn_rad: float = 0.2
    readings: int = 60
    rates: tuple[float, float] = (0.99, 0.01)
    exact: bool = True
    seed: int = 0
    json: Path | None = None


NAMES = {
    "top_m": "top 10, m",
    "top_rad": "top 10, rad",
    "mean_m": "mean, m",
    "mean_rad": "mean, rad",
    "active": "active",
}
PAPER = (
    "The paper has, for binary, smooth, smooth and resampled: 0.023, 0.019, 0.018 (position); 0.208, 0.185, 0.164 "
    "(yaw); 0.038, 0.077, 0.511 (active)."
)


def table(found: dict[str, Any]) -> str:
    """Markdown: a filter a line, then the differences, each with half of its 95 % interval."""
    lines = ["| filter | " + " | ".join(NAMES.values()) + " | resampled | s |", "|" + "---|" * (len(NAMES) + 3)]
    for name, column in found["variants"].items():
        cells = [f"{column[key][0]:.4f} ± {column[key][1]:.4f}" for key in NAMES]
        lines.append(f"| {name} | {' | '.join(cells)} | {column['resampled']:.1f} | {column['seconds']:.1f} |")
    for name, column in found["differences"].items():
        cells = [f"{column[key][0]:+.4f} ± {column[key][1]:.4f}" for key in NAMES]
        lines.append(f"| {name} | {' | '.join(cells)} | | |")
    return "\n".join(lines)


def main() -> None:
    """Print the table."""
    options = tyro.cli(Options, description=__doc__)
    setup = wide(PushSetup(), options.place_m, options.turn_rad)
    setup = replace(setup, readings=options.readings, rates=options.rates, exact=options.exact)
    begun = time.perf_counter()
    found = compare(
        setup,
        runs=options.runs,
        count=options.count,
        exact_count=options.exact_count,
        variants=options.variants,
        seed=options.seed,
    )
    seconds = time.perf_counter() - begun
    sys.stdout.write(f"{options.runs} runs of {options.count} particles, seed {options.seed}: {seconds:.1f} s\n\n")
    sys.stdout.write(f"{table(found)}\n\n{PAPER}\n")
    if options.json is not None:
        assert set(NAMES) < set(Scores._fields)
        options.json.write_text(json.dumps(found | {"seconds": seconds}, indent=1))


if __name__ == "__main__":
    main()
