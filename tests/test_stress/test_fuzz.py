"""Fuzz in short: some cases of every target, and a harness that catches what is wrong."""

import logging
import pickle
import warnings

import hypothesis
import numpy as np
import pytest
import torch
from hypothesis import strategies as st

from rumi.cli import main
from tests.stress.fuzz.draw import Draw
from tests.stress.fuzz.files import Bomb, damaged, originals, pickled
from tests.stress.fuzz.recordings import WHOLE
from tests.stress.fuzz.run import PickleLoadedError, fuzz, no_pickles, one
from tests.stress.fuzz.targets import TARGETS

warnings.filterwarnings("ignore", module="numpy")
pytestmark = pytest.mark.usefixtures("no_shape_check")


@pytest.mark.parametrize("name", TARGETS)
def test_only_documented_errors_come_out(name):
    assert fuzz(name, TARGETS[name], 15).wrong == []


def test_what_is_not_documented_is_told():
    def lost(draw):
        if draw.integer(0, 9) == 3:
            raise KeyError("lost")
        return (torch.zeros(2),)

    def nowhere(draw):
        return (torch.tensor(float("nan")) if draw.integer(0, 9) == 3 else torch.zeros(2),)

    for broken, error in ((lost, "KeyError"), (nowhere, "AssertionError")):
        (said,) = fuzz("broken", broken, 200).wrong
        assert said.startswith(error)


class Highest(Draw):
    """Draws the largest."""

    def __init__(self):
        pass

    def integer(self, low, high):
        return high


def test_a_pickle_is_caught_before_it_does_anything(tmp_path):
    np.save(tmp_path / "bomb.npy", np.array([Bomb()], dtype=object), allow_pickle=True)

    def careless(draw):
        np.load(tmp_path / "bomb.npy", allow_pickle=True)
        return ()

    with pytest.raises(PickleLoadedError):
        one(careless, Highest())
    with no_pickles(), pytest.raises(PickleLoadedError):
        pickle.loads(pickle.dumps([1]))
    assert not Bomb.fired and pickle.loads(pickle.dumps([1])) == [1]
    (tmp_path / "bomb.npz").write_bytes(pickled(Highest(), ["points"]))
    with np.load(tmp_path / "bomb.npz", allow_pickle=True) as archive:  # it would go off
        assert archive["points"] is not None
    assert Bomb.fired
    Bomb.fired = False


@pytest.mark.parametrize("name", WHOLE)
def test_what_is_damaged_was_right_before(name, tmp_path):
    assert list(WHOLE[name](tmp_path)) == []


@hypothesis.given(data=st.data())
@hypothesis.settings(max_examples=30, deadline=None)
def test_damage_is_of_the_file_alone(data):
    before = originals()["mesh.off"]
    assert isinstance(damaged(Draw(data), before), bytes) and originals()["mesh.off"] == before


def test_the_command(capsys):
    try:
        assert main(["stress", "--fuzz", "6", "--only", "contacts-"]) == 0
    finally:
        logging.disable(logging.NOTSET)
    assert "of 5 targets, 0 wrong" in capsys.readouterr().out
    assert main(["stress", "--fuzz", "6", "--only", "no-such"]) == 2
    assert main(["stress", "--fuzz", "6", "--kills", "3"]) == 2


@pytest.mark.stress
@pytest.mark.slow
@pytest.mark.parametrize("name", TARGETS)
def test_many_cases(name):
    assert fuzz(name, TARGETS[name], 1000, seed=1).wrong == []
