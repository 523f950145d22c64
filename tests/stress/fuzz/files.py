"""Files under damage: flipped bytes, cuts, numbers that are none, and pickles where arrays should be."""

import io
import os
import tempfile
import zipfile
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from rumi.commands.contact_files import read_contacts
from rumi.robot.reach_table import ReachSettings, table_shape
from rumi.robot.reach_table import _load as load_reach_table
from rumi.runs.folder import RunRecorder, load_run
from rumi.runs.jsonlines import append_line, read_lines
from scripts.reproduce.records import Records
from sdf.cache import load_table, save_arrays, save_table
from sdf.grid_sdf import GridSDF
from sdf.mesh.mesh import load_mesh
from sdf.primitives import Box
from tests.stress.fuzz.draw import Draw, choice
from tests.stress.made_run import made_result, made_steps

Target = Callable[[Draw], Iterable[Tensor]]
FILES: dict[str, Target] = {}
"""Targets by name: each damages a file that was right and reads it."""

WORDS = (b"nan", b"inf", b"-1", b"1e999", b"99999999999", b"null", b"[]", b"{}", b"\x00", b"\xff" * 8, b"", b"\n", b'"')


class Bomb:
    """What would run code if it were ever unpickled."""

    fired = False

    def __reduce__(self) -> tuple[Callable[[], None], tuple[()]]:
        """Say to call `fire`."""
        return Bomb.fire, ()

    @staticmethod
    def fire() -> None:
        """Note that code of a file was run."""
        Bomb.fired = True


@cache
def originals() -> dict[str, bytes]:
    """Small files of every kind that is read, as they should be."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _meshes(folder)
        _contacts(folder)
        table = GridSDF.from_sdf(Box((0.02, 0.03, 0.01)), 0.02, 0.02, outer=0.0)
        save_table(folder / "table.npz", table)
        shape = table_shape(ReachSettings())
        save_arrays(folder / "reach.npz", {"position": np.zeros(shape), "rotation": np.zeros(shape)})
        for step in range(3):
            append_line(folder / "lines.jsonl", {"step": step, "figures": [1.0, None]})
        _record(folder / "run")
        return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def _meshes(folder: Path) -> None:
    corners, faces = np.eye(4, 3), np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    rows = [" ".join(f"{x:g}" for x in corner) for corner in corners]
    triangles = [" ".join(map(str, face)) for face in faces]
    obj = [f"v {row}" for row in rows] + ["f " + " ".join(str(i + 1) for i in face) for face in faces]
    (folder / "mesh.obj").write_text("\n".join(obj) + "\n")
    (folder / "mesh.off").write_text("\n".join(["OFF", "4 4 0", *rows, *[f"3 {t}" for t in triangles]]) + "\n")
    head = ["ply", "format ascii 1.0", "element vertex 4", *[f"property float {a}" for a in "xyz"], "element face 4"]
    head += ["property list uchar int vertex_indices", "end_header"]
    (folder / "mesh.ply").write_text("\n".join([*head, *rows, *[f"3 {t}" for t in triangles]]) + "\n")
    parts = np.zeros(4, dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")])
    parts["corners"] = corners[faces]
    (folder / "mesh.stl").write_bytes(b"\0" * 80 + np.uint32(4).tobytes() + parts.tobytes())


def _contacts(folder: Path) -> None:
    points = np.arange(12.0).reshape(4, 3) * 0.01
    text = "x,y,z\n" + "\n".join(",".join(f"{x:g}" for x in row) for row in points) + "\n"
    (folder / "contacts.csv").write_text(text)
    rows = "\n".join(" ".join(f"{x:g}" for x in row) for row in points)
    (folder / "contacts.off").write_text(f"OFF\n4 0 0\n{rows}\n")
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 4\n"
    head += "".join(f"property float {a}\n" for a in "xyz") + "end_header\n"
    (folder / "contacts.ply").write_bytes(head.encode() + points.astype("<f4").tobytes())
    np.savez(folder / "contacts.npz", points=points, normals=np.zeros_like(points))
    np.save(folder / "contacts.npy", points)


def _record(folder: Path) -> None:
    """A run of two steps."""
    with RunRecorder(folder, {"seed": 0}) as recorder:
        for step in made_steps(2, points=2, particles=2):
            recorder(step)
        recorder.finish(made_result(1))


def damaged(draw: Draw, data: bytes) -> bytes:
    """A file after an accident or after somebody's work."""
    for _ in range(draw.integer(1, 3)):
        at = draw.integer(0, max(len(data) - 1, 0))
        upto = min(len(data), at + draw.integer(0, 40))
        kind = draw.integer(0, 6)
        if kind == 0 and data:
            data = data[:at] + bytes([data[at] ^ (1 << draw.integer(0, 7))]) + data[at + 1 :]
        elif kind == 1:
            data = data[:at]
        elif kind == 2:
            data = data[:at] + data[upto:]
        elif kind == 3:
            data = data[:at] + choice(draw, WORDS) + data[upto if draw.integer(0, 1) else at :]
        elif kind == 4:
            data = data[:upto] + data[at:]
        elif kind == 5:
            data = data[:at] + bytes(draw.integer(0, 255) for _ in range(draw.integer(1, 8))) + data[at:]
        else:
            data = _with_number(draw, data)
    return data


