"""Source of a recording's messages: a bag, or text."""

from pathlib import Path

from rumi.rosbag.source import BagSource
from rumi.rosbag.text_source import TextSource, text_files

Source = BagSource | TextSource


def source_of(path: Path) -> Source:
    """The messages of a bag, or of CSV or JSON lines.

    Args:
        path: a .bag, .mcap or .db3 file or the folder of a bag; a .csv or .jsonl file, or a folder of such.

    Raises:
        UsageError: there is nothing of these.
        ModuleNotFoundError: a bag, and rosbags is not installed.
    """
    return TextSource(path) if text_files(path) else BagSource(path)
