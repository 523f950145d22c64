"""The command `rumi pushes`: how an object slides, learnt from the pushes of a run."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import torch
import tyro

from rumi.cache import cache_folder
from rumi.errors import UsageError
from rumi.exit_codes import DONE
from sdf.extras import optional

_SHARES = (0.5, 0.05, 0.95)  # quantiles that are printed

if TYPE_CHECKING:
    from rumi.dynamics.push_posterior import PushPosterior
    from rumi.dynamics.pushed_body import ObservedPush, PushedBody
    from rumi.runs.folder import Run
    from rumi.tasks.rummage.agent import Rummager


@dataclass(frozen=True)
class PushesOptions:
    """Learn friction and limit surface of an object from the pushes of a run, whose outcome was measured or seen again.

    Prints what is believed of them before and after, and how far predicted pushes are from the real ones. The file that
    --out writes is what `rumi run --planner.push-parameters FILE` plans with, and --pushes goes on from.

    Attributes:
        run: folder of a rummaging run; or a log, which is replayed.
        pushes: file of what was learnt before; by default the prior, from real objects.
        out: file for what is believed then.
        figure: picture for it.
        seed: of the draws.
    """

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN|LOG")]
    pushes: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    figure: Annotated[Path | None, tyro.conf.arg(metavar="PNG")] = None
    seed: int = 0


def learnt(run: "Run", before: "PushPosterior", *, seed: int) -> "tuple[list[ObservedPush], PushedBody, PushPosterior]":
    """Pushes of a run, its object and tool, and the posterior over push parameters after them.

    Raises:
        UsageError: the run is none of a level tool, its motions are no one's but the push model's, or nothing touched.
    """
    from rumi.belief.measured_pushes import measured_pushes
    from rumi.dynamics.pushed_body import PushedBody
    from rumi.seeding import split
    from rumi.tasks.registry import entry_of

    entry = entry_of(run)
    agent = level_rummager(entry.agent(entry.from_dict(run.settings), cache_dir=cache_folder()), run.task)
    told = all(step.reading.object_motion is not None for step in run.steps[1:])
    if not told and agent.filter.settings.motion not in ("estimated", "corrected"):
        raise UsageError("Expected motions that were measured or seen again, got the push model's own")
    found = measured_pushes([(step.belief, step.reading) for step in run.steps])
    if not found:
        raise UsageError(f"Expected a run that touched the object, got none in {len(run.steps) - 1} actions")
    body = PushedBody.of(agent.model.sdf, agent.tool.height_m - agent.height_m, agent.tool.shape)
    return found, body, before.update(found, body, split(seed, "pushes"))


def level_rummager(agent: object, task: str) -> "Rummager":
    """The agent of a task whose pushes tell of push parameters.

    Raises:
        UsageError: it is another.
    """
    from rumi.tasks.rummage.agent import Rummager

    if not isinstance(agent, Rummager) or agent.tool.spatial:
        raise UsageError(f"Expected a rummaging run with a level tool, got {task}: no other tells of its pushes so")
    return agent


def pushes(arguments: Sequence[str]) -> int:
    """`rumi pushes`: 0 if something was learnt, 2 for bad input."""
    options = tyro.cli(PushesOptions, prog="rumi pushes", args=arguments)
    from rumi.commands.replayed import run_folder
    from rumi.dynamics.push_limits import held_twice
    from rumi.dynamics.push_posterior import PushPosterior
    from rumi.runs.files import whole_file
    from rumi.runs.folder import load_run
    from rumi.runs.jsonlines import check_writable

    if options.figure is not None:
        optional("matplotlib", "A figure")
    for path in (options.out, options.figure):
        if path is not None:
            check_writable(path)
    if options.out is not None and options.out.is_file():
        PushPosterior.load(options.out)  # refuses another kind of file, which would be lost
    before = PushPosterior.prior() if options.pushes is None else PushPosterior.load(options.pushes)
    with run_folder(options.run) as folder:
        found, body, after = learnt(load_run(folder), before, seed=options.seed)
    write = sys.stdout.write
    write(f"{len(found)} pushes; median [5 %, 95 %]\n")
    for name, own in (("before", before), ("after", after)):
        friction, lever = own.quantiles(_SHARES)[:, :2].exp().T.tolist()
        scale = own.scale_quantiles(_SHARES).tolist()
        ends, starts = torch.stack([push.end for push in found]), torch.stack([push.start for push in found])
        shown = [own.predict(push.start[None], push.path[None], body) for push in found]
        off = torch.cat([part.mean() for part in shown]) - ends
        density = torch.cat([part.log_density(end[None]) for part, end in zip(shown, ends, strict=True)]).mean()
        write(
            f"{name}: friction {friction[0]:.2f} [{friction[1]:.2f}, {friction[2]:.2f}], "
            f"lever {lever[0]:.2f} [{lever[1]:.2f}, {lever[2]:.2f}] of even pressure's, "
            f"residual {scale[0]:.2f} [{scale[1]:.2f}, {scale[2]:.2f}] of other objects'; "
            f"{1e3 * off[:, :2].norm(dim=-1).mean():.1f} mm and {off[:, 2].abs().mean().rad2deg():.1f} degrees off "
            f"(the object went {1e3 * (ends - starts)[:, :2].norm(dim=-1).mean():.0f} mm), log density {density:.2f}\n"
        )
    twice = held_twice(ends, torch.stack([push.path[-1] for push in found]), body)
    if bool(twice.any()):
        write(f"{int(twice.sum())} end with the tool at two sides of the object, which is outside of the model\n")
    if options.out is not None:
        with whole_file(options.out) as aside:
            after.save(aside)
        write(f"{options.out}\n")
    if options.figure is not None:
        from rumi.viz.pushes import push_figure

        push_figure([before, after], ("before", "after"), found, body, options.figure)
        write(f"{options.figure}\n")
    return DONE
