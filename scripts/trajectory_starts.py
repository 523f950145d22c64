"""Pushes of recorded episodes from their true starts, and the filter alone on their readings.

python -m scripts.trajectory_starts record --seeds 1000-1039   # closed loops of `mug`: their readings and true poses
python -m scripts.trajectory_starts pushes --seeds 1000-1039 --set filter.trajectories.tool_spacing_m=0.005
python -m scripts.trajectory_starts replay --seeds 1000-1039   # the filter on the readings of each
python -m scripts.trajectory_starts show

A push is replayed from the true pose before it: by the medians of the motion prior, and by draws of it, whose regions
are held against the true pose after it. It is one by two sides where the tool touches two places whose normals differ.
"""

import functools
import math
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
import tyro
from torch import Tensor

from rumi.belief.pose_trajectories import NOISE, PHYSICS, Trajectories
from rumi.belief.pose_trajectory_filter import PoseTrajectoryFilter
from rumi.belief.pushed_object import PushedObject
from rumi.belief.segments import cut, path_of
from rumi.belief.trajectory_history import History, Segment
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.cli import script
from rumi.dynamics.sliding import rotated
from rumi.loop import run
from rumi.metrics.calibration import SHARES, calibration_error, chance_error, checked, covered
from rumi.metrics.pose_error import pose_error
from rumi.records import StepRecord
from rumi.robot.gripper import GripperShape
from rumi.seeding import generator, split
from rumi.sim.world import Track
from rumi.task import StepResult
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.first_belief import first_belief
from scripts.reproduce.seeds import seeds_of
from scripts.store import Figures, Store
from scripts.trajectory_runs import DEFAULTS, settings_of
from scripts.trajectory_runs import Options as RunOptions
from sdf import se3
from sdf.so3 import wrap

RESULTS = Path(__file__).parent / "results" / "trajectory_starts.jsonl"
_DRAWS, _NEIGHBOUR = 600, 12
_M, _RAD = 1e-3, math.radians(1.5)  # that count as equal distances
_KERNEL = 1.5  # of the predictive density, in these
_MOVED_M, _TURNED = 0.003, math.radians(3.0)  # a push that counts
_TOUCHES_M, _APART_M, _NORMALS, _INSTANTS = 6e-4, 0.01, math.cos(math.radians(30.0)), 2  # of two sides


@dataclass(frozen=True)
class Options:
    """What is done.

    Attributes:
        command: "record" runs closed loops, "pushes" and "replay" work on them, "show" prints what is there.
        seeds: such as 1000-1009.
        set: settings, as name=number.
        results: file of the figures.
        folder: of the recorded episodes.
    """

    command: tyro.conf.Positional[Literal["record", "pushes", "replay", "show"]]
    seeds: str = "1000-1039"
    set: tuple[str, ...] = ()
    results: Path = RESULTS
    folder: Path = Path("runs/trajectory_starts")


def recorded(options: Options, seed: int) -> Figures:
    """A closed loop whose readings and true poses are kept."""
    readings: list[Any] = []
    tracks: list[Tensor] = []
    moved: list[Tensor] = []
    with build(settings_of(RunOptions(set=options.set), "trajectory", seed), cache_dir=Path("runs/cache")) as both:
        task, agent = both
        reset = task.reset

        def begun(number: int) -> StepResult:
            out, move = reset(number), task.world.move

            def watched(*args: Any) -> Track:  # noqa: ANN401
                track = move(*args)
                moved.append(track.world_T_object.clone())
                return track

            task.world.move = watched
            return out

        def note(step: StepRecord) -> None:
            assert step.truth is not None
            readings.append(step.reading)
            tracks.append(moved[-1] if step.step else step.truth.double()[None])

        task.reset = begun
        ended = run(task, agent, seed=seed, on_step=note)
    options.folder.mkdir(parents=True, exist_ok=True)
    torch.save((readings, tracks), options.folder / f"mug-{seed}.pt")
    return {"stopped_by": ended.stopped_by, "actions": len(readings) - 1}


