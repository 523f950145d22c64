"""A mapping that says what is wrong with it."""

import re

import pytest

from rumi.errors import UsageError
from rumi.rosbag.mapping_file import mapping_of
from tests.fixtures.bags import ALL_ROLES


def test_topics_have_to_be_a_table():
    text = re.sub(r"\[topics\]\n.*\[frames\]", "[frames]", ALL_ROLES, flags=re.DOTALL).replace(
        "schema = 1", "schema = 1\ntopics = 3"
    )
    with pytest.raises(UsageError, match=r"Expected topics to be a table, \[topics\], got 3"):
        mapping_of(text)
    assert mapping_of(ALL_ROLES + "[view]\nfar_m = inf\n").view.far_m == float("inf")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("schema = 1", "schema = 2"), "Expected schema = 1 .*, got 2: a newer one needs a newer rumi"),
        (("schema = 1", "schema = '1'"), "Expected schema = 1 in the mapping, got '1'"),
        (("schema = 1", ""), "Expected schema = 1 at the top of the mapping, found none: add that line"),
        (("schema = 1", "schema = 1\nfixed = 3"), r"Expected fixed to be tables, each headed \[\[fixed\]\], got 3"),
        (("schema = 1", "schema = 1\nsettings = 3"), r"Expected settings to be a table, \[settings\], got 3"),
        (
            ("[frames]", "[actions]\nview_s = inf\n[frames]"),
            "actions: Expected view_s to be 0 or more and finite, got inf",
        ),
        (("[frames]", "[actions]\nevery_s = inf\n[frames]"), "actions: Expected every_s above 0 and finite, got inf"),
        (("[1, 1, 1]]", "[1, inf, 1]]"), "Expected scene.within to be finite"),
        (('tool = "hand"', 'tool = "hand"\norigin_m = [nan, 0.0]'), "Expected frames.origin_m to be finite"),
        (("[frames]", '[fixed]\nparent = "a"\nchild = "b"\n[frames]'), "Expected fixed to be tables"),
        (
            ('"/cloud" = "cloud"', '"/cloud" = { role = "cloud", unit_m = nan }'),
            r'topics\."/cloud"\.unit_m to be finite',
        ),
        (("[scene]", "[scenery]"), r"no table \[scenery\]"),
        (('world = "base"', ""), "world"),
        (('"/cloud" = "cloud"', '"/cloud" = "clown"'), "clown"),
        (("within = [[0, 0, 0], [1, 1, 1]]", "within = [[0, 0, 0], [1, 0, 1]]"), "a lower and an upper corner"),
        (("builtin", "buildin"), "no setting scene.buildin; there are"),
        (("[frames]", "[frames"), "is no TOML"),
        (
            ("[scene]", "[tool]\noff_m = -0.001\n[scene]"),
            "tool: Expected off_m to be 0 or more and finite, got -0.001",
        ),
        (("[scene]", "[wrench]\n[scene]"), "expected either radius_m, of a ball or a rod, or mesh"),
    ],
)
def test_mappings_that_are_wrong_are_named(change, message):
    assert change[0] in ALL_ROLES
    with pytest.raises(UsageError, match=message):
        mapping_of(ALL_ROLES.replace(*change))
