"""How error and doubt grow along a way: real pushes of a square, the slider's pose known at the start alone.

python -m scripts.long_pushes run     # needs RUMI_DATA; again to go on
python -m scripts.long_pushes show

Stretches without knocks of the runs of github.com/mcubelab/cpush; "learnt" has seen ten of 50 mm of the other runs.
"""

from collections.abc import Mapping
from typing import Any

import torch

from rumi.cli import script
from rumi.dynamics.push_posterior import PushPosterior
from rumi.seeding import split
from scripts.bench.real_pushes import fixed, long_pushes, square_body
from scripts.experiment import Experiment, Line
from scripts.reproduce.cells import table

FIXED = {"lever 1.5 friction 0.5": (0.5, 1.5), "lever 1.0 friction 0.2": (0.2, 1.0)}
MODELS = (*FIXED, "library prior", "learnt")
WAYS = ("50 mm", "100 mm", "200 mm", "300 mm")
_LEARNT = 10


def measure(model: str, way: str) -> dict[str, Any]:
    """Mean errors, and the share of stretches that regions of 90 % hold."""
    length = 1e-3 * float(way.split()[0])
    body, errors, turns, levels = square_body(), [], [], []
    for run, push in long_pushes(length, round(500 * length) + 1):
        generator = split(0, f"long pushes {run}")
        posterior = fixed(*FIXED[model]) if model in FIXED else PushPosterior.prior(128)
        if model == "learnt":
            others = [own for name, own in long_pushes(0.05, 26) if name != run]
            chosen = torch.randperm(len(others), generator=generator)[:_LEARNT].tolist()
            posterior = posterior.update([others[i] for i in chosen], body, generator)
        shown = posterior.predict(push.start[None], push.path[None], body)
        off = shown.mean()[0] - push.end
        errors.append(1e3 * float(off[:2].norm()))
        turns.append(float(off[2].abs().rad2deg()))
        levels.append(float(shown.level(push.end[None], generator)))
    held = {} if model in FIXED else {"held_0.9": sum(level <= 0.9 for level in levels) / len(levels)}
    return {"stretches": len(errors), "mm": sum(errors) / len(errors), "degrees": sum(turns) / len(turns)} | held


def show(lines: list[Line], chosen: Mapping[str, tuple[Any, ...]]) -> str:
    """A row for each model: mean errors by way."""
    found = {(line["model"], line["way"]): line for line in lines}
    rows = []
    for model in chosen.get("model", MODELS):
        own = [found.get((model, way)) for way in WAYS]
        rows.append([model, *("-" if line is None else _cell(line) for line in own)])
    heads = [f"{way} ({found[MODELS[0], way]['stretches']})" if (MODELS[0], way) in found else way for way in WAYS]
    return table(("model", *heads), rows)


def _cell(line: Line) -> str:
    held = f"; {100 * line['held_0.9']:.0f} %" if "held_0.9" in line else ""
    return f"{line['mm']:.1f} mm, {line['degrees']:.1f} degrees{held}"


EXPERIMENT = Experiment(__doc__, "long_pushes.jsonl", {"model": MODELS, "way": WAYS}, measure, show)

if __name__ == "__main__":
    script(EXPERIMENT.main)
