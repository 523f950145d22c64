"""`rumi bench` and `python -m scripts.bench`: what is timed agrees, is compared, and is written down."""

import copy
import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from rumi import exit_codes
from rumi.bench import cases, command, table
from rumi.bench.case import CASES, HOST, SLOW, Case, Setup, Variant
from rumi.bench.machine import environment
from rumi.bench.measure import carry_out
from rumi.cli import main
from rumi.errors import UsageError
from rumi.fields.information import information_from_distances
from rumi.planning.costs import information_cost
from rumi.planning.reach_cost import ReachabilityCost
from scripts.bench import command as comparison
from scripts.bench import history, naive, peers, targets
from scripts.bench.comparisons import beside, plain_formula

assert cases
TINY = Setup(tiny=True, quick=True)
QUICK = [name for name in CASES if name not in ("import", *SLOW)]
OTHERS = ("rollouts", "trajectory", "reach", "distance", "gradient", "field", "normal", "discrepancy", "kmppi")


@pytest.fixture
def made_up(clock):
    """A case whose ways take known times: rumi's two, a peer's and a naive one."""

    def make(quick=0.01, off=0.0, **more):
        variants = (
            Variant("torch", clock.work(0.05, torch.tensor([1.0, 2.0]))),
            Variant("numba", clock.work(quick, torch.tensor([1.0, 2.0 + off]))),
            Variant("peer", clock.work(0.1, torch.tensor([1.5, 2.0])), "peer"),
            Variant("naive", clock.work(0.02, torch.tensor([1.0])), "naive", share=0.1, note="slow"),
        )
        values = {"baselines": ("not there", "peer", "naive"), "items": 1000, "item": "pair", "tolerance": 1e-3}
        error = lambda found, reference: float((found - reference[: len(found)]).abs().max())  # noqa: E731
        return Case(**({"title": "made up", "variants": variants, "error": error} | values | more))

    return make


@pytest.fixture(scope="module")
def machine():
    """What a result says of this machine, which takes a third of a second to find out."""
    return environment(torch.device("cpu"))


@pytest.fixture
def run(made_up, clock, machine):
    """A case carried out, as it is written down."""

    def record(quick=0.01, name="some", **more):
        result = carry_out(name, made_up(quick, **more), budget_s=1.0, clock=clock)
        return {"schema": 1, "machine": machine.copy(), "cases": [json.loads(json.dumps(result.as_dict()))]}

    return record


@pytest.mark.parametrize("name", QUICK)
def test_versions_agree_and_others_do_the_same_work(name):
    """Up to what the peers' tables lose, and the bounding box that their outside is measured from."""
    case = CASES[name](TINY)
    if name.startswith(OTHERS):
        case = beside(name, case, TINY)
    result = carry_out(name, case, budget_s=0.0, least=1)
    assert result.agree and any(row.by == "rumi" for row in result.rows)
    limit = {"distance": 0.1, "gradient": 0.1, "field": 0.1, "normal": 0.5, "discrepancy": 2.0, "trajectory": 50.0}
    kind = name.split("-")[0]
    assert kind not in limit or bool(peers.missing()) == bool(result.left_out)
    for row in result.rows:
        assert row.error is None or row.error < limit.get(kind, 1.0)
    names = {row.name for row in result.rows} | {"numba"}
    assert {variant for variant, *_ in targets.TARGETS.get(name, ())} <= names


def test_a_case(made_up, clock):
    result = carry_out("some", made_up(), budget_s=1.0, clock=clock)
    medians = {row.name: row.timing.median_s for row in result.rows}
    assert medians == pytest.approx({"torch": 0.05, "numba": 0.01, "peer": 0.1, "naive": 0.2})  # ten times its share
    assert (result.baseline, result.ratio(result.row("numba")), result.agree) == ("peer", pytest.approx(10.0), True)
    # a peer's error is kept, and does not count as disagreement
    assert [row.error for row in result.rows] == [None, 0.0, 0.5, 0.0]
    assert "naive: slow; 1/10 of the work timed" in table.section(result)
    assert "DIFFER" in table.section(carry_out("some", made_up(off=0.01), budget_s=1.0, clock=clock))


def test_it_says_where_a_compiled_version_was_not_taken(made_up, clock):
    result = carry_out("some", made_up(), budget_s=1.0, clock=clock)
    ran = {"discrepancy": "numba", "merge": "torch", "trajectory_cost": "torch"}  # the last is made of others
    told = table.section(replace(result, rows=tuple(replace(row, ran=ran) for row in result.rows)))
    assert "numba: the compiled version of merge does not take these tensors" in told
    assert "compiled version" not in table.section(result)


