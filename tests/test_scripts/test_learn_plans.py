"""The example that learns to propose plans, in small."""

import json
from pathlib import Path

import pytest
import torch

pytest.importorskip("matplotlib")
pytest.importorskip("mujoco")

from rumi.fields.information import information_field
from rumi.tasks.rummage.agent import Rummager
from scripts import learn_plans as example
from scripts.plan_judging import Method, Moment, paired, parts
from scripts.plan_proposals import Frame, ProposalNetwork, Scenes, SoftCost, Summary, policy_of
from scripts.plan_training import Imitation
from sdf import se3


def moment(agent: Rummager, seed: int) -> Moment:
    """A mug ahead of the tool, of unknown yaw."""
    random = torch.Generator().manual_seed(seed)
    planar = torch.tensor([0.6, 0.0, 0.0]) + torch.tensor([0.01, 0.01, 0.8]) * torch.randn(20, 3, generator=random)
    poses = se3.from_planar(planar, agent.height_m)
    return Moment(seed, 0, poses, torch.zeros(20).log_softmax(-1), torch.tensor([0.35, 0.02, 0.0]), None, 0)


@pytest.mark.usefixtures("at_home")
def test_the_whole_example_in_small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _, agent = parts(8, 1, 1)
    recorded = [moment(agent, seed) for seed in (1300, 1301)]
    for name, small in (("USUAL", (8, 1, 1)), ("LONG", Method(False, 8, 1, narrow=False))):
        monkeypatch.setattr(example, name, small)
    monkeypatch.setattr(example, "ALONE", {(8, False): (1, 2), (8, True): (1,)})
    monkeypatch.setattr(example, "WITH", {(8, True): (1,)})
    monkeypatch.setattr(example, "moments", lambda task, agent, seed: recorded)
    monkeypatch.setattr(example, "one_of", lambda task, agent, seed: recorded[seed % 2])
    out = tmp_path / "learnt"
    options = example.Options(
        episodes=1,
        scenes=2,
        fresh=2,
        imitation=2,
        steps=1,
        beliefs=2,
        runs=0,
        work=tmp_path / "work",
        out=out,
        figures=out,
    )
    example.main(options)
    lines = [json.loads(line) for line in (out / "plan_proposals.jsonl").read_text().splitlines()]
    assert [line["settings"]["seed"] for line in lines] == [1300, 1301]
    names = {"KMPPI 8 x 1", "KMPPI 8 x 2", "KMPPI 8 narrow x 1", "network and KMPPI 8 narrow x 1"}
    assert set(lines[0]["figures"]) == names
    assert (out / "plan_proposals.png").stat().st_size > 1000
    example.main(options)
    assert len((out / "plan_proposals.jsonl").read_text().splitlines()) == 2, "what is there is not done again"


@pytest.fixture(scope="module")
def agent() -> Rummager:
    return parts(8, 1, 1)[1]


def scenes(agent: Rummager) -> Scenes:
    """Two scenes, with plans ahead and to the side."""
    knots = torch.zeros(2, 8, 3)
    knots[0, :, 0], knots[1, :, 1] = 0.5, 0.5
    random, made = torch.Generator().manual_seed(0), []
    for seed in (1300, 1301):
        one = moment(agent, seed)
        made.append(Scenes.of(agent, one.belief, one.configuration, knots, torch.tensor([-4.0, -3.9]), random))
    return Scenes.from_parts([torch.cat(part) for part in zip(*(one.parts for one in made), strict=True)])


@pytest.mark.usefixtures("at_home")
def test_the_soft_cost_has_a_slope_through_controls_path_and_pushed_object(agent: Rummager) -> None:
    some, ahead = scenes(agent), torch.zeros(2, 1, 15, 3)
    ahead[..., 0] = 0.5
    controls = ahead.requires_grad_()
    cost = SoftCost(agent)(controls, some, some.poses[:, :2], 0.03)
    (slope,) = torch.autograd.grad(cost.sum(), controls)
    assert cost.shape == (2, 1) and bool(slope.isfinite().all()) and bool((slope[..., 0] != 0).any())
    still = SoftCost(agent)(torch.zeros(2, 1, 15, 3), some, some.poses[:, :2], 0.03)
    assert bool((cost.detach()[:, 0] != still[:, 0]).all())


