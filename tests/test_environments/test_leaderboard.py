import json
from types import SimpleNamespace

import pytest

pytest.importorskip("mujoco")
pytest.importorskip("gymnasium")

from rumi import exit_codes
from rumi.cli import main
from rumi.environments.leaderboard import Player, Score, load_policy, read_board, table
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


@pytest.mark.parametrize("board", ["folder", "file/board.jsonl"])
def test_a_board_that_cannot_be_written_is_refused_before_anything_is_built(board, tmp_path, capsys, monkeypatch):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setattr("rumi.api.build", None)
    assert main(["leaderboard", "rumi", "--board", str(tmp_path / board)]) == exit_codes.BAD_INPUT
    assert f"Cannot write {tmp_path / board}" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("def act(observation:\n", "SyntaxError: "),
        ("import nothing_of_this_name\ndef act(o): return o\n", "ModuleNotFoundError: No module named"),
        ("1 / 0\n", "ZeroDivisionError: division by zero"),
    ],
)
def test_a_file_that_cannot_be_loaded_is_named(text, words, tmp_path, capsys):
    policy = tmp_path / "mine.py"
    policy.write_text(text)
    assert main(["leaderboard", str(policy)]) == exit_codes.BAD_INPUT
    said = capsys.readouterr().err
    assert str(policy) in said and words in said and "Traceback" not in said


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("def act(observation): return None\n", "NoneType"),
        ("def act(observation): return 'abc'\n", "TypeError: "),
        ("def act(): return [0.0, 0.0, 0.0]\n", "TypeError: act() takes 0 positional arguments"),
        ("def act(observation): return observation['poze']\n", "KeyError: 'poze'"),
    ],
)
def test_a_policy_that_gives_no_control_is_named(no_shape_check, text, words, tmp_path):
    file = tmp_path / "mine.py"
    file.write_text(text)
    policy, _ = load_policy(file)
    state = SimpleNamespace(record=SimpleNamespace(reading=None))
    with pytest.raises(UsageError) as refused:
        Player(SimpleNamespace(), policy, lambda result, state: {}).act(state)
    assert str(file) in str(refused.value) and words in str(refused.value)


class _Task:
    """A task whose runs are not carried out."""

    def __enter__(self):
        return self

    def __exit__(self, *error):
        pass

    task = agent = None


def test_the_folder_of_a_board_is_made_and_the_table_is_shown_before_it_is_written(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("rumi.api.build", lambda settings, **kept: _Task())
    new = made_up("rumi", 7, 0, 5)
    monkeypatch.setattr("rumi.environments.leaderboard.score", lambda *given, **asked: new)
    board = tmp_path / "new" / "board.jsonl"
    assert main(["leaderboard", "rumi", "--board", str(board)]) == exit_codes.DONE
    assert read_board(board) == [new]
    monkeypatch.setattr("rumi.commands.leaderboard.append_line", lambda *given: 1 / 0)
    capsys.readouterr()
    with pytest.raises(ZeroDivisionError):
        main(["leaderboard", "rumi", "--board", str(board)])
    assert "7 of 10" in capsys.readouterr().out
