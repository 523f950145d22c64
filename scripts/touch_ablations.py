"""What each part of the touch-box task is worth, and what readings tell: runs with one thing changed at a time.

python scripts/touch_ablations.py run --seeds 1000-1029             # all variants, seed by seed; again to go on
python scripts/touch_ablations.py run --variants default 'no noise' --seconds 110
python scripts/touch_ablations.py show
"""

import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import tyro

from rumi.bench.ledger import Ledger
from rumi.commands import cache_folder
from rumi.reproduce.seeds import seeds_of
from rumi.touch.localise import localise
from rumi.touch.make import Robot, make_toucher
from rumi.touch.records import calibration, digest, figures_of, table
from rumi.touch.settings import TouchSettings
from rumi.touch.task import TouchTask

RESULTS = Path(__file__).resolve().parent / "results" / "touch_ablations.jsonl"
_FILTER = TouchSettings().filter
_EVERY = 0.2  # metres of a poke


@dataclass(frozen=True)
class Variant:
    """One thing changed.

    Attributes:
        settings: of the run.
        task: the scene and its readings.
        robot: by name.
    """

    settings: TouchSettings = TouchSettings()  # noqa: RUF009  (frozen)
    task: TouchTask = TouchTask()  # noqa: RUF009
    robot: Robot = "gripper"


def _with(**changes: Any) -> Variant:  # noqa: ANN401
    return Variant(replace(TouchSettings(), **changes))


def _filtered(**changes: Any) -> Variant:  # noqa: ANN401
    return _with(filter=replace(_FILTER, **changes))


def _readings(count: int) -> Variant:
    return Variant(task=TouchTask(readings=count, spacing_m=_EVERY / count))


def _correlated(chance: float, *, weighed: bool) -> Variant:
    own = replace(TouchSettings(), weigh_correlated=weighed)
    return Variant(own, replace(TouchTask(), correlation=chance))


VARIANTS: dict[str, Variant] = {
    "default": Variant(),
    "no noise": _filtered(noise=0.0, noise_tails=0.0),
    "normal noise": _filtered(noise_tails=0.0),
    "100 particles": _with(count=100),
    "2000 particles": _with(count=2000),
    "friction and limit surface known to the middle": _filtered(friction=(0.4, 0.4), lever_m=(0.08, 0.08)),
    "pushes through": _with(stop_early=False),
    "threshold 0.8": _with(threshold=0.8),
    "threshold 0.97": _with(threshold=0.97),
    "straight pokes": _with(poke=replace(TouchSettings().poke, bend=0.0)),
    "80 candidates": _with(poke=replace(TouchSettings().poke, candidates=80)),
    "funnel 0.3": _with(poke=replace(TouchSettings().poke, funnel=0.3)),
    "quasi-static truth": Variant(robot="planar"),
    "quasi-static truth, no noise": replace(_filtered(noise=0.0, noise_tails=0.0), robot="planar"),
    "displacement": _with(push_model="displacement"),
    "particles in MuJoCo": _with(push_model="mujoco", count=300, filter=replace(_FILTER, sweeps=1)),
    "20 readings": _readings(20),
    "8 readings": _readings(8),
    "1 reading": _readings(1),
    "correlated 0.5, taken as independent": _correlated(0.5, weighed=False),
    "correlated 0.5": _correlated(0.5, weighed=True),
    "correlated 0.9, taken as independent": _correlated(0.9, weighed=False),
    "correlated 0.9": _correlated(0.9, weighed=True),
    "sharp readings": Variant(task=TouchTask(rates=(0.9, 0.05))),
}
"""All by name."""


@dataclass(frozen=True)
class Options:
    """What is done.

    Attributes:
        what: run what is missing, or show what there is.
        variants: which; all by default.
        seeds: of the runs; tuning starts from 1000.
        seconds: end after this long; give the command again to go on.
        results: file of the results.
    """

    what: tyro.conf.Positional[Literal["run", "show"]]
    variants: tuple[str, ...] = ()
    seeds: str = "1000-1029"
    seconds: float = float("inf")
    results: Path = RESULTS


def run(options: Options, names: Sequence[str]) -> None:
    """All runs that the file does not hold."""
    begun, ledger = time.monotonic(), Ledger(options.results)
    for seed in seeds_of(options.seeds):
        for name in names:
            if time.monotonic() - begun > options.seconds:
                return
            own = VARIANTS[name]
            asked = {
                "part": "touch-ablation",
                "variant": name,
                "seed": seed,
                "settings": digest(own.task, own.settings, own.robot),
            }

            def work(own: Variant = own, seed: int = seed) -> dict[str, Any]:
                toucher = make_toucher(own.task, own.settings, own.robot, cache_dir=cache_folder())
                return figures_of(localise(toucher, seed=seed))

            if ledger.measure(asked, work):
                sys.stderr.write(f"seed {seed}, {name}\n")


def main() -> None:
    """Run or show."""
    options = tyro.cli(Options, description=__doc__)
    unknown = sorted(set(options.variants) - set(VARIANTS))
    if unknown:
        raise SystemExit(f"There is no variant {unknown[0]!r}; there are {', '.join(VARIANTS)}")
    names = options.variants or tuple(VARIANTS)
    if options.what == "run":
        run(options, names)
    lines = Ledger(options.results).of("touch-ablation")
    seeds = set(seeds_of(options.seeds))
    groups = {
        name: [
            line
            for line in lines
            if line["variant"] == name
            and line["seed"] in seeds
            and line["settings"] == digest(VARIANTS[name].task, VARIANTS[name].settings, VARIANTS[name].robot)
        ]
        for name in names
    }
    sys.stdout.write(table(groups) + "\n")
    for name, own in groups.items():
        if own and options.variants:
            sys.stdout.write(f"\n{name}\n\n{calibration(own)}\n")


if __name__ == "__main__":
    assert asdict(TouchTask())["readings"] == round(_EVERY / TouchTask().spacing_m)
    main()
