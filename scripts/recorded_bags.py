"""The ROS 1 bags of `RUMI_DATA/vicon_bags`: imported by one command, held against the bags, and replayed twice.

    python -m scripts.recorded_bags [FOLDER]            # a line a bag; FOLDER keeps logs, mapping, meshes and runs
    python -m scripts.recorded_bags suggested [FOLDER]  # each as a new user: by the mapping that rumi suggests
    python -m scripts.recorded_bags found [FOLDER]      # how well each block is found by that mapping, of five seeds

A fingertip of 4.75 mm radius pushes a block over a table. Heights of tip and block have no origin in common in these
bags, so that both are taken to be tall: the belief is over x, y and yaw. The blocks' sides are those that
`scripts.bench.vicon_pushes` finds from where the tip was.
"""

import contextlib
import io
import math
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from rumi.cli import main as rumi
from rumi.cli import script
from rumi.errors import UsageError
from rumi.metrics.calibration import checked
from rumi.metrics.pose_error import pose_error
from rumi.rosbag.frames import FrameTree
from rumi.rosbag.mapping_file import read_mapping
from rumi.runs.folder import load_run
from rumi.runs.replay import digest
from scripts.bench.bag_poses import Error, error_of, poses_of
from scripts.bench.real_pushes import TIP_M
from sdf import se3
from sdf.extras import optional
from sdf.symmetry import Symmetries
from sensors.log.reader import Log

MAP = """schema = 1

[topics]
"/tip_pose" = { role = "pose", frame = "map", child = "tip" }
"/vicon/*/*" = { role = "pose", child = "slider" }
"/netft_data" = "wrench"

[frames]
world = "map"
tool = "tip"
floor_z_m = -0.5

[scene]
within = [[0.2, -0.4, 0.0], [0.6, 0.3, 1.0]]
prior_mean_m = [0.366, -0.24]
prior_spread_m = 0.01

[tool]
mesh = "tip.stl"

[wrench]
mesh = "tip.stl"
tare_s = 0.3
least_force_n = 0.5
friction = 1.0

[actions]
view_s = 0.3
every_s = 0.5
"""
SEEDS = range(5)
WITHIN_M, WITHIN_RAD = 0.01, math.radians(10.0)
"""Of a block that is found: a belief that is sure and farther off is sure and wrong."""

SIDES_M = {"Al_block": 0.103, "Plastic_block": 0.118, "St_block": 0.102}


ROOT = Path(__file__).resolve().parents[1]


class Tried(NamedTuple):
    """What a new user of a bag has to do until there is a picture.

    Attributes:
        lines: commands, and lines of the mapping that were changed.
        seconds: by the clock.
        processor_s: of the processor.
    """

    lines: int
    seconds: float
    processor_s: float


class Found(NamedTuple):
    """The last belief of a replay against the tracker's pose, in the plane and modulo quarter turns.

    Attributes:
        mm: from the likeliest place to the true one.
        degrees: of the turn, too.
        foreseen_mm: weighted median of the particles' distances from the likeliest.
        foreseen_degrees: of their turns, too.
        level: share of the belief that is denser than it is at the truth.
        sure: whether the belief is.
    """

    mm: float
    degrees: float
    foreseen_mm: float
    foreseen_degrees: float
    level: float
    sure: bool

    @property
    def right(self) -> bool:
        """Whether the block is where the belief has it."""
        return self.mm <= 1e3 * WITHIN_M and self.degrees <= math.degrees(WITHIN_RAD)


def bags() -> list[Path]:
    """The bags.

    Raises:
        UsageError: RUMI_DATA does not say where they are.
    """
    found = sorted((Path(os.environ.get("RUMI_DATA", "")) / "vicon_bags").glob("*/*.bag"))
    if not os.environ.get("RUMI_DATA") or not found:
        raise UsageError("Expected RUMI_DATA to name the folder of data sets, with vicon_bags in it")
    return found


def prepare() -> None:
    """Write the mapping and the meshes into the current folder."""
    Path("lab.toml").write_text(MAP)
    make_meshes(1.0)
    trimesh = optional("trimesh", "A mesh")
    tip = trimesh.creation.cylinder(TIP_M, 0.25, sections=24)  # from the sensor's frame, whose z points down
    tip.apply_translation((0.0, 0.0, 0.125))
    tip.export("tip.stl")


def make_meshes(height_m: float = 0.06) -> None:
    """Write the blocks' meshes into the current folder."""
    trimesh = optional("trimesh", "A mesh")
    for name, side in SIDES_M.items():
        trimesh.creation.box((side, side, height_m)).export(f"{name}.stl")


