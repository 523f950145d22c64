"""What a run left out, since its scene did not need it: a table to read."""

from rumi.records import StepRecord
from sdf.skipped_work import Account, Work

WORKS = {
    "workspace_points": "places whose worth was worked out; the object cannot be at the others",
    "normals": "places given a direction of contact; the others are hardly ever touched",
    "contact_checks": "checks whether the tool touches a pose; the others were clear beforehand",
    "pushes": "small steps of a push that were worked out; in the others the tool was too far away to touch",
    "rollouts_valued": "foreseen motions that were valued; the others are copies of one of them",
    "reachability_sums": "sums for the reachability cost; the others were looked up in a table",
    "old_points": "points that were weighed anew; the others moved with the object, and kept their weight",
    "observed_points": "distances of a point to a pose; the others lie in space that the pose cannot touch",
    "resamplings": "steps that drew the poses anew; at the others the belief fitted well enough",
    "plans": "actions that were planned anew; the others followed the plan before",
}
"""What each kind of work is, in the order of the table."""


class Decisions:
    """Counts, as an `on_step`, how many steps asked for a plan and for a resampling.

    Args:
        account: that they are added to.
    """

    def __init__(self, account: Account) -> None:
        self._account = account
        self._last: object = None

    def __call__(self, step: object) -> None:
        """Count a step."""
        if not isinstance(step, StepRecord) or step.control is None:
            return
        self._account.add("resamplings", Work(float(step.resampled), 1.0))
        self._account.add("plans", Work(float(step.plan is not self._last), 1.0))
        self._last = step.plan


def explain(account: Account) -> str:
    """The table: how much was done of how much, how long that took, and what the rest would have taken at its pace."""
    lines = [f"{'skipped':>8}  {'done':>9}  {'of':>9}  {'took':>8}  {'saved':>9}"]
    named = [name for name in WORKS if name in account.works] + [name for name in account.works if name not in WORKS]
    for name in named:
        work = account.works[name]
        took = f"{work.seconds:.2f} s" if work.seconds else "-"
        saved = "-" if not work.seconds or work.saved_s is None else f"{work.saved_s:.2f} s"
        lines.append(
            f"{_share(work.skipped):>8}  {_short(work.done):>9}  {_short(work.whole):>9}  {took:>8}  {saved:>9}"
            f"  {WORKS.get(name, name)}"
        )
    lines.append("saved: what the rest would have taken at the pace of what was done")
    return "\n".join(lines) + "\n"


def _share(share: float) -> str:
    return f"{100 * share:.0f} %" if share < 0.995 else f"{100 * share:.2f} %"


def _short(count: float) -> str:
    """A count in at most four digits."""
    for factor, letter in ((1e12, "T"), (1e9, "G"), (1e6, "M"), (1e3, "k")):
        if count >= 10 * factor:
            return f"{count / factor:.4g} {letter}"
    return f"{count:.0f}"
