"""Settings of any task by the name of a preset: `rumi.preset`."""

from typing import Any

from rumi.runs.json_settings import changed
from rumi.tasks.registry import TASKS
from rumi.tasks.rummage.settings import Settings, under_conditions


def preset(name: str = "default", *, task: str = "mug-0", **changes: Any) -> Any:  # noqa: ANN401  (the task's own kind)
    """The settings of a preset of a task.

        rumi.preset("fast", task="box-1", seed=3, planner={"mppi": {"samples": 100}})
        rumi.preset(task="peg", **{"most_actions": 20})
        rumi.preset(**{"planner.push_model": "displacement"})

    Args:
        name: of the preset.
        task: one of those that `rumi tasks` lists.
        changes: settings to give another value, by the names of their flags with underscores: nested ones with dots, or
            as a mapping, or a group of settings as a whole; `conditions` before all others.

    Raises:
        UsageError: there is no such task, preset or setting, or a value that is none; the message says what there is.
    """
    settings = TASKS[task].preset(name)
    if isinstance(settings, Settings) and "conditions" in changes:
        settings = under_conditions(settings, changes["conditions"])
    return changed(settings, changes)
