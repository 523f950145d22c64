"""The touch-box task as a member of the tasks' table."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from rumi.agent import Parts
from rumi.errors import UsageError
from rumi.registration.pose_summary import PoseSummary, answer_lines
from rumi.runs.folder import Run, RunRecorder
from rumi.runs.json_settings import dataclass_of
from rumi.seeding import check_seed
from rumi.sim.fault import Fault
from rumi.sim.faults import Faults, chosen_faults
from rumi.tasks.registry import Role, check_preset
from rumi.tasks.touch_box.agent import Toucher
from rumi.tasks.touch_box.build import Robot, check_robot
from rumi.tasks.touch_box.faulty import KINDS
from rumi.tasks.touch_box.records import PARTS, TouchRun, TouchStep
from rumi.tasks.touch_box.robot import TouchBox
from rumi.tasks.touch_box.scene import TouchTask
from rumi.tasks.touch_box.settings import TouchSettings
from rumi.tasks.touch_box.view import TouchView
from sdf.mesh.mesh import TriangleMesh


@dataclass(frozen=True)
class TouchBoxSettings:
    """Settings of a run of the touch-box task.

    Attributes:
        settings: of belief and pokes.
        task: the scene and its readings.
        robot: that pokes and grasps.
        seed: of where the box stands and of all randomness.
        plan_budget_s: seconds for the choice of each poke: of the candidates as many are weighed as there is time for;
            None for as long as it needs.
        fault: what goes wrong, KIND[:SIZE][@STEP], once for each: knock, absent, hand, dead or false-contact, STEP the
            poke from which on it holds.
    """

    settings: Annotated[TouchSettings, tyro.conf.arg(name="")] = field(default_factory=TouchSettings)
    task: TouchTask = field(default_factory=TouchTask)
    robot: Robot = "gripper"
    seed: int = 0
    plan_budget_s: Annotated[float | None, tyro.conf.arg(metavar="SECONDS")] = None
    fault: Faults = ()


class _TouchBox:
    description = "a box in one of two places that only touch can tell, to be found, grasped and lifted"
    settings = TouchBoxSettings
    presets = ("default",)
    records = PARTS

    def preset(self, name: str) -> TouchBoxSettings:
        """The default."""
        check_preset(name, self.presets)
        return TouchBoxSettings()

    def label(self, settings: TouchBoxSettings) -> str:
        """Method, robot and seed."""
        return f"touch-box-{settings.settings.method}-{settings.robot}-s{settings.seed}"

    def check(self, settings: TouchBoxSettings) -> Sequence[str]:
        """Refuse rates of readings for a robot that has its own."""
        check_seed(settings.seed)
        check_robot(settings.task, settings.robot)
        if settings.plan_budget_s is not None and not 0 < settings.plan_budget_s < math.inf:
            raise UsageError(f"Expected --plan-budget-s above 0 s and finite, got {settings.plan_budget_s}")
        self._faults(settings)
        return ("grasps are simulated once and kept (a minute at first)",)

    def steps(self, settings: TouchBoxSettings) -> int:
        """Pokes at most."""
        return settings.settings.actions

    def build(self, settings: TouchBoxSettings, *, cache_dir: Path | None = None) -> Parts[TouchBox, Toucher]:
        """The robot with the box, and what finds it."""
        from rumi.tasks.touch_box.budget import BudgetedChoice
        from rumi.tasks.touch_box.build import build_touch_box

        faults = self._faults(settings)
        parts = build_touch_box(settings.task, settings.settings, settings.robot, cache_dir=cache_dir, faults=faults)
        if settings.plan_budget_s is not None:
            parts.agent.chooser = BudgetedChoice(parts.agent, settings.plan_budget_s)
        return parts

    def _faults(self, settings: TouchBoxSettings) -> tuple[Fault, ...]:
        """What goes wrong."""
        if settings.fault and settings.robot == "arm":
            raise UsageError("Expected --robot gripper or planar with --fault, got arm: nothing goes wrong with it")
        return chosen_faults(
            settings.fault, KINDS, task="touch-box", steps=settings.settings.actions, seed=settings.seed
        )

    def recorder(self, folder: Path, settings: TouchBoxSettings, parts: Parts[Any, Any], *, log: bool) -> RunRecorder:
        """Writes the run's folder."""
        return RunRecorder(folder, self.as_dict(settings))

    def role(self, name: str) -> Role:
        """What a setting is to a replay."""
        if name.partition(".")[0] in ("task", "robot", "fault"):
            return "sensed"
        return (
            "counted"
            if name in ("seed", "count", "threshold", "decay", "push_model", "weigh_correlated")
            or (name.startswith("filter."))
            else "idle"
        )

    def as_dict(self, settings: TouchBoxSettings) -> dict[str, Any]:
        """Settings as settings.json has them."""
        return {**asdict(settings), "task": "touch-box", "scene": asdict(settings.task)}

    def from_dict(self, values: Mapping[str, Any]) -> TouchBoxSettings:
        """The settings of a settings.json, also of one of before, where `task` is the scene."""
        scene = values["scene"] if "scene" in values else values["task"]
        own = {name: value for name, value in values.items() if name not in ("schema", "made_with", "scene")}
        return dataclass_of(TouchBoxSettings, own | {"task": scene})

    def agent(self, settings: TouchBoxSettings, *, cache_dir: Path | None = None) -> Toucher:
        """What finds the box."""
        return self.build(settings, cache_dir=cache_dir).agent

    def describe(self, step: TouchStep) -> str:
        """The readings of a poke, and the believed chance of lifting."""
        chance = f"lifted with {step.grasp.probability:.2f}"
        if step.touched is None:
            return chance
        empty = "out of reach" if step.touched.blocked is None else "blocked"
        contact = step.touched.contact
        felt = f"felt in {int(contact.sum())} of {len(contact)} readings" if len(contact) else empty
        return f"{felt}  {chance}"

    def success(self, run: TouchRun) -> bool:
        """Whether the grasp became likely enough to succeed, and did."""
        return run.stopped_by == "sure" and bool(run.lifted)

    def summary(self, settings: TouchBoxSettings, run: TouchRun) -> Sequence[str]:
        """A few lines on how a run ended."""
        found = run.as_dict()
        ended = "not sure" if run.stopped_by == "steps" else run.stopped_by
        seconds = ", ".join(f"{name} {value:.1f}" for name, value in run.timings_s.items())
        pokes = f"{found['actions']} poke{'s' * (found['actions'] != 1)}"
        done = "nothing grasped" if run.lifted is None else "lifted" if run.lifted else "not lifted"
        return [
            f"{ended} after {pokes}, {done}",
            *answer_lines(run.pose, run.why_not, run.warnings),
            f"grasp    believed {found['believed']:.2f}; off by {found['error_mm']:.1f} mm and "
            f"{found['error_deg']:.1f} degrees",
            f"seconds  {math.fsum(run.timings_s.values()):.1f}: {seconds}",
        ]

    def pose(self, run: Run) -> PoseSummary | None:
        """What a run's last belief knows of the box's pose."""
        return TouchRun.of(run).pose if run.steps else None

    def draw(self, run: Run, out: Path, steps: Sequence[int] | None = None) -> Sequence[Path]:
        """Beliefs with pokes and the grasp, and how sure the belief was."""
        from rumi.tasks.touch_box.figures import draw_run

        settings = self.from_dict(run.settings)
        return draw_run(TouchRun.of(run), settings.task, settings.settings.threshold, out)

    def mesh(self, settings: TouchBoxSettings) -> TriangleMesh:
        """Of the box, in its own frame, for exports."""
        (x, y), height = settings.task.half, settings.task.height_m
        return TriangleMesh.box((-x, -y, 0.0), (x, y, height))

    def view(self, run: Run) -> TouchView:
        """The box, the pokes that were weighed, what was felt and the best grasp."""
        settings = self.from_dict(run.settings)
        return TouchView(settings.task, settings.settings)


TOUCH_BOX = _TouchBox()
