"""Serial arm of an MJCF model as URDF text: MuJoCo reads defaults, angles and frames, whatever they are written in."""

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from rumi.errors import UsageError
from sdf import se3
from sdf.extras import optional

_MUJOCO = ("mujoco", "An arm by MJCF")
Numbers = Sequence[float] | np.ndarray


def urdf_of_mjcf(robot: str | Path, tip: str) -> str:
    """The arm from an MJCF's world to a body or site, as URDF text; its last link is `tip`, its root `world`.

    Boxes, spheres, cylinders and capsules that collide come along, other shapes do not.

    Args:
        robot: file of the MJCF, or its text.
        tip: name of the body or site.

    Raises:
        UsageError: it cannot be read, there is no such tip, or a joint is neither a hinge nor a slide.
    """
    mujoco = optional(*_MUJOCO)
    inline = str(robot).lstrip().startswith("<")
    try:
        load = mujoco.MjModel.from_xml_string if inline else mujoco.MjModel.from_xml_path
        model = load(str(robot))
    except (ValueError, OSError) as error:
        raise UsageError(f"Expected an MJCF that MuJoCo can read, got: {error}") from error
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, tip)
    body = int(model.site_bodyid[site]) if site >= 0 else mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, tip)
    if body < 0:
        names = [model.body(k).name for k in range(1, model.nbody)] + [model.site(k).name for k in range(model.nsite)]
        raise UsageError(f"There is no body or site {tip!r} in the MJCF; there are {', '.join(filter(None, names))}")
    bodies = [body]
    while bodies[0] > 0:
        bodies.insert(0, int(model.body_parentid[bodies[0]]))
    parts = ['<robot name="arm">', _link(model, 0, "world")]
    parent = "world"
    for own in bodies[1:]:
        # a body's joints act at a point of it: there, move on, and back
        rest = _pose(model.body_pos[own], model.body_quat[own])
        for joint in range(model.body_jntadr[own], model.body_jntadr[own] + model.body_jntnum[own]):
            at = _pose(model.jnt_pos[joint], (1.0, 0.0, 0.0, 0.0))
            name = model.joint(joint).name or f"joint_{joint}"
            parts += [f'<link name="{name}_link"/>', _joint(model, joint, name, parent, rest @ at)]
            parent, rest = f"{name}_link", se3.inverse(at)
        name = model.body(own).name or f"body_{own}"
        parts += [_link(model, own, name), _fixed(f"{name}_body", parent, name, rest)]
        parent = name
    end = torch.eye(4).double() if site < 0 else _pose(model.site_pos[site], model.site_quat[site])
    if parent == "tip":
        return "".join([*parts, "</robot>"])
    return "".join([*parts, '<link name="tip"/>', _fixed("tip_mount", parent, "tip", end), "</robot>"])


def _joint(model: Any, joint: int, name: str, parent: str, place: torch.Tensor) -> str:  # noqa: ANN401  (of MuJoCo)
    mujoco = optional(*_MUJOCO)
    kinds = {mujoco.mjtJoint.mjJNT_HINGE: "revolute", mujoco.mjtJoint.mjJNT_SLIDE: "prismatic"}
    kind = kinds.get(mujoco.mjtJoint(int(model.jnt_type[joint])))
    if kind is None:
        raise UsageError(f"Expected joints that turn or slide, got {name!r}, which is a ball or free")
    limited = bool(model.jnt_limited[joint])
    if not limited and kind == "prismatic":
        raise UsageError(f"Expected a range for the joint {name!r}, which slides, got none")
    low, high = model.jnt_range[joint].tolist()
    limit = f'<limit lower="{low!r}" upper="{high!r}" effort="1" velocity="1"/>' if limited else ""
    return (
        f'<joint name="{name}" type="{kind if limited else "continuous"}"><parent link="{parent}"/>'
        f'<child link="{name}_link"/>{_origin(place)}<axis xyz="{_words(model.jnt_axis[joint])}"/>{limit}</joint>'
    )


def _fixed(name: str, parent: str, child: str, place: torch.Tensor) -> str:
    return f'<joint name="{name}" type="fixed"><parent link="{parent}"/><child link="{child}"/>{_origin(place)}</joint>'


def _link(model: Any, body: int, name: str) -> str:  # noqa: ANN401  (of MuJoCo)
    mujoco = optional(*_MUJOCO)
    shapes = []
    for geom in range(model.body_geomadr[body], model.body_geomadr[body] + model.body_geomnum[body]):
        if not (model.geom_contype[geom] or model.geom_conaffinity[geom]):
            continue
        place, size = _pose(model.geom_pos[geom], model.geom_quat[geom]), model.geom_size[geom].tolist()
        kind = mujoco.mjtGeom(int(model.geom_type[geom]))
        if kind == mujoco.mjtGeom.mjGEOM_BOX:
            told = f'<box size="{_words(2.0 * side for side in size)}"/>'
        elif kind == mujoco.mjtGeom.mjGEOM_SPHERE:
            told = f'<sphere radius="{size[0]!r}"/>'
        elif kind in (mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_CAPSULE):
            told = f'<cylinder radius="{size[0]!r}" length="{2.0 * size[1]!r}"/>'
        else:
            continue
        shapes.append((place, told))
        if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
            for side in (-1.0, 1.0):
                end = place @ _pose((0.0, 0.0, side * size[1]), (1.0, 0.0, 0.0, 0.0))
                shapes.append((end, f'<sphere radius="{size[0]!r}"/>'))
    told = "".join(f"<collision>{_origin(place)}<geometry>{shape}</geometry></collision>" for place, shape in shapes)
    return f'<link name="{name}">{told}</link>'


def _pose(position: Numbers, quaternion_wxyz: Numbers) -> torch.Tensor:
    mujoco = optional(*_MUJOCO)
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, np.asarray(quaternion_wxyz, dtype=float))
    return se3.make(torch.from_numpy(turn.reshape(3, 3)), torch.from_numpy(np.asarray(position, dtype=float).copy()))


def _origin(place: torch.Tensor) -> str:
    turn = place[:3, :3]
    pitch = math.asin(max(-1.0, min(1.0, -float(turn[2, 0]))))
    if abs(float(turn[2, 0])) < 1.0 - 1e-9:
        roll, yaw = math.atan2(float(turn[2, 1]), float(turn[2, 2])), math.atan2(float(turn[1, 0]), float(turn[0, 0]))
    else:  # roll and yaw turn about one axis
        roll, yaw = 0.0, math.atan2(-float(turn[0, 1]), float(turn[1, 1]))
    return f'<origin xyz="{_words(place[:3, 3].tolist())}" rpy="{roll!r} {pitch!r} {yaw!r}"/>'


def _words(numbers: Iterable[float]) -> str:
    return " ".join(repr(float(x)) for x in numbers)
