"""Robot body from a URDF: collision shapes of links, and forward kinematics at measured joints."""

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.errors import UsageError
from rumi.robot.robot_file import read_robot
from sdf import se3
from sdf.base import SDF
from sdf.extras import optional
from sdf.mesh.convex import hull
from sdf.mesh.mesh import MeshError, TriangleMesh, load_mesh
from sdf.primitives import Box, Cylinder, Placed, Sphere
from sensors.vision.robot_body import RobotBody


class Hull(SDF):
    """The convex hull of a mesh: distances are exact inside; outside, beyond edges and corners, they are too small.

    So a filter takes at most too much for the robot.

    Args:
        mesh: any triangles.
    """

    planes: Tensor

    def __init__(self, mesh: TriangleMesh) -> None:
        outer = hull(mesh)
        super().__init__(outer.bounds.float())
        a, b, c = outer.corners.double().unbind(1)
        normals = torch.linalg.cross(b - a, c - a)
        length = normals.norm(dim=-1)
        normals = normals[length > 1e-12] / length[length > 1e-12, None]
        a = a[length > 1e-12]
        middle = outer.corners.double().reshape(-1, 3).mean(0)
        offsets = (normals * a).sum(-1)
        side = torch.where(normals @ middle > offsets, -1.0, 1.0).double()  # whichever way its faces turn
        planes = torch.cat((normals * side[:, None], (offsets * side)[:, None]), -1)
        self.register_buffer("planes", torch.unique((1e6 * planes).round(), dim=0).div(1e6).float())

    def distance(self, points_o: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        """Signed distance (*b), metres."""
        planes = self.planes.to(points_o)
        return (points_o @ planes[:, :3].mT - planes[:, 3]).amax(-1)


@dataclass(frozen=True)
class UrdfBody:
    """A robot's collision shapes and the chain that they hang on.

    Attributes:
        body: the shapes, one a link of the filter.
        owners: the URDF link of each.
        joints: names of the joints that must be measured.
        chain: of pytorch-kinematics.
    """

    body: RobotBody
    owners: tuple[str, ...]
    joints: tuple[str, ...]
    chain: Any

    @classmethod
    def load(cls, robot: str | Path, *, packages: Mapping[str, Path] | None = None) -> Self:
        """Read a URDF file, or its text.

        Args:
            robot: path, or text that starts with "<". Boxes, spheres, cylinders and meshes (their convex hulls) of its
                `collision` elements are taken; mesh files are looked for beside the file.
            packages: folders of the packages that `package://` names.

        Raises:
            UsageError: no URDF, no collision shapes, a shape of another kind or without its size, a mesh that cannot be
                read, or joints that cannot be.
            ModuleNotFoundError: pytorch-kinematics is not installed.
        """
        pytorch_kinematics = optional("pytorch_kinematics", "A robot's chain")
        text, folder = read_robot(robot)
        try:
            root = ElementTree.fromstring(text)
        except ElementTree.ParseError as error:
            raise UsageError(f"Expected a URDF, could not read it: {error}") from error
        links: list[SDF] = []
        owners: list[str] = []
        for link in root.iter("link"):
            for collision in link.findall("collision"):
                links.append(_shape(collision, folder or Path(), packages or {}))
                owners.append(str(link.get("name")))
        if not links:
            raise UsageError("Expected collision shapes in the URDF, got none: the robot's body cannot be told from it")
        try:
            chain = pytorch_kinematics.build_chain_from_urdf(text.encode())
        except Exception as error:  # it raises whatever it stumbles over
            raise UsageError(f"Expected a URDF whose links hang together by joints, got: {error}") from error
        return cls(RobotBody(links), tuple(owners), tuple(chain.get_joint_parameter_names()), chain)

    def poses(
        self, joints: Mapping[str, float], world_T_base: Float[Tensor, "4 4"] | None = None
    ) -> Float[Tensor, "L 4 4"]:
        """world_T_links of the body at measured joints, for `RobotBody.near` and `view_observation`.

        Args:
            joints: angle or way of each joint by name, radians or metres; more than are needed do no harm.
            world_T_base: (4, 4), where the URDF's root link stands; the world's origin by default.

        Raises:
            UsageError: a joint was not measured; with those that lack.
        """
        lacking = [name for name in self.joints if name not in joints]
        if lacking:
            raise UsageError(f"Expected all joints that move to be measured, {', '.join(lacking)} are not")
        measured = torch.tensor([float(joints[name]) for name in self.joints], dtype=torch.float32)
        found = self.chain.forward_kinematics(measured)
        poses = torch.stack([found[name].get_matrix()[0] for name in self.owners])
        return poses if world_T_base is None else world_T_base.to(poses) @ poses


def _shape(collision: ElementTree.Element, folder: Path, packages: Mapping[str, Path]) -> SDF:
    """A collision element, in its link's frame."""
    place, turn = (
        torch.tensor(_three(f"{name} of an origin", _attribute(collision, "origin", name) or "0 0 0"))
        for name in ("xyz", "rpy")
    )
    geometry = collision.find("geometry")
    kinds = [] if geometry is None else list(geometry)
    if len(kinds) != 1:
        raise UsageError(f"Expected one shape in each geometry of the URDF, got {len(kinds)}")
    shape = kinds[0]
    member: SDF
    if shape.tag == "box":
        member = Box([0.5 * side for side in _three("size of a box", str(shape.get("size")))])
    elif shape.tag == "sphere":
        member = Sphere(_size(shape, "radius"))
    elif shape.tag == "cylinder":
        member = Cylinder(_size(shape, "radius"), 0.5 * _size(shape, "length"))
    elif shape.tag == "mesh":
        try:
            member = Hull(_mesh(shape, folder, packages))
        except MeshError as error:
            raise UsageError(str(error)) from error
    else:
        raise UsageError(f"Expected a box, sphere, cylinder or mesh in the URDF's collisions, got {shape.tag!r}")
    roll, pitch, yaw = (
        se3.exp(torch.cat((torch.zeros(3), angle * axis))) for angle, axis in zip(turn, torch.eye(3), strict=True)
    )
    return Placed(member, se3.make((yaw @ pitch @ roll)[:3, :3], place))


def _three(name: str, text: str) -> list[float]:
    """Three numbers of an attribute."""
    try:
        found = [float(word) for word in text.split()]
    except ValueError:
        found = []
    if len(found) != 3 or not all(map(math.isfinite, found)):
        raise UsageError(f"Expected three numbers for the {name} in the URDF, got {text!r}")
    return found


def _size(shape: ElementTree.Element, name: str) -> float:
    """A size of a shape, such as its radius."""
    text = shape.get(name)
    try:
        found = math.nan if text is None else float(text)
    except ValueError:
        found = math.nan
    if not 0.0 < found < math.inf:
        raise UsageError(f"Expected a {name} above 0 for each {shape.tag} in the URDF, got {text!r}")
    return found


def _attribute(element: ElementTree.Element, child: str, name: str) -> str | None:
    found = element.find(child)
    return None if found is None else found.get(name)


def _mesh(shape: ElementTree.Element, folder: Path, packages: Mapping[str, Path]) -> TriangleMesh:
    name = str(shape.get("filename"))
    if name.startswith("package://"):
        package, _, rest = name.removeprefix("package://").partition("/")
        if package not in packages:
            raise UsageError(f"Expected the folder of package {package!r}, which {name} is in: give it in packages")
        path = packages[package] / rest
    else:
        path = folder / name.removeprefix("file://")
    mesh = load_mesh(path)
    scale = torch.tensor(_three(f"scale of {name}", shape.get("scale") or "1 1 1"))
    if not bool((scale == scale[0]).all()):
        raise UsageError(f"Expected one scale along all axes for {name}, got {scale.tolist()}")
    return mesh.scaled(float(scale[0]))
