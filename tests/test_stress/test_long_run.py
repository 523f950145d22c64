"""A belief over many readings."""

from rumi.cli import main
from tests.stress.long_run import long_run


def test_two_hundred_readings_stay_with_the_truth():
    found = long_run(200, moments=4)
    assert found.step == [50, 100, 150, 200]
    assert max(found.metres) < 0.003
    assert max(found.radians) < 0.05
    assert min(found.ess) > 5
    assert max(found.orthogonality) < 1e-6
    # what is known of every cell is kept once
    assert found.points[-1] - found.points[-2] < 50


def test_the_command(capsys):
    assert main(["stress", "--readings", "20"]) == 0
    assert "reading" in capsys.readouterr().out
