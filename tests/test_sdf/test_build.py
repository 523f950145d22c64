"""Tables of meshes: against closed forms, and what is kept on disk."""

import logging
import multiprocessing
import subprocess
import sys

import numpy as np
import pytest
import torch

import sdf
import sdf.mesh.build
from sdf.grid_sdf import GridSDF
from sdf.lattice import lattice_about
from sdf.mesh.build import choose_spacing, from_mesh
from sdf.mesh.fill import inside_nodes, unsigned_distances
from sdf.mesh.mesh import MeshError, TriangleMesh
from sdf.mesh.mesh_sdf import MeshSDF
from sdf.mesh.triangles import Triangles
from sdf.mesh.walls import thinnest_wall
from sdf.object_model import mesh_model
from sdf.primitives import Box, Sphere
from sdf.surface import sample_triangles

pytest.importorskip("scipy")

HALF = (0.03, 0.04, 0.05)


def write_obj(mesh, path):
    rows = [f"v {x!r} {y!r} {z!r}" for x, y, z in mesh.vertices.tolist()]
    rows += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in mesh.faces.tolist()]
    path.write_text("\n".join(rows) + "\n")
    return path


def test_the_table_of_a_box_is_that_of_its_closed_form(shapes):
    table, exact = from_mesh(shapes.box(), spacing=0.004), GridSDF.from_sdf(Box(HALF), 0.004)
    torch.testing.assert_close(table.values, exact.values, atol=1e-7, rtol=0)
    assert table.values.dtype == torch.float32
    assert (table.spacing, table.outer, table.outer_spacing) == (exact.spacing, exact.outer, exact.outer_spacing)
    torch.testing.assert_close(table.bounds, exact.bounds)


def test_the_table_is_what_the_exact_shape_says_at_every_node(shapes):
    """Sides are worked out by regions; here node by node. Open ones too."""
    ball = shapes.sphere(rings=9)
    for mesh in (
        shapes.together(shapes.box((0.05, 0.01, 0.02)), shapes.box((0.01, 0.05, 0.02))),
        shapes.together(shapes.box(), shapes.turned(shapes.box((0.02, 0.02, 0.02)))),
        shapes.without(ball, *range(0, len(ball.faces), 11)),
    ):
        shape = MeshSDF(mesh)
        table = from_mesh(shape, spacing=0.005)
        nodes = GridSDF.from_sdf(shape, 0.005)
        torch.testing.assert_close(table.values, nodes.values, atol=1e-7, rtol=0)