def pushes(options: Options, seed: int) -> Figures:
    """Every push of an episode that moved the object, from its true start."""
    follow, readings, tracks = _opened(options, seed)
    model = follow.model
    assert isinstance(model, PushedObject)
    found = []
    for before, track, reading in zip(tracks, tracks[1:], readings[1:], strict=False):
        start, true = se3.to_planar(before[-1]).double(), se3.to_planar(track).double()
        step = _off(true[-1:], start)[0]
        if not reading.in_contact.any() or (step[:2].norm() < _MOVED_M and step[2].abs() < _TURNED):
            continue
        path = path_of(reading, model)
        ends = drawn_ends(model, follow.own, path, cut(reading, follow.own), start)
        off = _off(ends, true[-1])
        scaled = off[1:] / off.new_tensor((_M, _M, _RAD))
        apart = torch.cdist(*2 * (torch.cat((scaled, scaled.new_zeros(1, 3))),)).fill_diagonal_(torch.inf)
        radius = apart.kthvalue(_NEIGHBOUR, -1).values
        density = torch.logsumexp(-0.5 * (scaled / _KERNEL).square().sum(-1), 0) - math.log(len(scaled))
        found.append(
            {
                "two": two_sides(model, true, path[:, 1]) >= _INSTANTS,
                "mm": round(1e3 * float(off[0, :2].norm()), 2),
                "deg": round(math.degrees(abs(float(off[0, 2]))), 2),
                "level": round(float((radius[:-1] < radius[-1]).double().mean()), 3),
                "nats": round(float(density), 2),
            }
        )
    return {"pushes": found}


def drawn_ends(
    model: PushedObject, own: PoseTrajectorySettings, path: Tensor, parts: Sequence[Tensor], start: Tensor
) -> Tensor:
    """Poses after an action, by the medians of the motion prior and by draws of it."""
    history, none = History.empty(), torch.zeros(0, dtype=torch.long)
    for part in parts:
        flat = torch.zeros(0, dtype=torch.float64)
        history = history.appended(Segment(path[part], True, flat.view(0, 3), none, none, flat), opens=not len(history))
    random, count = generator(0), 1 + _DRAWS
    physics = torch.randn(count, PHYSICS, generator=random, dtype=torch.float64)
    noise = torch.randn(count, len(history), NOISE, generator=random, dtype=torch.float64)
    physics[0], noise[0] = 0.0, 0.0
    poses = start.repeat(count, len(history) + 1, 1)
    given = Trajectories(physics, noise, poses, poses.new_zeros(count, len(history)), history, start[None][:0])
    return given.replayed(model, own, history, torch.zeros(count, dtype=torch.long)).pose


def two_sides(model: PushedObject, true: Tensor, tool: Tensor) -> int:
    """Instants in which the tool, where object and tool truly were, touched two places with normals apart."""
    border, count = GripperShape().outline(1e-3).to(tool), 0
    for pose, at in zip(true, tool, strict=True):
        placed = at[:2] + rotated(border, at[2].expand(len(border)))
        local = rotated(placed - pose[:2], -pose[2].expand(len(border)))
        distance, gradient = model.outline(local)
        near = distance < _TOUCHES_M
        if not bool(near.any()):
            continue
        normal = gradient / gradient.norm(dim=-1, keepdim=True).clamp_min(1e-9)
        first = distance.argmin()
        other = ((local - local[first]).norm(dim=-1) > _APART_M) & (normal @ normal[first] < _NORMALS)
        count += bool((near & other).any())
    return count


def replayed(options: Options, seed: int) -> Figures:
    """The filter alone on an episode's readings: its updates after the first contact."""
    readings, tracks = torch.load(options.folder / f"mug-{seed}.pt", weights_only=False)
    steps: list[dict[str, Any]] = []
    contacts = 0
    with build(settings_of(RunOptions(set=options.set), "trajectory", seed), cache_dir=Path("runs/cache")) as (
        _,
        agent,
    ):
        near = {"within_m": agent.position_tolerance_m, "within_rad": agent.rotation_tolerance_rad}
        random = split(seed, "replay 0")
        belief, memory = first_belief(agent, readings[0], generator=random)
        for reading, track in zip(readings[1:], tracks[1:], strict=True):
            began = time.process_time()
            belief, memory, _ = agent.filter(belief, memory, reading, generator=random)
            seconds = time.process_time() - began
            contacts += bool(reading.in_contact.any())
            if not contacts:
                continue
            truth = track[-1].to(belief.log_weights)
            held = checked(belief, truth, agent.model.symmetries, **near)
            metres, _ = pose_error(belief.mode(), truth, agent.model.symmetries)
            step: dict[str, Any] = {
                "contacts": contacts,
                "touched": bool(reading.in_contact.any()),
                "right": held.right,
            }
            step |= {"mm": round(1e3 * float(metres), 2), "cpu_s": round(seconds, 4)}
            steps.append(step | {name: round(getattr(held, name), 4) for name in ("p_right", "both", "place", "turn")})
    return {"updates": steps}


