"""How far the work is: a bar on a terminal, and nothing elsewhere."""

import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from tqdm import tqdm

from scripts.reproduce.jobs import Job
from scripts.reproduce.records import Records

PERIOD_S = 1.0


@contextmanager
def progress(jobs: Sequence[Job], path: Path) -> Iterator[None]:
    """Within the block, show how much of some work a file of results holds, and how much of that is right."""
    records, ended = Records(path), threading.Event()
    # without a terminal the bar is switched off
    with tqdm(total=len(jobs), initial=len(records.done(jobs)), file=sys.stderr, leave=False, disable=None) as bar:

        def keep_up() -> None:
            while not (bar.disable or ended.wait(PERIOD_S)):
                records.refresh()
                done = records.done(jobs)
                bar.set_postfix_str(f"{sum(bool(record.figures.get('right')) for record in done)} right", refresh=False)
                bar.update(len(done) - bar.n)

        thread = threading.Thread(target=keep_up, daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()
