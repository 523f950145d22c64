"""How well joint torques tell contact: rates, delays and tracking of pokes at a box by the simulated arm.

python -m scripts.torque_rates run --seeds 1000-1019           # one line a poke in scripts/results/torque_rates.jsonl
python -m scripts.torque_rates run --cases motor --seeds 1000-1099 --seconds 110
python -m scripts.torque_rates show                            # Markdown: rates by threshold, delays, tracking
python -m scripts.torque_rates limit                           # Markdown: pokes at a box that does not move
python -m scripts.torque_rates speed --threads 1               # microseconds a sample of the observer

Boxes of 0.3 to 0.8 kg with friction of 0.2 to 0.6 stand about two places; half of the pokes go for them, half beside.
Every ten pokes another arm is drawn, whose model and sensors are wrong by other amounts.
"""

import math
import statistics
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
import torch

from rumi.bench.timing import fitting_clock
from rumi.cli import script
from rumi.sim.arm_motion import joint_path
from rumi.sim.torque_arm import TorqueArm, TorqueSettings
from scripts.experiment import Experiment, Line, newest
from scripts.reproduce.cells import table
from scripts.reproduce.code import code_of
from scripts.reproduce.intervals import wilson
from scripts.reproduce.seeds import seeds_of

CASES: dict[str, TorqueSettings] = {
    "usual": TorqueSettings(),
    "raw": TorqueSettings(),
    "motor": TorqueSettings(motor_side=True),
    "friction": TorqueSettings(motor_side=True, friction_known=0.0),
}
WORDS = {
    "usual": "calibrated",
    "raw": "not calibrated",
    "motor": "by the motors, calibrated",
    "friction": "by the motors, not calibrated, friction not known",
}
HALF, HEIGHT = (0.03, 0.08), 0.10
SPEED, SPACING, LENGTH, CLEAR = 0.08, 0.005, 0.16, 0.15
POKES = 10
"""Of an arm, before another is drawn, with other errors."""

THRESHOLDS = (0.1, 0.15, 0.3, 0.6, 1.0, 1.3)


@dataclass(frozen=True)
class Limit:
    """Poke at a box that does not move, at several force limits.

    Attributes:
        seeds: as for `run`; those whose poke goes for the box and is within reach count.
        limits_n: that are tried.
    """

    seeds: str = "1000-1019"
    limits_n: tuple[float, ...] = (10.0, 25.0, 50.0)


@dataclass(frozen=True)
class Speed:
    """Time the observer.

    Attributes:
        threads: of torch.
    """

    threads: int = 1


