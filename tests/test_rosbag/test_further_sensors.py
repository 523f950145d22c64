"""Numbers of further sensors in a bag: they come into readings by the sensor's name, at their own instants."""

import numpy as np
import pytest
import torch

from rumi.errors import UsageError
from rumi.rosbag.mapping_file import mapping_of

TEXT = """
schema = 1
[topics]
"/palm/range" = { role = "sensor", sensor = "range" }
"/palm/force" = { role = "sensor", sensor = "pads" }
[frames]
world = "base"
tool = "gripper"
[scene]
builtin = "box"
within = [[0.40, -0.20, 0.0], [0.80, 0.20, 0.30]]
prior_mean_m = [0.60, 0.0]
[actions]
view_s = 0.1
every_s = 1.0
instants = 4
"""


def bag_of(bags, folder, rows):
    """One second of a still gripper, with ranges and pad forces at some tenths of it."""
    maker = bags.Maker(folder)
    for tenth in range(12):
        maker.tf(bags.START + tenth * bags.SECOND // 10, "base", "gripper", torch.eye(4))
    for tenth, value, forces in rows:
        stamp = bags.START + tenth * bags.SECOND // 10
        kind = maker.types.Range
        message = kind(
            header=maker.header(stamp, "palm"), radiation_type=0, field_of_view=0.1, min_range=0.0, max_range=0.5,
            range=value, **({"variance": 0.0} if "variance" in kind.__dataclass_fields__ else {}),
        )  # fmt: skip
        maker.add("/palm/range", message, stamp)
        layout = maker.types.MultiArrayLayout(dim=[], data_offset=0)
        maker.add("/palm/force", maker.types.Float64MultiArray(layout=layout, data=np.array(forces, float)), stamp)
    return maker.close()


def test_each_instant_has_the_last_numbers_before_it(bags, tmp_path):
    rows = [(2, 0.3, [1.0, 2.0]), (3, 0.25, [3.0, 4.0]), (9, float("inf"), [5.0, 6.0])]
    made = bags.readings_of(bag_of(bags, tmp_path / "bag", rows), TEXT, tmp_path / "log.h5")
    first, reading = (one.reading for one in made.taken)
    assert first.measurements == {}
    # instants 0.35, 0.6, 0.85 and 1.1 s from the start
    expected = torch.tensor([[0.25], [torch.nan], [torch.nan], [torch.nan]])
    torch.testing.assert_close(reading.measurements["range"], expected, equal_nan=True)
    pads = torch.tensor([[3.0, 4.0], [torch.nan] * 2, [torch.nan] * 2, [5.0, 6.0]])
    torch.testing.assert_close(reading.measurements["pads"], pads, equal_nan=True)


def test_rows_of_other_lengths_are_told_and_left_out(bags, tmp_path):
    bag = bag_of(bags, tmp_path / "bag", [(2, 0.3, [1.0, 2.0]), (3, 0.25, [3.0])])
    made = bags.readings_of(bag, TEXT, tmp_path / "log.h5")
    assert any("1 of 2 rows are not of as many numbers" in problem for problem in made.problems)


def test_the_role_needs_a_name():
    with pytest.raises(UsageError, match="expected sensor, a name, with the role sensor"):
        mapping_of(TEXT.replace(', sensor = "range"', ""))
