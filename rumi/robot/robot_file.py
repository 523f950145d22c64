"""Text of a robot's description, which is given as a file or as the text itself."""

from pathlib import Path

from rumi.errors import UsageError


def read_robot(robot: str | Path) -> tuple[str, Path | None]:
    """The text of a URDF or MJCF, and the folder of its file; None where the text itself was given.

    Args:
        robot: path, or text that starts with "<".

    Raises:
        UsageError: there is no such file, or it cannot be read.
    """
    text = str(robot)
    if text.lstrip().startswith("<"):
        return text, None
    path = Path(robot)
    if not path.is_file():
        raise UsageError(f"Expected a file of MJCF or URDF, got {path}, which is none")
    try:
        return path.read_text(encoding="utf-8"), path.resolve().parent
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"Cannot read the robot {path}: {error}") from error
