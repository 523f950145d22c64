"""The command `rumi leaderboard`: how a policy does on a task, beside those that were tried before."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from rumi.cache import cache_folder
from rumi.errors import UsageError
from rumi.exit_codes import DONE
from rumi.runs.jsonlines import append_line, check_writable
from rumi.runs.progress import say
from sdf.extras import optional


@dataclass(frozen=True)
class LeaderboardOptions:
    """Carry out a policy's runs on a task and rank it: right, sure and wrong, actions, CPU time of a decision.

    A policy is a Python file with a function act(observation) that gives the control, each number in [-1, 1]; VIEW in
    it names what it sees: "particles" (default), "image" or "reading"; start(seed) is called before each run.
    Conditions are ideal, as those of the boards of before.

    Attributes:
        policy: file of the policy, or `rumi` for the own planner.
        task: a rummaging task; "mug", "drill" and "box" draw a scene by the seed.
        seeds: first seed and number of runs.
        preset: of the settings.
        board: file of scores, a JSON line each; the policy's is added.
    """

    policy: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="POLICY.py")]
    task: str = "mug"
    seeds: Annotated[tuple[int, int], tyro.conf.arg(metavar="FIRST COUNT")] = (0, 10)
    preset: str = "default"
    board: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None


def leaderboard(arguments: Sequence[str]) -> int:
    """`rumi leaderboard`: 0 once all runs are done, 2 for bad input."""
    options = tyro.cli(LeaderboardOptions, prog="rumi leaderboard", args=arguments)
    first, count = options.seeds
    if first < 0 or count < 1:
        raise UsageError(f"Expected seeds to be a first seed of 0 or more and 1 or more runs, got {first} {count}")
    optional("gymnasium", "A leader board")
    from rumi.api import build
    from rumi.environments.leaderboard import OWN, load_policy, read_board, score, table
    from rumi.seeding import check_seed
    from rumi.tasks.rummage.scenes import find_task
    from rumi.tasks.rummage.settings import preset

    check_seed(first + count - 1, "the last of the seeds")
    before = [] if options.board is None else read_board(options.board)
    if options.board is not None:
        check_writable(options.board)
    path = None if options.policy == OWN else Path(options.policy)
    if path is not None:
        load_policy(path)  # what is none is refused before anything is built
    find_task(options.task)
    settings = preset(options.preset, task=options.task, conditions="ideal")
    with build(settings, cache_dir=cache_folder()) as parts:
        new = score(
            parts.task,
            parts.agent,
            path,
            name=options.task,
            preset=options.preset,
            instants=settings.simulator.mini_steps,
            seeds=range(first, first + count),
            on_run=lambda seed, result: say(f"seed {seed}: {result.stopped_by}, right {result.right}"),
        )
    same = [one for one in before if (one.task, one.preset, one.seeds) == (new.task, new.preset, new.seeds)]
    sys.stdout.write(f"{new.task}, seeds {first} to {first + count - 1}, preset {new.preset}\n{table([*same, new])}")
    if options.board is not None:
        append_line(options.board, new.line())
    return DONE
