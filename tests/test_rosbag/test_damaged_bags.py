"""Of a bag that was cut short or is damaged all else is in the log."""

import zlib

import numpy as np
import pytest

from rumi.rosbag.bag import import_bag
from rumi.rosbag.mapping_file import mapping_of
from sensors.log.reader import Log
from tests.fixtures.bags import ALL_ROLES


@pytest.fixture
def mapping():
    return mapping_of(ALL_ROLES)


def big(bags, folder, rows=24, **options):
    """A bag of several chunks of messages that do not compress."""
    maker = bags.Maker(folder, **options)
    for index in range(rows):
        points = np.random.default_rng(index).random((20000, 3), np.float32)
        maker.cloud("/cloud", bags.START + index, "camera", points)
    return maker.close(), rows


def check_big(path, least, most):
    with Log(path) as log:
        samples = log.stream("cloud").samples()
        assert least <= len(samples) <= most
        for one in samples:
            index = int(one.stamp_ns % 10**9)
            expected = np.random.default_rng(index).random((20000, 3), np.float32)
            assert np.array_equal(one.values["points"][0], expected), index
        return len(samples)


@pytest.mark.parametrize("packed", [False, True])
def test_of_a_bag_that_was_cut_short_the_start_is_kept(bags, tmp_path, mapping, packed):
    file, rows = big(bags, tmp_path / "bag", packed=packed)
    data = file.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[: int(0.6 * len(data))])
    done = import_bag(cut, mapping, tmp_path / "log.h5")
    kept = check_big(tmp_path / "log.h5", int(0.6 * rows) - 2, int(0.6 * rows) + 1)
    assert done.rows == {"cloud": kept}
    assert any("cut short" in problem or "left out" in problem for problem in done.problems)


def with_checksums(data: bytes) -> bytearray:
    """Give the chunks of an uncompressed MCAP file the checksums that rosbags leaves out."""
    made, at = bytearray(data), 8
    while at < len(made) - 8:
        size = int.from_bytes(made[at + 1 : at + 9], "little")
        if made[at] == 0x06:
            records = made[at + 9 + 40 : at + 9 + size]
            made[at + 9 + 24 : at + 9 + 28] = zlib.crc32(records).to_bytes(4, "little")
        at += 9 + size
    return made


@pytest.mark.parametrize("kind", ["plain", "checksums", "packed"])
def test_of_a_damaged_bag_the_rest_is_kept(bags, tmp_path, mapping, kind):
    """Without checksums damage shows only where it hits what is not a number."""
    file, rows = big(bags, tmp_path / "bag", packed=kind == "packed")
    data = bytearray(file.read_bytes())
    middle = len(data) // 2
    if kind == "plain":
        middle = data.index(b"camera\0", middle) - 4
    elif kind == "checksums":
        data = with_checksums(data)
    else:
        middle = data.index(bytes.fromhex("28b52ffd"), middle)
    data[middle : middle + 64] = bytes(range(100, 164))
    file.write_bytes(data)
    done = import_bag(file, mapping, tmp_path / "log.h5")
    kept = check_big(tmp_path / "log.h5", rows - 5, rows - 1)
    if kind == "plain":
        assert done.lost["/cloud"][0] == rows - kept
    else:
        assert any("left out" in problem for problem in done.problems)


@pytest.mark.parametrize("code", [0x06, 0x04])
def test_a_length_far_beyond_the_file_costs_what_is_behind_it_alone(bags, tmp_path, mapping, code):
    file, rows = big(bags, tmp_path / "bag")
    data = file.read_bytes()
    cut = int(0.6 * len(data))
    broken = tmp_path / "broken.mcap"
    whole = records_of(data, cut)
    broken.write_bytes(data[:whole] + bytes([code]) + (1 << 39).to_bytes(8, "little") + data[whole + 9 : cut])
    done = import_bag(broken, mapping, tmp_path / "log.h5")
    assert done.rows["cloud"] >= 0.6 * rows - 4
    assert any("cut short" in problem for problem in done.problems)


def records_of(data: bytes, end: int) -> int:
    """Where the last record of an MCAP file that begins before an end begins."""
    at = 8
    while (after := at + 9 + int.from_bytes(data[at + 1 : at + 9], "little")) < end:
        at = after
    return at