def _opened(options: Options, seed: int) -> tuple[PoseTrajectoryFilter, list[Any], list[Tensor]]:
    readings, tracks = torch.load(options.folder / f"mug-{seed}.pt", weights_only=False)
    with build(settings_of(RunOptions(set=options.set), "trajectory", seed), cache_dir=Path("runs/cache")) as (
        _,
        agent,
    ):
        follow = agent.filter
    assert isinstance(follow, PoseTrajectoryFilter)
    return follow, readings, tracks


def _off(poses: Tensor, truth: Tensor) -> Tensor:
    apart = poses - truth
    return torch.cat((apart[:, :2], wrap(apart[:, 2:])), -1)


def _tail(values: Sequence[float]) -> str:
    ordered = sorted(values)
    tail = ordered[min(len(ordered) - 1, int(0.9 * len(ordered)))]
    return f"{statistics.median(ordered):.1f}; {statistics.mean(ordered):.1f}; {tail:.1f}"


def tables(lines: Sequence[Figures]) -> str:
    """Markdown of what was measured, by settings."""
    out = []
    for command, head, row in (
        ("pushes", "pushes | mm: median; mean; 90 % | degrees | 50, 90, 95, 99 % hold | nats", _of_pushes),
        ("replay", "updates | mm | 50, 90, 95, 99 % hold | place | turn | P(right) errs | seconds; most", _of_updates),
    ):
        own = [line for line in lines if line["command"] == command]
        if own:
            out += [f"| settings | episodes | {head} |", "|-" * (3 + head.count("|")) + "|"]
        for label in dict.fromkeys((line["defaults"], *line["set"]) for line in own):
            some = [line for line in own if (line["defaults"], *line["set"]) == label]
            out += [f"| {' '.join(label)} | {len(some)} | {text} |" for text in row(some)]
    return "\n".join((*out, ""))


def _of_pushes(lines: Sequence[Figures]) -> list[str]:
    every = [push for line in lines for push in line["pushes"]]
    out = []
    for name, some in (("", every), (" by two sides", [push for push in every if push["two"]])):
        if some:
            holds = ", ".join(f"{100 * covered([push['level'] for push in some], share):.0f}" for share in SHARES)
            mm, deg = (_tail([push[key] for push in some]) for key in ("mm", "deg"))
            nats = statistics.mean(max(push["nats"], -60.0) for push in some)
            out.append(f"{len(some)}{name} | {mm} | {deg} | {holds} % | {nats:.2f}")
    return out


def _of_updates(lines: Sequence[Figures]) -> list[str]:
    every = [step | {"episode": k} for k, line in enumerate(lines) for step in line["updates"]]
    select: tuple[tuple[str, Callable[[dict[str, Any]], bool]], ...] = (
        ("", lambda _: True),
        (" of contacts 1 to 3", lambda step: step["contacts"] <= 3),
        (" of later ones", lambda step: step["contacts"] > 3),
    )
    out = []
    for name, chosen in select:
        some = [step for step in every if chosen(step)]
        if not some:
            continue
        holds = [
            ", ".join(f"{100 * covered([step[key] for step in some], share):.0f}" for share in SHARES)
            for key in ("both", "place", "turn")
        ]
        p, right = [step["p_right"] for step in some], [step["right"] for step in some]
        cpu = sorted(step["cpu_s"] for step in some if step["touched"]) or [0.0]
        chance = chance_error(p, groups=[(step["episode"], step["contacts"]) for step in some])
        errs = f"{calibration_error(p, right):.3f} ({chance:.3f})"
        mm = _tail([step["mm"] for step in some])
        out.append(f"{len(some)}{name} | {mm} | {' | '.join(holds)} | {errs} | {cpu[len(cpu) // 2]:.2f}; {cpu[-1]:.2f}")
    return out


def main() -> None:
    """Do what is missing, then print."""
    options = tyro.cli(Options, description=__doc__)
    store, seeds = Store(options.results), seeds_of(options.seeds)
    works = {"record": recorded, "pushes": pushes, "replay": replayed}
    for seed in seeds if options.command != "show" else ():
        work = works[options.command]
        settings = {"part": "mug", "command": options.command, "seed": seed, "set": list(options.set)}
        settings |= {"defaults": DEFAULTS}
        if options.command == "record" or (options.folder / f"mug-{seed}.pt").is_file():
            store.measure(settings, functools.partial(work, options, seed))
    lines = [line for line in store.of("mug") if line["seed"] in seeds]
    sys.stdout.write(tables(lines))


if __name__ == "__main__":
    script(main)
