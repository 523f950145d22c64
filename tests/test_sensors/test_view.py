"""From depth images of scenes in closed form to surface and free points."""

import math
from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from scripts.bench.known_scenes import SCENES, scene_view, with_noise
from sdf import se3
from sdf.primitives import Capsule
from sensors.semantics import Semantics
from sensors.vision.camera import free_lattice, free_points, lattice_points
from sensors.vision.depth_filters import EdgeSettings, nearest_about, reliable
from sensors.vision.images import depth_metres, undistorted
from sensors.vision.persistence import Persistence
from sensors.vision.robot_body import RobotBody
from sensors.vision.view import Image, KnownScene, view_observation
from tests.fixtures.views import BOUNDS, HEIGHT, WAYS, WIDTH, parts, seeded

pytest.importorskip("cv2")


@pytest.fixture(scope="module", params=SCENES)
def scene(request):
    return scene_view(request.param, HEIGHT, WIDTH)


def look(scene, depth, settings, **given):
    own = {"mask": {"mask": scene.mask}, "color": {"color": scene.color}, "plane": {"generator": seeded(0)}}
    given = {"bounds": BOUNDS, **own[settings.segmentation], **given}
    image, known = (
        {field.name: given.pop(field.name) for field in fields(kind) if field.name in given}
        for kind in (Image, KnownScene)
    )
    image = Image(depth, scene.intrinsics, **image)
    return view_observation(image, scene.world_T_camera, settings, KnownScene(**known), **given)


def parts_of(view):
    return parts(view.observation)


def test_without_the_filter_of_edges_mixed_pixels_are_in_it(scene):
    depth = with_noise(scene.depth, 0.002, lost=0.01, mixed=True, generator=seeded(1))
    off = [
        float((scene.distance(parts_of(look(scene, depth, settings))[0]).abs() > 0.006).double().mean())
        for settings in (replace(WAYS["mask"], edges=None), WAYS["mask"])
    ]
    assert off[0] > 2 * off[1]


def test_units_and_formats_say_the_same(scene):
    metres = look(scene, scene.depth.float(), WAYS["mask"]).observation
    millimetres = (1e3 * scene.depth).nan_to_num(posinf=0.0).round().numpy().astype(np.uint16)
    for depth, unit in ((millimetres, "auto"), (torch.from_numpy(millimetres.astype(np.int32)), "mm")):
        found = look(scene, depth, replace(WAYS["mask"], unit=unit)).observation
        surface = found.points[found.of_class(Semantics.SURFACE)]
        assert float(scene.distance(surface).abs().max()) < 0.001
        assert abs(len(surface) - int(metres.of_class(Semantics.SURFACE).sum())) < 100


def test_what_is_not_known_says_nothing():
    depth = depth_metres(np.array([[0, 65535, 700], [800, 3000, 100]], dtype=np.uint16), near_m=0.2, far_m=2.0)
    assert torch.allclose(depth, torch.tensor([[0.0, 0.0, 0.7], [0.8, 0.0, 0.0]]))
    depth = depth_metres(torch.tensor([[math.nan, -1.0, math.inf], [0.0, 0.5, 3.0]]), far_m=2.0)
    assert depth.tolist() == [[0.0, 0.0, math.inf], [0.0, 0.5, 0.0]]


@pytest.mark.parametrize(
    ("depth", "given", "message"),
    [
        (torch.full((4, 4), 700.0), {}, "median of 700"),
        (torch.zeros(4, 4, 3), {}, "image"),
        (torch.zeros(0, 0), {}, "with pixels"),
        (torch.zeros(0, 5), {}, "with pixels"),
        (torch.zeros(4, 4), {"unit": "cm"}, "auto, m, mm"),
        (torch.zeros(4, 4), {"unit": 0.0}, "above 0"),
    ],
)
def test_wrong_depth_is_refused(depth, given, message, no_shape_check):
    with pytest.raises(ValueError, match=message):
        depth_metres(depth, **given)


@pytest.mark.parametrize(
    ("settings", "given", "message"),
    [
        (WAYS["mask"], {"mask": None}, "mask"),
        (WAYS["mask"], {"mask": torch.ones(2, 2, dtype=torch.bool)}, "shape"),
        (WAYS["color"], {"color": None}, "colour"),
        (WAYS["plane"], {"generator": None}, "plane"),
        (replace(WAYS["mask"], persist_s=0.4), {}, "stamp"),
        (WAYS["mask"], {"body": RobotBody([])}, "world_T_links"),
    ],
)
def test_what_is_missing_is_named(settings, given, message, no_shape_check):
    scene = scene_view("sphere", 48, 64)
    with pytest.raises(ValueError, match=message):
        look(scene, scene.depth, settings, **given)