def suggested(bag: Path, steps: int | None = None) -> Tried:
    """Take a bag in by the mapping that is suggested for it, after a look at its lines with TODO, and draw what comes.

    Of these the rod's radius alone is wrong, in both tables; the block's mesh is there.

    Args:
        bag: one of the eleven.
        steps: readings to take in after the first; None for all.
    """
    start, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    few = [] if steps is None else ["--steps", str(steps)]
    changed = _taken_in(bag)
    _carry_out(["replay", "push.h5", "--mesh", f"{bag.parent.name}.stl", "--out", "found", "--figures", *few])
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    if not Path("found/figures/overview.png").is_file():
        raise UsageError(f"No picture came of {bag}")
    return Tried(3 + changed, time.perf_counter() - start, used)


def _taken_in(bag: Path) -> int:
    """Import a bag by the mapping that is suggested for it, with the rod's radius; how many lines that changes."""
    _carry_out(["import", str(bag), "--suggest", "--out", "push.toml"])
    text = Path("push.toml").read_text()
    right = text.replace("radius_m = 0.005 ", f"radius_m = {TIP_M} ")
    Path("push.toml").write_text(right)
    _carry_out(["import", str(bag), "--map", "push.toml", "--out", "push.h5"])
    return sum(one != other for one, other in zip(text.splitlines(), right.splitlines(), strict=True))


def found(bag: Path, seed: int) -> Found:
    """How well a block is found by the log of its bag, in the current folder.

    Raises:
        UsageError: the tracker lost the block at the end.
    """
    out = f"found-{seed}"
    _carry_out(["replay", "push.h5", "--mesh", f"{bag.parent.name}.stl", "--seed", str(seed), "--out", out])
    run = load_run(out)
    belief, truth = run.steps[-1].belief, run.steps[-1].truth
    if truth is None:
        raise UsageError(f"Expected the tracker to have the block at the end of {bag}, got no pose")
    turns = torch.stack([se3.from_planar(torch.tensor([0.0, 0.0, 0.5 * math.pi * k]))[:3, :3] for k in range(4)])
    square = Symmetries(turns.double())
    likeliest, poses = belief.mode().double(), belief.world_T_object.double()
    off, turned = pose_error(likeliest, truth.double(), square)
    apart = pose_error(poses, likeliest.expand_as(poses), square)
    weights = belief.log_weights.double().softmax(-1)
    foreseen = [float(each[order := each.argsort()][weights[order].cumsum(0) >= 0.5][0]) for each in apart]
    level = checked(belief, truth, square, within_m=WITHIN_M, within_rad=WITHIN_RAD).both
    sure = run.result is not None and run.result.stopped_by == "sure"
    return Found(
        1e3 * float(off), math.degrees(float(turned)), 1e3 * foreseen[0], math.degrees(foreseen[1]), level, sure
    )


def _carry_out(words: list[str]) -> None:
    """A command of rumi, in a process of its own as a user's is."""
    env = {**os.environ, "PYTHONPATH": os.pathsep.join((str(ROOT), os.environ.get("PYTHONPATH", "")))}
    done = subprocess.run([sys.executable, "-m", "rumi", *words], env=env, capture_output=True, text=True)
    if done.returncode not in (0, 1):  # 1 of a belief that is not sure
        raise UsageError(f"rumi {' '.join(words)} failed: {done.stderr}")


def replay(bag: Path, steps: int | None = None) -> tuple[int, int]:
    """Replay the log of a bag twice, and the first replay's own folder.

    Args:
        bag: whose log there is.
        steps: readings to take in after the first; None for all.

    Returns:
        number of beliefs, and how many of them are the same each time.
    """
    words = ["replay", f"{bag.stem}.h5", "--mesh", f"{bag.parent.name}.stl"]
    words += [] if steps is None else ["--steps", str(steps)]
    first, second = (_beliefs([*words, "--out", f"{bag.stem}-{which}"]) for which in "ab")
    again = _said(["replay", f"{bag.stem}-a"])
    if f"bit for bit, after each of {len(first)} readings" not in again:
        return len(first), 0
    return len(first), sum(one == other for one, other in zip(first, second, strict=True))


