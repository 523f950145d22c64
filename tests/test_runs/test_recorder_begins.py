import errno
from pathlib import Path

import pytest

from rumi.errors import UsageError
from rumi.runs import folder as folder_module
from rumi.runs.folder import RunRecorder
from tests.fixtures.made_up_run import make_up


@pytest.mark.parametrize("broken", ["steps.jsonl", "scene"])
def test_a_recorder_that_cannot_begin_lets_go_of_its_files(broken, tmp_path, monkeypatch):
    held, open_it = {}, Path.open

    def refuse(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    def opened(path, *arguments, **options):
        if path.name == broken:
            refuse()
        held[path.name] = open_it(path, *arguments, **options)
        return held[path.name]

    monkeypatch.setattr(Path, "open", opened)
    if broken == "scene":
        monkeypatch.setattr(folder_module, "write_geometry", refuse)
    with pytest.raises(UsageError, match="No space left"):
        RunRecorder(tmp_path / "run", {"task": "mug-0", "seed": 3}, make_up(2, particles=2).geometry)
    assert "trace.npz" in held and all(file.closed for file in held.values())
    assert not (tmp_path / "run").exists()
