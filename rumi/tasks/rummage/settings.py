"""All settings of a run as one value: presets, and the way to JSON and back."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal, cast

import torch
import tyro

from rumi.belief.initialise import InitialiseSettings
from rumi.belief.misfit import MisfitSettings
from rumi.belief.pose_filter import FilterSettings
from rumi.belief.reinitialise import ReinitialiseSettings
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.errors import UsageError
from rumi.information.stopping import StopSettings
from rumi.planning.gpvr import GPVRSettings
from rumi.planning.registry import POLICIES
from rumi.planning.rummaging import RummagingSettings
from rumi.planning.slide import SlideSettings
from rumi.registration.descent import DescentSettings
from rumi.runs.json_settings import changed, dataclass_of, not_numbers
from rumi.runs.plain import plain
from rumi.seeding import check_seed
from rumi.sim.conditions import Conditions, bundle, under
from rumi.sim.faults import Faults
from rumi.sim.settings import SimSettings
from rumi.tasks.rummage.drawn_scenes import DRAWN
from rumi.tasks.rummage.objects import ObjectSettings
from rumi.tasks.rummage.scenes import SCENES
from sdf import gpu
from sdf.extras import remedy

Preset = Literal["default", "fast", "paper"]

DRAWN_CONDITIONS: Conditions = "lab"
"""The conditions of the tasks whose scene the seed draws, where none are asked for; of all others they are ideal."""


@dataclass(frozen=True)
class Settings:
    """Everything that decides a run; the same settings on the same machine give the same run.

    Attributes:
        task: what to find; `rumi tasks` lists them.
        method: "rumi" weighs information against reachability, or chooses the next touch (`planner.next_touch`);
            "info-only" and "reach-only" are the paper's ablations with one of the two costs. "slide" goes to the object
            and along its surface; "gpvr" and "gpvr-greedy" go where a Gaussian-process implicit surface is least sure
            (extra `baselines`).
        preset: where all other settings started from; "paper" holds the paper's Table IV.
        seed: of all randomness.
        steps: actions at most; None for as many as the task allows.
        device: where plans are made, "cpu" or "cuda"; the belief is followed on the CPU, and a next touch chosen there.
        dtype: of the belief and the planner.
        replan_every: actions carried out of one plan; a contact always asks for a new one.
        approach_m: length of an action that may touch the object, which is slow then, for an action lasts as long
            whatever its length; 0 for as long as planned. None for 40 mm where actions are guarded and the object is
            soon toppled, else 0.
        retreats: whether the tool goes back, an action, to where it last touched nothing: from an object that most of
            the belief has leaning on it, so that it stands again and does not fall, and from one that it touches before
            the run ends as sure. None for where approach_m is not 0 by itself.
        plan_budget_s: seconds that each plan may take, for which it makes do with less; runs are not the same then from
            one time to the next. None for as long as it needs.
        tool_height_m: of a level tool's middle above the table; None for the task's, or lower where the object is.
        filter: how the belief follows the readings.
        initialise: how the first belief is found.
        renewal: when and how particles are drawn anew, where no camera sees the object.
        planner: how actions are chosen.
        slide: how the method slide moves.
        gpvr: the process of the methods gpvr and gpvr-greedy, which plan by `planner`.
        stop: when the belief is sure enough.
        misfit: when a reading fits no pose that is believed, and what is done then.
        conditions: bundle of what sensors lack and of how far the scene is off what is known of it, from which the
            settings of the simulator start: "ideal" lacks nothing. `rumi.sim.conditions.MEMBERS` has its numbers, each
            of which is a setting of its own too.
        simulator: how the simulator steps and what its sensors report.
        object: the object to find, where that is not the task's own.
        fault: what goes wrong in simulation, KIND[:SIZE][@STEP], once for each: the kinds are rows of
            `rumi.sim.faults.FAULTS`, SIZE in their units, STEP the action from which on it holds.
    """

    task: Annotated[str, tyro.conf.Suppress] = "mug-0"
    method: Annotated[str, tyro.conf.arg(metavar="{" + ",".join(POLICIES) + "}")] = "rumi"
    preset: Annotated[Preset, tyro.conf.Suppress] = "default"
    seed: int = 0
    steps: int | None = None
    device: Literal["cpu", "cuda"] = "cpu"
    dtype: Literal["float32", "float64"] = "float32"
    replan_every: int = 1
    approach_m: Annotated[float | None, tyro.conf.arg(metavar="M")] = None
    retreats: bool | None = None
    plan_budget_s: Annotated[float | None, tyro.conf.arg(metavar="SECONDS")] = None
    tool_height_m: Annotated[float | None, tyro.conf.arg(name="tool-height", metavar="M")] = None
    filter: FilterSettings = field(default_factory=lambda: FilterSettings(motion="auto"))
    initialise: InitialiseSettings = field(default_factory=InitialiseSettings)
    renewal: ReinitialiseSettings = field(default_factory=ReinitialiseSettings)
    planner: RummagingSettings = field(default_factory=RummagingSettings)
    slide: SlideSettings = field(default_factory=SlideSettings)
    gpvr: GPVRSettings = field(default_factory=GPVRSettings)
    stop: StopSettings = field(default_factory=StopSettings)
    misfit: MisfitSettings = field(default_factory=MisfitSettings)
    conditions: Conditions = "ideal"
    simulator: SimSettings = field(default_factory=SimSettings)
    object: Annotated[ObjectSettings, tyro.conf.arg(name="")] = field(default_factory=ObjectSettings)
    fault: Faults = ()

    def __post_init__(self) -> None:
        for name, valid in (("method", tuple(POLICIES)), ("preset", tuple(PRESETS)), ("device", ("cpu", "cuda"))):
            if getattr(self, name) not in valid:
                raise UsageError(f"There is no {name} {getattr(self, name)!r}; there are {', '.join(valid)}")
        bundle(self.conditions)
        check_seed(self.seed)
        if self.steps is not None and self.steps < 0:
            raise UsageError(f"Expected steps to be 0 or more, got {self.steps}")
        if self.replan_every < 1:
            raise UsageError(f"Expected replan_every to be 1 or more, got {self.replan_every}")
        if self.approach_m is not None and not self.approach_m >= 0:
            raise UsageError(f"Expected approach_m to be 0 or more, got {self.approach_m}")
        if self.plan_budget_s is not None and self.plan_budget_s < 0:
            raise UsageError(f"Expected plan_budget_s to be 0 or more, got {self.plan_budget_s}")
        if self.tool_height_m is not None and not self.tool_height_m > 0:
            raise UsageError(f"Expected tool_height_m above 0, got {self.tool_height_m}")
        for name in not_numbers(self):
            raise UsageError(f"Expected {name} to be a number, got nan")

    @property
    def torch_device(self) -> torch.device:
        """The device.

        Raises:
            UsageError: there is no such device here, or nothing to plan on it with.
        """
        if self.device == "cuda" and not torch.cuda.is_available():
            raise UsageError("There is no CUDA device that this PyTorch can use: leave out --device cuda")
        if self.device == "cuda" and not gpu.available():
            raise UsageError(f"Planning on a GPU needs warp: {remedy('warp')}, or leave out --device cuda")
        return torch.device(self.device)

    @property
    def torch_dtype(self) -> torch.dtype:
        """The floating dtype."""
        return torch.float32 if self.dtype == "float32" else torch.float64


def preset(name: str = "default", **changes: Any) -> Settings:  # noqa: ANN401  (values of the settings)
    """The settings of a preset.

    Args:
        name: of the preset.
        changes: settings to give another value (`rumi.runs.json_settings.changed`), such as `task` and `seed`;
            `conditions` before all others.

    Raises:
        UsageError: there is no such preset or setting; the message lists them.
    """
    if name not in PRESETS:
        raise UsageError(f"There is no preset {name!r}; the presets are {', '.join(PRESETS)}")
    start = PRESETS[name]()
    usual = DRAWN_CONDITIONS if changes.get("task", start.task) in DRAWN else "ideal"
    return changed(under_conditions(start, changes.get("conditions", usual)), changes)


def under_conditions(settings: Settings, conditions: str) -> Settings:
    """Settings with all members of a condition in place of their own.

    Raises:
        UsageError: there is no such condition.
    """
    return replace(settings, conditions=cast(Conditions, conditions), simulator=under(settings.simulator, conditions))


def to_dict(settings: Settings) -> dict[str, Any]:
    """Plain values, ready for JSON; infinity becomes None."""
    return dict(plain(settings))


def from_dict(values: Mapping[str, Any]) -> Settings:
    """Settings from `to_dict`'s values, such as a run folder's `settings.json`; what is missing has its default.

    Raises:
        UsageError: a name that is no setting (the message lists the valid ones), or a value that is none.
    """
    if "made_with" in values and "filter" in values:
        # runs on record that do not say otherwise are of before errors of a whole run were particles' own, populations
        # exchanged particles or were weighed by their evidence, what is felt standing still counted less, what is
        # pushed in space slipped, a camera that looks again was evidence of each particle's own motion, each cell that
        # a view sees through counted, what stands on its rim turned about it, the next touch was chosen in space, and
        # heights were uncertain
        following = {"stated_errors": "noise", "motion": "measured", **values["filter"]}
        spec = (SCENES | DRAWN).get(values.get("task", ""))
        if spec is not None and spec.looks_again and "seen_again_points" not in following.get("trajectories", {}):
            following["unmeasured"] = following.get("unmeasured") or "corrected"
        if "trajectories" in following:
            once: dict[str, Any] = {"exchanged": 0.0, "evidence_power": 0.0, "fresh_m": 0.0, "slip": 0.0, "rim": False}
            once |= {"push_m": 0.0, "height_off": (0.0, 0.0)}
            following["trajectories"] = once | following["trajectories"]
            if following["trajectories"]["exchanged"] is None:  # once a twentieth of what is soon toppled, else none
                following["trajectories"]["exchanged"] = 0.05 if values.get("task", "").startswith("drill") else 0.0
            if "free_points" not in following["trajectories"]:
                again = spec is not None and spec.looks_again
                following["trajectories"] |= _views_alike(following["trajectories"], again=again)
        planner, stop = {"next_touch": False, **values.get("planner", {})}, {"further": 0, **values.get("stop", {})}
        values = {**values, "filter": following, "planner": planner, "stop": stop}
    extra = {"schema", "made_with"}
    return dataclass_of(Settings, {name: value for name, value in values.items() if name not in extra})


def _views_alike(trajectories: Mapping[str, Any], *, again: bool) -> dict[str, Any]:
    """What a view is worth as once: all free points of it as much as all seen ones, a first view as a later one."""
    fitted = PoseTrajectorySettings()
    name = "seen_again_points" if again else "seen_points"
    worth = trajectories.get(name, getattr(fitted, name))
    return {"seen_points": worth, "free_points": worth, "free_most": trajectories.get("most", fitted.most)[1]}


def _default() -> Settings:
    return Settings()


def _fast() -> Settings:
    """A quarter of the starts, a third of the polished poses and a quarter of the rollouts that `default` has.

    What that gives up, `scripts/docs/how-to/choosing.md` says with figures.
    """
    planner = RummagingSettings()
    return Settings(
        preset="fast",
        initialise=InitialiseSettings(starts=500, polished=100),
        planner=replace(planner, mppi=replace(planner.mppi, samples=200), rollouts=3),
    )


def _paper() -> Settings:
    """Table IV and the text around it, also where the default has reasons to differ; two of its numbers are read.

    N_o = 10 counts rounds of fifty steps of Adam, and the discrepancy that lambda = 2 weighs particles by is in
    millimetres: `scripts/docs/reference/tasks.md` says why, and what each reading does. Not the paper's rule to
    stop, which holds at the first view of a mug: its runs are counted over all actions.
    """
    return Settings(
        preset="paper",
        replan_every=3,
        filter=FilterSettings(
            peakiness=2.0e3,
            free_scale=10.0,
            tolerance_m=0.0,
            free_spacing_m=0.010,
            surface_spacing_m=0.002,
            translation_noise_m=0.010,
            rotation_noise_rad=0.0,
            unmeasured="estimated",
            trigger=5.0,
            trigger_percentile=1.0,
            weigh_before_resampling=False,
            lies_flat=False,
            descent=DescentSettings(method="adam", iterations=50, rounds=10, margin_m=0.03),
        ),
        renewal=ReinitialiseSettings.never(),
        planner=RummagingSettings.paper(),
        gpvr=GPVRSettings(tolerance=0.0),
        stop=StopSettings(rule="never", apc_ratio=0.03),
        misfit=MisfitSettings(alpha=0.0),
        simulator=SimSettings(free_fraction=0.95, free_spacing_m=0.010),
    )


PRESETS: dict[str, Callable[[], Settings]] = {"default": _default, "fast": _fast, "paper": _paper}
"""Settings by preset: `paper` holds the paper's numbers, `default` the best that were found, `fast` cheaper ones."""