def test_edges_and_grazing_views_are_left_out():
    scene = scene_view("sphere", HEIGHT, WIDTH)
    depth = scene.depth.float()
    kept = reliable(depth, scene.intrinsics, EdgeSettings(jump_m=0.003, grazing_rad=math.radians(60.0)))
    points = look(scene, depth, replace(WAYS["mask"], edges=None)).observation.points[: int(scene.mask.sum())]
    center = scene.world_T_object[:3, 3].float()
    toward = scene.world_T_camera[:3, 3] - points
    angle = torch.rad2deg(torch.acos(((points - center) * toward).sum(-1) / 0.05 / toward.norm(dim=-1)))
    own = kept[scene.mask]
    assert bool(own[angle < 50].float().mean() > 0.99) and not bool(own[angle > 80].any())
    # a pixel that is not known takes its neighbours with it
    holed = depth.clone()
    holed[120, 160] = 0.0
    lost = reliable(depth, scene.intrinsics) & ~reliable(holed, scene.intrinsics)
    assert int(lost.sum()) == 9


def test_a_step_in_depth_is_cut_on_both_sides():
    depth = torch.full((20, 20), 0.5)
    depth[:, 10:] = 0.6
    kept = reliable(depth, torch.tensor([[300.0, 0, 10], [0, 300.0, 10], [0, 0, 1]]))
    assert not bool(kept[:, 9:11].any()) and bool(kept[2:-2, 2:9].all()) and bool(kept[2:-2, 11:-2].all())
    wide = reliable(depth, torch.tensor([[300.0, 0, 10], [0, 300.0, 10], [0, 0, 1]]), EdgeSettings(margin_px=3))
    assert not bool(wide[:, 7:13].any()) and bool(wide[2:-2, 2:7].all())


def test_nearest_about_is_the_least_and_nothing_where_one_is_not_known():
    depth = torch.full((7, 7), 1.0)
    depth[3, 3], depth[0, 6] = 0.4, 0.0
    near = nearest_about(depth, 1)
    assert near[2:5, 2:5].eq(0.4).all() and near[0:2, 5:7].eq(0.0).all() and near[6, 0] == 1.0
    assert nearest_about(torch.full((3, 3), math.inf), 1).isinf().all()


def test_the_robot_is_cut_out_of_the_object(scene):
    """A finger before the object, in its mask: its points are none of the object's, what is behind it is not free."""
    finger = Capsule((0.0, 0.0, 0.0), (0.0, 0.0, 0.06), 0.008)
    world_T_finger = se3.make(torch.eye(3), torch.tensor([0.25, 0.0, 0.07]))
    from scripts.bench.known_scenes import traced
    from sensors.vision.camera import pixel_rays

    eye, turn = scene.world_T_camera[:3, 3].double(), scene.world_T_camera[:3, :3].double()
    ways = pixel_rays(HEIGHT, WIDTH, scene.intrinsics.double()).reshape(-1, 3) @ turn.mT
    met = traced(finger.double(), se3.inverse(world_T_finger.double()), eye, ways).reshape(HEIGHT, WIDTH)
    depth, mask = torch.minimum(scene.depth, met), scene.mask | torch.isfinite(met)
    assert int((torch.isfinite(met) & scene.mask).sum()) > 50
    body = RobotBody([Capsule((0.0, 0.0, 0.0), (0.0, 0.0, 0.06), 0.008)])
    given = {"mask": mask, "body": body, "world_T_links": world_T_finger[None]}
    surface, free = parts_of(look(scene, depth, WAYS["mask"], **given))
    assert float(scene.distance(surface).abs().max()) < 1e-5 and float(scene.distance(free).min()) > 0
    with_robot, _ = parts_of(look(scene, depth, WAYS["mask"], mask=mask))
    assert float(scene.distance(with_robot).abs().max()) > 0.01


def test_only_what_lies_within_a_box_is_the_object(scene):
    box = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    surface, _ = parts_of(look(scene, scene.depth, WAYS["mask"], within=box))
    assert 50 < len(surface) < int(scene.mask.sum()) and float(surface[:, 1].min()) >= 0


def test_points_that_last_stay_and_fleeting_ones_do_not():
    """At 30 Hz over 0.4 s: steady pixels are averaged, what came later or went is left out."""
    scene = scene_view("box", 120, 160)
    settings = replace(WAYS["mask"], persist_s=0.4, cluster=False)
    memory, off = None, []
    ghost = torch.zeros(120, 160, dtype=torch.bool)
    ghost[5:10, 5:10] = True
    for frame in range(16):
        depth = with_noise(scene.depth, 0.002, generator=seeded(frame))
        mask = scene.mask | (ghost if frame % 6 == 0 else torch.zeros_like(ghost))
        view = look(scene, depth, settings, mask=mask, stamp=frame / 30.0, memory=memory)
        memory = view.memory
        surface, _ = parts_of(view)
        assert not bool(view.surface[ghost].any())
        assert (len(surface) > 0) == (frame >= 12)
        off.append(scene.distance(surface).abs().mean() if len(surface) else None)
    single, _ = parts_of(look(scene, depth, replace(WAYS["mask"], cluster=False)))
    assert len(surface) > 0.85 * len(single)
    # the mean of sixteen frames has a quarter of the noise
    assert off[-1] < 0.4 * scene.distance(single).abs().mean()


