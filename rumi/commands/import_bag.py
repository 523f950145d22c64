"""The command `rumi import`: ROS bags, and recordings as text, as logs."""

import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from rumi.errors import UsageError
from rumi.exit_codes import DONE, NOT_CONVERGED

if TYPE_CHECKING:
    from rumi.rosbag.bag import BagImport
    from rumi.rosbag.mapping import BagMap


_LONGEST_S = 1e9  # what a stamp of 64 bits has room for


@dataclass(frozen=True)
class ImportOptions:
    """Write a log of the raw streams in each ROS bag; `rumi replay` then takes it in. No ROS is needed.

    Attributes:
        bags: .bag files of ROS 1, .mcap or .db3 files, folders of bags, or folders of CSV or JSON-lines files.
        map: mapping file: which topics and frames mean what (scripts/docs/reference/mapping.md).
        suggest: write a mapping file to begin with, from the topics, types and frames of the bag, in place of a log.
        out: the log, by default the bag's name with .h5, in the current folder; of several bags the folder of their
            logs; of --suggest the mapping, with .toml.
        future: seconds that a stamp may be later than its message was received.
    """

    bags: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="BAG...")]
    map: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    suggest: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    out: Annotated[Path | None, tyro.conf.arg(metavar="LOG")] = None
    future: float = 1.0


def import_bag(arguments: Sequence[str]) -> int:
    """`rumi import`: 0 if all that was asked for was read, 1 if some of it was lost, 2 for bad input."""
    options = tyro.cli(ImportOptions, prog="rumi import", args=arguments)
    if not 0 <= options.future <= _LONGEST_S:
        raise UsageError(f"Expected --future of 0 s to {_LONGEST_S:.0e} s, got {options.future}")
    if not options.bags:
        raise UsageError("Expected a bag, got none: rumi import BAG --map FILE")
    if options.suggest == (options.map is not None):
        raise UsageError(
            "Expected --map FILE, or --suggest, which writes such a file to begin with: "
            f"rumi import {options.bags[0]} --suggest"
        )
    if options.suggest:
        return _suggest(options)
    assert options.map is not None
    from rumi.rosbag.mapping_file import read_mapping

    mapping = read_mapping(options.map)
    codes = [_import(bag, mapping, log, options.future) for bag, log in zip(options.bags, _logs(options), strict=True)]
    return max(codes)


def _logs(options: ImportOptions) -> list[Path]:
    """The log of each bag.

    Raises:
        UsageError: two would be the same, or the folder cannot be made.
    """
    if len(options.bags) == 1:
        return [options.out or Path(f"{options.bags[0].resolve().stem}.h5")]
    from rumi.runs.folder import make_folder

    folder = options.out or Path()
    logs = [folder / f"{bag.resolve().stem}.h5" for bag in options.bags]
    if twice := [log for log, count in Counter(logs).items() if count > 1]:
        raise UsageError(f"Expected bags of different names, got two that would be {twice[0]}: import them one by one")
    make_folder(folder)
    return logs


def _import(bag: Path, mapping: "BagMap", out: Path, future_s: float) -> int:
    """Write the log of a bag, and say what was read."""
    from rumi.rosbag.bag import check_frames
    from rumi.rosbag.bag import import_bag as write_log

    done = write_log(bag, mapping, out, future_s=future_s)
    if not (done.problems or done.lost):  # of a bag that is whole the mapping is wrong
        try:
            check_frames(out, mapping)
        except UsageError:
            out.unlink()
            raise
    sys.stdout.write(report(done, out))
    lost = [f"{count} of {topic} could not be read, the first: {why}" for topic, (count, why) in done.lost.items()]
    for problem in [*done.problems, *lost]:
        sys.stderr.write(f"rumi: {problem}\n")
    return NOT_CONVERGED if done.problems or done.lost else DONE


def _suggest(options: ImportOptions) -> int:
    from rumi.rosbag.suggest import suggest_mapping
    from rumi.runs.files import new_file

    if len(options.bags) > 1:
        raise UsageError(f"Expected one bag with --suggest, got {len(options.bags)}: one that has all topics")
    (bag,) = options.bags
    out = options.out or Path(f"{bag.resolve().stem}.toml")
    try:
        new_file(out, suggest_mapping(bag))
    except FileExistsError:
        raise UsageError(f"{out} is there already: give another name with --out, or move it away") from None
    sys.stdout.write(f"{out}: look at its lines with TODO, then rumi import {bag} --map {out}\n")
    return DONE


def report(done: "BagImport", path: Path) -> str:
    """What an import wrote, a line a stream."""
    width = max(map(len, done.kinds), default=0)
    lines = [f"{path}: {sum(done.rows.values())} rows of {len(done.kinds)} streams"]
    for name, kind in sorted(done.kinds.items()):
        odd = ", ".join(f"{count} {how}" for how, count in done.odd.get(name, {}).items())
        lines.append(f"{name:<{width}}  {kind:<8} {done.rows[name]:>7}" + (f"  ({odd})" if odd else ""))
    return "\n  ".join(lines) + "\n"
