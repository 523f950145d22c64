"""`rumi run touch-box`: one run of touch alone, its folder and its figures."""

import math
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from rumi.commands.progress import say
from rumi.errors import UsageError
from rumi.exit_codes import DONE, NOT_CONVERGED
from rumi.runs.folder import free_folder, left_if_begun, prepare_folder, write_json
from rumi.runs.jsonlines import append_line
from rumi.tasks.touch_box.build import Robot
from rumi.tasks.touch_box.scene import TouchTask
from rumi.tasks.touch_box.settings import TouchSettings

NAME = "touch-box"
DESCRIPTION = "a box in one of two places that only touch can tell, to be found, grasped and lifted"

_HELP = """Find a box by touch alone and lift it, in simulation.

    rumi run touch-box
    rumi run touch-box --method entropy --seed 3
    rumi run touch-box --push-model displacement --robot planar
    rumi run touch-box --budget 0.1
    rumi run touch-box --task.rates 0.9 0.05 --task.correlation 0.5

Ends with exit code 0 if the box was lifted, 1 if not."""


@dataclass(frozen=True)
class TouchRunOptions:
    """Options of `rumi run touch-box`.

    Attributes:
        settings: of the run.
        task: the scene and its readings.
        robot: that pokes and grasps.
        seed: of where the box stands and of all randomness.
        out: folder of the run; by default runs/touch-box-METHOD-ROBOT-sSEED, with a number where that is taken.
        figures: draw figures at the end.
        budget: seconds for the choice of each poke: of the candidates as many are weighed as there is time for.
    """

    settings: Annotated[TouchSettings, tyro.conf.arg(name="")] = field(default_factory=TouchSettings)
    task: TouchTask = field(default_factory=TouchTask)
    robot: Robot = "gripper"
    seed: int = 0
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    figures: bool = True
    budget: float | None = None


def run_touch(arguments: Sequence[str], *, cache_dir: Path | None) -> int:
    """Carry out `rumi run touch-box`; `arguments` are those after the name."""
    options = tyro.cli(TouchRunOptions, prog=f"rumi run {NAME}", description=_HELP, args=arguments)
    if options.budget is not None and not 0 < options.budget < math.inf:
        raise UsageError(f"Expected --budget above 0 s and finite, got {options.budget}")
    from rumi.tasks.touch_box.agent import TouchStep, localise, signals
    from rumi.tasks.touch_box.budget import BudgetedChoice
    from rumi.tasks.touch_box.build import check_robot, make_toucher
    from rumi.tasks.touch_box.report import figures_of, step_of

    check_robot(options.task, options.robot)
    folder = options.out or free_folder(
        Path("runs") / f"{NAME}-{options.settings.method}-{options.robot}-s{options.seed}"
    )
    prepare_folder(folder)
    say(f"{NAME} with {options.settings.method}, {options.robot}, seed {options.seed}; writing to {folder}")
    say("grasps are simulated once and kept (a minute at first)")
    with left_if_begun(folder):
        toucher = make_toucher(options.task, options.settings, options.robot, cache_dir=cache_dir)
    asked: dict[str, object] = {
        "settings": asdict(options.settings),
        "task": asdict(options.task),
        "robot": options.robot,
    }
    asked |= {"seed": options.seed} | ({} if options.budget is None else {"budget_s": options.budget})
    write_json(folder / "settings.json", asked)
    count = 0

    def told(step: TouchStep) -> None:
        nonlocal count
        count += 1
        append_line(folder / "steps.jsonl", step_of(step))
        empty = "out of reach" if step.touched.blocked is None else "blocked"
        readings = signals(step.touched.contact) or empty
        say(f"poke {count:2}: {readings:<{options.task.readings}}  lifted with {step.grasp.probability:.2f}")

    try:
        decide = None if options.budget is None else BudgetedChoice(toucher, options.budget)
        run = localise(toucher, seed=options.seed, on_step=told, decide=decide)
    except KeyboardInterrupt:
        say(f"{count} poke{'s' * (count != 1)} done so far: see {folder}")
        raise
    finally:
        toucher.robot.close()
    found = figures_of(run)
    write_json(folder / "result.json", found)
    if options.figures:
        from rumi.tasks.touch_box.figures import draw_run

        for path in draw_run(run, toucher, folder):
            say(f"figure {path}")
    ended = "sure" if run.sure else "not sure"
    sys.stdout.write(
        f"{NAME}: {ended} after {found['actions']} pokes, {'lifted' if run.lifted else 'not lifted'}\n"
        f"  grasp    believed {found['believed']:.2f}; off by {found['error_mm']:.1f} mm and "
        f"{found['error_deg']:.1f} degrees\n"
        f"  seconds  {math.fsum(run.seconds.values()):.1f}: "
        f"{', '.join(f'{name} {value:.1f}' for name, value in run.seconds.items())}\n"
        f"  folder   {folder}\n"
    )
    return DONE if run.lifted else NOT_CONVERGED
