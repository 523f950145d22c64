"""Bags of a simulated run, for tests of this folder."""

from types import SimpleNamespace

import pytest

from tests.fixtures.optional import tests_without

collect_ignore_glob = tests_without("rosbags", "h5py")
if not collect_ignore_glob:
    from tests.fixtures.bags import MAP, RISE, SECOND, START, BagMaker, readings_of, record


@pytest.fixture(scope="session")
def bags():
    """What bags are made with."""
    return SimpleNamespace(
        Maker=BagMaker, record=record, readings_of=readings_of, MAP=MAP, RISE=RISE, START=START, SECOND=SECOND
    )


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A simulated run as a bag."""
    return record(tmp_path_factory.mktemp("bags") / "pushes")
