"""The registry of a family: lookup, lazy addresses, members of other packages, and what is refused."""

import sys
from importlib.metadata import EntryPoint

import pytest

from rumi import registry
from rumi.errors import UsageError
from rumi.registry import Table


def test_members_are_found_in_their_order():
    table = Table[int]("number")
    table.add("two", 2)
    table.add("one", 1)
    assert (list(table), len(table), table["one"], table["two"]) == (["two", "one"], 2, 1, 2)
    assert "one" in table and "three" not in table


def test_an_unknown_name_is_refused_with_the_names_that_there_are():
    table = Table[int]("push model")
    table.add("a", 1)
    table.add("b", 2)
    with pytest.raises(UsageError, match=r"There is no push model 'c'; there are a, b"):
        table["c"]


def test_a_name_is_given_once():
    table = Table[int]("number")
    table.add("one", 1)
    table.add("one", 1)  # the same again, as by a module that is imported twice
    with pytest.raises(ValueError, match="'one', which is taken"):
        table.add("one", 2)


def test_an_address_is_imported_when_it_is_asked_for(tmp_path, monkeypatch):
    (tmp_path / "late_member.py").write_text("MEMBER = 7\n")
    monkeypatch.syspath_prepend(tmp_path)
    table = Table[int]("number")
    table.add("late", "late_member:MEMBER")
    assert list(table) == ["late"] and "late_member" not in sys.modules
    assert table["late"] == 7 and "late_member" in sys.modules


def test_a_mapping_is_imported_when_its_names_are_asked_for(tmp_path, monkeypatch):
    (tmp_path / "late_mapping.py").write_text("MEMBERS = {'two': 2, 'three': 3}\n")
    monkeypatch.syspath_prepend(tmp_path)
    table = Table[int]("number")
    table.include("late_mapping:MEMBERS")
    table.add("one", 1)
    assert table["one"] == 1 and "late_mapping" not in sys.modules
    assert (table["three"], list(table), "two" in table) == (3, ["two", "three", "one"], True)


def test_entry_points_add_members_and_replace_none(tmp_path, monkeypatch):
    (tmp_path / "own_package.py").write_text("OWN, ONE = 8, 9\n")
    monkeypatch.syspath_prepend(tmp_path)
    entries = [
        EntryPoint("own", "own_package:OWN", "rumi.numbers"),
        EntryPoint("one", "own_package:ONE", "rumi.numbers"),
    ]
    monkeypatch.setattr(registry, "entry_points", lambda group: entries if group == "rumi.numbers" else [])
    table = Table[int]("number", "rumi.numbers")
    table.add("one", 1)
    assert (list(table), table["own"], table["one"]) == (["one", "own"], 8, 1)