def test_others_failures_are_left_out_and_own_ones_are_not(made_up, clock):
    def fails():
        raise RuntimeError("no such mode\nand more")

    variants = made_up().variants
    peer = made_up(variants=(*variants, Variant("other", fails, "peer")))
    assert "other: failed, RuntimeError: no such mode" in carry_out("some", peer, budget_s=1.0, clock=clock).left_out[0]
    with pytest.raises(RuntimeError, match="no such mode"):
        carry_out("some", made_up(variants=(*variants, Variant("other", fails))), budget_s=1.0, clock=clock)


def test_targets_and_pages(made_up, clock, monkeypatch):
    monkeypatch.setitem(targets.TARGETS, "some", [("numba", 8.0, ("peer", "absent")), ("torch", 0.04), ("absent", 1.0)])
    monkeypatch.setitem(targets.GOALS, "some", [("numba", 20.0, ("peer",))])
    result = carry_out("some", made_up(), budget_s=1.0, clock=clock)
    assert [(v["variant"], v["goal"], v["met"]) for v in targets.verdicts(result)] == [
        ("numba", False, True), ("torch", False, False), ("numba", True, False),
    ]  # fmt: skip
    page = targets.markdown([result], environment(torch.device("cpu")))
    assert "| numba | 10.0 ms | 10.0 - 10.0 ms | 10.0 us | 10.0x | 0 | >= 8x peer: 10.0x, met; goal >= 20x" in page


def test_a_variant_that_became_slower_is_flagged_by_ratios_not_times(run):
    before = run(0.010)
    for quick, worse in ((0.0119, False), (0.0121, True), (0.005, False)):
        changes, remarks = history.compare(run(quick), [before])
        assert not remarks
        # rumi's own alone, against the peer
        assert [(c.variant, c.baseline, c.worse) for c in changes] == [
            ("torch", "peer", False),
            ("numba", "peer", worse),
        ]
    slower = copy.deepcopy(before)
    for row in slower["cases"][0]["variants"]:  # a machine half as quick does everything half as quickly
        row["least_s"] *= 2.0
    assert not any(change.worse for change in history.compare(slower, [before])[0])


def test_the_newest_run_of_the_same_case_and_threads_counts(run):
    other, now = run(name="other"), run(0.011)
    changes, remarks = history.compare(now, [run(0.001), run(0.01), other])
    assert not any(change.worse for change in changes) and not remarks
    assert history.compare(run(), [other]) == ([], ["some: not there before"])
    two = run(0.001)
    two["machine"] = two["machine"] | {"threads": now["machine"]["threads"] + 1}
    assert not any(change.worse for change in history.compare(now, [run(0.01), two])[0])
    changes, remarks = history.compare(now, [two])
    assert any(change.worse for change in changes) and "threads before" in remarks[0]


@pytest.mark.parametrize(
    ("content", "message"),
    [("", "holds no results"), ("not json\n[1]\n", "holds no results"), ('{"schema": 99, "cases": []}\n', "newer")],
)
def test_what_is_no_result_is_refused(content, message, tmp_path):
    path = tmp_path / "bench.jsonl"
    path.write_text(content)
    with pytest.raises(UsageError, match=message):
        history.read(path)


@pytest.fixture
def small(at_home, monkeypatch):
    """In a folder of its own, with everything tiny."""
    monkeypatch.setattr(command, "Setup", lambda device, **more: Setup(device, tiny=True, **more))
    monkeypatch.setattr(command, "QUICK", (0.0, 3))


def test_the_command_times_writes_and_compares(small, capsys):
    asked = ["--quick", "--only", "distance-mug", "kmppi-toy", "--threads", "2", "--json", "out/bench.jsonl"]
    before = torch.get_num_threads()
    assert main(["bench", *asked]) == exit_codes.DONE
    assert torch.get_num_threads() == before
    (kept,) = history.read(Path("out/bench.jsonl"))
    assert [case["name"] for case in kept["cases"]] == ["distance-mug", "kmppi-toy"]
    assert kept["machine"]["threads"] == 2 and kept["cases"][0]["variants"][0]["ran"]["posed_distance"] == "torch"
    for row in kept["cases"][0]["variants"]:
        row["least_s"] *= 1e-6 if row["name"] == "numba" else 1.0
    Path("doctored.jsonl").write_text(json.dumps(kept) + "\n")
    with pytest.raises(SystemExit) as end:
        comparison.bench(["--quick", "--only", "distance-mug", "--threads", "2", "--against", "doctored.jsonl"])
    assert end.value.code == command.WRONG and "WORSE distance-mug, numba" in capsys.readouterr().out