def poke(arm: TorqueArm, seed: int, *, fixed: bool = False) -> dict[str, Any] | None:
    """One poke at or beside a box that is drawn by the seed; None where the arm cannot go.

    A fixed box has half a ton.
    """
    random = np.random.default_rng(seed)
    mode = 0.2 * random.choice((-1.0, 1.0))
    pose = np.array([0.45, mode, 0.0]) + (0.06, 0.06, 0.5) * random.standard_normal(3)
    friction, floor = random.uniform(0.2, 0.6, 2)
    mass, angle = float(random.uniform(0.3, 0.8)), float(random.uniform(-math.pi, math.pi))
    if fixed:
        mass, floor = 500.0, 1.0
    ahead = np.array([math.cos(angle), math.sin(angle)])
    beside = np.array([-ahead[1], ahead[0]]) * (0.15 if seed % 2 else 0.0)
    inside = random.uniform(-1.0, 1.0, 2) * HALF
    turn = np.array([[math.cos(pose[2]), -math.sin(pose[2])], [math.sin(pose[2]), math.cos(pose[2])]])
    end = pose[:2] + turn @ inside + beside
    start = end - LENGTH * ahead
    knots = round(LENGTH / SPACING) + 1
    path = np.zeros((knots, 4))
    path[:, :2] = start + np.linspace(0.0, 1.0, knots)[:, None] * (end - start)
    down = np.repeat(path[:1], 9, 0)
    down[:, 2] = np.linspace(CLEAR, 0.0, 9)
    whole = np.concatenate((down, path[1:]))
    joints = None
    for yaw in (angle, angle + math.pi):
        whole[:, 3] = yaw
        joints = arm.kinematics.follow(whole) if joints is None else joints
    if joints is None:
        return None
    arm.mujoco.mj_resetData(arm.model, arm.data)
    arm.put_box(torch.from_numpy(pose))
    for name, value in (("floor", floor), ("left", friction), ("right", friction)):
        arm.model.pair_friction[arm.model.pair(name).id][:2] = value
    sides = np.array([2.0 * HALF[0], 2.0 * HALF[1], HEIGHT]) ** 2
    body = arm.model.body("box").id
    arm.model.body_mass[body], arm.model.body_inertia[body] = mass, mass / 12.0 * (sides.sum() - sides)
    arm.renew(seed)
    arm.stand(joints[0], arm.physics.finger_m)
    arm.rest(0.1, joints[0])
    descent = arm.follow(joint_path(joints[:9]), 10.0)
    line: dict[str, Any] = {"mass": round(mass, 3), "floor": round(float(floor), 3), "descent": descent.ended}
    if descent.ended == "end":
        arm.rest(0.15, joints[8])
        motion = arm.follow(joint_path(joints[8:]), SPEED / SPACING)
        parts = motion.parts
        line |= {
            "ended": motion.ended,
            "moved_mm": round(1e3 * float((arm.box_pose()[:2] - torch.from_numpy(pose[:2])).norm()), 2),
            "norm": [round(part.norm_nm, 4) for part in parts],
            "force": [round(part.force_n, 2) for part in parts],
            "touching": [int(part.touching) for part in parts],
            "tracking_mm": [round(1e3 * float(value), 3) for value in motion.tracking_m],
        }
    return line


@lru_cache(1)
def arm_of(case: str) -> TorqueArm:
    """The arm of a case, with a limit that no poke reaches, so that norms are of whole pokes."""
    return TorqueArm(HALF, HEIGHT, settings=replace(CASES[case], force_limit_n=60.0))


@lru_cache(1)
def drawn(case: str, group: int) -> TorqueArm:
    """The same with errors of its own."""
    arm = arm_of(case)
    arm.mujoco.mj_resetData(arm.model, arm.data)
    arm.seed(group)
    if case not in ("raw", "friction"):
        arm.calibrate()
    return arm


