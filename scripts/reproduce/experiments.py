"""Which runs each of the paper's tables and figures needs."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import product

from rumi.planning.registry import POLICIES
from rumi.runs.json_settings import setting_names
from rumi.tasks.rummage.scenes import SCENES
from rumi.tasks.rummage.settings import PRESETS, Settings
from scripts.reproduce import paper
from scripts.reproduce.jobs import TOY_METHODS, Job

DISPLACEMENT = "planner.displaced_information"
"""The setting that says whether information is counted where the object will be (Eq 29) or where it is (Eq 28)."""

PARTICLES: dict[int, dict[str, int]] = {
    30: {"initialise.particles": 30},
    100: {},
    1000: {"initialise.particles": 1000, "initialise.starts": 20000, "initialise.polished": 10000},
}
"""Settings of the belief by its number of particles: of the usual 300 polished poses 86 are plausible on mug-0, and a
thousand particles of those would be twelve copies of each."""
HORIZONS = (5, 9, 15, 25, 39)
"""Each with every other step a knot, as the paper's 8 of 15."""

PARTICLES_BEFORE, HORIZON_BEFORE = 100, 15
"""What the presets have: those runs are the ones of the tables."""

_MUGS = ("mug-0", "mug-1", "mug-2")


@dataclass(frozen=True)
class Selection:
    """What a command asks for; empty means what each experiment takes by itself.

    Attributes:
        tasks, methods, presets: by name.
        seeds: of the runs.
        overrides: settings of all runs on top of the presets, such as "planner.rollouts=3".
    """

    tasks: tuple[str, ...] = ()
    methods: tuple[str, ...] = ()
    presets: tuple[str, ...] = ()
    seeds: tuple[int, ...] = tuple(range(10))
    overrides: tuple[str, ...] = ()

    def runs(
        self,
        tasks: Iterable[str],
        methods: Iterable[str],
        presets: Iterable[str] = ("default", "paper"),
        variants: Sequence[tuple[str, ...]] = ((),),
    ) -> list[Job]:
        """Runs of all combinations, seed by seed; the arguments stand in for what is not selected."""
        chosen = (self.tasks or tuple(tasks), self.methods or tuple(methods), self.presets or tuple(presets))
        return [
            Job("run", task, method, preset, seed, (*variant, *self.overrides))
            for seed in self.seeds
            for task, method, preset in product(*chosen)
            for variant in variants
        ]


def _all_runs(selection: Selection) -> list[Job]:
    return selection.runs(SCENES, [method for method in POLICIES if method in paper.METHODS])


def _timed_runs(selection: Selection) -> list[Job]:
    tasks, methods = (name for name in ("mug-0", "box-0") if name in SCENES), ("rumi", "gpvr")
    return selection.runs(tasks, [name for name in methods if name in POLICIES])


def _particles(selection: Selection) -> list[Job]:
    variants = [tuple(f"{name}={value}" for name, value in own.items()) for own in PARTICLES.values()]
    return selection.runs(_MUGS, ("rumi",), ("default",), variants)


def _horizons(selection: Selection) -> list[Job]:
    variants = [
        () if h == HORIZON_BEFORE else (f"planner.mppi.horizon={h}", f"planner.mppi.knots={(h + 1) // 2}")
        for h in HORIZONS
    ]
    return selection.runs(_MUGS, ("rumi",), ("default",), variants)


def _displacement(selection: Selection) -> list[Job]:
    return selection.runs(_MUGS, ("rumi",), ("default",), [(), (f"{DISPLACEMENT}=false",)])


def _toys(selection: Selection) -> list[Job]:
    return [Job("toy", "toy", method, "", seed) for seed, method in product(selection.seeds, TOY_METHODS)]


PEG_TIMES = (1, 2, 3, 5, 7, 10, 15, 20, 30, 40)
"""t_max of the curve of total time, seconds."""

PEG_REAL = "evaluation_s=null"
"""Seconds that a candidate takes to weigh: what it takes on this machine, and all of choosing with it."""

PEG_MACHINES = ("", "evaluation_s=0.003", PEG_REAL)
"""Seconds that a candidate takes to weigh: 1, as of a slow machine, what it took on one of today's, this one's."""

SHARP = ("point_m=0.001", "normal_deg=2")
"""Noise of a better sensor than the paper's 5 mm and 6 degrees."""


def _pegs(variants: Sequence[tuple[str, ...]]) -> Callable[[Selection], list[Job]]:
    def jobs(selection: Selection) -> list[Job]:
        found = []
        for seed, variant in product(selection.seeds, variants):
            overrides = (*(part for part in variant if part), *selection.overrides)
            kind = "peg-real" if PEG_REAL in overrides else "peg"
            found.append(Job(kind, "peg", "allocation", "", seed, overrides))
        return found

    return jobs


def _none(selection: Selection) -> list[Job]:
    return []


EXPERIMENTS: dict[str, Callable[[Selection], list[Job]]] = {
    "table5": _all_runs,
    "table6": _all_runs,
    "table2": _all_runs,
    "table7": _timed_runs,
    "fig16": _all_runs,
    "fig13": _all_runs,
    "fig8": _toys,
    "fig5": _particles,
    "fig15": _none,
    **dict.fromkeys(("fig2", "fig4", "fig6", "fig7", "fig14"), _none),
    "horizon": _horizons,
    "displacement": _displacement,
    "allocation-table1": _pegs([(f"t_max_s={t}", "stop=contacts") for t in (10, 20)]),
    "allocation-accuracy": _pegs(
        [("t_max_s=10", *noise, stop) for noise in ((), SHARP) for stop in ("", "stop=contacts")]
    ),
    "allocation-time": _pegs([(f"t_max_s={t}", machine) for machine in PEG_MACHINES for t in PEG_TIMES]),
}
"""The work of each experiment, by its name on the command line; several share runs."""


def missing(name: str) -> str:
    """Why an experiment cannot be done here, or nothing."""
    if name == "displacement" and DISPLACEMENT not in setting_names(Settings):
        return f"there is no setting {DISPLACEMENT}"
    return ""


def work_of(names: Iterable[str], selection: Selection) -> list[Job]:
    """The work of some experiments, each piece once."""
    return list(dict.fromkeys(job for name in names for job in EXPERIMENTS[name](selection)))


def valid_tasks() -> tuple[str, ...]:
    """Names of all tasks."""
    return tuple(SCENES)


def valid_presets() -> tuple[str, ...]:
    """Names of all presets."""
    return tuple(PRESETS)
