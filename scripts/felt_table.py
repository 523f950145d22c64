"""Replay recordings of a simulated finger's pokes, with what it felt as bare points and flags, or as likelihoods.

    python -m scripts.felt_table run --objects box mug --seeds 1000-1002
    python -m scripts.felt_table show

A ball on a stick pokes an object that no camera sees, and that is held fast or sticks to the ball; its wrist measures
forces, and the three slides that carry it torques, all with noise. Each replay adds one line to
scripts/results/felt.jsonl; those that are there are not run again.
"""

import math
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rumi.cli import script
from rumi.rosbag.mapping_file import mapping_of
from rumi.rosbag.readings import make_readings
from rumi.rosbag.scene import rummager_of_map, settings_of
from rumi.runs.replay import replay
from rumi.tasks.rummage.scenes import large_handled_mug
from scripts.experiment import Experiment, Line
from scripts.reproduce.cells import table
from sdf import se3
from sdf.object_model import ObjectModel, box_model
from sensors.log.reader import Log
from sensors.log.writer import LogWriter, StreamSpec

CASES = {
    "wrench: points": (True, False, False),
    "wrench: likelihood": (True, False, True),
    "torques: flags": (False, True, False),
    "torques: likelihood": (False, True, True),
    "both: points and flags": (True, True, False),
    "both: likelihood": (True, True, True),
}
"""Whether there is a wrench, whether there are torques, and whether they count as likelihoods."""

MODELS = {"box": box_model, "mug": large_handled_mug}
_START_NS = 10**18
_STEP_NS = 10**7
_RADIUS, _AHEAD, _PUSH_N, _MASS_KG = 0.01, 0.10, 5.0, 1.0
_NOISE = (0.05, 0.001, 0.1)  # N, N m, N: of forces and moments at the wrist, and of the slides' forces
_SPREAD = 0.02

MAP = """
schema = 1
[frames]
world = "world"
tool = "tool"
[scene]
builtin = "OBJECT"
within = [[0.35, -0.25, 0.0], [0.85, 0.25, 0.30]]
prior_mean_m = [0.60, 0.0]
prior_spread_m = 0.02
[tool]
palm_m = [0.12, 0.02, 0.02]
palm_front_m = 0.11
pad_m = [0.01, 0.01, 0.01]
pad_offset_m = 0.0
[actions]
view_s = 0.2
every_s = 1.0
instants = 20
[settings]
filter.motion = "sticking"
initialise = { particles = 100 }
stop.rule = "never"
[topics]
"""
WRENCH = """
[wrench]
radius_m = 0.01
center_m = [0.10, 0.0, 0.0]
force_n = 0.05
moment_nm = 0.001
"""
TORQUES = """
[robot]
file = "FILE"
[torques]
threshold_nm = 1.0
rest_s = 0.2
counted = 3
gain = 100.0
"""
SLIDES = """<mujoco><option gravity="0 0 -9.81"/><worldbody><body name="carriage">
<joint name="x" type="slide" axis="1 0 0"/><joint name="y" type="slide" axis="0 1 0"/>
<joint name="z" type="slide" axis="0 0 1"/><geom type="sphere" size="0.02" mass="1"/></body></worldbody></mujoco>"""


def simulate(model: ObjectModel, seed: int, pokes: int, push_m: float, path: Path) -> Tensor:
    """Record pokes, each of which takes the object along; returns world_T_object at the end."""
    random = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=random, dtype=torch.float64)

    standing = -float(model.exact.bounds[0, 2])
    off, turn = _SPREAD * draw(2).clamp(-2, 2), 2 * math.pi * torch.rand((), generator=random, dtype=torch.float64)
    place = torch.stack((0.6 + off[0], off[1], turn))
    world_T_object = se3.from_planar(place, standing)
    frames = {"parent": "world", "child": "tool", "static": False, "topic": "/tf", "role": "tf"}
    streams = [
        StreamSpec("tf", "pose", "world", frames),
        StreamSpec("wrist", "wrench", "tool", {"topic": "/wrist"}),
        StreamSpec("slides", "joints", "", {"topic": "/slides", "names": ["x", "y", "z"]}),
    ]
    yaw = (torch.rand(pokes, generator=random, dtype=torch.float64) - 0.5) * math.radians(140)
    aside = 0.02 * draw(pokes)
    height = 0.03 + 0.05 * torch.rand(pokes, generator=random, dtype=torch.float64)
    steps = []  # pose, force on the finger, touched point
    for poke in range(pokes):
        along = torch.stack((yaw[poke].cos(), yaw[poke].sin(), yaw.new_zeros(())))
        side = torch.stack((-yaw[poke].sin(), yaw[poke].cos(), yaw.new_zeros(())))
        middle = torch.tensor([0.6, 0.0, 0.0], dtype=torch.float64) + aside[poke] * side
        start = middle - 0.17 * along + torch.tensor([0.0, 0.0, 1.0]).double() * height[poke]
        travel, ball = 0.0, start
        while travel < 0.25:  # until the ball touches, or has passed by
            gap = float(model.exact.distance(se3.apply(se3.inverse(world_T_object), ball[None]))[0]) - _RADIUS
            if gap < 1e-5:
                break
            travel += min(max(gap, 1e-5), 0.005)
            ball = start + travel * along
        touched = travel < 0.25
        pushed_m = push_m if touched else 0.0
        own = se3.apply(se3.inverse(world_T_object), ball[None])
        normal = se3.rotate(world_T_object, model.exact(own).gradient)[0]
        across = draw(3)
        across = across - (across @ normal) * normal
        force = _PUSH_N * (normal + 0.2 * across / across.norm())
        rotation = torch.stack((along, side, torch.tensor([0.0, 0.0, 1.0]).double()), -1)
        for step in range(100):
            share = min(step / 50, 1.0) if step < 80 else max(0.0, (99 - step) / 20)
            gone = pushed_m * min(max((step - 50) / 20, 0.0), 1.0)
            at = start + (travel + gone) * share * along
            pushed = touched and 50 <= step < 70
            pose = se3.make(rotation, at - _AHEAD * along)
            steps.append((pose, force if pushed else torch.zeros(3).double(), at - _RADIUS * normal))
        world_T_object = world_T_object.clone()
        world_T_object[:3, 3] += pushed_m * along
    first = steps[0]
    steps = [(first[0], torch.zeros(3).double(), first[2])] * 21 + steps
    carriage = torch.stack([pose[:3, 3] for pose, *_ in steps])
    seconds = _STEP_NS / 1e9
    velocity = torch.zeros_like(carriage)
    velocity[1:] = (carriage[1:] - carriage[:-1]) / seconds
    # from one poke to the next it is put, not moved: nothing is felt then
    velocity[velocity.norm(dim=-1) > 1.0] = 0.0
    with LogWriter(path, streams, live=False) as log:
        for index, (pose, force, point) in enumerate(steps):
            stamp = _START_NS + index * _STEP_NS
            log.append("tf", stamp, stamp, pose=pose.numpy())
            turn_back = pose[:3, :3].mT
            moment = torch.linalg.cross(turn_back @ (point - pose[:3, 3]), turn_back @ force)
            measured = torch.cat((turn_back @ force, moment)) + draw(6) * torch.tensor(
                [_NOISE[0]] * 3 + [_NOISE[1]] * 3, dtype=torch.float64
            )
            log.append("wrist", stamp, stamp, force=measured[:3].numpy(), torque=measured[3:].numpy())
            weight = torch.tensor([0.0, 0.0, 9.81 * _MASS_KG], dtype=torch.float64)
            effort = weight - force + _NOISE[2] * draw(3)
            rest = torch.zeros(3, dtype=torch.float64)  # so slow that mass does not matter
            log.append("slides", stamp, stamp, position=rest.numpy(), velocity=rest.numpy(), effort=effort.numpy())
    return world_T_object