def measure(case: str, seed: int) -> dict[str, Any]:
    """One poke."""
    found = poke(drawn(case, seed // POKES), seed)
    return {"reached": found is not None} | (found or {})


def show(lines: list[Line], chosen: Mapping[str, tuple[str, ...]]) -> str:
    """Rates by threshold, and how the pokes went, by the newest code."""
    lines = newest(lines)
    told, ends = [], []
    for case in CASES:
        own = [x for x in lines if x["case"] == case]
        pokes = [x for x in own if "norm" in x]
        if not pokes:
            continue
        told += [[WORDS[case], f"{threshold:g}", *rates(pokes, threshold)] for threshold in THRESHOLDS]
        tracking = np.concatenate([x["tracking_mm"] for x in pokes])
        ends.append(
            [
                WORDS[case],
                str(len(pokes)),
                str(sum(not x["reached"] for x in own)),
                str(sum(x.get("descent", "end") != "end" for x in own)),
                f"{tracking.mean():.2f}, {np.quantile(tracking, 0.95):.2f}, {tracking.max():.2f}",
                f"{max(max(x['force']) for x in pokes):.1f}",
            ]
        )
    heads = ("case", "threshold, N m", "true positive", "false positive", "pokes that touch, felt", "delay, ms")
    end = ("case", "pokes", "out of reach", "stopped coming down", "tracking, mm: mean, 95 %, most")
    return f"{table((*heads, 'errs again'), told)}\n{table((*end, 'largest force, N'), ends)}"


def rates(pokes: list[dict[str, Any]], threshold: float) -> list[str]:
    """Cells of one threshold."""
    hits = [(np.array(x["norm"]) > threshold, np.array(x["touching"], dtype=bool)) for x in pokes]
    said = np.concatenate([signal for signal, _ in hits])
    true = np.concatenate([touching for _, touching in hits])
    cells = []
    for chosen in (true, ~true):
        low, high = wilson(int(said[chosen].sum()), int(chosen.sum()))
        cells.append(f"{said[chosen].mean():.3f} [{low:.3f}, {high:.3f}]")
    delays, touched = [], 0
    for signal, touching in hits:
        # a touch of two readings and more, and who was silent before it
        if touching.sum() < 2:
            continue
        first = int(touching.argmax())
        touched += 1
        late = signal[first:] & touching[first:]
        if late.any():
            delays.append(1e3 * SPACING / SPEED * int(late.argmax()))
    cells.append(f"{len(delays)} of {touched}")
    cells.append(f"{statistics.mean(delays):.0f}" if delays else "-")
    wrong = [signal != touching for signal, touching in hits]
    again = [bool(b) for x in wrong for a, b in pairwise(x) if a]
    cells.append(f"{np.mean(again):.2f}" if again else "-")
    return cells


def limit(options: Limit) -> None:
    """Markdown: who stopped, the largest estimated force, and how far the tool went on after the first reading."""
    torch.set_num_threads(1)
    rows = []
    for newtons in options.limits_n:
        arm = TorqueArm(HALF, HEIGHT, settings=replace(CASES["usual"], force_limit_n=newtons))
        arm.seed(0)
        arm.calibrate()
        lines = [poke(arm, seed, fixed=True) for seed in seeds_of(options.seeds) if seed % 2 == 0]
        found = [x for x in lines if x is not None and any(x.get("touching", ()))]
        forces = [max(x["force"]) for x in found]
        stopped = sum(x["ended"] == "force" for x in found)
        most = f"{max(x['moved_mm'] for x in found):.1f}"
        cells = [str(len(found)), str(stopped), f"{statistics.mean(forces):.1f}, {max(forces):.1f}", most]
        rows.append([f"{newtons:g}", *cells])
    heads = ("limit, N", "pokes that touch", "stopped by it", "largest force, N: mean, most", "box moved, mm")
    sys.stdout.write(table(heads, rows))


def speed(options: Speed) -> None:
    """Microseconds a sample, median of five: the terms of the model, and the observer's step.

    With one thread by the processor's clock.
    """
    torch.set_num_threads(options.threads)
    clock = fitting_clock(options.threads)
    arm = TorqueArm(HALF, HEIGHT)
    position, velocity, torque = torch.zeros(7, dtype=torch.float64) + 0.3, torch.zeros(7), torch.zeros(7)
    velocity, torque = velocity.double(), torque.double()
    terms = arm.dynamics(position, velocity)
    state = arm.observer.start(terms, velocity)

    def step() -> None:
        arm.observer.step(state, terms, velocity, torque, 0.001)

    for name, work in (("terms", lambda: arm.dynamics(position, velocity)), ("observer", step)):
        took = []
        for _ in range(5):
            began = clock()
            for _ in range(1000):
                work()
            took.append((clock() - began) / 1000)
        sys.stdout.write(f"{name}: {1e6 * sorted(took)[2]:.1f} us\n")


EXPERIMENT = Experiment(
    __doc__,
    "torque_rates.jsonl",
    {"case": tuple(CASES)},
    measure,
    show,
    seeds="1000-1019",
    usual={"case": ("usual",)},
    identity=lambda variant: {"code": code_of("torques")},
    commands={"limit": (Limit, limit), "speed": (Speed, speed)},
)

if __name__ == "__main__":
    script(EXPERIMENT.main)
