"""Report on a mesh: size, defects, and how each is repaired."""

import math
from dataclasses import asdict, dataclass
from typing import Any

from sdf.lattice import lattice_about
from sdf.mesh.build import choose_spacing
from sdf.mesh.mesh import MeshError, TriangleMesh, check_size
from sdf.mesh.mesh_sdf import MeshSDF
from sdf.mesh.repair import Repaired
from sdf.mesh.triangles import area_vectors
from sdf.mesh.walls import thinnest_wall

ERROR, WARNING, NOTE = "error", "warning", "note"
# metres: sizes beyond which a mesh is taken, with a question
_SMALL_M, _LARGE_M = 0.02, 1.5
# from the origin, beyond which nothing more is looked at
_FAR_M = 1000.0


@dataclass(frozen=True)
class Finding:
    """One thing that was found.

    Attributes:
        level: "error" (the mesh cannot be used), "warning" (look at it) or "note" (put right, nothing to do).
        text: what was found, what was done, and what to do.
    """

    level: str
    text: str


@dataclass(frozen=True)
class MeshReport:
    """Report on a mesh: its size, its defects and their repair.

    Attributes:
        vertices: number of vertices, those on each other merged.
        faces: number of faces.
        bounds_m: lower and upper corner.
        size_m: edges of the box.
        diagonal_m: of the box.
        area_m2: of all faces.
        volume_m3: enclosed, after putting right; None if that failed.
        watertight: whether each edge was shared by faces that agree, before anything was put right.
        parts: faces joined by edges.
        wall_m: thickness that 99 % of the walls' area has; None where there are none.
        spacing_m: of the table, as given or as it would be chosen; None if the mesh cannot be used.
        nodes: of that table, along each axis.
        findings: what is wrong, the worst first.
    """

    vertices: int
    faces: int
    bounds_m: tuple[tuple[float, ...], ...]
    size_m: tuple[float, ...]
    diagonal_m: float
    area_m2: float
    volume_m3: float | None
    watertight: bool
    parts: int
    wall_m: float | None
    spacing_m: float | None
    nodes: tuple[int, ...]
    findings: tuple[Finding, ...]

    @property
    def usable(self) -> bool:
        """Whether signed distances can be had of it."""
        return all(finding.level != ERROR for finding in self.findings)

    def to_dict(self) -> dict[str, Any]:
        """Everything, as JSON takes it."""
        return {**asdict(self), "usable": self.usable}

    def text(self) -> str:
        """Everything, for people."""
        size = " x ".join(f"{1e3 * x:.4g}" for x in self.size_m)
        low, high = self.bounds_m
        spans = ", ".join(f"{name} {1e3 * a:.4g} to {1e3 * b:.4g}" for name, a, b in zip("xyz", low, high, strict=True))
        lines = [
            f"faces      {self.faces} of {self.vertices} vertices in {_count(self.parts, 'part')}, "
            f"{'watertight' if self.watertight else 'not watertight'}",
            f"size       {size} mm ({spans})",
            f"area       {1e4 * self.area_m2:.4g} cm^2",
        ]
        if self.volume_m3 is not None:
            lines.append(f"volume     {1e6 * self.volume_m3:.4g} cm^3")
            wall = "none found" if self.wall_m is None else f"{1e3 * self.wall_m:.3g} mm"
            lines.append(f"thin wall  {wall}")
        if self.spacing_m is not None:
            lines.append(
                f"table      a node every {1e3 * self.spacing_m:.3g} mm, {' x '.join(map(str, self.nodes))} nodes, "
                f"{4 * math.prod(self.nodes) / 2**20:.3g} MiB"
            )
        lines += [f"{finding.level + ':':<10} {finding.text}" for finding in self.findings]
        if not self.findings:
            lines.append("nothing is wrong with it")
        return "\n".join(lines) + "\n"


