"""Readings and first runs of the bench: what is timed."""

from rumi.bench import cases
from rumi.bench.case import CASES, Setup

assert cases
TINY = Setup(tiny=True, quick=True)


def test_every_reading_is_timed() -> None:
    for name in ("reading-free", "reading-contact"):
        case = CASES[name](TINY)
        assert case.facts["readings"] == case.items == 4
        assert 0.0 < case.facts["p50, CPU ms"] <= case.facts["p99.9, CPU ms"] <= case.facts["longest, CPU ms"]
        assert bool(case.variants[0]().isfinite().all())


def test_a_first_run_begins_without_compiled_kernels() -> None:
    case = CASES["cold-start"](Setup())
    assert [variant.name for variant in case.variants] == ["kernels kept", "nothing compiled"]
    assert case.elsewhere
    assert not case.warm
