"""Point cloud files: PLY, PCD and NPZ, organised as an image or not."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from sdf import se3, so3
from sdf.cache import DAMAGED
from sensors.vision.images import depth_metres
from sensors.vision.numpy_files import read_arrays
from sensors.vision.pcd import read_pcd
from sensors.vision.ply import read_vertices

SUFFIXES = (".ply", ".pcd", ".npz")


class Cloud(NamedTuple):
    """Points as they came from a file.

    Attributes:
        points: (M, 3), or (H, W, 3) in the order of a camera's pixels; metres; NaN where nothing is known.
        colors: (M, 3) or (H, W, 3), bytes, red, green, blue; None where the file has none.
        normals: (M, 3) or (H, W, 3); None where the file has none.
        viewpoint: (4, 4), the pose that the file gives of the sensor (PCD's VIEWPOINT, NPZ's `world_T_camera`); None
            where it gives none. Which way its axes point is up to whoever wrote it.
    """

    points: Float[Tensor, "*b 3"]
    colors: UInt8[Tensor, "*b 3"] | None
    normals: Float[Tensor, "*b 3"] | None
    viewpoint: Float[Tensor, "4 4"] | None


def read_cloud(path: str | Path, *, scale: float = 1.0) -> Cloud:
    """Read a point cloud.

    Args:
        path: .ply (ASCII or binary, vertices first), .pcd (ASCII, binary or compressed), or .npz with an array `points`
            (M, 3) or (H, W, 3) and perhaps `colors`, `normals` and `world_T_camera`, or with `depth` (H, W) and
            `intrinsics` (3, 3) and perhaps `color` (H, W, 3) in place of points. Colours are whole numbers from 0 to
            255, or floating ones from 0 to 1.
        scale: metres that one unit of the file's points is; a depth image has its own rule (`images.depth_metres`).

    Raises:
        ValueError: another kind of file, or one that cannot be read; with what was expected.
        FileNotFoundError: there is no such file.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise ValueError(f"Expected a point cloud ending in {', '.join(SUFFIXES)}, got {path}")
    if not scale > 0:
        raise ValueError(f"Expected a scale above 0, got {scale}")
    data = path.read_bytes()
    try:
        cloud = {".ply": _ply, ".pcd": _pcd, ".npz": _npz}[suffix](data)
    except (*DAMAGED, IndexError, AttributeError) as error:  # all that readers raise of a byte that is another one
        why = str(error) or type(error).__name__
        raise ValueError(f"Expected a point cloud in {path}, could not read it: {why}") from error
    if cloud.points.shape[-1:] != (3,) or cloud.points.ndim not in (2, 3):
        raise ValueError(f"Expected points (M, 3) or (H, W, 3) in {path}, got {tuple(cloud.points.shape)}")
    for name in ("colors", "normals"):
        value = getattr(cloud, name)
        if value is not None and value.shape != cloud.points.shape:
            raise ValueError(
                f"Expected as many {name} as points in {path}, got {tuple(value.shape)} and {tuple(cloud.points.shape)}"
            )
    viewpoint = cloud.viewpoint
    if viewpoint is not None and scale != 1.0:
        viewpoint = se3.make(viewpoint[:3, :3], viewpoint[:3, 3] * scale)
    return cloud._replace(points=cloud.points * scale, viewpoint=viewpoint)


def _ply(data: bytes) -> Cloud:
    columns = read_vertices(data)
    points = _columns(columns, ("x", "y", "z"))
    if points is None or not len(points):
        raise ValueError(f"expected vertices with x, y and z, got {len(points or ())} with {', '.join(columns)}")
    colors = _beside(columns, ("red", "green", "blue"))
    return Cloud(points, None if colors is None else _bytes(colors), _columns(columns, ("nx", "ny", "nz")), None)


def _pcd(data: bytes) -> Cloud:
    file = read_pcd(data)
    columns = file.columns
    points = _columns(columns, ("x", "y", "z"))
    if points is None:
        raise ValueError(f"expected fields x, y and z, found {', '.join(columns)}")
    colors = None
    packed = next((columns[name] for name in ("rgb", "rgba") if name in columns), None)
    if packed is not None:
        bits = packed.view(np.uint32) if packed.dtype.itemsize == 4 else packed.astype(np.uint32)
        colors = torch.from_numpy(np.stack([(bits >> shift) & 255 for shift in (16, 8, 0)], -1).astype(np.uint8))
    normals = _columns(columns, ("normal_x", "normal_y", "normal_z"))
    place, turn = torch.tensor(file.viewpoint, dtype=torch.float64).split((3, 4))
    pose = se3.make(so3.from_wxyz(turn), place).float()
    shape = (file.height, file.width, 3) if file.height > 1 else (file.width, 3)
    return Cloud(
        points.reshape(shape),
        None if colors is None else colors.reshape(shape),
        None if normals is None else normals.reshape(shape),
        pose,
    )


def _npz(data: bytes) -> Cloud:
    names = ("points", "colors", "normals", "depth", "intrinsics", "color", "world_T_camera")
    arrays = read_arrays(data, *names)
    single = {name: torch.tensor(array, dtype=torch.float32) for name, array in arrays.items()}
    viewpoint = single.get("world_T_camera")
    if viewpoint is not None and viewpoint.shape != (4, 4):
        raise ValueError(f"expected world_T_camera (4, 4), got {tuple(viewpoint.shape)}")
    if "points" in arrays:
        points = single["points"]
        colors, normals = arrays.get("colors"), single.get("normals")
    elif "depth" in arrays and "intrinsics" in arrays:
        from sensors.vision.camera import pixel_rays

        depth = depth_metres(arrays["depth"])
        rays = pixel_rays(depth.shape[0], depth.shape[1], single["intrinsics"])
        points = rays * torch.where((depth > 0) & torch.isfinite(depth), depth, torch.nan)[..., None]
        colors, normals = arrays.get("color"), None
    else:
        raise ValueError(f"expected arrays `points`, or `depth` and `intrinsics`, found {', '.join(arrays) or 'none'}")
    return Cloud(points, None if colors is None else _bytes(colors), normals, viewpoint)


def _bytes(colors: np.ndarray) -> UInt8[Tensor, "..."]:
    """Colours as bytes: whole numbers up to 255 as they are, floating ones up to 1 as parts of it; NaN as 0."""
    values = np.nan_to_num(colors.astype(np.float64), nan=0.0)
    least, most = float(values.min(initial=0.0)), float(values.max(initial=0.0))
    if colors.dtype.kind == "f" and least >= 0.0 and most <= 1.0:
        values = np.rint(255.0 * values)
    elif least < 0.0 or most > 255.0 or not (values == np.rint(values)).all():
        raise ValueError(
            "expected colours to be whole numbers from 0 to 255 or floating ones from 0 to 1, got "
            f"{least:g} to {most:g} of {colors.dtype}"
        )
    return torch.from_numpy(values.astype(np.uint8))


def _beside(columns: dict[str, Any], names: tuple[str, ...]) -> np.ndarray | None:
    """Columns of these names side by side; None where one is missing."""
    if not all(name in columns for name in names):
        return None
    return np.stack([np.asarray(columns[name]).reshape(-1) for name in names], -1)


def _columns(columns: dict[str, Any], names: tuple[str, ...]) -> Float[Tensor, "M 3"] | None:
    """The same in single precision."""
    found = _beside(columns, names)
    return None if found is None else torch.tensor(found, dtype=torch.float32)
