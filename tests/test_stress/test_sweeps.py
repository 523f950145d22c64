"""The sweeps: each carries out a round within its limit, and none could pass with a wrong operation."""

import json
from dataclasses import replace

import pytest
import torch

from rumi.cli import main
from sdf import se3, so3
from tests.stress import exact, subjects
from tests.stress.on_device import on_device, sweeps_there
from tests.stress.sweep import SWEEPS, carry_out, register

subjects.load()
QUICK = [name for name, sweep in SWEEPS.items() if not sweep.slow and "compositions" not in name]


@pytest.mark.parametrize("name", QUICK)
def test_a_round_stays_within_its_limit(name):
    # an even seed: one thread, which a busy machine does not slow tenfold
    found = carry_out(SWEEPS[name], (2,))
    assert found.kept, (found.failure, found.worst, found.inputs)
    assert found.rounds == 1


def test_a_round_is_drawn_again_by_its_seed():
    sweep = SWEEPS["se3-log-float32"]
    first = carry_out(sweep, range(3, 6))
    again = carry_out(sweep, (first.seed,))
    assert (again.worst, again.case, again.inputs) == (first.worst, first.case, first.inputs)


def planted(name, operation):
    return replace(SWEEPS[name], operation=operation)


def naive_log(inputs):
    """The textbook's: right but for small angles and half turns."""
    rotation = inputs["pose"][..., :3, :3]
    angle = torch.acos(((rotation.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(-1, 1))[..., None]
    omega = so3.vee(rotation) * angle / torch.sin(angle)
    return torch.cat((inputs["pose"][..., :3, 3], omega), -1)


WRONG = {
    "se3-log-float32": naive_log,
    "se3-compose-float32": lambda i: i["other"] @ i["pose"],
    "se3-distance-float32": lambda i: torch.stack(se3.distance(i["pose"], i["other"]), -1) * (1 + 1e-4),
    "beliefs-weights": lambda i: torch.log_softmax(-i["peakiness"] * i["discrepancy"], -1),
    "beliefs-effective-size": lambda i: 1 / i["log_weights"].exp().square().sum(-1),
    "beliefs-resampling": lambda i: torch.ones(i["log_weights"].shape, dtype=torch.float64),
    "distances-table-float32": lambda i: SWEEPS["distances-table-half"].operation(i),
    "fields-sensor-mi-of-agreement": lambda i: torch.full((200,), 1e-5),
    "likelihoods-log-surface": lambda i: -i["sharpness"] * (i["distance"].abs() - i["tolerance"]),
    "entropy-of-weights": lambda i: -(i["log_weights"].softmax(-1) * i["log_weights"].log_softmax(-1)).sum(-1),
    "planning-workspace": lambda i: SWEEPS["planning-workspace"].operation(i) + 1,
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_operation_is_caught(name):
    found = carry_out(planted(name, WRONG[name]), range(2, 14, 2))
    assert not found.kept


@pytest.mark.gpu
def test_sweeps_on_a_cuda_device():
    for sweep in sweeps_there():
        found = carry_out(on_device(sweep, torch.device("cuda")), (2,))
        assert found.kept, (sweep.name, found.failure, found.worst)


def test_the_number_of_threads_is_given_back():
    before = torch.get_num_threads()
    carry_out(SWEEPS["se3-apply-float32"], (1, 2))
    assert torch.get_num_threads() == before


@pytest.mark.slow
def test_a_million_compositions():
    assert carry_out(SWEEPS["se3-1e6-compositions-float32"], (1,)).kept


@pytest.mark.skipif(not exact.available(), reason="without mpmath")
def test_exact_references_agree_with_matrix_exponentials(generator):
    twist = torch.randn(4, 6, generator=generator, dtype=torch.float64)
    matrix = torch.zeros(4, 4, 4, dtype=torch.float64)
    matrix[:, :3, :3], matrix[:, :3, 3] = so3.hat(twist[:, 3:]), twist[:, :3]
    torch.testing.assert_close(exact.by_row(exact.transform, twist), torch.linalg.matrix_exp(matrix))


def test_the_command_writes_what_it_found(tmp_path, capsys):
    arguments = [
        "stress",
        "--only",
        "se3-apply",
        "--rounds",
        "2",
        "--seed",
        "4",
        "--json",
        str(tmp_path / "found.json"),
    ]
    assert main(arguments) == 0
    said = capsys.readouterr().out
    assert "se3-apply-float32" in said
    assert "0 sweeps went beyond" in said
    (outcome,) = json.loads((tmp_path / "found.json").read_text())["outcomes"]
    assert outcome["rounds"] == 2 and outcome["kept"] and outcome["seed"] in (4, 5)
    assert [path.name for path in tmp_path.iterdir()] == ["found.json"]


def test_the_command_tells_of_a_wrong_operation(capsys):
    name = "se3-wrong"
    register(replace(planted("se3-compose-float32", WRONG["se3-compose-float32"]), name=name))
    try:
        assert main(["stress", "--only", name, "--rounds", "1"]) == 1
    finally:
        del SWEEPS[name]
    said = capsys.readouterr().out
    assert "BEYOND ITS LIMIT" in said and "pose = [" in said


@pytest.mark.parametrize(
    "wrong",
    [
        ["--only", "nothing-of-the-kind"],
        ["--minutes", "0"],
        ["--seed", "-1"],
        ["--rounds", "0"],
        ["--json", "."],
    ],
)
def test_bad_input_is_refused(wrong, capsys):
    assert main(["stress", *wrong]) == 2
    assert "Traceback" not in capsys.readouterr().err
