"""Particles along a path: one push after the other, both versions, and a path for each."""

import pytest
import torch
from torch import Tensor

from rumi.dynamics.along_path import Pusher, distance_to, push_along_path
from rumi.dynamics.outline import GridOutline, RectangleOutline
from rumi.dynamics.sliding import Outline, OutlineQuery, Sliding, push
from sdf import backend
from sdf.primitives import Mug
from sdf.threads import using

DOUBLE = {"dtype": torch.float64}
BOX = RectangleOutline((0.03, 0.08))


# every test of this file holds for the plain and for the compiled version
pytestmark = pytest.mark.usefixtures("version")


def objects(generator: torch.Generator, count: int = 20, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Sliding]:
    poses = torch.randn(count, 3, generator=generator, **DOUBLE) * torch.tensor([0.02, 0.03, 0.5])
    spread = torch.rand(count, 2, generator=generator, **DOUBLE)
    centre = 0.01 * torch.randn(count, 2, generator=generator, **DOUBLE)
    return poses.to(dtype), Sliding(centre.to(dtype), (0.03 + 0.04 * spread[:, 0]).to(dtype), spread[:, 1].to(dtype))


def straight(instants: int = 12, dtype: torch.dtype = torch.float64) -> Tensor:
    share = torch.linspace(0, 1, instants + 1, **DOUBLE)[:, None]
    start, end = torch.tensor([-0.15, 0.01, 0.0], **DOUBLE), torch.tensor([0.02, -0.01, 0.4], **DOUBLE)
    return (start + share * (end - start)).to(dtype)[None]


def finger(kind: str, dtype: torch.dtype = torch.float64) -> Pusher:
    if kind == "disc":
        return Pusher.disc(0.03, torch.zeros(1, dtype=dtype))
    return Pusher(torch.tensor([[0.02, 0.02], [0.02, -0.02], [-0.02, 0.0]], dtype=dtype), 0.005)


@pytest.mark.parametrize("kind", ["disc", "three points"])
def test_is_pushes_in_a_row(kind: str, generator: torch.Generator) -> None:
    poses, sliding = objects(generator)
    path, tool = straight(), finger(kind)
    found = push_along_path(poses, path, tool, BOX, sliding, substeps=3, passes=2)
    now = poses
    for k in range(12):
        way = (path[0, k + 1] - path[0, k]).expand(20, 3)
        for part in range(3):
            before, after = path[0, k] + part / 3 * way, path[0, k] + (part + 1) / 3 * way
            now, _ = push(now, before, after, tool.points, BOX, sliding, thickness=tool.thickness, passes=2)
        torch.testing.assert_close(found.track[:, k], now, atol=1e-10, rtol=0)
        expected = distance_to(now, path[:, k + 1], tool, BOX)
        torch.testing.assert_close(found.distance[:, k], expected, atol=1e-10, rtol=0)
    assert float((found.track[:, -1] - poses).norm(dim=-1).max()) > 0.02
    assert float(found.distance.min()) > -0.004
    assert float((found.distance[:, -1].abs() < 1e-3).double().mean()) > 0.3


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("kind", ["disc", "three points"])
@pytest.mark.parametrize("shape", ["box", "mug"])
def test_versions_agree(shape: str, kind: str, dtype: torch.dtype, generator: torch.Generator) -> None:
    outline: Outline = BOX
    if shape == "mug":
        outline = GridOutline.of_slice(Mug().to(dtype), 0.045, spacing=0.002)
    poses, sliding = objects(generator, 40, dtype)
    arguments = (poses, straight(dtype=dtype), finger(kind, dtype), outline, sliding)
    found = push_along_path(*arguments)
    alone = push_along_path(*arguments, distances=False)
    assert torch.equal(alone.track, found.track) and alone.distance.shape == (40, 0)
    with backend.force("torch"):
        plain = push_along_path(*arguments)
        assert torch.equal(push_along_path(*arguments, distances=False).track, plain.track)
    # rounding may decide which of two points is the deeper
    off = (found.track - plain.track).abs().amax((-1, -2)) > (1e-3 if dtype == torch.float32 else 1e-9)
    assert float(off.double().mean()) <= (0.1 if dtype == torch.float32 else 0.0)
    torch.testing.assert_close(found.distance[~off], plain.distance[~off], atol=1e-3, rtol=0)


def test_other_outlines_work_too(generator: torch.Generator) -> None:
    """A round object pushed off its middle, with friction: nothing but slides round the finger."""

    class Round:
        radius = 0.05

        def __call__(self, points_o: Tensor) -> OutlineQuery:
            length = points_o.norm(dim=-1)
            return OutlineQuery(length - 0.05, points_o / length[..., None])

        def to(self, like: Tensor) -> "Round":
            return self

    _, sliding = objects(generator, 1)
    pose = torch.tensor([[0.0, 0.02, 0.0]], **DOUBLE)
    found = push_along_path(
        pose, straight(60), finger("disc"), Round(), sliding._replace(centre=torch.zeros(1, 2, **DOUBLE))
    )
    # it ends where the finger leaves it: touching, and pushed to its own side
    assert float(found.track[0, -1, 1]) > 0.03
    assert float(found.distance[0].min()) > -1e-3


def test_gradients_reach_the_start_pose(generator: torch.Generator) -> None:
    poses, sliding = objects(generator, 3)
    with backend.force("torch"):
        poses = poses.requires_grad_()
        found = push_along_path(poses, straight(4), finger("disc"), BOX, sliding)
        found.track[:, -1].sum().backward()
    assert bool(torch.isfinite(poses.grad).all())
    assert float(poses.grad.abs().max()) > 0


@pytest.mark.parametrize("each", [False, True], ids=["one path", "a path for each"])
def test_two_threads_carry_as_one_does(each: bool, generator: torch.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sdf.threads.team", lambda threads, work_s: threads)  # however little work it is
    poses, sliding = objects(generator, 40)
    path, tool = straight().expand(40 if each else 1, -1, 3), finger("disc")
    found = []
    for threads in (1, 2):
        with using(threads):
            found.append(push_along_path(poses, path, tool, BOX, sliding))
    assert torch.equal(found[0].track, found[1].track)
    assert torch.equal(found[0].distance, found[1].distance)


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_what_is_nowhere_is_refused(bad: float, generator: torch.Generator) -> None:
    poses, sliding = objects(generator, 3)
    path = straight()
    path[0, 4, 1] = bad
    with pytest.raises(ValueError, match="Expected path to be finite"):
        push_along_path(poses, path, finger("disc"), BOX, sliding)
    poses[1, 2] = bad
    with pytest.raises(ValueError, match="Expected poses to be finite"):
        push_along_path(poses, straight(), finger("disc"), BOX, sliding)