def test_a_disagreement_is_an_error_and_an_interrupt_keeps_what_there_is(small, monkeypatch, capsys):
    make = CASES["distance-mug"]
    monkeypatch.setitem(CASES, "distance-mug", lambda setup: replace(make(setup), tolerance=-1.0))
    monkeypatch.setitem(CASES, "reach-mug", lambda setup: (_ for _ in ()).throw(KeyboardInterrupt))
    assert main(["bench", "--quick", "--only", "distance-mug"]) == command.WRONG
    assert (
        main(["bench", "--only", "distance-mug", "reach-mug", "--quick", "--json", "a.json"]) == exit_codes.INTERRUPTED
    )
    assert [case["name"] for case in json.loads(Path("a.json").read_text())["cases"]] == ["distance-mug"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--only", "field-mgu"], "There is no case 'field-mgu'; the cases are distance-mug, distance-box"),
        (["--json", "file/bench.json"], "Cannot write file/bench.json"),
        (["--json", "."], "Cannot write .: it is a folder"),
        (["--threads", "0"], "Expected threads to be 1 or more, got 0"),
    ],
)
def test_bad_input_is_named_before_anything_is_timed(arguments, message, at_home, capsys, monkeypatch):
    Path("file").write_text("in the way")
    monkeypatch.setattr(command, "time_cases", lambda *a, **k: pytest.fail("timed"))
    assert main(["bench", *arguments]) == exit_codes.BAD_INPUT
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("name", ["pareto", "scaling"])
def test_studies_get_what_they_need(name, at_home, monkeypatch):
    asked = []
    monkeypatch.setattr(f"{comparison._STUDIES[name]}.run", lambda **options: asked.append(options))
    comparison.bench([f"--{name}", "--quick", "--out", "here", "--json", "lines.jsonl"])
    assert asked == [{"quick": True, "out": Path("here"), "jsonl": Path("lines.jsonl")}]
    with pytest.raises(UsageError, match="leave them out"):
        comparison.bench([f"--{name}", "--only", "reach-mug"])


@pytest.mark.parametrize("mode", ["surrogate", "sensor_mi"])
def test_the_plain_formula_is_the_fields(mode, generator):
    distance = 0.05 * torch.randn(7, 50, generator=generator, dtype=torch.float64)
    log_weights = torch.randn(7, generator=generator, dtype=torch.float64).log_softmax(-1)
    expected = information_from_distances(distance, log_weights, mode=mode)
    for found, known in zip(
        plain_formula(distance, log_weights, mode), (expected.semantics, expected.information), strict=True
    ):
        torch.testing.assert_close(found, known, atol=1e-12, rtol=0)


def test_the_naive_sums_are_the_costs(generator):
    scene = cases.rollouts.push_scene(TINY)
    q = torch.randn(20, 3, 3, generator=generator) * torch.tensor([0.2, 0.2, 2.0]) + torch.tensor([0.4, 0.0, 0.0])
    moved = 0.05 * torch.randn(20, 3, 3, generator=generator) * torch.tensor([1.0, 1.0, 0.0])
    found = naive.gathered(scene.information, scene.tool.info, q, moved)
    assert float(found.max()) > 0
    torch.testing.assert_close(-found, information_cost(scene.information, scene.tool.info, q, moved))
    reach = scene.information.with_values(torch.rand(scene.information.shape, generator=generator))
    torch.testing.assert_close(
        naive.reach_cost(scene.information, reach, moved), ReachabilityCost(scene.information, reach)(moved)
    )


def test_what_the_cpu_alone_does_is_left_out_on_a_gpu(monkeypatch, capsys):
    monkeypatch.setattr(command, "environment", lambda device: environment(torch.device("cpu")))
    options = command.BenchOptions(only=tuple(sorted(HOST)), device="cuda", quick=True)
    assert command.time_cases(options) == ([], exit_codes.DONE)
    assert capsys.readouterr().err.count("its work is done on the CPU") == len(HOST) > 3
