"""Reading of mapping files, which are TOML; `rumi.rosbag.mapping` has their tables."""

import math
import tomllib
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from rumi.errors import UsageError
from rumi.rosbag.mapping import Actions, BagMap, Fixed, Frames, SceneMap, ToolMap, Topic, ViewMap
from rumi.rosbag.sensor_maps import BubbleMap, RobotMap, TorqueMap, WrenchMap
from rumi.runs.json_settings import dataclass_of
from rumi.tasks.rummage.objects import ObjectSettings

SCHEMA = 1
"""Of mapping files."""

_TABLES: dict[str, type] = {
    "frames": Frames,
    "scene": SceneMap,
    "object": ObjectSettings,
    "tool": ToolMap,
    "view": ViewMap,
    "bubble": BubbleMap,
    "wrench": WrenchMap,
    "robot": RobotMap,
    "torques": TorqueMap,
    "actions": Actions,
}


def read_mapping(path: Path | str) -> BagMap:
    """A mapping file.

    Raises:
        UsageError: there is none, or it is wrong; with the name of what is.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"Cannot read the mapping {path}: {error}") from error
    return mapping_of(text, str(path))


def mapping_of(text: str, name: str = "the mapping") -> BagMap:
    """Mapping of a file's text; see `read_mapping`."""
    try:
        values = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise UsageError(f"{name} is no TOML: {error}") from error
    if "schema" not in values:
        raise UsageError(f"Expected schema = {SCHEMA} at the top of {name}, found none: add that line")
    schema = values.pop("schema")
    if not isinstance(schema, int) or isinstance(schema, bool) or schema < 1:
        raise UsageError(f"Expected schema = {SCHEMA} in {name}, got {schema!r}")
    if schema > SCHEMA:
        raise UsageError(f"Expected schema = {SCHEMA} in {name}, got {schema}: a newer one needs a newer rumi")
    known = {*_TABLES, "topics", "fixed", "settings"}
    if wrong := sorted(set(values) - known):
        raise UsageError(f"There is no table [{wrong[0]}] in a mapping; there are {', '.join(sorted(known))}")
    if lacking := [table for table in ("topics", "frames", "scene") if table not in values]:
        raise UsageError(f"Expected a table [{lacking[0]}] in {name}, found none")
    for table in ("topics", "settings"):
        if not isinstance(values.get(table, {}), Mapping):
            raise UsageError(f"{name}: Expected {table} to be a table, [{table}], got {values[table]!r}")
    if not isinstance(values.get("fixed", []), list):
        raise UsageError(f"{name}: Expected fixed to be tables, each headed [[fixed]], got {values['fixed']!r}")
    try:
        made: dict[str, Any] = {
            key: dataclass_of(kind, values[key], f"{key}.") for key, kind in _TABLES.items() if key in values
        }
        topics = {topic: _topic(topic, value) for topic, value in values["topics"].items()}
        fixed = tuple(dataclass_of(Fixed, value, "fixed.") for value in values.get("fixed", ()))
        for key, one in [*made.items(), *((f'topics."{topic}"', one) for topic, one in topics.items())]:
            _check_finite(one, f"{key}.")
        for one in fixed:
            one.pose()
            _check_finite(one, "fixed.")
    except ValueError as error:
        raise UsageError(f"{name}: {error}") from error
    return BagMap(topics=topics, fixed=fixed, settings=values.get("settings", {}), text=text, **made)


def _check_finite(table: Any, at: str) -> None:  # noqa: ANN401  (a table of any kind)
    """Refuse numbers that are none; only `view.far_m` may be infinite."""
    for name, value in asdict(table).items():
        numbers = np.ravel([part for part in np.ravel(np.array(value, dtype=object)) if isinstance(part, float)])
        if not np.isfinite(numbers.astype(float)).all() and (at + name, value) != ("view.far_m", math.inf):
            raise ValueError(f"Expected {at}{name} to be finite, got {value}")


def _topic(name: str, value: Any) -> Topic:  # noqa: ANN401  (read from TOML)
    values = value if isinstance(value, Mapping) else {"role": value}
    return dataclass_of(Topic, values, f'topics."{name}".')
