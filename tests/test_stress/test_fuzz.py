"""Fuzz in short: some cases of every target, by hypothesis and by seed, and a harness that catches what is wrong."""

import pickle
import warnings

import hypothesis
import numpy as np
import pytest
import torch
from hypothesis import strategies as st

from rumi.cli import main
from tests.stress.fuzz.draw import Given, Seeded, number, tensor
from tests.stress.fuzz.files import Bomb, damaged, originals, pickled
from tests.stress.fuzz.recordings import WHOLE
from tests.stress.fuzz.run import PickleLoadedError, many, no_pickles, one
from tests.stress.fuzz.targets import TARGETS

warnings.filterwarnings("ignore", module="numpy")
pytestmark = pytest.mark.usefixtures("no_shape_check")


@pytest.mark.parametrize("name", TARGETS)
@hypothesis.given(data=st.data())
@hypothesis.settings(max_examples=12, suppress_health_check=list(hypothesis.HealthCheck))
def test_only_documented_errors_come_out(name, data):
    one(TARGETS[name], Given(lambda low, high: data.draw(st.integers(low, high))))


@pytest.mark.parametrize("name", TARGETS)
def test_cases_by_seed(name):
    assert many(name, TARGETS[name], map(str, range(5))).wrong == []


def test_a_seed_makes_the_same_case():
    assert torch.equal(*(tensor(Seeded("7"), 5, 3) for _ in range(2)))
    assert [number(Seeded(str(k)), wild=True) for k in range(9)] != [0.0] * 9


def test_what_is_not_documented_is_told_with_its_seed():
    def broken(draw):
        if draw.integer(0, 9) == 3:
            raise KeyError("lost")
        return (torch.tensor(float("nan")) if draw.integer(0, 9) == 3 else torch.zeros(2),)

    found = many("broken", broken, map(str, range(60)))
    said = {what.split(":")[0] for _, what in found.wrong}
    assert said == {"KeyError", "AssertionError"}
    seed, _ = found.wrong[0]
    assert many("broken", broken, [seed]).wrong


def test_a_pickle_is_caught_before_it_does_anything(tmp_path):
    np.save(tmp_path / "bomb.npy", np.array([Bomb()], dtype=object), allow_pickle=True)

    def careless(draw):
        np.load(tmp_path / "bomb.npy", allow_pickle=True)
        return ()

    with pytest.raises(PickleLoadedError):
        one(careless, Seeded("0"))
    assert not Bomb.fired
    assert pickle.loads(pickle.dumps([1])) == [1]


def test_the_bomb_would_go_off(tmp_path):
    (tmp_path / "bomb.npz").write_bytes(pickled(Given(lambda low, high: high), ["points"]))
    with np.load(tmp_path / "bomb.npz", allow_pickle=True) as archive:
        assert archive["points"] is not None
    assert Bomb.fired
    Bomb.fired = False


def test_pickles_of_compiled_code_are_let_through():
    with no_pickles(), pytest.raises(PickleLoadedError):
        pickle.loads(pickle.dumps([1]))


@pytest.mark.parametrize("name", WHOLE)
def test_what_is_damaged_was_right_before(name, tmp_path):
    assert list(WHOLE[name](tmp_path)) == []


def test_damage_changes_files():
    data = originals()["mesh.off"]
    assert sum(damaged(Seeded(str(k)), data) != data for k in range(50)) > 40


def test_the_command(capsys):
    assert main(["stress", "--fuzz", "6", "--only", "contacts-"]) == 0
    assert "10 cases of 5 targets, 0 wrong" in capsys.readouterr().out
    assert main(["stress", "--fuzz", "6", "--only", "no-such"]) == 2
    assert main(["stress", "--fuzz", "6", "--kills", "3"]) == 2
