"""Where trajectories in space lose the truth: episodes recorded with the true motion, and the filter held against it.

python -m scripts.space_truth record --task box --seeds 1000-1009      # closed loops, their readings and true poses
python -m scripts.space_truth replay --task box --seeds 1000-1009      # the filter alone on what was recorded
python -m scripts.space_truth show --task box
python -m scripts.space_truth touches                  # what touches do, by how far they move the object

A step says how far the best pose is off, how much of the belief lies as the object does and how much is near it, and
what the truth did. Recorded episodes are kept
in --folder, figures in --results, one line an episode; what is there is not done again.
"""

import hashlib
import itertools
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any, Literal

import torch
import tyro
from torch import Tensor

from rumi.belief.particles import PoseBelief
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.cli import script
from rumi.loop import run_to_end
from rumi.metrics.calibration import checked
from rumi.metrics.pose_error import pose_error
from rumi.records import StepRecord
from rumi.seeding import split
from rumi.task import StepResult
from rumi.tasks.rummage.agent import Rummager
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.first_belief import first_belief
from scripts.reproduce.seeds import seeds_of
from scripts.store import Figures, Store
from scripts.trajectory_runs import Options as RunOptions
from scripts.trajectory_runs import settings_of
from sdf import se3

RESULTS = Path(__file__).parent / "results" / "space_truth.jsonl"
_NEAR_M, _NEAR_RAD = 0.02, 0.3
_KNOWN, _SURE, _TILTS, _MOVED_MM = 0.8, 0.95, 3.0, (0, 3, 10, 25, 300)  # share near the truth; P; degrees; bounds
_DEFAULTS = hashlib.sha256(repr(PoseTrajectorySettings()).encode()).hexdigest()[:8]


@dataclass(frozen=True)
class Options:
    """What is done.

    Attributes:
        command: "record" runs closed loops, "replay" the filter on their readings, "show" prints what is there,
            "touches" what touches do to a belief that is about right, of all tasks, by how far they move the object.
        task: whose scenes the seeds draw.
        seeds: such as 1000-1009.
        set: settings, as name=number.
        conditions: of the scenes, by name.
        steps: actions at most.
        results: file of the figures.
        folder: of the recorded episodes.
        again: other random streams of the replayed filter, by number.
    """

    command: tyro.conf.Positional[Literal["record", "replay", "show", "touches"]]
    task: str = "box"
    seeds: str = "1000-1009"
    set: tuple[str, ...] = ()
    conditions: str = "lab"
    steps: int = 15
    results: Path = RESULTS
    folder: Path = Path("runs/space_truth")
    again: int = 0

    def runs(self) -> RunOptions:
        """As the closed loops take them."""
        return RunOptions(task=self.task, steps=self.steps, set=self.set, conditions=self.conditions)


def figures(agent: Rummager, belief: PoseBelief, now: Tensor, before: Tensor, seconds: float) -> Figures:
    """Of one step."""
    symmetries = agent.model.symmetries
    now = now.double()
    metres, radians = pose_error(belief.mode().double(), now, symmetries)
    tolerances = {"within_m": agent.position_tolerance_m, "within_rad": agent.rotation_tolerance_rad}
    held = checked(belief, now, symmetries, **tolerances)
    poses, weights = se3.renormalised(belief.world_T_object.double()), belief.log_weights.double().softmax(-1)
    some = pose_error(poses, now.expand_as(poses), symmetries)
    near = (some[0] < _NEAR_M) & (some[1] < _NEAR_RAD)
    lies = (se3.inverse(poses)[:, :3, 2] * symmetries.nearest(now.expand_as(poses), poses)[:, 2, :3]).sum(-1) > 0.9
    moved, turned = pose_error(before[None], now[None], symmetries)
    tilt = torch.acos((before[2, :3] @ now[2, :3]).clamp(-1.0, 1.0))
    return {
        "mm": round(1e3 * float(metres), 1),
        "deg": round(float(radians) * 57.2958, 1),
        "p": round(held.p_right, 3),
        "level": round(held.both, 3),
        "place": round(held.place, 3),
        "turn": round(held.turn, 3),
        "lies": round(float(weights @ lies.double()), 3),
        "near": round(float(weights @ near.double()), 3),
        "moved": round(1e3 * float(moved), 1),
        "turned": round(57.3 * float(turned), 1),
        "tilt": round(57.3 * float(tilt), 1),
        "cpu_s": round(seconds, 3),
    }


