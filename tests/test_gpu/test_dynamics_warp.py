"""What the push rollouts of a planning pass ask of a GPU."""

from collections.abc import Callable

import pytest
import torch

from rumi.dynamics.base import RolloutModel
from rumi.dynamics.contact import ContactField
from rumi.dynamics.displacement_rollouts import DisplacementRollouts
from rumi.dynamics.outline import GridOutline, support_of
from rumi.dynamics.push_posterior import PushPosterior
from rumi.dynamics.quasi_static import QuasiStaticRollouts
from rumi.dynamics.registry import PushModels, PushSettings
from rumi.fields.information import information_field
from rumi.fields.workspace import Workspace
from rumi.robot.reach import Reach, SpatialReach
from rumi.robot.reach_table import ReachTable
from rumi.robot.tool import Tool
from sdf import se3
from sdf.check import no_waits
from sdf.object_model import object_model
from sdf.primitives import Box, Mug
from sdf.symmetry import Symmetries
from sdf.voxel_grid import VoxelGrid
from tests.fixtures.pretended_gpu import CUDA, pretended_gpu, to_cpu, to_gpu

pytest.importorskip("warp")

BOUNDS = torch.tensor([[0.0, -0.4, 0.03], [0.8, 0.4, 0.2]])
SAMPLES, KEPT, HORIZON = 24, 6, 5
LAUNCHES = 60  # of a pass, making its model included
MAKING = 30


def tool(*, spatial: bool) -> Tool:
    left = (torch.arange(141.0)[:, None].expand(141, 61) * 0.01 - 0.5).clamp_min(0)
    table = ReachTable(left, torch.zeros(141, 61))
    reach = SpatialReach([table] * 2, (0.03, 0.2)) if spatial else Reach(table)
    bounds = BOUNDS if spatial else BOUNDS[:, :2]
    return Tool(bounds, reach, body_spacing_m=0.02, info_spacing_m=0.02).to("cuda")


def quasi_static(posterior: PushPosterior | None = None) -> Callable[[], RolloutModel]:
    mug = Mug()
    outline, support = GridOutline.of_slice(mug, 0.045, spacing=0.002), support_of(mug, spacing=0.004)
    held = GridOutline(to_gpu(outline.values), to_gpu(outline.origin), outline.spacing, outline.radius)
    own, flat = tool(spatial=False), to_gpu(torch.zeros(9).log_softmax(-1))
    poses = torch.tensor([0.4, 0.0, 0.3]) + torch.linspace(-1, 1, 9)[:, None] * torch.tensor([0.01, 0.02, 0.5])
    placed = to_gpu(se3.from_planar(poses))
    return lambda: QuasiStaticRollouts(held, support, own, placed, flat, posterior=posterior)


def displacement(*, spatial: bool) -> Callable[[], RolloutModel]:
    sizes = (17, 17, 5) if spatial else (17, 17, 1)
    place = torch.stack(torch.meshgrid(*(torch.arange(float(n)) for n in sizes), indexing="ij"), -1)
    off = (place - torch.tensor([8.0, 8.0, 0.0]))[..., :2].norm(dim=-1)
    origin = torch.tensor([0.3, -0.16, 0.03 if spatial else 0.045])
    probability = VoxelGrid((1.5 - 0.5 * off).clamp(0.0, 1.0), origin, 0.02)
    normal = VoxelGrid(torch.nn.functional.pad(place[..., :2] - 8.0, (0, 1)), origin, 0.02)
    field, own = ContactField(probability.to("cuda"), normal.to("cuda")), tool(spatial=spatial)
    return lambda: DisplacementRollouts(field, own)


MODELS = {
    "quasi-static": quasi_static,
    "quasi-static, learnt": lambda: quasi_static(PushPosterior.prior(16)),
    "displacement": lambda: displacement(spatial=False),
    "displacement, in space": lambda: displacement(spatial=True),
}


def dynamics_of_a_pass(make: Callable[[], RolloutModel], size: int) -> None:
    """Two iterations of many coarse and few full rollouts, and the plan's own."""
    start = to_gpu(torch.tensor([0.25, 0.0, 0.12, 0.1])[[0, 1, 2, 3] if size == 4 else [0, 1, 3]])
    random = torch.Generator().manual_seed(0)
    ahead = torch.tensor([0.2, -0.5, -0.5, -0.5][:size])
    controls = to_gpu(torch.rand(SAMPLES, HORIZON, size, generator=random) + ahead)
    model = make()
    coarse, generator = model.coarse(), torch.Generator()
    for _ in range(2):
        coarse.rollout(start, controls, rollouts=2, generator=generator)
        found = model.rollout(start, controls[:KEPT], rollouts=4, generator=generator)
    shown = model.nominal_rollout(start, controls[0])
    contact = to_cpu(found.contact)
    assert bool(contact.any()) and not bool(contact.all()) and shown.contact.device == CUDA


@pytest.mark.parametrize("name", MODELS)
def test_the_rollouts_of_a_pass_are_few_launches_and_no_wait(name: str) -> None:
    with pretended_gpu() as counts, torch.no_grad():
        make = MODELS[name]()
        size = 4 if "space" in name else 3
        dynamics_of_a_pass(make, size)  # makes what a run keeps
        counts.clear()
        with no_waits():
            dynamics_of_a_pass(make, size)
    found = counts.totals()
    print(found, counts.by_line().most_common(), sep="\n")
    assert found["launches"] <= LAUNCHES
    assert found["waits"] == found["copies_out"] == found["mixed"] == 0, counts.waits
    assert found["copies_in"] == 0 or "learnt" in name, counts.copies_in


@pytest.mark.parametrize(("push_model", "copies"), [("auto", 1), ("displacement", 0)])
def test_a_model_is_made_with_one_copy_for_how_the_particles_stand(push_model: str, copies: int) -> None:
    box = object_model("box", Box([0.04, 0.06, 0.05]), Symmetries.none(), spacing=0.004, points=20)
    area = torch.tensor([[0.2, -0.3, 0.045], [0.7, 0.3, 0.045]])
    family = PushModels(PushSettings(push_model))
    with pretended_gpu() as counts, torch.no_grad():
        model, own = box.to("cuda"), tool(spatial=False)
        workspace = Workspace.from_bounds(area, 0.01, planar_height=0.045).to("cuda")
        for _ in range(2):  # the first makes what a run keeps
            poses = to_gpu(se3.from_planar(torch.tensor([[0.4, 0.0, 0.1], [0.41, 0.01, 0.4]]), 0.05))
            flat = to_gpu(torch.zeros(2).log_softmax(-1))
            fields = information_field(model.sdf, poses, flat, workspace.points)
            counts.clear()
            with no_waits():
                assert family.chosen(poses, own) == {"auto": "quasi-static"}.get(push_model, push_model)
                made = family.rollouts(model, poses, flat, own, workspace, fields)
        start, controls = to_gpu(torch.tensor([0.25, 0.0, 0.0])), to_gpu(torch.ones(1, 3, 3))
        print(counts.totals(), counts.by_line().most_common(), counts.waits, counts.copies_in, sep="\n")
        totals = counts.totals()
        assert totals["waits"] == totals["copies_out"] == copies, counts.waits
        assert totals["copies_in"] == totals["mixed"] == 0, counts.copies_in
        assert totals["launches"] <= MAKING
        assert bool(to_cpu(made.nominal_rollout(start, controls[0]).contact).any())
