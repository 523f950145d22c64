"""Compare contact models and resampling rules on one push of a box (touch-only paper, Table II).

python -m scripts.touch_filters                                # 1000 runs of 100 particles
python -m scripts.touch_filters --exact-count 3000             # and what a next to exact filter gets
python -m scripts.touch_filters --place-m 0.015 --turn-rad 0.15 --json table2.json
"""

import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import tyro

from rumi.cli import script
from scripts.bench.touch_filters import PAPER, PushSetup, Variant, compare, markdown, wide


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
        seed: of all randomness.
        json: file for all figures.
    """

    runs: int = 1000
    count: int = 100
    exact_count: int = 0
    variants: tuple[Variant, ...] = ("binary", "smooth", "smooth+newcomers", "smooth+replay")
    place_m: float = 0.02
    turn_rad: float = 0.2
    readings: int = 60
    seed: int = 0
    json: Path | None = None


def main() -> None:
    """Print the table."""
    options = tyro.cli(Options, description=__doc__)
    setup = wide(PushSetup(readings=options.readings), options.place_m, options.turn_rad)
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
    sys.stdout.write(f"{markdown(found)}\n\n{PAPER}\n")
    if options.json is not None:
        options.json.write_text(json.dumps(found | {"seconds": seconds}, indent=1))


if __name__ == "__main__":
    script(main)
