"""Lines that several processes add to one file."""

import json
import subprocess
import sys

import pytest

from rumi.runs.jsonlines import append_line, read_lines

POSIX = pytest.mark.skipif(sys.platform == "win32", reason="locks of files are POSIX's")


def values(path, start=0):
    return [line for line, _ in read_lines(path, start)]


def test_lines_are_read_as_they_come(tmp_path):
    path = tmp_path / "deep" / "a.jsonl"
    assert values(path) == []
    append_line(path, {"k": 0})
    ((first, end),) = read_lines(path)
    assert first == {"k": 0} and end == path.stat().st_size
    append_line(path, {"k": 1})
    assert values(path, end) == [{"k": 1}]


@pytest.mark.parametrize("cut", [1, 5, 9])
def test_what_was_cut_off_is_passed_over(tmp_path, cut):
    path = tmp_path / "a.jsonl"
    append_line(path, {"k": 0})
    append_line(path, {"k": 1})
    path.write_bytes(path.read_bytes()[:-cut])
    assert values(path) == [{"k": 0}]
    append_line(path, {"k": 2})
    # a line that only lacked its end is whole now
    assert values(path) == [{"k": 0}, *([{"k": 1}] if cut == 1 else []), {"k": 2}]
    path.write_text(path.read_text() + "no json\n[1]\n")
    assert values(path)[-1] == {"k": 2}


def test_numbers_that_json_has_not_are_refused(tmp_path):
    with pytest.raises(ValueError):
        append_line(tmp_path / "a.jsonl", {"k": float("nan")})
    assert not (tmp_path / "a.jsonl").exists() or values(tmp_path / "a.jsonl") == []


@POSIX
def test_processes_do_not_mix_their_lines(tmp_path):
    code = (
        "import sys; from pathlib import Path; from rumi.runs.jsonlines import append_line\n"
        "for k in range(60): append_line(Path(sys.argv[1]), {'who': sys.argv[2], 'k': k, 'fill': 'x' * 9000})"
    )
    path = tmp_path / "a.jsonl"
    started = [subprocess.Popen([sys.executable, "-c", code, str(path), who]) for who in "abc"]
    assert [process.wait() for process in started] == [0, 0, 0]
    lines = [json.loads(text) for text in path.read_text().splitlines()]
    assert sorted((line["who"], line["k"]) for line in lines) == [(w, k) for w in "abc" for k in range(60)]
