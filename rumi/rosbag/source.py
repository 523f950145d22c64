"""Messages of a recording as it lies on disk: of a bag, of ROS 1 or 2, or of text."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rumi.errors import UsageError
from rumi.rosbag.mcap import BagError, Message, Walk
from rumi.rosbag.text_source import TextSource, text_files
from sdf.extras import optional

_PACKED = ".zstd"
_NAMES = (".mcap", ".db3", f".mcap{_PACKED}", f".db3{_PACKED}")


class BagSource:
    """A bag.

    Args:
        path: a .bag file of ROS 1, an .mcap or .db3 file, or the folder of a bag.

    Raises:
        UsageError: there is no such bag.
        ModuleNotFoundError: rosbags is not installed.
    """

    def __init__(self, path: Path) -> None:
        optional("rosbags", "A ROS bag")
        if not path.exists():
            raise UsageError(
                f"There is no bag {path}: give a .bag, .mcap or .db3 file, the folder of a bag, or CSV files"
            )
        from rosbags.typesys import Stores, get_typestore

        self.path, self._files = path, _files(path)
        self._first = path.suffix == ".bag"
        self._store = get_typestore(Stores.ROS1_NOETIC if self._first else Stores.ROS2_JAZZY)

    @property
    def salvageable(self) -> bool:
        """Whether it can be read record by record too."""
        return all(file.suffix == ".mcap" for file in self._files)

    def messages(self) -> Iterator[Message]:
        """All messages, in the order in which they were received.

        Raises:
            BagError: it cannot be read, or not further.
        """
        try:
            yield from self._of_ros1() if self._first else self._of_ros2()
        except (GeneratorExit, KeyboardInterrupt, MemoryError):
            raise
        except Exception as error:  # a damaged file may bring about any error in there
            raise BagError(f"{type(error).__name__}: {error}") from error

    def salvaged(self, problems: list[str]) -> Iterator[Message]:
        """The messages of MCAP files that were cut short or are damaged; what could not be read goes to `problems`."""
        for file in self._files:
            walk = Walk(file)
            try:
                yield from walk.messages()
            except ValueError as error:
                problems.append(str(error))
            problems += [f"{file.name}: {problem}" for problem in walk.problems]

    def unpack(self, message: Message) -> Any:  # noqa: ANN401  (a message's class is made when a bag is read)
        """A message of this bag."""
        if self._first:
            return self._store.deserialize_ros1(message.data, message.kind)
        return self._store.deserialize_cdr(message.data, message.kind)

    def _of_ros1(self) -> Iterator[Message]:
        from rosbags.rosbag1 import Reader
        from rosbags.typesys import get_types_from_msg

        with Reader(self.path) as reader:
            for connection in reader.connections:  # a bag of ROS 1 carries its types
                told = get_types_from_msg(connection.msgdef.data, connection.msgtype)
                self._store.register({name: kind for name, kind in told.items() if name not in self._store.fielddefs})
            for connection, received, data in reader.messages():
                yield Message(connection.topic, connection.msgtype, received, bytes(data))

    def _of_ros2(self) -> Iterator[Message]:
        from rosbags.rosbag2 import Reader

        with Reader(self.path) as reader:
            for connection, received, data in reader.messages():
                yield Message(connection.topic, connection.msgtype, received, bytes(data))


def _files(bag: Path) -> list[Path]:
    found = [bag] if bag.is_file() else sorted(file for file in bag.iterdir() if file.name.endswith(_NAMES))
    packed = [file.name for file in found if file.suffix == _PACKED]
    if packed and not (bag / "metadata.yaml").is_file():  # by which rosbags unpacks them
        raise UsageError(
            f"{packed[0]} is compressed as a whole: give the folder that it lies in, with its metadata.yaml, or unpack "
            f"it by `unzstd {packed[0]}`"
        )
    if not found:
        raise UsageError(f"Expected a bag in the folder {bag}, found no .mcap and no .db3 file there")
    return found


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
