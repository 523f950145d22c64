"""The example that learns to propose plans, in small."""

import json
from pathlib import Path

import pytest
import torch

pytest.importorskip("matplotlib")
pytest.importorskip("mujoco")

from scripts import learn_plans as example
from scripts.plan_judging import Moment, paired, parts
from scripts.plan_proposals import SoftCost
from sdf import se3


def moment(agent, seed: int) -> Moment:
    """A mug ahead of the tool, of unknown yaw."""
    random = torch.Generator().manual_seed(seed)
    planar = torch.tensor([0.6, 0.0, 0.0]) + torch.tensor([0.01, 0.01, 0.8]) * torch.randn(20, 3, generator=random)
    poses = se3.from_planar(planar, agent.height_m)
    return Moment(seed, 0, poses, torch.zeros(20).log_softmax(-1), torch.tensor([0.35, 0.02, 0.0]), None, 0)


@pytest.mark.usefixtures("at_home")
def test_the_whole_example_in_small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _, agent = parts(8, 1, 1)
    recorded = [moment(agent, seed) for seed in (1000, 1001)]
    monkeypatch.setattr(example, "moments", lambda task, agent, seed: recorded)
    monkeypatch.setattr(example, "one_of", lambda task, agent, seed: recorded[seed % 2])
    out = tmp_path / "learnt"
    options = example.Options(
        episodes=1,
        steps=2,
        beliefs=2,
        runs=0,
        samples=20,
        iterations=(1, 2),
        work=tmp_path / "work",
        out=out,
        figures=out,
    )
    example.main(options)
    lines = [json.loads(line) for line in (out / "plan_proposals.jsonl").read_text().splitlines()]
    assert [line["settings"]["seed"] for line in lines] == [1000, 1001]
    assert set(lines[0]["figures"]) == {f"{net}KMPPI x {count}" for net in ("", "network and ") for count in (1, 2)}
    assert (out / "plan_proposals.png").stat().st_size > 1000
    example.main(options)
    assert len((out / "plan_proposals.jsonl").read_text().splitlines()) == 2, "what is there is not done again"

    # the soft cost: a slope through the controls, the tool's path, and the object that it pushes
    scenes = example.scenes_of(agent, recorded, torch.Generator().manual_seed(0), turns=0)
    ahead = torch.zeros(2, 1, 15, 3)
    ahead[..., 0] = 0.5
    controls = ahead.requires_grad_()
    cost = SoftCost(agent)(controls, scenes, scenes.poses[:, :2], 0.03)
    (slope,) = torch.autograd.grad(cost.sum(), controls)
    assert cost.shape == (2, 1) and bool(slope.isfinite().all()) and bool((slope[..., 0] != 0).any())
    still = SoftCost(agent)(torch.zeros(2, 1, 15, 3), scenes, scenes.poses[:, :2], 0.03)
    assert bool((cost.detach()[:, 0] != still[:, 0]).all())


def test_paired_differences() -> None:
    sure = paired([0.1 + 0.001 * k for k in range(20)])
    assert sure["low"] > 0.1 and sure["p"] < 0.001
    unsure = paired([(-1.0) ** k for k in range(20)])
    assert unsure["low"] < 0 < unsure["high"] and unsure["p"] > 0.5


def test_equal_time_is_between_two_numbers_of_iterations() -> None:
    lines = [{f"KMPPI x {k}": {"cost": -float(k), "seconds": 0.1 * k} for k in (1, 2, 4)}]
    found = [example.at_equal_time(lines, (1, 2, 4), seconds)[0] for seconds in (0.05, 0.1, 0.15, 0.3, 0.4, 0.9)]
    assert found == pytest.approx([-1.0, -1.0, -1.5, -3.0, -4.0, -4.0])


def test_the_page_has_the_recorded_tables() -> None:
    root = Path(__file__).resolve().parents[2] / "scripts"
    lines = example.Store(root / "results" / "plan_proposals.jsonl").flat()
    page = (root / "docs" / "how-to" / "learning.md").read_text()
    for text in (example.table(example.Options(), lines), example.runs_table(lines)):
        assert text in page, text
