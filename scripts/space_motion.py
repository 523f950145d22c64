"""What the motion of objects in space is worth: evidence of recorded actions from their true starts.

python -m scripts.space_truth record --task box --seeds 1000-1009      # closed loops, their readings and true poses
python -m scripts.space_motion run --task box --seeds 1000-1009        # each action that touched, from where it began
python -m scripts.space_motion show --task box --seeds 1000-1009

An action's evidence is the mean likelihood of its readings over motions of the prior that begin at the true pose, by a
bootstrap particle filter (nats), and `near` the share of them that ends within 20 mm and 17 degrees of the truth. What
a motion prior cannot do shows as little evidence, whatever a filter makes of it; compare code on the same recordings.
Where these motions end is a belief too: its own probability of being right, and whether it is, tell whether the prior
is wide enough. Actions that begin while the object leans are left out.
"""

import math
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import torch
import tyro
from jaxtyping import Float
from torch import Tensor

from rumi.belief.bootstrap_filter import BootstrapFilter
from rumi.belief.particles import PoseBelief
from rumi.belief.pose_trajectories import NOISE, OWN, PHYSICS, Trajectories
from rumi.belief.segments import cut, felt_pads, path_of, pushed
from rumi.belief.toppled_object import ToppledObject
from rumi.belief.trajectory_history import History
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.cli import script
from rumi.metrics.calibration import checked
from rumi.metrics.pose_error import pose_error
from rumi.resampling import resample_systematic
from rumi.seeding import generator, normal
from rumi.tasks.rummage.build import build
from scripts.reproduce.seeds import seeds_of
from scripts.space_truth import Options as TruthOptions
from scripts.store import Figures, Store
from scripts.trajectory_runs import settings_of
from sdf import se3
from sdf.symmetry import Symmetries
from sensors.reading import Reading

RESULTS = Path(__file__).parent / "results" / "space_motion.jsonl"
_PARTICLES, _ABOUT = 1500, (0.0003, 0.0003, 0.003)  # deviations of their starts about the true one
_NEAR_M, _NEAR_RAD, _LEANS_RAD, _TRACKS = 0.02, 0.3, 0.03, 24
_EACH, _SURE = 4, 0.95  # one of so many ends stands for the belief; P(right) that counts as sure


@dataclass(frozen=True)
class Options:
    """What is done.

    Attributes:
        command: "run" works out what is missing, "show" prints what is there.
        task: whose recordings.
        seeds: such as 1000-1009.
        results: file of the figures.
        folder: of the recorded episodes.
        label: of the code that is looked at.
    """

    command: tyro.conf.Positional[Literal["run", "show"]]
    task: str = "box"
    seeds: str = "1000-1009"
    results: Path = RESULTS
    folder: Path = Path("runs/space_truth")
    label: str = "now"


def resting(model: ToppledObject, pose: Float[Tensor, "4 4"], symmetries: Symmetries) -> tuple[Tensor, float]:
    """(x, y, yaw, resting pose, no edge, no tilt) of the nearest pose at rest, and the angle to it, radians."""
    alike = pose[:3, :3].double() @ symmetries.rotations.double()
    turned = alike[:, None] @ model.rests.turn.mT
    flat = int(turned[..., 2, 2].argmax())
    rotation = turned.reshape(-1, 3, 3)[flat]
    yaw = torch.atan2(rotation[1, 0] - rotation[0, 1], rotation[0, 0] + rotation[1, 1])
    lies = torch.tensor([float(flat % len(model.rests)), -1.0, 0.0], dtype=torch.float64)
    off = math.acos(min(1.0, float(rotation[2, 2])))
    return torch.cat((pose[:2, 3].double(), yaw[None], lies)), off


