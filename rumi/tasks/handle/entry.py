"""The handle task as a member of the tasks' table."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from rumi.agent import Parts
from rumi.runs.folder import RunRecorder
from rumi.runs.json_settings import dataclass_of
from rumi.runs.progress import stages
from rumi.seeding import check_seed
from rumi.sim.fault import Fault
from rumi.sim.faults import FAULTS, Faults, chosen_faults
from rumi.tasks.handle.agent import HandleAgent, HandleResult, build_agent
from rumi.tasks.handle.settings import SENSORS, HandleSettings
from rumi.tasks.handle.simulated import HandleTask
from rumi.tasks.registry import Role, check_preset
from rumi.tasks.rummage.entry import Rummaging, ending
from rumi.tasks.rummage.settings import PRESETS

COUNTED = (
    *("seed", "preset", "renewals", "fit_a_contact", "contacts", "steps", "signals", "spread_m"),
    *("wrist.point_m", "wrist.normal_rad", "wrist.outlier"),
)
"""Settings of what readings count for, which a replay may change; all others decided what was sensed."""

IDLE = ("run_budget_s", "thinking_s")
"""Settings of what was done when, which a replay does not use."""


@dataclass(frozen=True)
class HandleRunSettings:
    """Settings of a run of the handle task.

    Attributes:
        settings: of belief, sensors and time.
        seed: of where the mug stands, of the noise and of the choices.
        fault: what goes wrong, KIND[:SIZE][@STEP], once for each: any of `rumi.sim.faults.FAULTS` but stale.
    """

    settings: Annotated[HandleSettings, tyro.conf.arg(name="")] = field(default_factory=HandleSettings)
    seed: int = 0
    fault: Faults = ()


class _Handle(Rummaging):
    description = "a mug seen once, then felt by bubbles, wrench and joint torques, and lifted by its handle"
    settings = HandleRunSettings
    presets = ("fast", *(name for name in PRESETS if name != "fast"))

    def preset(self, name: str) -> HandleRunSettings:
        """Planner and belief of a preset of the rummaging task."""
        check_preset(name, self.presets)
        return HandleRunSettings(HandleSettings(preset=name))

    def label(self, settings: HandleRunSettings) -> str:
        """Sensors and seed."""
        sensors = "all" if settings.settings.sensors == SENSORS else "-".join(settings.settings.sensors)
        return f"handle-{sensors}-s{settings.seed}"

    def check(self, settings: HandleRunSettings) -> Sequence[str]:
        """Say what takes long at first, and where the time is up before the first look and the grasp are done."""
        check_seed(settings.seed)
        self._faults(settings)
        note = short_of(settings.settings)
        return ("grasps are simulated once and kept (a minute at first)", *([] if note is None else [note]))

    def steps(self, settings: HandleRunSettings) -> int:
        """Actions at most."""
        return settings.settings.steps

    def build(self, settings: HandleRunSettings, *, cache_dir: Path | None = None) -> Parts[HandleTask, HandleAgent]:
        """The simulated arm with its sensors, and what finds and grasps the mug."""
        from rumi.tasks.handle.build import build_handle

        return build_handle(settings.settings, cache_dir=cache_dir, faults=self._faults(settings))

    def _faults(self, settings: HandleRunSettings) -> tuple[Fault, ...]:
        """What goes wrong."""
        kinds = [name for name in FAULTS if name != "stale"]  # the camera looks once
        return chosen_faults(settings.fault, kinds, task="handle", steps=settings.settings.steps, seed=settings.seed)

    def recorder(
        self, folder: Path, settings: HandleRunSettings, parts: Parts[Any, HandleAgent], *, log: bool
    ) -> RunRecorder:
        """Writes the run's folder."""
        from rumi.tasks.rummage.geometry import scene_geometry

        return RunRecorder(folder, self.as_dict(settings), scene_geometry(parts.agent.rummager))

    def role(self, name: str) -> Role:
        """What a setting is to a replay."""
        if name in IDLE:
            return "idle"
        return "counted" if any(name == one or name.startswith(f"{one}.") for one in COUNTED) else "sensed"

    def as_dict(self, settings: HandleRunSettings) -> dict[str, Any]:
        """Settings as settings.json has them."""
        own = asdict(settings.settings)
        return {"task": "handle", "seed": settings.seed, "handle": own, "fault": list(settings.fault)}

    def from_dict(self, values: Mapping[str, Any]) -> HandleRunSettings:
        """The settings of a settings.json, also of one of before, when the task was called "fused"."""
        own = values["handle"] if "handle" in values else values["fused"]
        fault = tuple(values.get("fault", ()))
        return HandleRunSettings(dataclass_of(HandleSettings, own), values["seed"], fault)

    def agent(self, settings: HandleRunSettings, *, cache_dir: Path | None = None) -> HandleAgent:
        """What finds the mug, and grasps nothing."""
        return build_agent(settings.settings, cache_dir=cache_dir)

    def success(self, result: HandleResult) -> bool:
        """Whether the belief became sure, and the mug was lifted."""
        return result.stopped_by == "sure" and result.lifted

    def summary(self, settings: HandleRunSettings, result: HandleResult) -> Sequence[str]:
        """A few lines on how a run ended."""
        lines, budget_s = ending(result), settings.settings.run_budget_s
        if result.grasp is not None and result.believed is not None:
            done = "lifted by its handle" if result.lifted else "not lifted"
            lines.append(f"grasp    {done}; believed {result.believed:.2f}")
        late_s = result.total_s - budget_s
        over = f", {late_s:.1f} too many" if late_s > 1e-6 else ""
        lines.append(f"clock    {result.total_s:.0f} s of {budget_s:g}{over}; nll summed up {result.total_nll:.0f}")
        lines.append(f"seconds  {sum(result.timings_s.values()):.1f}: {stages(result.timings_s)}")
        return lines


HANDLE = _Handle()


def short_of(settings: HandleSettings) -> str | None:
    """What to say where the time is up before the first look's belief and the grasp are done; None where it is not."""
    from rumi.tasks.grasp_primitive import GRASP_S

    least_s = (settings.thinking_s or 0.0) + GRASP_S
    if settings.run_budget_s >= least_s:
        return None
    return (
        f"{settings.run_budget_s:g} s are less than the {least_s:.1f} s that the first look's belief and the "
        "grasp take: it looks, grasps at once, and is late"
    )
