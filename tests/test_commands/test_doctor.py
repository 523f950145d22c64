import json
from types import SimpleNamespace

import pytest

from rumi.cli import main
from rumi.commands import doctor as command
from rumi.commands.doctor import Finding
from sdf.extras import EXTRAS

pytestmark = pytest.mark.usefixtures("at_home")


def test_every_extra_is_told_with_what_it_is_for():
    assert set(command._USES) == set(EXTRAS)


def test_it_looks_at_everything_and_all_of_it_works(capsys):
    assert main(["doctor", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    found = {finding["name"]: finding for finding in told["findings"]}
    assert told["ok"] and not [one for one in told["findings"] if one["state"] == "wrong"]
    assert {f"[{extra}]" for extra in EXTRAS} | {"rumi", "machine", "threads", "cache", "devices"} <= set(found)
    assert "took" in found["self-test"]["told"] and " ms by numba" in found["compiled"]["told"]
    for finding in told["findings"]:
        assert finding["remedy"] or finding["state"] == "ok", "what is not as it could be comes with what to do"


def test_what_is_wrong_is_said_with_what_to_do(capsys, monkeypatch):
    def broken():
        yield Finding("disk", "ok", "there")
        raise RuntimeError("it is bent")

    monkeypatch.setattr(command, "LOOKS", (broken, command._versions, command._extras))
    other = SimpleNamespace(origin="/elsewhere/sdf/__init__.py")
    real = command.find_spec
    monkeypatch.setattr(
        command,
        "find_spec",
        lambda name: {"sdf": other, "mujoco": None}[name] if name in ("sdf", "mujoco") else real(name),
    )
    assert main(["doctor"]) == 1
    out = capsys.readouterr().out
    assert "broke off: RuntimeError: it is bent" in out
    assert "another project brings a package sdf" in out
    assert "note  [sim]       tasks in simulation: not installed (mujoco)" in out and "pip install -e" in out
    assert out.splitlines()[-1] == "broken, sdf: does not work, see above"


def test_a_cache_that_cannot_be_written(capsys, monkeypatch, tmp_path):
    (tmp_path / "file").touch()
    monkeypatch.setenv("RUMI_CACHE", str(tmp_path / "file" / "cache"))
    monkeypatch.setattr(command, "LOOKS", (command._caches,))
    assert main(["doctor"]) == 1
    assert "set RUMI_CACHE" in capsys.readouterr().out
