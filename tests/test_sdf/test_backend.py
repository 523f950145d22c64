import pytest
import torch

from sdf import backend, se3
from sdf.posed import posed_distance
from sdf.primitives import Sphere


@pytest.fixture
def versions(monkeypatch):
    """An operation of its own with a plain version and one for float32 alone."""
    monkeypatch.setattr(backend, "_VERSIONS", {})
    monkeypatch.delenv(backend.VARIABLE, raising=False)
    backend.register("twice")(lambda x: ("plain", 2 * x))
    backend.register("twice", "quick", lambda x: x.dtype == torch.float32)(lambda x: ("quick", 2 * x))
    backend.register("other")(lambda x: ("plain", x))


def run(op: str, x: torch.Tensor) -> str:
    return backend.dispatch(op, x)(x)[0]


def test_quickest_version_that_supports_the_tensors_runs(versions):
    assert backend.versions("twice") == ["torch", "quick"]
    assert run("twice", torch.zeros(1)) == "quick"
    assert run("twice", torch.zeros(1, dtype=torch.float64)) == "plain"


def test_forcing_a_version(versions, monkeypatch):
    with backend.force("torch"):
        assert run("twice", torch.zeros(1)) == "plain"
        with backend.force("quick"):
            assert run("twice", torch.zeros(1)) == "quick"
            assert run("other", torch.zeros(1)) == "plain"  # it has no other version
        assert run("twice", torch.zeros(1)) == "plain"
    assert run("twice", torch.zeros(1)) == "quick"
    monkeypatch.setenv(backend.VARIABLE, "torch")
    assert run("twice", torch.zeros(1)) == "plain"


def test_errors_list_what_is_valid(versions, monkeypatch):
    message = r"backends \['quick', 'torch'\] \(RUMI_BACKEND or force\), got 'cuda'"
    with pytest.raises(ValueError, match=message), backend.force("cuda"):
        pass
    with pytest.raises(ValueError, match=r"operations \['other', 'twice'\], got 'thrice'"):
        backend.dispatch("thrice")
    message = r"forced version 'quick' of twice supports, got torch\.float64 on cpu"
    with backend.force("quick"), pytest.raises(ValueError, match=message):
        run("twice", torch.zeros(1, dtype=torch.float64))
    monkeypatch.setenv(backend.VARIABLE, "cuda")
    with pytest.raises(ValueError, match="got 'cuda'"):
        run("twice", torch.zeros(1))


def test_hot_operations_are_registered():
    for op in ("posed_distance", "posed_query"):
        assert backend.versions(op)[0] == "torch"
    with backend.force("torch"):
        distance = posed_distance(Sphere(0.1), se3.identity((1,)), torch.ones(1, 3))
    assert distance.item() == pytest.approx(3**0.5 - 0.1)


def test_what_ran_is_observed(versions):
    with backend.observed() as ran:
        run("twice", torch.zeros(1))
        with backend.force("quick"):
            run("other", torch.zeros(1))
    run("twice", torch.zeros(1, dtype=torch.float64))
    assert ran == {"twice": "quick", "other": "torch"}