def test_persistence_step_by_step():
    depth, on, off = torch.full((1, 2), 0.5), torch.tensor([[True, False]]), torch.zeros(1, 2, dtype=torch.bool)
    state = Persistence.start(1, 2)
    state, seen = state.seen(depth, on, 0.0)
    assert not bool(seen.lasting.any())
    state, seen = state.seen(depth + 0.002, on, 0.1)
    state, seen = state.seen(depth, off, 0.2)  # missing for once
    state, seen = state.seen(depth + 0.001, on, 0.2)
    state, seen = state.seen(depth + 0.001, on, 0.4)
    assert not bool(seen.lasting.any())  # 0.2 s without it: it began anew
    for stamp in (0.5, 0.6, 0.7, 0.8):
        state, seen = state.seen(depth, on, stamp)
    assert seen.lasting.tolist() == [[True, False]]
    assert float(seen.depth[0, 0]) == pytest.approx(0.5002, abs=1e-6)
    state, seen = state.seen(depth + 0.02, on, 0.9)  # another surface
    assert not bool(seen.lasting.any())
    with pytest.raises(ValueError, match="go back"):
        state.seen(depth, on, 0.8)
    with pytest.raises(ValueError, match="images of"):
        state.seen(torch.zeros(2, 2), torch.zeros(2, 2, dtype=torch.bool), 1.0)


def test_lens_distortion_is_undone():
    """A wall's depth stays; a patch of it comes back to where a camera without distortion has it."""
    intrinsics = torch.tensor([[200.0, 0, 80], [0, 200.0, 60], [0, 0, 1]])
    lens = (-0.2, 0.05, 0.0, 0.0)
    depth = torch.full((121, 161), 1.0)
    # where the lens puts the ray of pixel (20, 30)
    x, y = (30 - 80) / 200.0, (20 - 60) / 200.0
    r2 = x * x + y * y
    factor = 1 + lens[0] * r2 + lens[1] * r2 * r2
    u, v = round(200 * x * factor + 80), round(200 * y * factor + 60)
    depth[v - 1 : v + 2, u - 1 : u + 2] = 0.5
    straight = undistorted(depth, intrinsics, lens)
    rows, columns = (straight == 0.5).nonzero().unbind(-1)
    assert abs(float(rows.float().mean()) - 20) < 0.7 and abs(float(columns.float().mean()) - 30) < 0.7
    assert undistorted(depth, intrinsics, (0.0, 0.0)) is depth


def test_free_space_stays_clear_of_all_pixels_about_a_point(scene):
    """Every free point is one by the four pixels about its image, and few of those are left out."""
    depth = scene.depth.float().clone()
    depth[::17, ::13] = 0.0
    place = (scene.intrinsics, scene.world_T_camera, BOUNDS)
    for given in ({"margin_m": 0.01, "spacing": 0.01}, {"fraction": 0.95, "spacing": 0.01}):
        wide = {tuple(p) for p in (1e4 * free_points(depth, *place, **given)).round().long().tolist()}
        near = free_lattice(nearest_about(depth, 1), *place, **given)
        found = {tuple(p) for p in (1e4 * near).round().long().tolist()}
        assert found <= wide and len(found) > 0.75 * len(wide)


def test_free_space_against_a_loop():
    scene = scene_view("box", 48, 64)
    nearest = nearest_about(scene.depth.float(), 1)
    bounds = torch.tensor([[0.25, -0.1, -0.02], [0.55, 0.12, 0.15]])
    found = free_lattice(nearest, scene.intrinsics, scene.world_T_camera, bounds, spacing=0.02)
    expected = []
    for point in lattice_points(bounds, 0.02):
        x, y, z = se3.apply(se3.inverse(scene.world_T_camera), point[None])[0].tolist()
        column = round(x / z * float(scene.intrinsics[0, 0]) + float(scene.intrinsics[0, 2]))
        row = round(y / z * float(scene.intrinsics[1, 1]) + float(scene.intrinsics[1, 2]))
        if 0 <= row < 48 and 0 <= column < 64 and z < float(nearest[row, column]) - 0.010:
            expected.append(point)
    assert len(expected) > 100 and torch.allclose(found, torch.stack(expected))
    behind = torch.tensor([[-0.6, -0.1, 0.0], [-0.4, 0.1, 0.2]])
    assert len(free_lattice(nearest, scene.intrinsics, scene.world_T_camera, behind)) == 0