def evidence(
    model: ToppledObject, own: PoseTrajectorySettings, start: Float[Tensor, "6"], reading: Reading
) -> tuple[float, Float[Tensor, "N 6"]]:
    """Log of the mean likelihood of an action's readings, nats, and where motions end that are drawn by it."""
    random, count = generator(0), _PARTICLES
    path, felt, total = path_of(reading, model), felt_pads(reading, model, own), 0.0
    pose = start.repeat(count, 1)
    pose[:, :3] += pose.new_tensor(_ABOUT) * normal((count, 3), generator=random, dtype=torch.float64)
    physics = normal((count, PHYSICS), generator=random, dtype=torch.float64)
    shared = normal((count, 1, NOISE), generator=random, dtype=torch.float64)
    for instants in cut(reading, own):
        tracks = model.tracks(own, pose[:_TRACKS], path[instants])
        history = History.empty(4).appended(pushed(reading, instants, path, felt, tracks, model, own))
        noise = normal((count, 1, NOISE), generator=random, dtype=torch.float64)
        noise[..., OWN:] = shared[..., OWN:]
        poses, logs = pose[:, None].repeat(1, 2, 1), pose.new_zeros(count, 1)
        moved = Trajectories(physics, noise, poses, logs, history, pose[:0])
        moved = moved.replayed(model, own, history, torch.zeros(count, dtype=torch.long))
        gained = moved.log_likelihood[:, 0]
        total += float(gained.logsumexp(0)) - math.log(count)
        rows = resample_systematic(gained, count, generator=random)
        pose, physics, shared = moved.pose[rows], physics[rows], shared[rows]
    return total, pose


def measured(options: Options, seed: int) -> Figures:
    """An episode's actions, one entry each."""
    readings, tracks = torch.load(options.folder / f"{options.task}-{seed}.pt", weights_only=False)
    runs, actions = TruthOptions(command="replay", task=options.task).runs(), []
    with build(settings_of(runs, "trajectory", seed), cache_dir=Path("runs/cache")) as (_, agent):
        follow, symmetries = agent.filter, agent.model.symmetries
        assert isinstance(follow, BootstrapFilter)
        before = tracks[0][-1].double()
        for number, (reading, track) in enumerate(zip(readings[1:], tracks[1:], strict=True), 1):
            first, before = before, track[-1].double()
            start, leans = resting(follow.model, first, symmetries)
            if not bool(reading.in_contact.any()) or leans > _LEANS_RAD:
                continue
            nats, ends = evidence(follow.model, follow.own, start, reading)
            poses = follow.model.world_T_object(ends)
            metres, radians = pose_error(se3.renormalised(poses), before.expand_as(poses), symmetries)
            moved, turned = pose_error(first[None], before[None], symmetries)
            near = (metres < _NEAR_M) & (radians < _NEAR_RAD)
            within = {"within_m": agent.position_tolerance_m, "within_rad": agent.rotation_tolerance_rad}
            held = checked(PoseBelief.uniform(poses[::_EACH]), before, symmetries, **within)
            actions.append(
                {
                    "action": number,
                    "moved_mm": round(1e3 * float(moved), 1),
                    "turned_deg": round(math.degrees(float(turned)), 1),
                    "nats": round(nats, 1),
                    "near": round(float(near.double().mean()), 3),
                    "p": round(held.p_right, 3),
                    "right": held.right,
                    "falls": bool(torch.acos((first[2, :3] @ before[2, :3]).clamp(-1.0, 1.0)) > 5.0 * _LEANS_RAD),
                }
            )
    return {"actions": actions}


def main() -> None:
    """Work out what is missing, then print."""
    options = tyro.cli(Options, description=__doc__)
    store, seeds = Store(options.results), seeds_of(options.seeds)
    for seed in seeds if options.command == "run" else ():
        settings = {"part": options.task, "seed": seed, "label": options.label}
        store.measure(settings, partial(measured, options, seed))
    lines = [line for line in store.of(options.task) if line["seed"] in seeds]
    heads = "code | what happened | actions | nats, mean; worst | below -40 | near, mean"
    out = [f"| {heads} | P(right), mean; right | sure; wrong |", "|-" * 8 + "|"]
    for label in dict.fromkeys(line["label"] for line in lines):
        every = [action for line in lines if line["label"] == label for action in line["actions"]]
        for name, falls in (("it tilts or falls", True), ("it stays or slides", False)):
            some = [action for action in every if action["falls"] is falls]
            nats, near = [action["nats"] for action in some], [action["near"] for action in some]
            if some:
                told = [action for action in some if "p" in action]
                sure = [action for action in told if action["p"] >= _SURE]
                count = max(1, len(told))
                out.append(
                    f"| {label} | {name} | {len(some)} | {sum(nats) / len(some):.1f}; {min(nats):.1f} "
                    f"| {sum(n < -40.0 for n in nats)} | {sum(near) / len(some):.2f} "
                    f"| {sum(a['p'] for a in told) / count:.2f}; {sum(a['right'] for a in told) / count:.2f} "
                    f"| {len(sure)}; {sum(not a['right'] for a in sure)} |"
                )
    sys.stdout.write("\n".join((*out, "")))


if __name__ == "__main__":
    script(main)
