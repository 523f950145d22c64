import pytest
import torch

from rumi.bench import table
from rumi.bench.case import Target, Variant
from rumi.bench.machine import environment
from rumi.bench.measure import carry_out, judge
from sdf import se3
from sdf.posed import posed_distance
from sdf.primitives import Sphere
from sdf.processor import processor
from sdf.threads import cores


def test_a_case(made_up, clock):
    result = carry_out("some", made_up(), budget_s=1.0, clock=clock)
    assert [row.name for row in result.rows] == ["torch", "numba", "peer", "naive"]
    medians = {row.name: row.timing.median_s for row in result.rows}
    assert medians == pytest.approx({"torch": 0.05, "numba": 0.01, "peer": 0.1, "naive": 0.2})  # ten times its share
    assert result.baseline == "peer"
    assert result.ratio(result.row("numba")) == pytest.approx(10.0)
    assert result.agree
    # a peer's error is kept, and does not count as disagreement
    assert [row.error for row in result.rows] == [None, 0.0, 0.5, 0.0]
    assert result.row("naive").note == "slow; 1/10 of the work timed"
    kept, goal, limit = result.verdicts  # none for what was not timed
    assert kept.met and kept.factor == pytest.approx(10.0) and kept.against == "peer"
    assert not goal.met and not limit.met


def test_rumis_own_must_agree(made_up, clock):
    result = carry_out("some", made_up(off=0.01), budget_s=1.0, clock=clock)
    assert not result.agree
    assert "DIFFER" in table.section(result)
    reference = made_up(off=0.01, reference=torch.tensor([1.0, 2.01]))
    result = carry_out("some", reference, budget_s=1.0, clock=clock)
    assert result.row("torch").error == pytest.approx(0.01)
    assert not result.agree


def test_others_failures_are_left_out_and_own_ones_are_not(made_up, clock):
    def fails():
        raise RuntimeError("no such mode\nand more")

    case = made_up()
    peer = made_up(variants=(*case.variants, Variant("other", fails, "peer")))
    result = carry_out("some", peer, budget_s=1.0, clock=clock)
    assert [row.name for row in result.rows] == ["torch", "numba", "peer", "naive"]
    assert "other: failed, RuntimeError: no such mode" in table.section(result)
    own = made_up(variants=(*case.variants, Variant("other", fails)))
    with pytest.raises(RuntimeError, match="no such mode"):
        carry_out("some", own, budget_s=1.0, clock=clock)


def test_targets_beyond_another(made_up, clock):
    rows = carry_out("some", made_up(), budget_s=1.0, clock=clock).rows
    assert judge(Target("peer", at_most_s=0.06, beyond="torch"), rows).met
    assert not judge(Target("peer", at_most_s=0.04, beyond="torch"), rows).met
    assert judge(Target("peer", at_most_s=0.04, beyond="absent"), rows) is None
    assert judge(Target("peer", at_least=2.0, against=("absent",)), rows) is None


def test_the_version_that_ran_is_told(made_up, clock):
    def look_up():
        return posed_distance(Sphere(0.1), se3.identity((1,)), torch.ones(1, 3))

    forced = made_up(variants=(Variant("torch", look_up, version="torch"),), error=None, targets=())
    result = carry_out("some", forced, budget_s=0.0, clock=clock_of_its_own(clock))
    assert result.rows[0].ran["posed_distance"] == "torch"
    assert result.baseline == "torch"


def clock_of_its_own(clock):
    """Goes on by a second each time it is read."""

    def read():
        clock.now += 1.0
        return clock.now

    return read


def test_table_names_units_ratios_and_targets(made_up, clock):
    result = carry_out("some", made_up(left_out=("peers: not there",)), budget_s=1.0, clock=clock)
    shown = table.text([result], environment(torch.device("cpu")))
    numba = next(line for line in shown.splitlines() if line.startswith("  numba"))
    assert " ".join(numba.split()) == "numba 10.0 ms 10.0 - 10.0 ms 10.0 us 10.0x >= 8x met 0"
    assert "goal >= 20x " in shown
    assert "some: made up (1000 pairs)" in shown
    assert "left out: peers: not there" in shown
    torch_line = next(line for line in shown.splitlines() if line.startswith("  torch"))
    assert torch_line.endswith("MISSED")
    # columns stand below one another
    header = next(line for line in shown.splitlines() if line.startswith("  variant"))
    assert numba.index(">= 8x") == header.index("target")
    page = table.markdown([result], environment(torch.device("cpu")))
    rows = [line for line in page.splitlines() if line.startswith("|")]
    assert len({line.count("|") for line in rows}) == 1
    assert "| numba | 10.0 ms |" in page


def test_the_machine_is_named():
    machine = environment(torch.device("cpu"))
    model, *kernels = processor()
    assert machine["processor"] == model and list(machine["kernels"].values()) == kernels
    assert machine["cores"] == cores() >= 1
    assert machine["threads"] == torch.get_num_threads()
    assert machine["versions"]["torch"] == torch.__version__
