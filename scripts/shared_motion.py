"""Figure of one run believed twice: by one motion for all particles, and by a motion for each.

    python -m scripts.shared_motion --seed 1050 --out scripts/docs/figures/shared_motion.png

Nothing measures the motion of a drawn mug; `--filter.motion corrected` follows it until that is sure. The same readings
are then taken in by `--filter.motion trajectory`, which goes on by its own actions until it is sure itself. Prints how
far off both are, and draws both beliefs over the truth.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from rumi.cache import cache_folder
from rumi.cli import script
from rumi.clock import Clock
from rumi.metrics.pose_error import pose_error
from rumi.records import StepRecord
from rumi.runs.scene_geometry import SceneGeometry
from rumi.tasks.rummage.agent import Rummager, RummageState
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.geometry import scene_geometry
from rumi.tasks.rummage.settings import Settings, preset
from rumi.viz import style
from rumi.viz.scene import draw_particles, draw_truth, interesting
from scripts.experiment import FIGURES
from scripts.outcomes import by_chance, unmeasured

STEPS = 25
SHARED, OWN = "corrected", "trajectory"


@dataclass(frozen=True)
class Options:
    """Which scene, and where the figure goes."""

    seed: int = 1050
    out: Path = FIGURES / "shared_motion.png"


def settings_of(motion: str, seed: int) -> Settings:
    """Settings of a run in which nothing measures the object's motion."""
    own = preset(task="mug", seed=seed, steps=STEPS, conditions="ideal", **{"filter.motion": motion})
    return by_chance(own) if motion == OWN else unmeasured(own)


def believed(seed: int) -> tuple[list[StepRecord], list[StepRecord], Rummager]:
    """Steps by one motion, then of the same readings and what follows by a motion each; the latter's agent."""
    with (
        build(settings_of(SHARED, seed), cache_dir=cache_folder()) as (task, shared),
        build(settings_of(OWN, seed), cache_dir=cache_folder()) as (_, own),
    ):
        clock, first = Clock(), task.reset(seed)
        states: list[RummageState] = [agent.begin(first, seed=seed, clock=clock) for agent in (shared, own)]
        for k, agent in enumerate((shared, own)):
            while agent.stop(states[k]) is None and states[k].record.step < STEPS:
                states[k], control = agent.act(states[k])
                result = task.step(control)
                states = [
                    state if by is shared and agent is own else by.update(state, control, result)
                    for by, state in zip((shared, own), states, strict=True)
                ]
    return list(states[0].history), list(states[1].history), own


def off(step: StepRecord, agent: Rummager) -> tuple[float, float]:
    """Error of a step's best pose, mm and degrees."""
    assert step.truth is not None
    metres, radians = pose_error(step.belief.mode(), step.truth, agent.model.symmetries)
    return 1e3 * float(metres), 57.29578 * float(radians)


def draw(shared: Sequence[StepRecord], own: Sequence[StepRecord], agent: Rummager, path: Path) -> Path:
    """Both beliefs: at the first touch, halfway, where the shared one is sure, and at the end."""
    geometry: SceneGeometry = scene_geometry(agent)
    touch = next((step.step for step in own if step.contacts), 0)
    last = shared[-1].step
    shown = sorted({touch, (touch + last) // 2, last, own[-1].step})
    extent = interesting([own[k] for k in shown] + [shared[k] for k in shown if k < len(shared)], geometry, 0.02)
    with style.figure(3.0 * len(shown), 6.4) as figure:
        rows = figure.subplots(2, len(shown), sharex=True, sharey=True)
        for name, steps, axes in (("one motion for all", shared, rows[0]), ("a motion for each", own, rows[1])):
            axes[0].set_ylabel(f"{name}\ny [m]")
            for k, ax in zip(shown, axes, strict=True):
                ax.set(xlim=extent[:2], ylim=extent[2:], aspect="equal")
                if k >= len(steps):
                    ax.set_axis_off()
                    continue
                draw_particles(steps[k], geometry, ax, 40)
                draw_truth(steps[k], geometry, ax)
                mm, deg = off(steps[k], agent)
                said = "first view" if k == 0 else f"action {k}"
                sure = ", sure" if steps[k].converged else ""
                ax.set_title(f"{said}: {mm:.1f} mm, {deg:.0f} deg off{sure}", fontsize=8)
        for ax in rows[1]:
            ax.set_xlabel("x [m]")
        return style.save(figure, path)


def main(options: Options) -> None:
    """Run, print and draw."""
    shared, own, agent = believed(options.seed)
    for name, steps in ((SHARED, shared), (OWN, own)):
        for k in sorted({shared[-1].step, steps[-1].step}):
            mm, deg = off(steps[k], agent)
            sys.stdout.write(f"{name}, action {k}: {mm:.1f} mm, {deg:.1f} deg off; sure: {steps[k].converged}\n")
    draw(shared, own, agent, options.out)


if __name__ == "__main__":
    script(lambda: main(tyro.cli(Options, description=__doc__)))
