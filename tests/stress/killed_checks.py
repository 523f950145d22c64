"""What a killed command may leave: all that it had said, as an undisturbed one says it, and nothing half-written."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch

from rumi.errors import UsageError
from rumi.records import StepRecord
from rumi.runs.folder import Run, load_run
from rumi.runs.jsonlines import read_lines
from sdf.cache import load_arrays


def check_run(folder: Path, said: int, whole: Run) -> None:
    """A run's folder holds all steps that were said, and no step or result that the undisturbed run has not."""
    for name in ("object.json", "settings.json"):
        if (folder / name).exists():
            json.loads((folder / name).read_text())
    belief = folder / "belief.npz"
    if belief.exists() and load_arrays(belief, ("poses", "log_weights", "stamp", "frame")) is None:
        raise AssertionError("half a belief was believed")
    try:
        run = load_run(folder)
    except UsageError as error:
        if said or (folder / "result.json").exists():
            raise AssertionError(f"a run that had {said} steps cannot be read: {error}") from error
        return
    if not said <= len(run.steps) <= len(whole.steps):
        raise AssertionError(f"of {said} steps {len(run.steps)} are left")
    for mine, right in zip(run.steps, whole.steps, strict=False):
        if not _same_step(mine, right):
            raise AssertionError(f"step {mine.step} is not that of the undisturbed run")
    if run.result is not None and whole.result is not None:
        figures = [{**result.as_dict(), "timings_s": None} for result in (run.result, whole.result)]
        if figures[0] != figures[1]:
            raise AssertionError("the result is not that of the undisturbed run")


def _same_step(a: StepRecord, b: StepRecord) -> bool:
    """Whether two steps are the same, bit for bit."""
    pairs = [(a.belief.world_T_object, b.belief.world_T_object), (a.belief.log_weights, b.belief.log_weights)]
    pairs.append((a.reading.observation.points, b.reading.observation.points))
    if (a.control is None) != (b.control is None):
        return False
    if a.control is not None and b.control is not None:
        pairs.append((a.control, b.control))
    return a.step == b.step and all(torch.equal(x, y) for x, y in pairs)


def arrays(path: Path) -> dict[str, Any]:
    """What an .npz file holds."""
    with np.load(path, allow_pickle=False) as stored:
        return dict(stored)


def results(folder: Path) -> dict[str, dict[str, Any]]:
    """What is kept of each run, timings apart, by its id.

    Raises:
        AssertionError: one is there twice.
    """
    lines = [line for line, _ in read_lines(folder / "runs.jsonl")]
    found = {line["id"]: {name: line[name] for name in ("figures", "curves", "method", "seed")} for line in lines}
    if len(found) != len(lines):
        raise AssertionError("a result is there twice")
    return found


def check_same(found: dict[str, Any], wanted: dict[str, Any]) -> None:
    """Results are those of an undisturbed command."""
    if found != wanted:
        raise AssertionError("the results are not those of an undisturbed command")
