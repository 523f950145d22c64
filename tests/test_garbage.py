"""What is set aside of the garbage collector, and until when."""

import gc

import pytest

from rumi.garbage import set_aside


def test_an_inner_block_leaves_set_aside_what_the_outer_one_did(monkeypatch: pytest.MonkeyPatch) -> None:
    frozen = [0]
    monkeypatch.setattr(gc, "get_freeze_count", lambda: frozen[0])
    monkeypatch.setattr(gc, "freeze", lambda: frozen.append(frozen.pop() + 1))
    monkeypatch.setattr(gc, "unfreeze", lambda: frozen.append(frozen.pop() * 0))
    with set_aside():
        with set_aside():
            assert frozen == [2]
        assert frozen == [2]
    assert frozen == [0]
