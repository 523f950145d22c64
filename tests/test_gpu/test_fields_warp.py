"""Fields by their versions for a GPU, against the definitions, over the inputs of the family."""

import pytest
import torch

from rumi.fields.information import InformationSettings, information_field
from rumi.fields.normal import expected_normal
from sdf import backend, gpu, se3
from sdf.grid_sdf import GridSDF
from sdf.primitives import Mug

pytest.importorskip("warp")

MODES = ("sensor_mi", "surrogate", "reverse_kl", "forward_kl")
BELIEFS = ("some", "scenes", "upright", "far", "one", "weightless", "no-points")


@pytest.fixture(scope="module")
def grid():
    return GridSDF.from_sdf(Mug(), spacing=0.006)


def belief_and_points(name, dtype, generator):
    def normal(*shape):
        return torch.randn(*shape, dtype=dtype, generator=generator)

    batch = (2, 3) if name == "scenes" else ()
    count = 1 if name == "one" else 7
    poses, log_weights = se3.exp(0.05 * normal(*batch, count, 6)), normal(*batch, count).log_softmax(-1)
    points = 0.15 * normal(0 if name == "no-points" else 80, 3)
    if name == "upright":
        poses, points[:, 2] = se3.from_planar(0.05 * normal(7, 3), 0.01), 0.05
    if name == "far":  # as far from the origin as single floats may be for the shape of a mug
        poses[..., :3, 3] += 40.0
        points += 40.0
    if name == "weightless":
        log_weights[2] = -torch.inf
    return poses, log_weights, points


def both(ask):
    found = {}
    for version in (backend.PLAIN, gpu.VERSION):
        with backend.force(version):
            found[version] = ask()
    return found[backend.PLAIN], found[gpu.VERSION]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("tail", [0.0, 1e-3])
@pytest.mark.parametrize("name", BELIEFS)
def test_information_is_equal_to_the_definition(grid, name, tail, mode, dtype, generator):
    belief = belief_and_points(name, dtype, generator)
    settings = InformationSettings(mode=mode, tail=tail, tolerance=0.001)
    plain, own = both(lambda: information_field(grid.to(dtype), *belief, settings))
    bound = 2000 * torch.finfo(dtype).eps  # sharpness times the rounding of a distance
    for name_, expected in plain._asdict().items():
        found = getattr(own, name_)
        assert found.shape == expected.shape and found.dtype == dtype
        assert torch.allclose(found, expected, rtol=0.0, atol=bound), name_


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", BELIEFS)
def test_normals_are_equal_to_the_definition(grid, name, dtype, generator):
    poses, log_weights, points = belief_and_points(name, dtype, generator)
    where = torch.rand(*poses.shape[:-3], len(points), generator=generator) < 0.5
    for chosen in (None, where):
        plain, own = both(lambda chosen=chosen: expected_normal(grid.to(dtype), poses, log_weights, points, chosen))
        assert own.shape == plain.shape and own.dtype == dtype
        assert torch.allclose(own, plain, rtol=0.0, atol=20000 * torch.finfo(dtype).eps)