def test_loose_sides_are_asked_about_at_every_node(shapes):
    box = shapes.box()
    sides = [shapes.without(box, *(k for k in range(12) if k // 2 != side)) for side in range(6)]
    table = from_mesh(shapes.together(*sides), spacing=0.005)
    exact = GridSDF.from_sdf(Box(HALF), 0.005)
    on = exact.values.abs() < 1e-6
    torch.testing.assert_close(table.values[~on], exact.values[~on], atol=1e-7, rtol=0)


def test_far_values_may_be_interpolated(shapes):
    full = from_mesh(shapes.sphere(), spacing=0.003)
    rough = from_mesh(shapes.sphere(), spacing=0.003, band=0.01)
    near = full.values.abs() <= 0.01
    assert torch.equal(rough.values[near], full.values[near])
    far = full.values.abs() > 0.01
    assert not torch.equal(rough.values[far], full.values[far])
    assert float((rough.values - full.values).abs().max()) < 0.002
    assert torch.equal(rough.values < 0, full.values < 0)


def test_a_file_in_one_line(shapes, tmp_path):
    path = write_obj(shapes.box().scaled(1000.0), tmp_path / "box.obj")
    table = sdf.from_mesh(path, scale=0.001, spacing=0.005)
    assert float(table.distance(torch.tensor([0.05, 0.0, 0.0]))) == pytest.approx(0.02, abs=1e-6)


def test_progress_is_told(shapes):
    told = []
    from_mesh(shapes.box(), spacing=0.005, progress=lambda what, share: told.append((what, share)))
    assert {what for what, _ in told} == {"mesh", "distance", "sign"}
    assert all(0 <= share <= 1 for _, share in told)
    assert told[-1] == ("sign", 1.0)


def test_spacing_follows_the_thinnest_wall(shapes):
    tray = shapes.box((0.05, 0.05, 0.0009))
    assert thinnest_wall(Triangles(tray.corners), tray.diagonal) == pytest.approx(0.0018, rel=0.01)
    assert choose_spacing(MeshSDF(tray)) == pytest.approx(0.0009, rel=0.01)
    assert choose_spacing(MeshSDF(shapes.box())) == sdf.mesh.build.SPACING_M
    # a shape without opposite sides has no wall; a small one has smaller steps
    tetrahedron = shapes.tetrahedron(0.04)
    assert thinnest_wall(Triangles(tetrahedron.corners), tetrahedron.diagonal) is None
    assert choose_spacing(MeshSDF(tetrahedron)) == pytest.approx(tetrahedron.diagonal / 50)


def test_walls_of_a_hollow_count(shapes):
    hollow = shapes.together(shapes.box(), shapes.turned(shapes.box((0.027, 0.03, 0.04))))
    wall = thinnest_wall(MeshSDF(hollow).repair.surface, hollow.diagonal)
    assert wall == pytest.approx(0.003, rel=0.01)


def test_bytes_are_bounded(shapes, caplog):
    sheet = shapes.box((0.2, 0.2, 0.0005))
    with caplog.at_level(logging.WARNING):
        spacing = choose_spacing(MeshSDF(sheet), most_bytes=4 << 20)
    assert "are lost" in caplog.text
    table = from_mesh(sheet, spacing=spacing)
    assert 2 << 20 < table.values.numel() * 4 <= 4 << 20
    with pytest.raises(MeshError, match="widen the spacing"):
        from_mesh(sheet, spacing=0.0002)


def test_bad_arguments(shapes):
    for bad in ({"spacing": 0.0}, {"padding": -1.0}, {"band": -1.0}):
        with pytest.raises(ValueError, match="Expected"):
            from_mesh(shapes.box(), **bad)
    with pytest.raises(ValueError, match="scale of 1"):
        from_mesh(MeshSDF(shapes.box()), scale=2.0)
    with pytest.raises(MeshError, match="millimetres"):
        from_mesh(shapes.box().scaled(1000.0))


def forbidden(*arguments, **options):
    raise AssertionError("worked out again")


def test_the_cache_saves_the_work(shapes, tmp_path, monkeypatch):
    path, kept = write_obj(shapes.box(), tmp_path / "box.obj"), tmp_path / "cache"
    first = from_mesh(path, spacing=0.005, cache_dir=kept)
    copy = tmp_path / "another name.obj"
    copy.write_bytes(path.read_bytes())
    with monkeypatch.context() as patch:
        patch.setattr(sdf.mesh.build, "_build", forbidden)
        patch.setattr(sdf.mesh.build, "load_mesh", forbidden)
        for again in (path, copy):
            table = from_mesh(again, spacing=0.005, cache_dir=str(kept))
            assert torch.equal(table.values, first.values) and torch.equal(table.bounds, first.bounds)
            names = ("origin", "spacing", "outer", "outer_spacing", "inset")
            assert all(getattr(table, name) == getattr(first, name) for name in names)
        for other in ({"padding": 0.03}, {"scale": 0.9}, {"spacing": 0.006}, {"band": 0.01}):
            with pytest.raises(AssertionError, match="again"):
                from_mesh(path, cache_dir=kept, **{"spacing": 0.005, **other})
        patch.setattr(sdf.mesh.build, "VERSION", -1)
        with pytest.raises(AssertionError, match="again"):
            from_mesh(path, spacing=0.005, cache_dir=kept)
    path.write_text(path.read_text().replace("0.05", "0.06"))
    changed = from_mesh(path, spacing=0.005, cache_dir=kept)
    assert float(changed.bounds[1, 2]) == pytest.approx(0.06)
    assert len(list(kept.iterdir())) == 2


def test_meshes_in_memory_are_kept_by_what_they_hold(shapes, tmp_path, monkeypatch):
    from_mesh(shapes.box(), spacing=0.005, cache_dir=tmp_path)
    monkeypatch.setattr(sdf.mesh.build, "_build", forbidden)
    from_mesh(shapes.box(), spacing=0.005, cache_dir=tmp_path)
    from_mesh(MeshSDF(shapes.box()), spacing=0.005, cache_dir=tmp_path)
    with pytest.raises(AssertionError, match="again"):
        from_mesh(shapes.turned(shapes.box()), spacing=0.005, cache_dir=tmp_path)


@pytest.mark.parametrize("damage", ["garbage", "truncated", "pickle", "nan", "foreign", "shape", "dtype"])
def test_a_damaged_or_foreign_file_is_worked_out_again(shapes, tmp_path, caplog, damage):
    first = from_mesh(shapes.box(), spacing=0.01, cache_dir=tmp_path)
    (path,) = tmp_path.iterdir()
    with np.load(path) as stored:
        arrays = dict(stored)
    if damage == "garbage":
        path.write_bytes(b"not a table")
    elif damage == "truncated":
        path.write_bytes(path.read_bytes()[:-500])
    elif damage == "pickle":
        np.savez(path, **{**arrays, "values": np.array([{"a": 1}], dtype=object)})
    elif damage == "nan":
        np.savez(path, **{**arrays, "values": np.full_like(arrays["values"], np.nan)})
    elif damage == "foreign":
        np.savez(path, something=np.zeros(3))
    elif damage == "shape":
        np.savez(path, **{**arrays, "values": arrays["values"][:5]})
    else:
        np.savez(path, **{**arrays, "values": arrays["values"].astype(np.int32)})
    with caplog.at_level(logging.WARNING):
        again = from_mesh(shapes.box(), spacing=0.01, cache_dir=tmp_path)
    assert "working it out again" in caplog.text
    assert torch.equal(again.values, first.values)
    caplog.clear()
    from_mesh(shapes.box(), spacing=0.01, cache_dir=tmp_path)
    assert not caplog.text
    assert len(list(tmp_path.iterdir())) == 1


def _work(folder, vertices, faces, gate, results):
    mesh = TriangleMesh(torch.from_numpy(vertices), torch.from_numpy(faces))
    gate.wait()
    results.put(from_mesh(mesh, spacing=0.008, cache_dir=folder).values.numpy().tobytes())


def test_two_processes_at_once(shapes, tmp_path):
    box, context = shapes.box(), multiprocessing.get_context("fork")
    gate, results = context.Barrier(2), context.Queue()
    arguments = (tmp_path, box.vertices.numpy(), box.faces.numpy(), gate, results)
    workers = [context.Process(target=_work, args=arguments) for _ in range(2)]
    for worker in workers:
        worker.start()
    found = [results.get(timeout=60) for _ in workers]
    for worker in workers:
        worker.join()
    assert found[0] == found[1] == from_mesh(box, spacing=0.008).values.numpy().tobytes()
    assert [path.suffix for path in tmp_path.iterdir()] == [".npz"]


def test_nothing_is_written_without_a_folder(shapes, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    from_mesh(shapes.box(), spacing=0.01)
    assert list(tmp_path.iterdir()) == []


def test_parts_of_the_filling(shapes):
    lattice = lattice_about(shapes.box().bounds, 0.01, 0.02)
    shape = MeshSDF(shapes.box())
    distance = unsigned_distances(lattice, shape.repair.surface)
    assert (distance >= 0).all() and distance.shape == tuple(len(axis) for axis in lattice.axes)
    inside = inside_nodes(lattice, shape.repair, shape.mesh.bounds, distance)
    grid = torch.stack(torch.meshgrid(*lattice.axes, indexing="ij"), -1)
    exact = Box(HALF).double().distance(grid).numpy()
    assert (inside == (exact < 0))[np.abs(exact) > 1e-9].all()


def test_the_exact_shape_is_a_signed_distance_function(shapes, generator):
    shape = MeshSDF(shapes.box())
    points = 0.08 * torch.randn(500, 3, generator=generator)
    exact = Box(HALF)
    torch.testing.assert_close(shape.distance(points), exact.distance(points), atol=1e-7, rtol=0)
    query, expected = shape(points), exact(points)
    outside = expected.distance > 1e-4
    torch.testing.assert_close(query.gradient[outside], expected.gradient[outside], atol=1e-4, rtol=0)
    on = shape(torch.tensor([[0.03, 0.01, 0.01], [0.0, 0.04, 0.0]]))
    torch.testing.assert_close(on.gradient, torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]))
    assert bool(torch.isfinite(shape.distance(torch.full((2, 3), torch.nan))).all())
    assert shape.diagonal == pytest.approx(exact.diagonal)


def test_points_on_triangles_are_uniform_by_area(shapes, generator):
    box = shapes.box()
    points, normals = sample_triangles(Triangles(box.corners), 1200, generator=generator)
    assert float(Box(HALF).double().distance(points).abs().max()) < 1e-12
    areas = torch.tensor([0.08 * 0.1, 0.06 * 0.1, 0.06 * 0.08])
    for axis in range(3):
        side = normals[:, axis].abs() > 0.5
        assert float(side.double().mean()) == pytest.approx(float(areas[axis] / areas.sum()), abs=0.02)
        on = normals[side, axis] * points[side, axis]
        torch.testing.assert_close(on, torch.full_like(on, HALF[axis]))
    # within a triangle too
    assert points.mean(0).abs().max() < 0.002
    with pytest.raises(ValueError, match="count"):
        sample_triangles(Triangles(box.corners), 0, generator=generator)


def test_a_model_of_a_mesh(shapes, tmp_path):
    ball = shapes.sphere(0.04, rings=40)
    path = write_obj(ball, tmp_path / "ball.obj")
    model = mesh_model(path, spacing=0.004, points=200, cache_dir=tmp_path)
    assert model.name == "ball"
    assert isinstance(model.exact, MeshSDF) and isinstance(model.sdf, GridSDF)
    assert float(Sphere(0.04).distance(model.surface_points).abs().max()) < 1e-4
    assert float((model.surface_points / 0.04 - model.surface_normals).norm(dim=-1).max()) < 0.06
    assert float(model.exact.distance(model.surface_points).abs().max()) < 1e-7
    again = mesh_model(path, spacing=0.004, points=200, cache_dir=tmp_path)
    assert torch.equal(again.surface_points, model.surface_points) and torch.equal(again.sdf.values, model.sdf.values)
    other = mesh_model(ball, name="other", spacing=0.004, points=200, seed=1)
    assert other.name == "other" and not torch.equal(other.surface_points, model.surface_points)
    double = model.to(torch.float64)
    assert double.exact.bounds.dtype == torch.float64 and model.exact.bounds.dtype == torch.float32
    assert double.exact.distance(torch.zeros(1, 3, dtype=torch.float64)).dtype == torch.float64


def test_importing_is_light():
    code = "import sys, sdf, sdf.object_model; print({'trimesh', 'scipy', 'numba'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
    with pytest.raises(AttributeError, match="no attribute"):
        _ = sdf.nothing_of_that_name
