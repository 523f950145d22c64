"""What each part of the touch-box task is worth, and what readings tell: runs with one thing changed at a time.

python -m scripts.touch_ablations run --seeds 1000-1029             # all variants, seed by seed; again to go on
python -m scripts.touch_ablations run --variants default 'no noise' --seconds 110
python -m scripts.touch_ablations run --seeds 1000-1009 --variants 'particles in MuJoCo'    # a minute a run
python -m scripts.touch_ablations show
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

from rumi import loop
from rumi.agent import Parts
from rumi.cache import cache_folder
from rumi.cli import script
from rumi.tasks.touch_box.agent import Toucher
from rumi.tasks.touch_box.build import Robot, build_touch_box
from rumi.tasks.touch_box.gripper_robot import GripperRobot
from rumi.tasks.touch_box.mujoco_scene import GripperPhysics
from rumi.tasks.touch_box.planar_robot import PlanarRobot
from rumi.tasks.touch_box.robot import TouchBox, TouchRobot
from rumi.tasks.touch_box.scene import TouchTask
from rumi.tasks.touch_box.settings import TouchSettings
from scripts.experiment import Experiment, Line
from scripts.reproduce.code import code_of
from scripts.reproduce.touch_report import calibration, digest, table

PART = "touch-ablation"
# the default's when most of these were run
_FILTER = replace(TouchSettings().filter, lever_m=(1.22 * 0.0447, 2.45 * 0.0447))
_OWN = replace(TouchSettings(), filter=_FILTER)
_EVERY = 0.2  # metres of a poke


@dataclass(frozen=True)
class Variant:
    """One thing changed.

    Attributes:
        settings: of the run.
        task: the scene and its readings.
        robot: by name.
        truth: physics of the gripper that pokes, where they are others; the table of grasps stays as it is.
        levers: of the quasi-static truth, in multiples of that of even pressure, where they are others.
        slow: takes a minute a run; left out unless it is asked for by name.
    """

    settings: TouchSettings = _OWN
    task: TouchTask = TouchTask()  # noqa: RUF009
    robot: Robot = "gripper"
    truth: GripperPhysics | None = None
    levers: tuple[float, float] | None = None
    slow: bool = False

    @property
    def digest(self) -> str:
        """A name of all that decides a run but its seed and the code."""
        name = " ".join(str(part) for part in (self.robot, self.truth, self.levers) if part is not None)
        return digest(self.task, self.settings, name)

    def parts(self) -> Parts[TouchBox, Toucher]:
        """What a run needs."""
        parts = build_touch_box(self.task, self.settings, self.robot, cache_dir=cache_folder())
        if self.truth is None and self.levers is None:
            return parts
        robot: TouchRobot
        if self.levers is None:
            robot = GripperRobot(self.task, self.truth)
        else:
            robot = PlanarRobot(self.task, parts.agent.table, self.levers)
        agent = Toucher(self.task, self.settings, robot, parts.agent.table, parts.agent.carrier)
        return Parts(TouchBox(self.task, robot), agent)


def _with(**changes: Any) -> Variant:  # noqa: ANN401
    return Variant(replace(_OWN, **changes))


def _filtered(**changes: Any) -> Variant:  # noqa: ANN401
    return _with(filter=replace(_FILTER, **changes))


def _readings(count: int) -> Variant:
    return Variant(task=TouchTask(readings=count, spacing_m=_EVERY / count))


def _correlated(chance: float, *, weighed: bool) -> Variant:
    own = replace(_OWN, weigh_correlated=weighed)
    return Variant(own, replace(TouchTask(), correlation=chance))


def _limit_surface(low: float, high: float) -> Variant:
    """A prior of c, in multiples of that of even pressure."""
    even = TouchTask().even_lever_m
    return _filtered(lever_m=(low * even, high * even))


def _real_levers(low: float, high: float) -> Variant:
    """A truth as real objects have it, and a prior of c."""
    return replace(_limit_surface(low, high), robot="planar", levers=(0.4, 1.6))


def _in_engine(**changes: Any) -> Variant:  # noqa: ANN401
    """Fewer particles and candidates, of the engine or to compare it with."""
    poke = replace(_OWN.poke, candidates=10, particles=60)
    few = replace(_FILTER, sweeps=1, **changes)
    return Variant(replace(_OWN, push_model="mujoco", count=300, poke=poke, filter=few), slow=True)


def _sharp(**changes: Any) -> Variant:  # noqa: ANN401
    return Variant(replace(_OWN, **changes), TouchTask(rates=(0.9, 0.05)))


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
    "limit surface 1.22 to 2.45": _limit_surface(1.22, 2.45),
    "limit surface 0.4 to 2.45": _limit_surface(0.4, 2.45),
    "pushes through": _with(stop_early=False),
    "soft contact in the truth": Variant(truth=GripperPhysics(contact_s=0.02)),
    "threshold 0.8": _with(threshold=0.8),
    "threshold 0.9": _with(threshold=0.9),
    "threshold 0.97": _with(threshold=0.97),
    "100 particles": _with(count=100),
    "300 particles": _with(count=300),
    "2000 particles": _with(count=2000),
    "straight pokes": _with(poke=replace(_OWN.poke, bend=0.0)),
    "80 candidates": _with(poke=replace(_OWN.poke, candidates=80)),
    "funnel 0.3": _with(poke=replace(_OWN.poke, funnel=0.3)),
    "quasi-static truth": Variant(robot="planar"),
    "quasi-static truth, no noise": replace(_filtered(noise=0.0, noise_tails=0.0), robot="planar"),
    "real levers, 0.4 to 1.6; limit surface 1.22 to 2.45": _real_levers(1.22, 2.45),
    "real levers, 0.4 to 1.6; limit surface 0.4 to 2.45": _real_levers(0.4, 2.45),
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


def measure(variant: str, seed: int) -> dict[str, Any]:
    """One run."""
    with VARIANTS[variant].parts() as parts:
        return loop.run_to_end(*parts, seed=seed).as_dict()


def show(lines: list[Line], chosen: Mapping[str, tuple[str, ...]]) -> str:
    """Each variant, and those that were asked for with their calibration."""
    groups = {}
    for name in chosen.get("variant", VARIANTS):
        kept = {"variant": name, "settings": VARIANTS[name].digest}
        # later lines are of newer code, and count alone
        groups[name] = list({line["seed"]: line for line in lines if kept.items() <= line.items()}.values())
    asked = [(name, own) for name, own in groups.items() if own and "variant" in chosen]
    return "\n".join([table(groups), *(f"\n{name}\n\n{calibration(own)}" for name, own in asked)])


EXPERIMENT = Experiment(
    __doc__,
    "touch_ablations.jsonl",
    {"variant": tuple(VARIANTS)},
    measure,
    show,
    seeds="1000-1029",
    usual={"variant": tuple(name for name, variant in VARIANTS.items() if not variant.slow)},
    identity=lambda variant: {"part": PART, "settings": VARIANTS[variant["variant"]].digest, "code": code_of(PART)},
)

if __name__ == "__main__":
    assert asdict(TouchTask())["readings"] == round(_EVERY / TouchTask().spacing_m)
    script(EXPERIMENT.main)
