"""Run time against error: beliefs, fields and whole runs over the settings that their cost depends on."""

import logging
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

from scripts.bench.boxes import measure_boxes
from scripts.bench.estimates import Bench, measure_estimates, time_estimates
from scripts.bench.runs import measure_runs
from scripts.bench.situations import situation
from scripts.store import Store

_logger = logging.getLogger(__name__)
SITUATIONS = (("mug-1", "view"), ("mug-1", "handle"))
BELIEF_SEEDS = (1000, 1001)
CHAINS_AT = TIMED_AT = ("mug-1", "handle")
_QUICK, _ENOUGH = 0.05, 0.01


def run(*, quick: bool, out: Path, jsonl: Path | None = None) -> None:
    """Measure what is missing and draw the figures.

    Args:
        quick: few settings of one situation, for a look in a few minutes.
        out: folder of the figures and of the references, which take minutes to work out and are kept there.
        jsonl: file of the results; by default `pareto.jsonl` in the folder.
    """
    store = Store(jsonl or out / "pareto.jsonl")
    for done in chain(measure_times(store, out, quick=quick), measure(store, out, quick=quick)):
        if done:
            _logger.info("%d measurements", len(store.lines))
    from scripts.bench.pareto_figures import draw

    draw(store, out)


def measure(store: Store, folder: Path, *, quick: bool) -> Iterator[bool]:
    """Do what is missing, one measurement at a time; gives whether each was missing."""
    many = 1 if quick else None
    for place in SITUATIONS[:many]:
        here = Bench(situation(*place), folder, _QUICK if quick else _ENOUGH)
        yield from measure_estimates(store, here, BELIEF_SEEDS[:many], quick=quick)
    yield from measure_boxes(store, situation(*CHAINS_AT), folder, quick=quick)
    yield from measure_runs(store, quick=quick)


def measure_times(store: Store, folder: Path, *, quick: bool) -> Iterator[bool]:
    """Take the times that are missing, of one situation: a minute or three, with nothing else on the machine."""
    here = situation(*(SITUATIONS[0] if quick else TIMED_AT))
    yield from time_estimates(store, Bench(here, folder, _QUICK if quick else _ENOUGH), BELIEF_SEEDS[0], quick=quick)
