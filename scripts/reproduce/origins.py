"""Where results come from: scenes, conditions, code and processor, as tables say them."""

from collections.abc import Sequence

from rumi.tasks.rummage.drawn_scenes import DRAWN
from rumi.tasks.rummage.scenes import SCENES
from rumi.tasks.rummage.settings import DRAWN_CONDITIONS
from scripts.reproduce.records import Record
from scripts.store import commit, machine

_KINDS = {
    "run": "runs",
    "toy": "closed loops of the toy",
    "peg": "runs of the peg task",
    "peg-real": "runs of the peg task in real time",
}
"""What each kind of work is called."""
_ASKED = "conditions="
_APART = "Between these, code and processor differ beside what a row is about"


def provenance(records: Sequence[Record]) -> str:
    """What the results were made by and with."""
    parts = []
    for kind in dict.fromkeys(record.kind for record in records):
        own = [record for record in records if record.kind == kind]
        seeds = sorted({record.seed for record in own})
        code, commits = (", ".join(sorted({getattr(record, name) for record in own})) for name in ("code", "commit"))
        machines = "; ".join(sorted({named_machine(record.machine) for record in own}))
        parts.append(f"- {len(own)} {_KINDS[kind]}, seeds {_ranges(seeds)}; code {code}, commit {commits}; {machines}")
    return "\n".join(parts) + "\n"


def origin(records: Sequence[Record]) -> str:
    """In a paragraph the scenes and conditions of some results, and the commit and processor of each column."""
    if not records:
        return ""
    by_machine: dict[str, list[Record]] = {}
    for record in records:
        by_machine.setdefault(named_machine(record.machine), []).append(record)
    groups = sorted(by_machine.items(), key=lambda item: len({record.column for record in item[1]}))
    made = []
    for k, (name, own) in enumerate(groups):
        columns = "`, `".join(dict.fromkeys(record.column for record in own))
        who = "" if len(groups) == 1 else "All else: " if k == len(groups) - 1 else f"`{columns}`: "
        commits = list(dict.fromkeys(record.commit for record in own))
        made.append(f"{who}commit{'s' if len(commits) > 1 else ''} {', '.join(commits)}; {name}")
    seeds = _ranges(sorted({record.seed for record in records}))
    by = made[0][0].upper() + made[0][1:] if len(made) == 1 else ". ".join([*made, _APART])
    return ". ".join([*_scenes(records), f"Seeds {seeds}", by]) + "."


def present() -> str:
    """Conditions, commit and processor of what is worked out while a page is written, of the fixed starts."""
    return f"ideal conditions; commit {commit()}; {machine()}"


def named_machine(text: str) -> str:
    """A machine as on record, which says so where the record has no processor's name."""
    kind, comma, rest = text.partition(",")
    return f"{kind} of a model not recorded{comma}{rest}" if kind == "x86_64" else text


def _scenes(records: Sequence[Record]) -> list[str]:
    """Sentences about the scenes of runs, without full stops; of other work there are none."""
    runs = [record for record in records if record.kind == "run"]
    if not runs:
        return []
    said = []
    for drawn in (False, True):
        own = [record for record in runs if (record.task in DRAWN) == drawn]
        for conditions in dict.fromkeys(map(_conditions, own)):
            tasks = list(dict.fromkeys(record.task for record in own if _conditions(record) == conditions))
            specs = SCENES | DRAWN
            without = [task for task in tasks if task in specs and not specs[task].measures_motion]
            motion = "motion measured" if len(without) < len(tasks) else "motion not measured"
            if 0 < len(without) < len(tasks):
                motion += f", but not on {', '.join(without)}"
            starts = "drawn by the seed" if drawn else "fixed"
            said.append(f"Starts {starts} ({', '.join(tasks)}), {conditions} conditions, {motion}")
    return said


def _conditions(record: Record) -> str:
    asked = [value.removeprefix(_ASKED) for value in record.overrides if value.startswith(_ASKED)]
    return asked[-1] if asked else DRAWN_CONDITIONS if record.task in DRAWN else "ideal"


def _ranges(numbers: Sequence[int]) -> str:
    """0-3, 7 of 0, 1, 2, 3, 7."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    return ", ".join(str(run[0]) if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in runs)
