"""Flags of `rumi run` that have another name now: one table, which keeps commands on record working."""

from collections.abc import Sequence
from dataclasses import asdict

from rumi.errors import UsageError
from rumi.runs.progress import say
from rumi.sim.sensor_settings import SensorSettings, degraded

_SENSORS = "--simulator.sensors."

FORMER_FLAGS: dict[str, dict[str, str]] = {
    "Settings": {
        "--budget": "--plan-budget-s",
        "--motion": "--filter.motion",
        "--push-model": "--planner.push-model",
        "--sensor": f"{_SENSORS}kind",
        "--degraded": " ".join(
            f"{_SENSORS}{name.replace('_', '-')} {value}"
            for name, value in asdict(degraded("camera")).items()
            if value != getattr(SensorSettings("camera"), name)
        ),
    },
    "TouchBoxSettings": {"--budget": "--plan-budget-s"},
    "PegRunSettings": {"--t-max": "--action-budget-s", "--evaluation": "--evaluation-s"},
    "HandleRunSettings": {"--budget": "--run-budget-s", "--thinking": "--thinking-s"},
}
"""What a flag is now by its name before, by the dataclass of the task's settings."""

_REAL = ("--evaluation-s", "--thinking-s")  # "real" was the word for None


def renamed(settings: type, arguments: Sequence[str]) -> list[str]:
    """A command line with the names that flags have now.

    Args:
        settings: dataclass of the task's settings.
        arguments: of the command line, after the task's name.

    Raises:
        UsageError: `--set NAME=VALUE`, which has no one name; the message says what to write.
    """
    former = FORMER_FLAGS.get(settings.__name__, {})
    found: list[str] = []
    for argument in arguments:
        flag, equals, value = argument.partition("=")
        if flag == "--set":
            raise UsageError("--set NAME=VALUE is --NAME VALUE now, such as --point-m 0.001 for --set point_m=0.001")
        if flag in former:
            say(f"{flag} is {former[flag]} now")
            *first, last = former[flag].split()
            found += first
            argument = last + equals + value
        if found and found[-1] in _REAL and argument == "real":
            argument = "None"
        found.append(argument)
    return found
