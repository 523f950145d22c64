"""Localise simulated touches of which some are bad, and print how often the heaviest mode is right, and surely wrong.

    python -m scripts.localize_outliers --poses 40 --outlier 0.05       # Markdown; seeds 1000-1039
    RUMI_DATA=... python -m scripts.localize_outliers --shape drill
    RUMI_DATA=... python -m scripts.localize_outliers --shape lego --touches 4 6 9 12 --bad 0 --poses 20
    python -m scripts.localize_outliers --touches 30 --bad 6 --off-mm 50 --poses 5

A bad touch is 15 mm off in a direction drawn evenly. Right is within 10 mm, at the middle of the object's box,
and 10 degrees, up to symmetries.
"""

import math
import os
import statistics
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
import tyro
from torch import Tensor

from rumi.cli import script
from rumi.registration.from_contacts import LocalizeSettings, localize
from rumi.registration.touch_surface import TouchSurface
from rumi.seeding import generator
from scripts.reproduce.cells import table
from sdf import se3, so3
from sdf.mesh.mesh import TriangleMesh
from sdf.surface import sample_triangles

_OUTLINE = [(0.0, 0.0), (0.08, 0.0), (0.08, 0.008), (0.008, 0.008), (0.008, 0.06), (0.0, 0.06)]
_CAP = [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)]
_WIDE = 0.04
_HEADS = (
    "touches",
    "bad",
    "normals",
    "right",
    "a right one kept",
    "wrong, weight > 0.95",
    "plausible",
    "noise, mm",
    "spread, mm",
    "seconds",
)


@dataclass(frozen=True)
class Options:
    """Options.

    Attributes:
        shape: an angle bracket of 80 x 60 x 40 mm with walls of 8 mm, or the drill or the block in RUMI_DATA.
        touches: how many.
        bad: how many of them, a table row each; none gives rows for none, one and a fifth of them.
        poses: how many, of seeds from 1000 on.
        outlier: share of outliers that the likelihood has.
        off_mm: of a bad touch.
    """

    shape: Literal["bracket", "drill", "lego"] = "bracket"
    touches: tuple[int, ...] = (6, 8, 10, 12, 20, 30)
    bad: tuple[int, ...] = ()
    poses: int = 40
    outlier: float = 0.05
    off_mm: float = 15.0


def bracket() -> TriangleMesh:
    """An L of one thickness, without symmetries but its mirror."""
    count = len(_OUTLINE)
    corners = [(x, y, z) for z in (0.0, _WIDE) for x, y in _OUTLINE]
    sides = [(i, (i + 1) % count) for i in range(count)]
    faces = [(a, b, count + b) for a, b in sides] + [(a, count + b, count + a) for a, b in sides]
    faces += [(c, b, a) for a, b, c in _CAP] + [(count + a, count + b, count + c) for a, b, c in _CAP]
    return TriangleMesh(torch.tensor(corners, dtype=torch.float64), torch.tensor(faces))


def touches(surface: TouchSurface, count: int, bad: int, off_m: float, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """A pose, points with 1 mm of noise on the object there, the first of them bad, and normals with 2 degrees."""
    draws = generator(seed)
    turn = so3.exp(math.pi * torch.nn.functional.normalize(torch.randn(4, generator=draws).double(), dim=0)[:3])
    truth = se3.make(turn, 0.3 * torch.randn(3, generator=draws).double())
    points, normals = sample_triangles(surface.triangles, count, generator=draws)
    points = se3.apply(truth, points + surface.middle_o) + 0.001 * torch.randn(count, 3, generator=draws).double()
    away = torch.nn.functional.normalize(torch.randn(count, 3, generator=draws).double(), dim=-1)
    points[:bad] += off_m * away[:bad]
    bent = so3.exp(math.radians(2.0) * torch.randn(count, 3, generator=draws).double())
    return truth, points, (bent @ (normals @ turn.mT)[..., None])[..., 0]


def cell(surface: TouchSurface, options: Options, count: int, bad: int, with_normals: bool) -> list[str]:
    """Of so many touches: right, a right one kept, wrong above 0.95; medians of modes, noise, spread and seconds."""
    right, kept, sure, told = 0, 0, 0, []
    for seed in range(1000, 1000 + options.poses):
        truth, points, normals = touches(surface, count, bad, 1e-3 * options.off_mm, seed)
        began = time.perf_counter()
        settings = LocalizeSettings(outlier=options.outlier)
        found = localize(
            surface, points, normals=normals if with_normals else None, settings=settings, generator=generator(seed)
        )
        seconds = time.perf_counter() - began
        own = [surface.centred(surface.symmetries.nearest(truth, mode)) for mode in found.world_T_object]
        modes = [surface.centred(mode) for mode in found.world_T_object]
        good = [_near(*pair) for pair in zip(own, modes, strict=True)]
        right, kept = right + good[0], kept + any(good)
        sure += not good[0] and float(found.weights[0]) > 0.95
        spread_m = float(torch.linalg.eigvalsh(found.covariance[0, :3, :3])[-1].clamp_min(0.0).sqrt())
        told.append((found.found, 1e3 * found.noise_m, 1e3 * spread_m, seconds))
    modes_, noise, spread, took = (statistics.median(values) for values in zip(*told, strict=True))
    return [f"{right}", f"{kept}", f"{sure}", f"{modes_:g}", f"{noise:.1f}", f"{spread:.1f}", f"{took:.2f}"]


def _near(one: Tensor, other: Tensor) -> bool:
    metres, radians = se3.distance(one, other)
    return float(metres) < 0.01 and float(radians) < math.radians(10.0)


def main() -> None:
    """Print the table."""
    torch.set_num_threads(1)
    options = tyro.cli(Options, description=__doc__)
    mesh: TriangleMesh | Path = bracket()
    if options.shape == "drill":
        mesh = next((Path(os.environ["RUMI_DATA"]) / "ycb_power_drill").glob("**/*.obj"))
    if options.shape == "lego":
        mesh = Path(os.environ["RUMI_DATA"]) / "icub_touch" / "legoBox.off"
    surface = TouchSurface.of(mesh)
    rows = []
    for count in options.touches:
        for bad in options.bad or sorted({0, 1, round(0.2 * count)}):
            for with_normals in (False, True):
                own = cell(surface, options, count, bad, with_normals)
                rows.append([str(count), str(bad), "with" if with_normals else "none", *own])
                print("\t".join(rows[-1]), flush=True)
    print(table(_HEADS, rows))


if __name__ == "__main__":
    script(main)
