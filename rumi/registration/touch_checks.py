"""What touches must be for a pose to be found from them."""

import torch
from torch import Tensor

from rumi.registration.touch_surface import TouchSurface
from sdf.check import check_near

# of the object's diagonal: points further apart than the first were not all on it; nearer together than the second say
# nothing; and of the points' length, what they need across for a plane
_APART, _TOGETHER, _ACROSS = 2.0, 1e-3, 1e-3
_UNIT = 0.02
_SCALES = {"millimetres": 0.001, "centimetres": 0.01, "inches": 0.0254}


def check_contacts(surface: TouchSurface, points: Tensor, normals: Tensor | None) -> tuple[Tensor, Tensor | None]:
    """Points and normals in float64 on the CPU.

    Raises:
        ValueError: what is wrong with them, and what to do.
    """
    points = _rows("points", points)
    if len(points) < 3:
        raise ValueError(f"Expected 3 contact points or more, got {len(points)}: fewer leave the pose wide open")
    if normals is not None:
        normals = _rows("normals", normals)
        if len(normals) != len(points):
            raise ValueError(f"Expected a normal for each of the {len(points)} points, got {len(normals)}")
        off = (normals.norm(dim=-1) - 1.0).abs()
        if bool((off > _UNIT).any()):
            worst = int(off.argmax())
            raise ValueError(
                f"Expected unit normals, got {int((off > _UNIT).sum())} of {len(normals)} that are not, such as number "
                f"{worst + 1} of length {float(normals[worst].norm()):.4g}: divide each by its length"
            )
        normals = torch.nn.functional.normalize(normals, dim=-1)
    size = float((points.amax(0) - points.amin(0)).norm())
    if size > _APART * surface.diagonal:
        fits = [f"{name} ({x:g})" for name, x in _SCALES.items() if size * x <= _APART * surface.diagonal]
        guess = f"are they in {' or '.join(fits)}, or the mesh in another unit?" if fits else "are they on one object?"
        raise ValueError(
            f"Expected points in metres on one object of {surface.diagonal:.4g} m across, got {size:.4g} m from first "
            f"to last: {guess} Scale them (on the command line --points-scale ...)"
        )
    spread = torch.linalg.svdvals(points - points.mean(0))
    if not float(spread[0]) > _TOGETHER * surface.diagonal:
        raise ValueError(
            f"Expected points at different places, got all {len(points)} within {1e3 * size:.3g} mm: touch elsewhere, "
            "or are they in another unit (on the command line --points-scale ...)?"
        )
    if float(spread[1]) < _ACROSS * float(spread[0]):
        raise ValueError(
            f"Expected points that are not all on one line, got {len(points)} on one: the object could turn about it "
            "as it likes; touch beside it too"
        )
    return points, normals


def _rows(name: str, values: Tensor) -> Tensor:
    given = torch.as_tensor(values).detach()
    values = given.double().cpu()
    if values.ndim != 2 or values.shape[1] != 3:
        raise ValueError(f"Expected {name} of shape (K, 3), got {tuple(values.shape)}")
    bad = int((~torch.isfinite(values)).any(-1).sum())
    if bad:
        raise ValueError(f"Expected finite {name}, got {bad} of {len(values)} with NaN or infinity: leave them out")
    if given.is_floating_point():
        check_near(name, given)
    return values
