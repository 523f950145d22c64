"""Localise simulated touches of which some are bad, and print how often the heaviest mode is right, and surely wrong.

    python -m scripts.localize_outliers --poses 40 --outlier 0.05       # Markdown; seeds 1000-1039
    RUMI_DATA=... python -m scripts.localize_outliers --shape drill

A bad touch is 15 mm off in a direction drawn evenly. Right is within 10 mm, at the middle of the object's box,
and 10 degrees, up to symmetries.
"""

import math
import os
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


@dataclass(frozen=True)
class Options:
    """Options.

    Attributes:
        shape: an angle bracket of 80 x 60 x 40 mm with walls of 8 mm, or the drill in RUMI_DATA.
        touches: how many, one table row each for none, one and a fifth of them bad.
        poses: how many, of seeds from 1000 on.
        outlier: share of outliers that the likelihood has.
        off_mm: of a bad touch.
    """

    shape: Literal["bracket", "drill"] = "bracket"
    touches: tuple[int, ...] = (6, 8, 10, 12, 20, 30)
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
    """Of so many touches: right, wrong with a weight above 0.95, and the median of the seconds."""
    right, sure, seconds = 0, 0, []
    for seed in range(1000, 1000 + options.poses):
        truth, points, normals = touches(surface, count, bad, 1e-3 * options.off_mm, seed)
        began = time.perf_counter()
        settings = LocalizeSettings(outlier=options.outlier)
        found = localize(
            surface, points, normals=normals if with_normals else None, settings=settings, generator=generator(seed)
        )
        seconds.append(time.perf_counter() - began)
        own = surface.symmetries.nearest(truth, found.world_T_object[0])
        metres, radians = se3.distance(surface.centred(own), surface.centred(found.world_T_object[0]))
        good = float(metres) < 0.01 and float(radians) < math.radians(10.0)
        right += good
        sure += not good and float(found.weights[0]) > 0.95
    return [f"{right}", f"{sure}", f"{sorted(seconds)[len(seconds) // 2]:.2f}"]


def main() -> None:
    """Print the table."""
    torch.set_num_threads(1)
    options = tyro.cli(Options, description=__doc__)
    mesh: TriangleMesh | Path = bracket()
    if options.shape == "drill":
        mesh = next((Path(os.environ["RUMI_DATA"]) / "ycb_power_drill").glob("**/*.obj"))
    surface = TouchSurface.of(mesh)
    rows = []
    for count in options.touches:
        for bad in sorted({0, 1, round(0.2 * count)}):
            for with_normals in (False, True):
                own = cell(surface, options, count, bad, with_normals)
                rows.append([str(count), str(bad), "with" if with_normals else "none", *own])
                print("\t".join(rows[-1]), flush=True)
    print(table(("touches", "bad", "normals", "right", "wrong, weight > 0.95", "seconds"), rows))


if __name__ == "__main__":
    script(main)
