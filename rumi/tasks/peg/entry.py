"""The peg task as a member of the tasks' table."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from rumi.agent import Parts
from rumi.registration.pose_summary import PoseSummary, answer_lines
from rumi.runs.folder import Run, RunRecorder
from rumi.runs.json_settings import dataclass_of
from rumi.seeding import check_seed
from rumi.sim.fault import Fault
from rumi.sim.faults import Faults, chosen_faults
from rumi.tasks.peg.agent import PegAgent, build_peg
from rumi.tasks.peg.faulty import KINDS
from rumi.tasks.peg.records import PARTS, PegRun, PegStep
from rumi.tasks.peg.settings import PegSettings
from rumi.tasks.peg.simulated import PegTask
from rumi.tasks.peg.view import PegView
from rumi.tasks.registry import Role, check_preset
from sdf.mesh.mesh import TriangleMesh

_KINDS = ("nothing", "side", "top")


@dataclass(frozen=True)
class PegRunSettings:
    """Settings of a run of the peg task.

    Attributes:
        settings: of the task and the robot.
        seed: of the block's pose, the noise and the choices.
        fault: what goes wrong, KIND[:SIZE][@STEP], once for each: knock, hand or false-contact, STEP the motion from
            which on it holds.
    """

    settings: Annotated[PegSettings, tyro.conf.arg(name="")] = field(default_factory=PegSettings)
    seed: int = 0
    fault: Faults = ()


class _Peg:
    description = "a block with two holes on a table, found by touch under a deadline, and a peg put into it"
    settings = PegRunSettings
    presets = ("default", "paper")
    records = PARTS

    def preset(self, name: str) -> PegRunSettings:
        """The default, or the paper's stop: four contacts on two sides."""
        check_preset(name, self.presets)
        return PegRunSettings(PegSettings(stop="contacts") if name == "paper" else PegSettings())

    def label(self, settings: PegRunSettings) -> str:
        """Seconds of an action, stop and seed."""
        return f"peg-t{settings.settings.action_budget_s:g}-{settings.settings.stop}-s{settings.seed}"

    def check(self, settings: PegRunSettings) -> Sequence[str]:
        """Refuse a seed that is none, and faults that cannot be."""
        check_seed(settings.seed)
        self._faults(settings)
        return ()

    def _faults(self, settings: PegRunSettings) -> tuple[Fault, ...]:
        """What goes wrong."""
        own = settings.settings
        return chosen_faults(settings.fault, KINDS, task="peg", steps=own.most_actions, seed=settings.seed)

    def steps(self, settings: PegRunSettings) -> None:
        """The agent decides: it counts no lanes."""

    def build(self, settings: PegRunSettings, *, cache_dir: Path | None = None) -> Parts[PegTask, PegAgent]:
        """The cell and what finds the block."""
        return build_peg(settings.settings, self._faults(settings))

    def recorder(self, folder: Path, settings: PegRunSettings, parts: Parts[Any, Any], *, log: bool) -> RunRecorder:
        """Writes the run's folder."""
        return RunRecorder(folder, self.as_dict(settings))

    def role(self, name: str) -> Role:
        """What a setting is to a replay."""
        counted = ("seed", "particles", "search_particles", "stop", "probability", "contacts", "sides", "most_nats")
        if name in (*counted, "spread_m", "spread_deg"):
            return "counted"
        thought = ("action_budget_s", "evaluation_s", "readings", "sampled", "configurations", "doublings")
        return "idle" if name in (*thought, "most_actions") else "sensed"

    def as_dict(self, settings: PegRunSettings) -> dict[str, Any]:
        """Settings as settings.json has them."""
        return {"task": "peg", "seed": settings.seed, "peg": asdict(settings.settings), "fault": list(settings.fault)}

    def from_dict(self, values: Mapping[str, Any]) -> PegRunSettings:
        """The settings of a settings.json."""
        return PegRunSettings(dataclass_of(PegSettings, values["peg"]), values["seed"], tuple(values.get("fault", ())))

    def agent(self, settings: PegRunSettings, *, cache_dir: Path | None = None) -> PegAgent:
        """What finds the block."""
        return PegAgent(settings.settings)

    def describe(self, step: PegStep) -> str:
        """What was touched, and how well the holes are known."""
        known = "" if step.probability is None else f"  holes within the tolerance with {step.probability:.2f}"
        return (_KINDS[step.felt.kind] if step.step else "at rest") + known

    def success(self, run: PegRun) -> bool:
        """Whether the belief became sure, and the peg is in a hole."""
        return run.stopped_by == "sure" and run.in_hole

    def summary(self, settings: PegRunSettings, run: PegRun) -> Sequence[str]:
        """A few lines on how a run ended."""
        return summary(run)

    def pose(self, run: Run) -> PoseSummary | None:
        """What a run's last belief knows of the block's pose."""
        return PegRun.of(run, self.from_dict(run.settings).settings).pose if run.steps else None

    def draw(self, run: Run, out: Path, steps: Sequence[int] | None = None) -> Sequence[Path]:
        """Contacts and time-line."""
        from rumi.tasks.peg.figures import draw_run

        return draw_run(PegRun.of(run, self.from_dict(run.settings).settings), out)

    def mesh(self, settings: PegRunSettings) -> TriangleMesh:
        """Of the block without its holes, in its own frame, for exports."""
        (x, y), height = settings.settings.block.half_m, settings.settings.height_m
        return TriangleMesh.box((-x, -y, 0.0), (x, y, height))

    def view(self, run: Run) -> PegView:
        """The block with its holes, the motions that were weighed, and what was touched."""
        return PegView(self.from_dict(run.settings).settings)


PEG = _Peg()


def summary(run: PegRun) -> list[str]:
    """A few lines on how a run ended."""
    ended: str = "not sure" if run.stopped_by == "steps" else run.stopped_by
    if run.stopped_by == "nothing to do":
        weighed = run.thoughts[-1].selection.evaluated if run.thoughts else 0
        ended = "nothing more that a touch would tell" if weighed else "no time for any motion"
        if run.aim is None:
            ended = "nothing met on any lane"
    found = run.as_dict()
    touches = f"{found['touches']} touch{'es' if found['touches'] != 1 else ''}"
    lines = [f"{ended} after {touches}"]
    if run.inserted is not None:
        place = "in the hole" if run.in_hole else "beside the hole"
        lines[0] += f", {place} by {found['off_mm']:.1f} mm from its middle"
    lines += answer_lines(run.pose, run.why_not, ())
    if run.aim is not None:
        within = f"within {1e3 * run.settings.tolerance_m:g}"
        off = f"off by {found['hole_error_mm']:.1f} mm at most"
        lines.append(f"holes    {off}; believed {found['probability']:.2f} {within}")
    said = f"{found['search_s']:.0f} search, {found['thinking_s']:.0f} reasoning"
    lines.append(f"seconds  {found['total_s']:.0f}: {said}; {found['evaluated']} candidates weighed")
    return lines
