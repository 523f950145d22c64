"""Let results of earlier code count as those of the present code, which must give the same: after moves, say.

    python -m scripts.reproduce.same_code run 0f3a9c2b71de     # results of this earlier code count as the present's
    python -m scripts.reproduce.same_code run 0f3a9c2b71de --golden mug-0 mug-1     # after these golden runs alone

Only after `scripts/golden.py check` has passed, which this runs itself first: it ends with that one's exit code and
writes nothing where a belief differs. Entered in scripts/results/same_code.json are the earlier hash, the present one,
the kind of work and the commit; what was done by either then counts for the other. What the golden runs do not cover
(cameras, torques at the joints) is the user's word.
"""

import json
import subprocess
import sys
from dataclasses import dataclass
from typing import Annotated

import tyro

from rumi.cli import script
from rumi.errors import UsageError
from rumi.runs.folder import write_json
from scripts.reproduce.code import ROOT, ROOTS, SAME_CODE, code_of, same_code
from scripts.store import commit


@dataclass(frozen=True)
class Options:
    """What counts as the same.

    Attributes:
        kind: of work, as in `scripts.reproduce.code.ROOTS`.
        old: hash of the earlier code, whose beliefs the golden runs have on record.
        golden: names of the golden runs to check; all by default.
    """

    kind: Annotated[str, tyro.conf.Positional]
    old: Annotated[str, tyro.conf.Positional]
    golden: tuple[str, ...] = ()


def enter(kind: str, old: str) -> None:
    """Write down that an earlier hash of a kind of work counts as the present one, with those that counted as it."""
    entries = json.loads(SAME_CODE.read_text(encoding="utf-8")) if SAME_CODE.is_file() else []
    present = code_of(kind)
    others = [entry for entry in entries if (entry["kind"], entry["old"]) != (kind, old) and entry["old"] != present]
    others = [entry | {"new": present} if entry["new"] == old else entry for entry in others]
    if old != present:
        others.append({"old": old, "new": present, "kind": kind, "commit": commit()})
    write_json(SAME_CODE, others)
    same_code.cache_clear()


def main() -> None:
    """Check, and enter."""
    options = tyro.cli(Options, description=__doc__)
    if options.kind not in ROOTS:
        raise UsageError(f"There is no kind of work {options.kind!r}; there are {', '.join(ROOTS)}")
    check = [sys.executable, str(ROOT / "scripts" / "golden.py"), "check", *options.golden]
    if code := subprocess.run(check, cwd=ROOT, check=False).returncode:
        raise SystemExit(code)
    enter(options.kind, options.old)
    sys.stdout.write(f"{options.kind}: {options.old} counts as {code_of(options.kind)}\n")


if __name__ == "__main__":
    script(main)
