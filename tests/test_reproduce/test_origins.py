"""Where results come from, as tables say it."""

from scripts.reproduce.origins import named_machine, origin
from scripts.reproduce.records import record_of

NOW = {"commit": "fed", "machine": "AMD EPYC x86_64, 2 cores"}


def test_scenes_conditions_code_and_processor(made):
    runs = [made("mug-0", "rumi", seed, nll=(30.0, 10.0)) for seed in (0, 1, 3)]
    assert origin(runs) == ("Starts fixed (mug-0), ideal conditions, motion measured. Seeds 0-1, 3. Commit abc; here.")
    assert origin([]) == ""


def test_columns_of_another_processor_are_named(made):
    others = [made("mug-0", method, 0, nll=(30.0, 10.0), machine="x86_64, 2 cores") for method in ("slide", "gpvr")]
    said = origin([made("mug-0", "rumi", 0, nll=(30.0, 10.0), **NOW), *others])
    assert said.endswith(
        "`rumi/default`: commit fed; AMD EPYC x86_64, 2 cores. "
        "All else: commit abc; x86_64 of a model not recorded, 2 cores. "
        "Between these, code and processor differ beside what a row is about."
    )


def test_conditions_are_the_tasks_or_those_asked_for(made):
    runs = [
        made("shelf-mug", "rumi", 0, nll=(30.0, 10.0)),
        made("mug", "rumi", 0, nll=(30.0, 10.0)),
        made("mug-0", "rumi", 0, nll=(30.0, 10.0), overrides=("conditions=harsh",)),
    ]
    said = origin(runs)
    assert "Starts fixed (shelf-mug), ideal conditions, motion not measured." in said
    assert "Starts fixed (mug-0), harsh conditions, motion measured." in said
    assert "Starts drawn by the seed (mug), lab conditions" in said


def test_a_machine_without_a_model_says_so():
    assert named_machine(NOW["machine"]) == NOW["machine"]


def test_runs_of_before_the_preset_was_read_otherwise_say_so(made):
    line = {"schema": 1, "kind": "run", "task": "mug-0", "method": "rumi", "preset": "paper", "overrides": []}
    line |= {"seed": 0, "settings": "x", "code": "57019228b80a", "id": "y", "figures": {}, "timings": {}, "curves": {}}
    line |= NOW
    assert record_of(line).column == "rumi/paper as printed"
    assert record_of(line | {"code": "c0de"}).column == "rumi/paper"
    assert record_of(line | {"preset": "default"}).column == "rumi/default"
