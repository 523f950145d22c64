import json

import pytest

pytest.importorskip("mujoco")
pytest.importorskip("gymnasium")

from rumi import exit_codes
from rumi.cli import main
from rumi.environments.leaderboard import Score, read_board, table
from rumi.errors import UsageError
from rumi.tasks.rummage import settings
from rumi.tasks.rummage.settings import preset

AHEAD = """
VIEW = "particles"
seeds = []

def start(seed):
    seeds.append(seed)

def act(observation):
    assert seeds == [3]
    place = observation["weights"] @ observation["poses"][:, :2, 3]
    way = place - observation["configuration"][:2]
    return [*(way / (way @ way) ** 0.5), 0.0]
"""


def made_up(policy, right, wrong, actions, count=10):
    return Score(policy, "", "mug", "default", list(range(count)), right, wrong, actions, 1.0)


@pytest.mark.sim
@pytest.mark.usefixtures("at_home")
def test_a_policy_is_ranked_beside_those_before(tmp_path, capsys, monkeypatch):
    short = {"steps": 3, "initialise.particles": 12, "initialise.starts": 40, "initialise.polished": 12}
    monkeypatch.setattr(settings, "preset", lambda name, **asked: preset(name, **asked, **short))
    policy, board = tmp_path / "ahead.py", tmp_path / "board.jsonl"
    policy.write_text(AHEAD)
    before = Score("best", "", "mug-0", "default", [3], 1, 0, 4.0, 1.0)
    board.write_text(json.dumps(before.line()) + "\n")
    asked = ["leaderboard", str(policy), "--task", "mug-0", "--seeds", "3", "1", "--board", str(board)]
    assert main(asked) == exit_codes.DONE
    title, _, *rows = capsys.readouterr().out.splitlines()
    assert title == "mug-0, seeds 3 to 3, preset default"
    assert rows[0].startswith("best") and any(row.startswith("ahead.py") for row in rows)
    scores = read_board(board)
    assert scores[0] == before and scores[1].policy == "ahead.py" and 1 <= scores[1].actions <= 3


@pytest.mark.sim
@pytest.mark.usefixtures("at_home")
def test_ctrl_c_ends_it_without_a_score(tmp_path, capsys, monkeypatch):
    def interrupt(*arguments):
        raise KeyboardInterrupt

    short = {"steps": 3, "initialise.particles": 12, "initialise.starts": 40, "initialise.polished": 12}
    monkeypatch.setattr(settings, "preset", lambda name, **asked: preset(name, **asked, **short))
    monkeypatch.setattr("rumi.tasks.rummage.simulated.SimTask.step", interrupt)
    policy, board = tmp_path / "ahead.py", tmp_path / "board.jsonl"
    policy.write_text(AHEAD)
    asked = ["leaderboard", str(policy), "--task", "mug-0", "--seeds", "3", "2", "--board", str(board)]
    assert main(asked) == exit_codes.INTERRUPTED
    said = capsys.readouterr()
    assert said.err.endswith("rumi: interrupted\n") and "seed 3" not in said.err and not board.exists()


def test_the_order_is_right_then_wrong_then_actions():
    scores = [made_up("a", 7, 0, 5), made_up("b", 8, 2, 5), made_up("c", 8, 1, 9), made_up("d", 8, 1, 5)]
    assert [line[0] for line in table(scores).splitlines()[1:]] == ["d", "c", "b", "a"]


def test_what_is_no_policy_is_refused(tmp_path, capsys):
    empty = tmp_path / "empty.py"
    empty.write_text("")
    for path, words in ((empty, "act"), (tmp_path / "nothing.py", "nothing.py")):
        assert main(["leaderboard", str(path)]) == exit_codes.BAD_INPUT
        assert words in capsys.readouterr().err
    empty.write_text("VIEW = 'x'\ndef act(o): return o\n")
    assert main(["leaderboard", str(empty)]) == exit_codes.BAD_INPUT
    assert "the views are" in capsys.readouterr().err
    assert main(["leaderboard", "rumi", "--seeds", "0", "0"]) == exit_codes.BAD_INPUT
    assert main(["leaderboard", "rumi", "--task", "peg"]) == exit_codes.BAD_INPUT
    (tmp_path / "board").write_text("{}\n")
    with pytest.raises(UsageError, match="a score a line"):
        read_board(tmp_path / "board")
