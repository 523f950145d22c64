"""Commands that end before their work is done: by Ctrl-C, or for want of memory."""

from pathlib import Path

import pytest

from rumi import exit_codes
from rumi.cli import main
from tests.fixtures.small_run import SMALL

pytestmark = pytest.mark.usefixtures("at_home")


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        MemoryError("Unable to allocate 7.45 GiB for an array"),
        RuntimeError("[enforce fail at alloc_cpu.cpp:118] DefaultCPUAllocator: can't allocate memory: you tried to"),
        RuntimeError("CUDA out of memory. Tried to allocate 20.00 GiB"),
    ],
)
def test_too_little_memory_is_bad_input(error, monkeypatch, capsys):
    def fail(arguments):
        raise error

    monkeypatch.setattr("rumi.commands.run.run", fail)
    assert main(["run", "mug-0"]) == exit_codes.BAD_INPUT
    said = capsys.readouterr().err
    assert "rumi: This needs more memory than there is: ask for fewer" in said and "Traceback" not in said
    monkeypatch.setenv("RUMI_DEBUG", "1")
    with pytest.raises(type(error)):
        main(["run", "mug-0"])


def test_other_errors_of_a_run_keep_their_traceback(monkeypatch):
    def fail(arguments):
        raise RuntimeError("expected scalar type Float but found Double")

    monkeypatch.setattr("rumi.commands.run.run", fail)
    with pytest.raises(RuntimeError, match="scalar type"):
        main(["run", "mug-0"])


@pytest.mark.sim
def test_ctrl_c_ends_a_calibration_and_leaves_out_the_episode_that_it_cut_off(monkeypatch, capsys):
    asked = ["calibrate", "mug-0", "--seed", "7", "--steps", "1", *SMALL, "--out", "c.jsonl", "--episodes"]
    assert main([*asked, "1"]) == exit_codes.DONE
    first = Path("c.jsonl").read_text()

    def interrupt(*arguments):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("rumi.tasks.rummage.simulated.SimTask.step", interrupt)
        assert main([*asked, "3"]) == exit_codes.INTERRUPTED
    assert capsys.readouterr().err.endswith("rumi: interrupted\n")
    assert Path("c.jsonl").read_text() == first
    # a line of before that says so is no episode
    Path("c.jsonl").write_text(first.replace('"steps"', '"interrupted"', 1))
    assert main([*asked, "1"]) == exit_codes.DONE
    assert "1 of 1: seed 7, steps" in capsys.readouterr().err
    assert main([*asked, "1"]) == exit_codes.DONE
    assert "seed 7" not in capsys.readouterr().err
