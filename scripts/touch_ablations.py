"""What each part of the touch-box task is worth, and what readings tell: runs with one thing changed at a time.

python scripts/touch_ablations.py run --seeds 1000-1029             # all variants, seed by seed; again to go on
python scripts/touch_ablations.py run --variants default 'no noise' --seconds 110
python scripts/touch_ablations.py run --seeds 1000-1009 --slow      # particles in MuJoCo: a minute a run
python scripts/touch_ablations.py show
"""

import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from rumi import loop
from rumi.agent import Parts
from rumi.cache import cache_folder
from rumi.cli import script
from rumi.tasks.touch_box.agent import Toucher
from rumi.tasks.touch_box.build import Robot, build_touch_box
from rumi.tasks.touch_box.gripper_robot import GripperRobot
from rumi.tasks.touch_box.mujoco_scene import GripperPhysics
from rumi.tasks.touch_box.report import calibration, digest, table
from rumi.tasks.touch_box.robot import TouchBox
from rumi.tasks.touch_box.scene import TouchTask
from rumi.tasks.touch_box.settings import TouchSettings
from scripts.bench.ledger import Ledger
from scripts.reproduce.code import code_hash
from scripts.reproduce.seeds import seeds_of

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
        truth: physics of the gripper that pokes, where they are others; the table of grasps stays as it is.
        slow: takes a minute a run; left out unless it is asked for.
    """

    settings: TouchSettings = TouchSettings()  # noqa: RUF009  (frozen)
    task: TouchTask = TouchTask()  # noqa: RUF009
    robot: Robot = "gripper"
    truth: GripperPhysics | None = None
    slow: bool = False

    @property
    def digest(self) -> str:
        """A name of all that decides a run but its seed and the code."""
        name = self.robot if self.truth is None else f"{self.robot} {self.truth}"
        return digest(self.task, self.settings, name)

    def parts(self) -> Parts[TouchBox, Toucher]:
        """What a run needs."""
        parts = build_touch_box(self.task, self.settings, self.robot, cache_dir=cache_folder())
        if self.truth is None:
            return parts
        robot = GripperRobot(self.task, self.truth)
        agent = Toucher(self.task, self.settings, robot, parts.agent.table, parts.agent.carrier)
        return Parts(TouchBox(self.task, robot), agent)


def _with(**changes: Any) -> Variant:  # noqa: ANN401
    return Variant(replace(TouchSettings(), **changes))


def _filtered(**changes: Any) -> Variant:  # noqa: ANN401
    return _with(filter=replace(_FILTER, **changes))


def _readings(count: int) -> Variant:
    return Variant(task=TouchTask(readings=count, spacing_m=_EVERY / count))


def _correlated(chance: float, *, weighed: bool) -> Variant:
    own = replace(TouchSettings(), weigh_correlated=weighed)
    return Variant(own, replace(TouchTask(), correlation=chance))


def _limit_surface(low: float, high: float) -> Variant:
    """A prior of c, in multiples of that of even pressure."""
    even = TouchTask().even_lever_m
    return _filtered(lever_m=(low * even, high * even))


def _in_engine(**changes: Any) -> Variant:  # noqa: ANN401
    """Fewer particles and candidates, of the engine or to compare it with."""
    poke = replace(TouchSettings().poke, candidates=10, particles=60)
    few = replace(_FILTER, sweeps=1, **changes)
    return Variant(replace(TouchSettings(), push_model="mujoco", count=300, poke=poke, filter=few), slow=True)


def _sharp(**changes: Any) -> Variant:  # noqa: ANN401
    return Variant(replace(TouchSettings(), **changes), TouchTask(rates=(0.9, 0.05)))


_ENGINE = _in_engine()
VARIANTS: dict[str, Variant] = {
    "default": Variant(),
    "no noise": _filtered(noise=0.0, noise_tails=0.0),
    "normal noise": _filtered(noise_tails=0.0),
    "noise of 4 %": _filtered(noise=0.04),
    "noise of 16 %": _filtered(noise=0.16),
    "heavier tails, 0.3": _filtered(noise_tails=0.3),
    "no replay: importance resampling": _filtered(resampling="importance"),
    "no replay: newcomers near the robot": _filtered(resampling="newcomers"),
    "binary likelihood": _with(decay=1e6),
    "binary likelihood up to 0.2 mm": _with(decay=None),
    "friction and limit surface not learned: the middles": _filtered(friction=(0.4, 0.4), lever_m=(0.082, 0.082)),
    "limit surface 1.4 to 1.6": _limit_surface(1.4, 1.6),
    "limit surface 1.2 to 1.9": _limit_surface(1.2, 1.9),
    "pushes through": _with(stop_early=False),
    "soft contact in the truth": Variant(truth=GripperPhysics(contact_s=0.02)),
    "threshold 0.8": _with(threshold=0.8),
    "threshold 0.9": _with(threshold=0.9),
    "threshold 0.97": _with(threshold=0.97),
    "100 particles": _with(count=100),
    "300 particles": _with(count=300),
    "2000 particles": _with(count=2000),
    "straight pokes": _with(poke=replace(TouchSettings().poke, bend=0.0)),
    "80 candidates": _with(poke=replace(TouchSettings().poke, candidates=80)),
    "funnel 0.3": _with(poke=replace(TouchSettings().poke, funnel=0.3)),
    "quasi-static truth": Variant(robot="planar"),
    "quasi-static truth, no noise": replace(_filtered(noise=0.0, noise_tails=0.0), robot="planar"),
    "displacement": _with(push_model="displacement"),
    "20 readings": _readings(20),
    "8 readings": _readings(8),
    "1 reading": _readings(1),
    "correlated 0.5, taken as independent": _correlated(0.5, weighed=False),
    "correlated 0.5": _correlated(0.5, weighed=True),
    "correlated 0.9, taken as independent": _correlated(0.9, weighed=False),
    "correlated 0.9": _correlated(0.9, weighed=True),
    "sharp readings": _sharp(),
    "sharp readings, limit surface 1.2 to 1.9": _sharp(filter=_limit_surface(1.2, 1.9).settings.filter),
    "sharp readings, noise of 16 %": _sharp(filter=replace(_FILTER, noise=0.16)),
    "sharp readings, 2000 particles": _sharp(count=2000),
    "as in MuJoCo, quasi-static": Variant(replace(_ENGINE.settings, push_model="quasi-static")),
    "particles in MuJoCo": _ENGINE,
    "particles in MuJoCo, no noise": _in_engine(noise=0.0, noise_tails=0.0),
    "particles in MuJoCo, noise of 4 %": _in_engine(noise=0.04),
}
"""All by name."""


@dataclass(frozen=True)
class Options:
    """What is done.

    Attributes:
        what: run what is missing, or show what there is.
        variants: which; by default all that are not slow.
        seeds: of the runs; tuning starts from 1000.
        seconds: end after this long; give the command again to go on.
        results: file of the results.
        slow: the slow ones, where no variants are named.
    """

    what: tyro.conf.Positional[Literal["run", "show"]]
    variants: tuple[str, ...] = ()
    seeds: str = "1000-1029"
    seconds: float = float("inf")
    results: Path = RESULTS
    slow: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False


def run(options: Options, names: Sequence[str]) -> None:
    """All runs that the file does not hold."""
    begun, ledger, code = time.monotonic(), Ledger(options.results), code_hash(("rumi.tasks.touch_box.build",))
    for seed in seeds_of(options.seeds):
        for name in names:
            if time.monotonic() - begun > options.seconds:
                return
            own = VARIANTS[name]
            asked = {
                "part": "touch-ablation",
                "variant": name,
                "seed": seed,
                "settings": own.digest,
                "code": code,
            }

            def work(own: Variant = own, seed: int = seed) -> dict[str, Any]:
                with own.parts() as parts:
                    return loop.run(*parts, seed=seed).as_dict()

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
        run(options, [name for name in names if options.variants or VARIANTS[name].slow == options.slow])
    lines = Ledger(options.results).of("touch-ablation")
    seeds = set(seeds_of(options.seeds))
    groups = {}
    for name in names:
        kept = {"variant": name, "settings": VARIANTS[name].digest}
        own = [line for line in lines if line["seed"] in seeds and kept.items() <= line.items()]
        # later lines are of newer code, and count alone
        groups[name] = list({line["seed"]: line for line in own}.values())
    sys.stdout.write(table(groups) + "\n")
    for name, own in groups.items():
        if own and options.variants:
            sys.stdout.write(f"\n{name}\n\n{calibration(own)}\n")


if __name__ == "__main__":
    assert asdict(TouchTask())["readings"] == round(_EVERY / TouchTask().spacing_m)
    script(main)