def report(
    mesh: TriangleMesh, *, spacing: float | None = None, padding: float = 0.02, scale: float = 1.0
) -> MeshReport:
    """Look a mesh over.

    Args:
        mesh: as it came.
        spacing: of the table, metres, if it is given.
        padding: of the table, metres.
        scale: by which it was read from its file.
    """
    findings = []
    far = float(mesh.bounds.abs().max()) > _FAR_M
    try:
        check_size(mesh, scale)
    except MeshError as error:
        findings.append(Finding(ERROR if spacing is None or far else WARNING, str(error)))
    else:
        if not _SMALL_M <= mesh.diagonal <= _LARGE_M:
            findings.append(Finding(WARNING, f"{mesh.diagonal:.3g} m across: are the units metres? (--scale)"))
    shape = None
    try:
        shape = MeshSDF(mesh)
    except MeshError as error:
        findings.append(Finding(ERROR, str(error)))
    wall: float | None = None
    chosen: float | None = None
    nodes: tuple[int, ...] = ()
    if shape is not None:
        wall = None if far else thinnest_wall(shape.repair.surface, mesh.diagonal)
        findings += _findings(shape.repair)
        if wall is not None and all(finding.level != ERROR for finding in findings):
            chosen = choose_spacing(shape, padding) if spacing is None else spacing
            nodes = tuple(len(axis) for axis in lattice_about(mesh.bounds, chosen, padding).axes)
            findings += _wall_findings(wall, chosen)
    worst = (ERROR, WARNING, NOTE)
    repair = None if shape is None else shape.repair
    low, high = mesh.bounds.tolist()
    return MeshReport(
        len(mesh.vertices),
        len(mesh.faces),
        (tuple(low), tuple(high)),
        tuple(b - a for a, b in zip(low, high, strict=True)),
        mesh.diagonal,
        float(area_vectors(mesh.corners).norm(dim=-1).sum()),
        None if repair is None else repair.volume,
        repair is not None and not repair.openings and repair.orientation.turned_faces == 0,
        0 if repair is None else repair.orientation.parts,
        wall,
        chosen,
        nodes,
        tuple(sorted(findings, key=lambda finding: worst.index(finding.level))),
    )


def _findings(repair: Repaired) -> list[Finding]:
    """What putting right has come across."""
    found, turns = [], repair.orientation
    closed = [opening for opening in repair.openings if opening.closed]
    left = [opening for opening in repair.openings if not opening.closed]
    if closed:
        widest = max(opening.width for opening in closed)
        found.append(
            Finding(
                WARNING if widest > 0.005 else NOTE,
                f"{_count(len(closed), 'opening')}, up to {1e3 * widest:.3g} mm wide: closed by flat fans, so that "
                "the surface there is a guess",
            )
        )
    if left:
        edges, widest = sum(opening.edges for opening in left), max(opening.width for opening in left)
        found.append(
            Finding(
                WARNING,
                f"{_count(len(left), 'opening')} that cannot be closed ({edges} open edges, up to "
                f"{1e3 * widest:.3g} mm wide): inside is where the faces wind more than half about a point, "
                "which is a guess near them",
            )
        )
    if repair.hidden_share > 0:
        found.append(
            Finding(
                NOTE,
                f"parts overlap: {100 * repair.hidden_share:.2g} % of the area is inside of other parts, and left out",
            )
        )
    if turns.turned_faces:
        found.append(
            Finding(
                NOTE, f"{_count(turns.turned_faces, 'face')} turned, to agree with those beside them on what is out"
            )
        )
    if turns.turned_parts:
        found.append(Finding(NOTE, f"{_count(turns.turned_parts, 'part')} turned, inside out as they were"))
    if turns.cavities:
        found.append(Finding(NOTE, f"{_count(turns.cavities, 'cavity', 'cavities')} inside, kept hollow"))
    if turns.one_sided:
        found.append(
            Finding(WARNING, f"{_count(turns.one_sided, 'part')} with one side only (as a Moebius band): left as it is")
        )
    if repair.duplicates:
        found.append(Finding(NOTE, f"{_count(repair.duplicates, 'face')} there more than once: left out"))
    if repair.degenerate:
        found.append(Finding(NOTE, f"{_count(repair.degenerate, 'face')} without area: left out"))
    return found


def _wall_findings(wall: float | None, spacing: float) -> list[Finding]:
    if wall is None or spacing <= 0.5 * wall * 1.001:
        return []
    text = f"walls of {1e3 * wall:.3g} mm are too thin for a node every {1e3 * spacing:.3g} mm, and get lost in part"
    return [Finding(WARNING, f"{text}: give --spacing {0.5 * wall:.2g}")]


def _count(number: int, word: str, many: str | None = None) -> str:
    return f"{number} {word if number == 1 else many or word + 's'}"
