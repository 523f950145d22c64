"""The command `rumi result`: the answer of a run, also of one that was cut short."""

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from rumi.columns import folded
from rumi.exit_codes import DONE
from rumi.runs.plain import plain


@dataclass(frozen=True)
class ResultOptions:
    """The answer of a run: the pose, how sure it is, and why not. Of a run that was cut short that of its last step.

    Attributes:
        run: folder of the run.
        json: print JSON: pose (position, quaternion x y z w, covariance, modes), why_not, warnings and all else.
    """

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    json: bool = False


def result(arguments: Sequence[str]) -> int:
    """`rumi result`: 0 where there is an answer, sure or not; 2 for bad input."""
    options = tyro.cli(ResultOptions, prog="rumi result", args=arguments)
    from rumi.registration.pose_summary import answer_lines
    from rumi.runs.folder import load_run
    from rumi.tasks.registry import entry_of

    run = load_run(options.run)
    pose = entry_of(run).pose(run)
    ended: dict[str, Any] = dict(run.ended or {})
    last = run.steps[-1].step if run.steps else None
    reason = ended.get("why_not")
    if not ended:
        reason = "the run was cut short, or goes on" + ("" if last is None else f": after step {last}")
    if options.json:
        about = {"task": run.task, "run": str(options.run), "finished": bool(ended), "last_step": last}
        answer = {"pose": None if pose is None else pose.as_dict(), "why_not": reason}
        sys.stdout.write(json.dumps(plain(about | ended | answer), allow_nan=False) + "\n")
        return DONE
    stopped = ended.get("stopped_by", "not finished")
    lines = [f"{run.task}: {stopped}" + ("" if last is None else f" after {last} actions")]
    lines += answer_lines(pose, reason, ended.get("warnings", ()))
    if pose is None:
        lines.append("pose     not known yet")
    for remark in ended.get("remarks") or ():
        lines += folded(f"odd      {remark['name']} at action {remark['step']}: {remark['sentence']}")
    if relies_on := ended.get("relies_on"):
        lines += folded(f"relies on {relies_on}")
    sys.stdout.write("\n  ".join(lines) + "\n")
    return DONE