def _with_number(draw: Draw, data: bytes) -> bytes:
    """One of its numbers in text turned into another word."""
    places = [k for k in range(len(data)) if data[k : k + 1].isdigit()][:200]
    if not places:
        return data
    at = choice(draw, places)
    return data[:at] + choice(draw, WORDS) + data[at + 1 :]


def pickled(draw: Draw, names: list[str]) -> bytes:
    """An archive, one of whose arrays is of objects: to read it means to unpickle a bomb."""
    whole, bad = io.BytesIO(), io.BytesIO()
    np.save(bad, np.array([Bomb()], dtype=object), allow_pickle=True)
    with zipfile.ZipFile(whole, "w") as archive:
        chosen = draw.integer(0, len(names) - 1)
        for k, name in enumerate(names):
            good = io.BytesIO()
            np.save(good, np.zeros((2, 3)))
            archive.writestr(f"{name}.npy", (bad if k == chosen else good).getvalue())
    return whole.getvalue() if draw.integer(0, 1) else bad.getvalue()


def with_file(
    draw: Draw,
    name: str,
    original: Callable[[], bytes],
    read: Callable[[Path], Iterable[Tensor]],
    arrays: list[str],
) -> Iterable[Tensor]:
    """A case that damages a file and reads it.

    Args:
        draw: of the case.
        name: of the file.
        original: its bytes as they should be.
        read: what is tested.
        arrays: names of the arrays that it holds, one of which is a pickle at times; none if it holds no arrays.

    Raises:
        AssertionError: code of the file was run.
    """
    with tempfile.TemporaryDirectory() as folder:
        bomb = arrays and draw.integer(0, 9) == 0
        path = Path(folder) / name
        path.write_bytes(pickled(draw, arrays) if bomb else damaged(draw, original()))
        results = list(read(path))
    if Bomb.fired:
        Bomb.fired = False
        raise AssertionError("code of a file was run")
    return results


def _enter(name: str, original: str, read: Callable[[Path], Iterable[Tensor]], *arrays: str) -> None:
    FILES[name] = lambda draw: with_file(draw, original, lambda: originals()[original], read, list(arrays))


def _mesh(path: Path) -> Iterable[Tensor]:
    return (load_mesh(path).vertices,)


def _points(path: Path) -> Iterable[Tensor]:
    found = read_contacts(path)
    # what is not finite is told by who uses it, with the number of the touch
    assert found.points.ndim == 2
    return ()


def _table(path: Path) -> Iterable[Tensor]:
    found = load_table(path)
    if found is None:
        return ()
    query = found(torch.linspace(-1.0, 1.0, 12).reshape(4, 3))
    return query.distance, query.gradient


def _reach(path: Path) -> Iterable[Tensor]:
    found = load_reach_table(path, ReachSettings())
    return () if found is None else (found.position, found.rotation)


def _lines(path: Path) -> Iterable[Tensor]:
    lines = [line for line, _ in read_lines(path)]
    Records(path)
    before = len(lines)
    append_line(path, {"step": 99})
    after = [line for line, _ in read_lines(path)]
    if after[-1] != {"step": 99} or not before <= len(after) - 1 <= before + 1:
        raise AssertionError("a line was lost")
    return ()


def _run(draw: Draw) -> Iterable[Tensor]:
    """A run folder, one of whose files was damaged."""
    files = {name: data for name, data in originals().items() if name.startswith("run")}
    chosen = choice(draw, sorted(files))
    bomb = chosen.endswith(".npz") and draw.integer(0, 9) == 0
    with tempfile.TemporaryDirectory() as folder:
        for name, data in files.items():
            path = Path(folder) / name
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(data)
        path = Path(folder) / chosen
        path.write_bytes(pickled(draw, ["step_00000/control"]) if bomb else damaged(draw, files[chosen]))
        if draw.integer(0, 19) == 0:
            os.unlink(path)
        load_run(Path(folder) / "run")
    if Bomb.fired:
        Bomb.fired = False
        raise AssertionError("code of a file was run")
    return ()


for _suffix in ("obj", "off", "ply", "stl"):
    _enter(f"mesh-{_suffix}", f"mesh.{_suffix}", _mesh)
for _suffix in ("csv", "off", "ply", "npz", "npy"):
    _enter(f"contacts-{_suffix}", f"contacts.{_suffix}", _points, *(("points",) if _suffix.startswith("np") else ()))
_enter("cached-table", "table.npz", _table, "values", "origin", "spacing", "bounds", "outer", "outer_spacing")
_enter("cached-reach", "reach.npz", _reach, "position", "rotation")
_enter("result-lines", "lines.jsonl", _lines)
FILES["run-folder"] = _run
