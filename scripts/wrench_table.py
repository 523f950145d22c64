"""How far contact points from noisy wrenches are off, against the bound that comes with them; and how long they take.

python -m scripts.wrench_table                         # Markdown: a ball of 25 mm, levers of 50 and 100 mm
python -m scripts.wrench_table --count 100000 --friction 0.3
python -m scripts.wrench_table --speed --threads 1     # microseconds, one wrench at a time and many
"""

import itertools
import math
import sys
from dataclasses import dataclass
from typing import NamedTuple

import torch
import tyro
from torch import Tensor

from rumi.bench.timing import fitting_clock
from rumi.cli import script
from scripts.reproduce.cells import table
from sdf.mesh.convex import hull
from sdf.mesh.mesh import TriangleMesh
from sensors.force.force_torque import WrenchNoise, WrenchSettings, WrenchStatus, wrench_contact
from sensors.force.tool_surface import ConvexTool, SphereTool, ToolSurface

RADIUS = 0.0125
NOISES = ((0.02, 0.0005), (0.05, 0.001), (0.1, 0.005))
FORCES = (2.0, 5.0, 10.0)
LEVERS = (0.05, 0.1)
F64 = torch.float64


@dataclass(frozen=True)
class Options:
    """What is drawn.

    Attributes:
        count: contacts of a cell.
        friction: largest coefficient with which a contact leans, and that is assumed.
        seed: of the draws.
        speed: measure times instead.
        threads: of torch and the kernels, for times.
    """

    count: int = 20000
    friction: float = 0.5
    seed: int = 0
    speed: bool = False
    threads: int = 1


class Cell(NamedTuple):
    """One noise, force and lever.

    Attributes:
        error_mm: root mean square of the point's error.
        bound_mm: root mean square of what the covariance says.
        covered: share in which the 90 % ellipse has the true point.
        normal_deg: root mean square of the angle between the normals, over sqrt(2): about each axis.
        normal_said_deg: what is said of it.
        refused: share that is reported as impossible.
    """

    error_mm: float
    bound_mm: float
    covered: float
    normal_deg: float
    normal_said_deg: float
    refused: float


def unit(generator: torch.Generator, count: int) -> Tensor:
    """Directions (n, 3), uniform."""
    return torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=F64), dim=-1)