def recorded(options: Options, seed: int) -> Figures:
    """A closed loop: its readings and true poses, and the figures of its steps."""
    steps: list[dict[str, Any]] = []
    readings, tracks = [], []
    with build(settings_of(options.runs(), "trajectory", seed), cache_dir=Path("runs/cache")) as (task, agent):
        state: dict[str, Any] = {}
        timer = [0.0, 0.0]
        agent.filter.register_forward_pre_hook(lambda *_: timer.__setitem__(0, time.process_time()))
        agent.filter.register_forward_hook(lambda *_: timer.__setitem__(1, time.process_time() - timer[0]))
        reset = task.reset

        def begun(number: int) -> StepResult:
            out = reset(number)
            move = task.world.move

            def watched(*args: Any) -> Any:  # noqa: ANN401
                track = move(*args)
                state["track"] = track.world_T_object.clone()
                return track

            task.world.move = watched
            return out

        task.reset = begun

        def note(step: StepRecord) -> None:
            assert step.truth is not None
            now = step.truth.double()
            if step.step == 0:
                state["before"] = now
                track = now[None]
            else:
                track = state["track"]
            line = figures(agent, step.belief, now, state["before"], timer[1])
            line |= {"touched": bool(step.reading.in_contact.any()), "nll": round(float(step.nll or 0.0), 1)}
            line["contacts"] = step.contacts
            steps.append(line)
            readings.append(step.reading)
            tracks.append(track)
            state["before"] = now

        ended = run_to_end(task, agent, seed=seed, on_step=note)
    options.folder.mkdir(parents=True, exist_ok=True)
    torch.save((readings, tracks), options.folder / f"{options.task}-{seed}.pt")
    return {"stopped_by": ended.stopped_by, "steps": steps}


def replayed(options: Options, seed: int) -> Figures:
    """The filter alone on the readings of a recorded episode."""
    readings, tracks = torch.load(options.folder / f"{options.task}-{seed}.pt", weights_only=False)
    steps: list[dict[str, Any]] = []
    with build(settings_of(options.runs(), "trajectory", seed), cache_dir=Path("runs/cache")) as (_, agent):
        random = split(seed, f"replay {options.again}")
        belief, memory = first_belief(agent, readings[0], generator=random)
        before, contacts = tracks[0][-1], 0
        for reading, track in zip(readings[1:], tracks[1:], strict=True):
            began = time.process_time()
            belief, memory, _ = agent.filter(belief, memory, reading, generator=random)
            seconds = time.process_time() - began
            line = figures(agent, belief, track[-1], before, seconds)
            contacts += bool(reading.in_contact.any())
            line |= {"touched": bool(reading.in_contact.any()), "contacts": contacts}
            steps.append(line)
            before = track[-1]
    return {"steps": steps}


def main() -> None:
    """Do what is missing, then print."""
    options = tyro.cli(Options, description=__doc__)
    store, seeds = Store(options.results), seeds_of(options.seeds)
    for seed in seeds if options.command in ("record", "replay") else ():
        work = recorded if options.command == "record" else replayed
        settings = {"part": options.task, "command": options.command, "seed": seed, "set": list(options.set)}
        settings |= {"steps": options.steps, "again": options.again, "defaults": _DEFAULTS}
        settings["conditions"] = options.conditions
        store.measure(settings, lambda work=work, seed=seed: work(options, seed))
    if options.command == "touches":
        asked = {"command": "record", "conditions": options.conditions, "defaults": _DEFAULTS, "set": list(options.set)}
        some = [line for line in store.flat() if line["seed"] in seeds and asked.items() <= line.items()]
        sys.stdout.write(touches(some))
        return
    lines = [line for line in store.of(options.task) if line["seed"] in seeds]
    sys.stdout.write("".join(_words(line) for line in lines))


def touches(lines: Sequence[Figures]) -> str:
    """A table of touches of what is known about, by how far they moved it."""
    pairs = [pair for line in lines for pair in itertools.pairwise(line["steps"])]
    known = [(last, now) for last, now in pairs if now["touched"] and last["near"] > _KNOWN and last["contacts"]]
    rows = [
        (f"{low} to {high} mm", [pair for pair in known if low <= pair[1]["moved"] < high and pair[1]["tilt"] < _TILTS])
        for low, high in itertools.pairwise(_MOVED_MM)
    ]
    rows.append(("tilted", [pair for pair in known if pair[1]["tilt"] >= _TILTS]))
    out = ["| moved | touches | P(right) before; after | off before; after, mm | sure after |", "|-" * 5 + "|"]
    for name, some in rows:
        if some:
            means = [fmean(pair[at][what] for pair in some) for what in ("p", "mm") for at in (0, 1)]
            sure = sum(now["p"] >= _SURE for _, now in some)
            out.append("| {} | {} | {:.2f}; {:.2f} | {:.1f}; {:.1f} | {} |".format(name, len(some), *means, sure))
    return "\n".join((*out, ""))


def _words(line: Figures) -> str:
    """A line a step."""
    out = [f"# {line['command']} {line['seed']} {' '.join(line['set'])}"]
    for k, s in enumerate(line["steps"]):
        out.append(
            f"{k:3d} touched {s['contacts']:2d}{' now' if s['touched'] else ''}, off {s['mm']:6.1f} mm {s['deg']:6.1f}"
            f" deg, P(right) {s['p']:.2f} level {s['level']:.2f} lies {s['lies']:.2f} near {s['near']:.2f}; moved "
            f"{s['moved']:5.1f} mm {s['turned']:5.1f} deg, tilt {s['tilt']:5.1f}; {s['cpu_s']:.2f} s"
        )
    return "\n".join((*out, ""))


if __name__ == "__main__":
    script(main)
