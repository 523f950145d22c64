"""Exports as JSON, NPZ, MJCF and URDF."""

import math
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.errors import UsageError
from rumi.registration.pose_summary import COVARIANCE_ORDER, PoseMode
from rumi.runs.export import Estimates, Format
from rumi.runs.files import whole_file
from rumi.runs.folder import write_json
from rumi.runs.trace import TraceWriter
from sdf import so3

SCHEMA = 1
"""Of JSON and NPZ exports."""


def _json(found: Estimates, path: Path) -> list[Path]:
    """The answer, and the estimate after each step: SI units, quaternions x y z w."""
    steps = [{"step": one.step, "stamp_s": one.stamp, "pose": one.pose.as_dict()} for one in found.steps]
    known = {"free_points": len(found.free), "surface_points": len(found.surface)}
    write_json(path, {"schema": SCHEMA, **found.answer, "pose": steps[-1]["pose"], "steps": steps, **known})
    return [path]


def _npz(found: Estimates, path: Path) -> list[Path]:
    """Arrays (T steps, at most M modes, unused ones with weight 0; N particles of the last belief)."""
    most = max(len(one.pose.modes) for one in found.steps)
    unused = PoseMode(torch.eye(4, dtype=torch.float64), 0.0, torch.zeros(6, 6, dtype=torch.float64))
    modes = [[*one.pose.modes, *[unused] * (most - len(one.pose.modes))] for one in found.steps]
    arrays = {
        "step": np.array([one.step for one in found.steps]),
        "stamp_s": np.array([one.stamp for one in found.steps]),
        "world_T_object": torch.stack([one.pose.world_T_object for one in found.steps]),
        "covariance": torch.stack([one.pose.covariance for one in found.steps]),
        "covariance_order": np.array(COVARIANCE_ORDER),
        "probability": np.array([one.pose.probability for one in found.steps]),
        "mode_world_T_object": torch.stack([torch.stack([mode.world_T_object for mode in row]) for row in modes]),
        "mode_covariance": torch.stack([torch.stack([mode.covariance for mode in row]) for row in modes]),
        "mode_weight": np.array([[mode.weight for mode in row] for row in modes]),
        "particle_world_T_object": found.poses,
        "particle_log_weight": found.log_weights,
        "free": found.free,
        "surface": found.surface,
        "frame": np.array("world"),
        "schema": np.array(SCHEMA),
    }
    with whole_file(path) as aside, TraceWriter(aside) as archive:
        for name, values in arrays.items():
            archive.array(name, np.asarray(values))
    return [path]


def _mjcf(found: Estimates, path: Path) -> list[Path]:
    """A MuJoCo model with the object at its best pose; it is seen and does not collide."""
    mesh, pose = _obj(found, path), found.last.pose.world_T_object
    x, y, z, w = so3.quaternion(pose[:3, :3]).tolist()
    model = ElementTree.Element("mujoco", model=found.task)
    asset = ElementTree.SubElement(model, "asset")
    ElementTree.SubElement(asset, "mesh", name="object", file=mesh.name)
    world = ElementTree.SubElement(model, "worldbody")
    body = ElementTree.SubElement(world, "body", name="object", pos=_words(pose[:3, 3]), quat=_words([w, x, y, z]))
    # its convex hull would fill what is hollow: who wants contacts says how
    ElementTree.SubElement(body, "geom", type="mesh", mesh="object", contype="0", conaffinity="0")
    return [_xml(model, path), mesh]


def _urdf(found: Estimates, path: Path) -> list[Path]:
    """A URDF of two links, world and object, joined by a fixed joint at the best pose."""
    mesh, pose = _obj(found, path), found.last.pose.world_T_object
    robot = ElementTree.Element("robot", name=found.task)
    ElementTree.SubElement(robot, "link", name="world")
    link = ElementTree.SubElement(robot, "link", name="object")
    for kind in ("visual", "collision"):
        geometry = ElementTree.SubElement(ElementTree.SubElement(link, kind), "geometry")
        ElementTree.SubElement(geometry, "mesh", filename=mesh.name)
    joint = ElementTree.SubElement(robot, "joint", name="world_to_object", type="fixed")
    ElementTree.SubElement(joint, "parent", link="world")
    ElementTree.SubElement(joint, "child", link="object")
    ElementTree.SubElement(joint, "origin", xyz=_words(pose[:3, 3]), rpy=_words(roll_pitch_yaw(pose[:3, :3])))
    return [_xml(robot, path), mesh]


JSON = Format("the answer and the estimate after each step", "pose.json", _json)
NPZ = Format("poses, covariances, modes, particles, free and surface points", "estimates.npz", _npz)
MJCF = Format("a MuJoCo model: the object's mesh at its best pose", "object.xml", _mjcf, meshed=True)
URDF = Format("a URDF: the object's mesh at its best pose", "object.urdf", _urdf, meshed=True)


def roll_pitch_yaw(rotation: Float[Tensor, "3 3"]) -> list[float]:
    """Angles about the fixed x, y and z axes in this order, radians, as URDF has them; roll 0 where two axes meet."""
    level = math.hypot(float(rotation[0, 0]), float(rotation[1, 0]))
    pitch = math.atan2(-float(rotation[2, 0]), level)
    if level < 1e-9:
        return [0.0, pitch, math.atan2(-float(rotation[0, 1]), float(rotation[1, 1]))]
    yaw = math.atan2(float(rotation[1, 0]), float(rotation[0, 0]))
    return [math.atan2(float(rotation[2, 1]), float(rotation[2, 2])), pitch, yaw]


def _obj(found: Estimates, beside: Path) -> Path:
    """The object's mesh in its own frame, metres, as a Wavefront file beside another one."""
    if found.mesh is None:
        raise UsageError("Expected the object's mesh, got none: give --mesh FILE")
    path = beside.with_suffix(".obj")
    if path.exists() and not beside.exists():  # no export's: one writes both
        raise UsageError(f"Expected no file {path}, where the mesh goes: give another --out, or take it away")
    vertices = [f"v {_words(row)}" for row in found.mesh.vertices]
    faces = ["f " + " ".join(map(str, row)) for row in (found.mesh.faces + 1).tolist()]
    with whole_file(path) as aside:
        aside.write_text("\n".join([*vertices, *faces]) + "\n", encoding="ascii")
    return path


def _xml(root: ElementTree.Element, path: Path) -> Path:
    ElementTree.indent(root)
    with whole_file(path) as aside:
        aside.write_text(ElementTree.tostring(root, encoding="unicode") + "\n", encoding="utf-8")
    return path


def _words(numbers: Tensor | list[float]) -> str:
    """Numbers as text that reads back as the same numbers."""
    values = numbers.tolist() if isinstance(numbers, Tensor) else numbers
    return " ".join(repr(float(value)) for value in values)