def ball_points(lever: float, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Points and normals all over a ball, the sensor's own side apart."""
    normals = unit(generator, count)
    normals[:, 2] = normals[:, 2].abs()
    return torch.tensor([0.0, 0.0, lever], dtype=F64) + RADIUS * normals, normals


def pushed(normals: Tensor, friction: float, size: float, generator: torch.Generator) -> Tensor:
    """Forces anywhere in the friction cone."""
    side = unit(generator, len(normals))
    side = torch.nn.functional.normalize(side - (side * normals).sum(-1, keepdim=True) * normals, dim=-1)
    share = friction * torch.rand(len(normals), 1, generator=generator, dtype=F64).sqrt()
    return size * (share * side - normals) / (1.0 + share.square()).sqrt()


def cell(tool: ToolSurface, lever: float, size: float, noise: WrenchNoise, options: Options) -> Cell:
    """Draw contacts, add noise, and compare."""
    generator = torch.Generator().manual_seed(options.seed)
    points, normals = ball_points(lever, options.count, generator)
    forces = pushed(normals, options.friction, size, generator)
    wrench = torch.cat((forces, torch.linalg.cross(points, forces)), -1)
    covariance = noise.covariance()
    wrench = wrench + covariance.diagonal().sqrt() * torch.randn(wrench.shape, generator=generator, dtype=F64)
    found = wrench_contact(wrench, tool, covariance, WrenchSettings(friction=options.friction))
    good = found.status == WrenchStatus.CONTACT
    off, spread = (found.point_s - points)[good], found.covariance[good]
    distance = (off * (torch.linalg.pinv(spread, rtol=1e-6) @ off[..., None])[..., 0]).sum(-1)
    chord = (found.normal_s - normals)[good].norm(dim=-1)
    angle = 2.0 * torch.asin((0.5 * chord).clamp(max=1.0))
    return Cell(
        1e3 * float(off.square().sum(-1).mean().sqrt()),
        1e3 * float(spread.diagonal(dim1=-2, dim2=-1).sum(-1).mean().sqrt()),
        float((distance < -2.0 * math.log(0.1)).double().mean()),  # chi-square of two degrees of freedom
        math.degrees(float((0.5 * angle.square().mean()).sqrt())),
        math.degrees(float(found.normal_sd_rad[good].square().mean().sqrt())),
        1.0 - float(good.double().mean()),
    )


def tools(lever: float) -> dict[str, ToolSurface]:
    """The ball in closed form, and as a polyhedron of 1000 corners."""
    center = torch.tensor([0.0, 0.0, lever], dtype=F64)
    turn = torch.arange(1000, dtype=F64)
    height = 1.0 - 2.0 * (turn + 0.5) / len(turn)
    angle, ring = math.pi * (1.0 + math.sqrt(5.0)) * turn, (1.0 - height.square()).sqrt()
    corners = center + RADIUS * torch.stack((ring * angle.cos(), ring * angle.sin(), height), -1)
    mesh = hull(TriangleMesh(corners, torch.tensor([[0, 1, 2], [2, 3, 4]])))
    return {"ball": SphereTool(center, RADIUS), "1000 corners": ConvexTool.of(mesh)}


def errors(options: Options) -> str:
    """Markdown."""
    heads = ("tool", "noise", "force, N", "lever, mm", "error, mm", "bound, mm", "ratio", "in the 90 % ellipse")
    rows = []
    for name in ("ball", "1000 corners"):
        noises = NOISES if name == "ball" else NOISES[1:2]
        for (force_n, moment_nm), size, lever in itertools.product(noises, FORCES, LEVERS):
            found = cell(tools(lever)[name], lever, size, WrenchNoise(force_n, moment_nm), options)
            rows.append(
                [
                    *(name, f"{force_n:g} N, {1e3 * moment_nm:g} mN m", f"{size:g}", f"{1e3 * lever:g}"),
                    *(f"{x:.2f}" for x in (found.error_mm, found.bound_mm, found.error_mm / found.bound_mm)),
                    f"{100 * found.covered:.1f} %",
                    f"{found.normal_deg:.1f} ({found.normal_said_deg:.1f})",
                    f"{100 * found.refused:.1f} %",
                ]
            )
    return table((*heads, "normal, deg (said)", "reported impossible"), rows)


def speed(options: Options) -> str:
    """Markdown: medians of five, microseconds a wrench; with one thread by the processor's clock."""
    torch.set_num_threads(options.threads)
    clock = fitting_clock(options.threads)
    rows = []
    for name, tool in tools(LEVERS[0]).items():
        generator = torch.Generator().manual_seed(options.seed)
        points, normals = ball_points(LEVERS[0], 1000, generator)
        forces = pushed(normals, options.friction, 5.0, generator)
        many = torch.cat((forces, torch.linalg.cross(points, forces)), -1)
        covariance = WrenchNoise().covariance()
        wrench_contact(many, tool, covariance)
        cells = []
        for wrench, repeats in ((many[0], 500), (many, 10)):
            took = []
            for _ in range(5):
                began = clock()
                for _ in range(repeats):
                    wrench_contact(wrench, tool, covariance)
                took.append((clock() - began) / repeats / wrench.reshape(-1, 6).shape[0])
            cells.append(f"{1e6 * sorted(took)[2]:.3g}")
        rows.append([name, *cells])
    return table(("tool", "one wrench, us", "of 1000 at once, us each"), rows)


def main() -> None:
    """Print the table."""
    options = tyro.cli(Options, description=__doc__)
    sys.stdout.write(speed(options) if options.speed else errors(options))


if __name__ == "__main__":
    script(main)
