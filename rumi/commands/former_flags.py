"""Flags of `rumi run` that have another name now: one table, which keeps commands on record working."""

from collections.abc import Sequence

from rumi.errors import UsageError
from rumi.runs.progress import say

FORMER_FLAGS: dict[str, dict[str, str]] = {
    "Settings": {
        "--budget": "--plan-budget-s",
        "--motion": "--filter.motion",
        "--push-model": "--planner.push-model",
        "--sensor": "--simulator.sensors.kind",
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
        UsageError: a flag that has no one name now; the message says what to write.
    """
    former = FORMER_FLAGS.get(settings.__name__, {})
    found: list[str] = []
    for argument in arguments:
        flag, equals, value = argument.partition("=")
        if flag == "--set":
            raise UsageError("--set NAME=VALUE is --NAME VALUE now, such as --point-m 0.001 for --set point_m=0.001")
        if flag == "--degraded" and former:
            raise UsageError(
                "--degraded is --conditions lab now, which has more than errors of images; those alone are its values "
                "below --simulator.sensors, such as --simulator.sensors.calibration-m 0.002"
            )
        if flag in former:
            say(f"{flag} is {former[flag]} now")
            *first, last = former[flag].split()
            found += first
            argument = last + equals + value
        if found and found[-1] in _REAL and argument == "real":
            argument = "None"
        found.append(argument)
    return found