@pytest.mark.usefixtures("at_home")
def test_imitation_is_of_the_nearest_plan(agent: Rummager) -> None:
    some, network = scenes(agent), ProposalNetwork(policy_of(agent).settings.mppi)
    imitation = Imitation(agent, network)
    far = torch.full((2, 1, 8, 3), -0.5)
    assert float(imitation(torch.cat((some.knots, far), 1), some, 0.0)) == 0.0
    assert float(imitation(far, some, 0.0)) > 1.0


@pytest.mark.usefixtures("at_home")
def test_a_scene_turned_about_the_base_and_mirrored_has_the_same_plans_turned_and_mirrored(agent: Rummager) -> None:
    network = ProposalNetwork(policy_of(agent).settings.mppi, proposals=3).eval()
    assert agent.tool.reach is not None
    base, own = agent.tool.reach.base, policy_of(agent).settings.information
    turn = se3.from_planar(torch.tensor([0.0, 0.0, 0.3]))
    there = se3.from_planar(torch.tensor([float(base[0]), float(base[1]), 0.0]))
    turn = there @ turn @ se3.inverse(there)
    flip = torch.tensor([1.0, -1.0, -1.0])  # about the base's axis, at y = 0
    one = moment(agent, 1300)
    planar, tool = se3.to_planar(one.world_T_object), one.configuration

    def seen(poses: torch.Tensor, configuration: torch.Tensor) -> Summary:
        belief = one._replace(world_T_object=se3.from_planar(poses, agent.height_m)).belief
        where = agent.workspace.points
        fields = information_field(agent.model.sdf, belief.world_T_object, belief.log_weights, where, own)
        return Summary.of(belief, fields, agent.workspace, agent.tool, configuration)

    def moved(poses: torch.Tensor) -> torch.Tensor:
        return se3.to_planar(turn @ se3.from_planar(poses))

    first = seen(planar, tool)
    for other in (seen(moved(planar), moved(tool)), seen(flip * planar, flip * tool)):
        torch.testing.assert_close(other.tool, first.tool, atol=1e-4, rtol=0)
        # fields are of a lattice: between its nodes they differ
        assert float((other.image - first.image).abs().mean()) < 0.02
    batch = [torch.stack((first.image, first.image)), torch.stack((first.tool, first.tool))]
    frame = first.frame
    both = Frame(torch.stack((frame.angle, -frame.angle)), torch.stack((frame.mirror, -frame.mirror)))
    straight, mirrored = network.plans(Summary(batch[0], both, batch[1])).detach()
    torch.testing.assert_close(mirrored, straight * flip)


def test_paired_differences() -> None:
    sure = paired([0.1 + 0.001 * k for k in range(20)])
    assert sure["low"] > 0.1 and sure["p"] < 0.001
    unsure = paired([(-1.0) ** k for k in range(20)])
    assert unsure["low"] < 0 < unsure["high"] and unsure["p"] > 0.5


def test_equal_time_is_between_two_numbers_of_iterations() -> None:
    lines = [{f"k{k}": {"cost": -float(k), "seconds": 0.1 * k} for k in (1, 2, 4)}]
    found = [example.at_equal_time(lines, ["k1", "k2", "k4"], seconds) for seconds in (0.05, 0.1, 0.15, 0.3, 0.4)]
    assert [cost for every in found for cost in every or ()] == pytest.approx([-1.0, -1.0, -1.5, -3.0, -4.0])
    assert example.at_equal_time(lines, ["k1", "k2", "k4"], 0.5) is None, "nobody took as long"


def test_what_is_compared_with_is_the_best_kind_of_kmppi_at_that_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(example, "ALONE", {(8, False): (1, 2), (4, True): (1,)})
    costs = {"KMPPI 8 x 1": (-1.0, 0.1), "KMPPI 8 x 2": (-2.0, 0.2), "KMPPI 4 narrow x 1": (-1.7, 0.15)}
    lines = [{name: {"cost": cost, "seconds": seconds} for name, (cost, seconds) in costs.items()}]
    found = [example.best_alone(lines, seconds) for seconds in (0.1, 0.15, 0.2)]
    assert [cost for every in found for cost in every or ()] == pytest.approx([-1.7, -1.7, -2.0])
    assert example.best_alone(lines, 0.3) is None


def test_the_page_has_the_recorded_tables() -> None:
    root = Path(__file__).resolve().parents[2] / "scripts"
    lines = example.Store(root / "results" / "plan_proposals.jsonl").flat()
    page = (root / "docs" / "how-to" / "learning.md").read_text()
    for text in (example.table(lines), example.runs_table(lines)):
        assert text in page, text