def errors(bag: Path) -> tuple[Error, Error]:
    """Tip and block at the stamps of their messages: what the log has less what the bag has."""
    mapping = read_mapping("lab.toml")
    tip, block, map_T_tracker = poses_of(bag)
    belief_T_map = np.eye(4)
    belief_T_map[2, 3] = -mapping.frames.floor_z_m
    with Log(Path(f"{bag.stem}.h5")) as log:
        tree = FrameTree.of_log(log, mapping)
        return error_of(tree, "tip", tip, belief_T_map), error_of(tree, "slider", block, belief_T_map @ map_T_tracker)


def _beliefs(words: list[str]) -> list[bytes]:
    """Digests of the beliefs of a replay that the command writes."""
    _said(words)
    return [digest(step.belief) for step in load_run(words[-1]).steps]


def _said(words: list[str]) -> str:
    """What a command of rumi says; exit code 1, of a belief that is not sure, is fine."""
    with contextlib.redirect_stdout(io.StringIO()) as said, contextlib.redirect_stderr(io.StringIO()) as err:
        if rumi(words) not in (0, 1):
            raise UsageError(f"rumi {' '.join(words)} failed: {err.getvalue()}")
    return said.getvalue()


def main() -> None:
    """All bags, a line each."""
    arguments = sys.argv[1:]
    ways = {"suggested": _as_newcomers, "found": _how_well}
    way = ways.get(arguments[0]) if arguments else None
    arguments = arguments[way is not None :]
    every = bags()
    with contextlib.ExitStack() as stack:
        folder = Path(arguments[0]) if arguments else Path(stack.enter_context(tempfile.TemporaryDirectory()))
        folder.mkdir(parents=True, exist_ok=True)
        stack.enter_context(contextlib.chdir(folder))
        (way or _by_one_mapping)(every)


def _as_newcomers(every: list[Path]) -> None:
    print("| bag | commands and changed lines | seconds by the clock | of the processor |")
    print("|---|---|---|---|")
    for bag in every:
        own = Path(bag.stem).resolve()
        own.mkdir(exist_ok=True)
        with contextlib.chdir(own):
            make_meshes()
            tried = suggested(bag)
        print(
            f"| {bag.parent.name} {bag.stem} | {tried.lines} | {tried.seconds:.0f} | {tried.processor_s:.0f} |",
            flush=True,
        )


def _how_well(every: list[Path]) -> None:
    """A line a bag, medians over seeds, and one for all bags of each seed."""
    print("| bag | mm, degrees | by seed, mm | foreseen | holds | sure |")
    print("|---|---|---|---|---|---|")
    of_seed: dict[int, list[Found]] = {seed: [] for seed in SEEDS}
    for bag in every:
        own = Path(bag.stem).resolve()
        own.mkdir(exist_ok=True)
        with contextlib.chdir(own):
            make_meshes()
            _taken_in(bag)
            mine = [found(bag, seed) for seed in SEEDS]
        for seed, one in zip(SEEDS, mine, strict=True):
            of_seed[seed].append(one)
        mm, degrees, foreseen_mm, foreseen_degrees, level, sure = np.array(mine, dtype=float).T
        print(
            f"| {bag.parent.name} {bag.stem} | {np.median(mm):.1f}, {np.median(degrees):.1f} | "
            f"{', '.join(f'{one:.0f}' for one in mm)} | "
            f"{np.median(foreseen_mm):.1f}, {np.median(foreseen_degrees):.1f} | "
            f"{(level <= 0.9).sum()} ({np.median(level):.2f}) | {int(sure.sum())} |",
            flush=True,
        )
    for seed, some in of_seed.items():
        mm, degrees, _, _, level, _ = np.array(some, dtype=float).T
        wrong = sum(one.sure and not one.right for one in some)
        print(
            f"seed {seed}: medians {np.median(mm):.1f} mm, {np.median(degrees):.1f} degrees, "
            f"{(level <= 0.9).sum()} of {len(some)} regions hold, {wrong} sure and wrong"
        )


def _by_one_mapping(every: list[Path]) -> None:
    prepare()
    _said(["import", *map(str, every), "--map", "lab.toml"])
    print("| bag | tip: poses, mm, degrees | block: poses, mm, degrees | beliefs | the same |")
    print("|---|---|---|---|---|")
    for bag in every:
        tip, block = errors(bag)
        count, same = replay(bag)
        cells = [f"{one.poses}, {one.mm:.1g}, {one.degrees:.1g}" for one in (tip, block)]
        print(f"| {bag.parent.name} {bag.stem} | {' | '.join(cells)} | {count} | {same} |", flush=True)


if __name__ == "__main__":
    script(main)