def mapping_text(model: str, case: str, robot: Path) -> str:
    """The mapping file of a case."""
    wrench, torques, likely = CASES[case]
    text = MAP.replace("OBJECT", model)
    text += '"/wrist" = "wrench"\n' if wrench else ""
    text += '"/slides" = "torques"\n' if torques else ""
    tables = (WRENCH if wrench else "") + (TORQUES.replace("FILE", str(robot)) if torques else "")
    for name in ("wrench", "torques"):
        tables = tables.replace(f"[{name}]", f"[{name}]\nlikelihood = true") if likely else tables
    return text + tables


@cache
def recording(name: str, seed: int, pokes: int, push_m: float) -> tuple[bytes, Tensor]:
    """A log, and world_T_object at its end."""
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "pokes.h5"
        truth = simulate(MODELS[name](), seed, pokes, push_m, log)
        return log.read_bytes(), truth


def measure(object: str, case: str, seed: int, pokes: int, push_m: float) -> dict[str, Any]:
    """One replay by the case's mapping."""
    data, world_T_object = recording(object, seed, pokes, push_m)
    with tempfile.TemporaryDirectory() as folder:
        log, robot = Path(folder) / "pokes.h5", Path(folder) / "slides.xml"
        log.write_bytes(data)
        robot.write_text(SLIDES)
        mapping = mapping_of(mapping_text(object, case, robot))
        with Log(log) as opened:
            made = make_readings(opened, mapping)
    taken = [replace(one, truth=world_T_object.float()) for one in made.taken]
    places = torch.cat([one.reading.tool_pose[:, :3, 3] for one in taken])
    done = replay(taken, rummager_of_map(mapping, settings_of(mapping), places), seed=seed)
    found = done.result
    return {
        "nll": found.final_nll,
        "position_mm": found.position_error_mm,
        "rotation_deg": found.rotation_error_deg,
        "contacts": found.contacts,
        "seconds": done.wall_s,
    }


def show(lines: list[Line], chosen: Mapping[str, tuple[str, ...]]) -> str:
    """Medians over the recordings, and in how many the nll is less than that of the case before."""
    rows = []
    for name, push_m in dict.fromkeys((line["object"], line["push_m"]) for line in lines):
        before: dict[int, float] = {}
        for case, (*_, likely) in CASES.items():
            own = [line for line in lines if (line["object"], line["push_m"], line["case"]) == (name, push_m, case)]
            if own:
                figures = [_spread([row[key] for row in own]) for key in ("nll", "position_mm", "rotation_deg")]
                nll = {row["seed"]: row["nll"] for row in own}
                both = [seed for seed in nll if seed in before]
                less = f"{sum(nll[seed] < before[seed] for seed in both)} of {len(both)}" if likely else ""
                moved = f"pushed {1e3 * push_m:.0f} mm a poke" if push_m > 0 else "held fast"
                rows.append([f"{name}, {moved}", case, str(len(own)), *figures, less])
                before = nll
    heads = ("object", "what was felt", "recordings", "nll", "position, mm", "rotation, deg", "nll less in")
    return table(heads, rows)


def _spread(values: list[float]) -> str:
    ordered = sorted(values)
    middle = 0.5 * (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2])
    return f"{middle:.1f} ({ordered[0] + 0.0:.1f} to {ordered[-1]:.1f})"


EXPERIMENT = Experiment(
    __doc__,
    "felt.jsonl",
    {"object": tuple(MODELS), "case": tuple(CASES)},
    measure,
    show,
    seeds="1000-1002",
    parameters={"pokes": 5, "push_m": 0.0},
)

if __name__ == "__main__":
    script(EXPERIMENT.main)
