"""The peg task as a member of the tasks' table."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from rumi.agent import Parts
from rumi.runs.folder import write_json
from rumi.tasks.peg.agent import PegAgent, build_peg
from rumi.tasks.peg.records import PegRun, PegStep
from rumi.tasks.peg.settings import PegSettings
from rumi.tasks.peg.simulated import PegTask
from rumi.tasks.registry import check_preset, check_seed

_KINDS = ("nothing", "side", "top")


@dataclass(frozen=True)
class PegRunSettings:
    """Settings of a run of the peg task.

    Attributes:
        settings: of the task and the robot.
        seed: of the block's pose, the noise and the choices.
    """

    settings: Annotated[PegSettings, tyro.conf.arg(name="")] = field(default_factory=PegSettings)
    seed: int = 0


class _Peg:
    description = "a block with two holes on a table, found by touch under a deadline, and a peg put into it"
    settings = PegRunSettings
    presets = ("default", "paper")

    def preset(self, name: str) -> PegRunSettings:
        """The default, or the paper's stop: four contacts on two sides."""
        check_preset(name, self.presets)
        return PegRunSettings(PegSettings(stop="contacts") if name == "paper" else PegSettings())

    def label(self, settings: PegRunSettings) -> str:
        """Seconds of an action, stop and seed."""
        return f"peg-t{settings.settings.t_max_s:g}-{settings.settings.stop}-s{settings.seed}"

    def check(self, settings: PegRunSettings) -> Sequence[str]:
        """Refuse a seed that is none."""
        check_seed(settings.seed)
        return ()

    def steps(self, settings: PegRunSettings) -> None:
        """The agent decides: it counts no lanes."""

    def build(self, settings: PegRunSettings, *, cache_dir: Path | None = None) -> Parts[PegTask, PegAgent]:
        """The cell and what finds the block."""
        return build_peg(settings.settings)

    def recorder(self, folder: Path, settings: PegRunSettings, parts: Parts[Any, Any], *, log: bool) -> "_Recorder":
        """Writes how the run ended."""
        return _Recorder(folder, settings)

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

    def draw(self, folder: Path, settings: PegRunSettings, run: PegRun) -> Sequence[Path]:
        """Contacts and time-line."""
        from rumi.tasks.peg.figures import draw_run

        return draw_run(run, folder)


PEG = _Peg()


class _Recorder:
    """Writes result.json at the end."""

    def __init__(self, folder: Path, settings: PegRunSettings) -> None:
        self._folder, self._settings = folder, settings

    def __call__(self, step: PegStep) -> None:
        pass

    def finish(self, run: PegRun) -> None:
        write_json(self._folder / "result.json", as_record(run, self._settings.seed))

    def __enter__(self) -> "_Recorder":
        return self

    def __exit__(self, *error: object) -> None:
        pass


def as_record(run: PegRun, seed: int) -> dict[str, Any]:
    """A run as plain values: how it ended, its settings, and every motion."""
    motions = [
        {
            "kind": _KINDS[felt.kind],
            "begun_s": felt.begun_s,
            "ended_s": felt.ended_s,
            "path": felt.path.tolist(),
            "point": felt.point.tolist(),
            "normal": felt.normal.tolist(),
        }
        for felt in (*run.searched, *run.felt)
    ]
    decisions = [
        {
            "begun_s": thought.begun_s,
            "ended_s": thought.ended_s,
            "gain": thought.selection.gain,
            "evaluated": thought.selection.evaluated,
            "skipped": thought.selection.skipped,
            "late_s": thought.selection.late_s,
        }
        for thought in run.thoughts
    ]
    return {
        "seed": seed,
        "truth": run.truth.tolist(),
        "holes_m": None if run.aim is None else run.aim.points.tolist(),
        **run.as_dict(),
        "settings": run.settings.as_dict(),
        "motions": motions,
        "decisions": decisions,
    }


def summary(run: PegRun) -> list[str]:
    """A few lines on how a run ended."""
    ended: str = "not sure" if run.stopped_by == "steps" else run.stopped_by
    if run.stopped_by == "nothing to do":
        weighed = run.thoughts[-1].selection.evaluated
        ended = "nothing more that a touch would tell" if weighed else "no time for any motion"
    found = run.as_dict()
    touches = f"{found['touches']} touch{'es' if found['touches'] != 1 else ''}"
    lines = [f"{ended} after {touches}"]
    if run.inserted is not None:
        place = "in the hole" if run.in_hole else "beside the hole"
        lines[0] += f", {place} by {found['off_mm']:.1f} mm from its middle"
    if run.aim is not None:
        within = f"within {1e3 * run.settings.tolerance_m:g}"
        off = f"off by {found['hole_error_mm']:.1f} mm at most"
        lines.append(f"holes    {off}; believed {found['probability']:.2f} {within}")
    said = f"{found['search_s']:.0f} search, {found['thinking_s']:.0f} reasoning"
    lines.append(f"seconds  {found['total_s']:.0f}: {said}; {found['evaluated']} candidates weighed")
    return lines
