"""Which lens and which colours a depth image has, and which pictures a view is made of."""

import numpy as np
import pytest
import torch

from rumi.errors import UsageError
from rumi.rosbag.frames import FrameTree
from rumi.rosbag.mapping_file import mapping_of
from rumi.rosbag.streams import lens_of, lenses_of
from rumi.rosbag.views import Views
from sensors.log.reader import Log
from sensors.log.writer import LogWriter, StreamSpec
from sensors.semantics import Semantics

START = 1_700_000_000 * 10**9
STEP = 10**8
K = np.array([[100.0, 0.0, 31.5], [0.0, 100.0, 23.5], [0.0, 0.0, 1.0]])
MAP = """
schema = 1
[topics]
"/a/depth" = { role = "depth", camera = "/a/info" }
"/a/info" = "camera"
"/a/color" = "color"
"/b/color" = "color"
[frames]
world = "base"
tool = "base"
[scene]
builtin = "mug"
within = [[-0.2, -0.2, 0.4], [0.2, 0.2, 0.55]]
[view]
segmentation = "color"
hue_deg = [200, 260]
"""
NAMED = MAP.replace('camera = "/a/info"', 'camera = "/a/info", color = "/a/color"')


def patch(left):
    """A grey picture with a blue patch of 20 x 20."""
    color = np.full((48, 64, 3), 120, np.uint8)
    color[10:30, left : left + 20] = (30, 60, 200)
    return color


def written(path, *, frames=("a", "b"), model="plumb_bob", distortion=(), projection=None, pictures=(5,), other=40):
    """A camera `a` with colours of its own, and the colours of another one that come nearer in time."""
    about = {"topic": "/a/info", "role": "camera", "distortion_model": model}
    about |= {} if projection is None else {"projection": list(projection)}
    specs = [
        StreamSpec("a/depth", "depth", "a", {"topic": "/a/depth", "role": "depth", "camera": "a/info"}),
        StreamSpec("a/info", "camera", "a", about),
        StreamSpec("a/color", "color", frames[0], {"topic": "/a/color", "role": "color"}),
        StreamSpec("b/color", "color", frames[1], {"topic": "/b/color", "role": "color"}),
        StreamSpec("tf", "pose", "base", {"parent": "base", "child": "a", "static": True}),
    ]
    with LogWriter(path, specs) as log:
        log.append("tf", START, START, pose=np.eye(4))
        log.append("a/info", START, START, intrinsics=K, distortion=np.array(distortion), size=np.array([48, 64]))
        for index, left in enumerate(pictures):
            at = START + (1 + index) * STEP
            log.append("a/depth", at, at, depth=np.full((48, 64), 0.5, np.float32))
            log.append("b/color", at + 1000, at + 1000, color=patch(other))
            log.append("a/color", at + 5000, at + 5000, color=patch(left))
        log.finish({})
    return path


def surface(path, text, *, last=False):
    """x of the surface points that are seen."""
    mapping = mapping_of(text)
    with Log(path) as log:
        views = Views(log, mapping, FrameTree.of_log(log, mapping), torch.Generator().manual_seed(0))
        seen = views.between(START, START + 100 * STEP, last=last)
        assert views.problems == []
    return seen.points[seen.of_class(Semantics.SURFACE)][:, 0]


def columns(left):
    """First and last x of a patch."""
    return [0.5 * (left - 31.5) / 100, 0.5 * (left + 19 - 31.5) / 100]


def ends(x):
    return [float(x.min()), float(x.max())]


@pytest.mark.parametrize("text", [MAP, NAMED])
def test_depth_images_have_the_colours_of_their_camera(tmp_path, text):
    assert ends(surface(written(tmp_path / "log.h5"), text)) == pytest.approx(columns(5), abs=0.01)


def test_which_colours_are_meant_has_to_be_said_where_several_could_be(tmp_path):
    for number, frames in enumerate((("a", "a"), ("c", "d"))):
        path = written(tmp_path / f"log{number}.h5", frames=frames)
        with pytest.raises(UsageError, match="a/color, b/color all could be; name one as `color` of its topic"):
            surface(path, MAP)
        assert ends(surface(path, NAMED)) == pytest.approx(columns(5), abs=0.01)
    with pytest.raises(UsageError, match="Expected /c, the colours of a/depth, to have the role color; got a/color, b"):
        surface(path, NAMED.replace('color = "/a/color"', 'color = "/c"'))


def lens(path, text):
    with Log(path) as log:
        mapping = mapping_of(text)
        return lens_of(log.stream("a/depth"), lenses_of(log, mapping), mapping)


def test_distortions_of_unknown_models_are_refused_but_for_rectified_pictures(tmp_path):
    bent = written(tmp_path / "bent.h5", model="equidistant", distortion=(0.2, 0.01, 0.03, 0.0))
    with pytest.raises(UsageError, match=r"plumb_bob or rational_polynomial, got equidistant: .* rectified = true"):
        surface(bent, NAMED)
    straight = NAMED.replace("color =", "rectified = true, color =")
    assert lens(bent, straight).distortion == ()
    torch.testing.assert_close(lens(bent, straight).intrinsics, torch.tensor(K).float())
    assert ends(surface(bent, straight)) == pytest.approx(columns(5), abs=0.01)
    flat = written(tmp_path / "flat.h5", model="equidistant", distortion=(0.0, 0.0, 0.0, 0.0))
    assert lens(flat, NAMED).distortion == (0.0,) * 4
    known = written(tmp_path / "known.h5", distortion=(0.1, 0.0, 0.0, 0.0, 0.0))
    assert lens(known, NAMED).distortion[0] == pytest.approx(0.1)


def test_rectified_pictures_have_the_intrinsics_of_the_projection(tmp_path):
    projection = np.array([90.0, 0, 30, 0, 0, 90, 20, 0, 0, 0, 1, 0])
    path = written(tmp_path / "log.h5", distortion=(0.1, 0.0, 0.0, 0.0, 0.0), projection=projection)
    torch.testing.assert_close(lens(path, NAMED).intrinsics, torch.tensor(K).float())
    straight = lens(path, NAMED.replace("color =", "rectified = true, color ="))
    torch.testing.assert_close(straight.intrinsics, torch.tensor(projection.reshape(3, 4)[:, :3]).float())


@pytest.mark.parametrize("persist", [0.0, 0.15])
def test_the_last_picture_is_the_latest_that_shows_the_object(tmp_path, persist):
    """Also where what it shows must have lasted for a while; the object moves from column 5 to 35 in between."""
    path = written(tmp_path / "log.h5", pictures=(5, 5, 5, 35, 35, 35, 35))
    text = NAMED + f"persist_s = {persist}\npersist_gap_s = 0.15\n"
    assert ends(surface(path, text)) == pytest.approx(columns(5), abs=0.01)
    assert ends(surface(path, text, last=True)) == pytest.approx(columns(35), abs=0.01)
