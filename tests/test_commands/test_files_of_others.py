"""Commands that write into a file leave one of another kind as it is."""

import pytest

from rumi import exit_codes
from rumi.cli import main
from tests.fixtures.small_run import SMALL

pytestmark = pytest.mark.usefixtures("at_home")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["calibrate", "mug-0", "--episodes", "1", *SMALL], "episodes of before"),
        (["pushes", "run"], "Expected a file of push parameters"),
    ],
    ids=["calibrate", "pushes"],
)
def test_a_file_of_another_kind_stays(arguments, said, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("rumi.commands.calibrate.episode", lambda *_: pytest.fail("an episode was run"))
    path = tmp_path / "bracket.stl"
    path.write_text("solid bracket\nendsolid bracket\n")
    assert main([*arguments, "--out", str(path)]) == exit_codes.BAD_INPUT
    assert said in capsys.readouterr().err
    assert path.read_text() == "solid bracket\nendsolid bracket\n"
