from dataclasses import replace

import pytest
import torch
from torch.utils import _pytree as pytree
from torch.utils.data import DataLoader

from rumi.errors import UsageError
from rumi.runs.dataset import Episode, RecordedRuns, collate_episodes
from rumi.runs.folder import RunRecorder
from rumi.runs.recorded import RunLog
from sdf.containers import index
from sensors.contact_reading import ContactReading
from tests.fixtures.made_up_run import make_up

SETTINGS = {"task": "mug-0", "seed": 3}


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Two recorded runs of 4 and 6 steps."""
    paths = []
    for count in (4, 6):
        made, folder = make_up(count, particles=10), tmp_path_factory.mktemp("runs") / "run"
        with RunRecorder(folder, SETTINGS, made.geometry) as recorder:
            for step in made.steps:
                recorder(step)
            recorder.finish(made.result)
        paths.append(folder)
    return paths


def test_an_item_holds_what_was_recorded(folders):
    runs = RecordedRuns(folders)
    assert len(runs) == 2 and [len(run) for run in runs] == [4, 6]
    steps, episode = RunLog(folders[1]).taken(), runs[1]
    assert torch.equal(episode.truth, torch.stack([step.truth for step in steps]))
    assert not episode.control[0].any() and torch.equal(episode.control[2], steps[2].control)
    for k, step in enumerate(steps):
        seen, count = index(episode.reading, k).observation, len(step.reading.observation)
        assert torch.equal(seen.points[:count], step.reading.observation.points)
        assert not seen.valid[count:].any()


def test_a_batch_is_the_same_with_workers(folders):
    runs = RecordedRuns(folders)
    batches = [
        next(iter(DataLoader(runs, batch_size=2, num_workers=workers, collate_fn=collate_episodes)))
        for workers in (0, 2)
    ]
    assert isinstance(batches[0], Episode) and batches[0].valid.sum(-1).tolist() == [4, 6]
    for alone, working in zip(*map(pytree.tree_leaves, batches), strict=True):
        assert torch.equal(alone, working)


def test_a_log_is_read_as_its_run_is(folders, tmp_path):
    pytest.importorskip("h5py")
    from sensors.log.writer import LogWriter

    path, steps = tmp_path / "log.h5", RunLog(folders[0]).taken()
    with LogWriter(path) as log:
        for step in steps:
            log.reading(step.reading, control=step.control, truth=step.truth)
    (one,) = RecordedRuns([path])
    for logged, traced in zip(*map(pytree.tree_leaves, (one, RecordedRuns(folders)[0])), strict=True):
        assert torch.equal(logged, traced)


def test_a_log_with_further_contacts_is_read(folders, tmp_path):
    """As the handle's were, of before; nobody says of which kind its readings are."""
    pytest.importorskip("h5py")
    from sensors.log.writer import LogWriter

    path, steps = tmp_path / "log.h5", RunLog(folders[0]).taken()
    with LogWriter(path, readings=ContactReading) as log:
        for step in steps:
            reading = replace(ContactReading.of(step.reading), signals=step.reading.in_contact)
            log.reading(reading, control=step.control, truth=step.truth)
    (one,) = RecordedRuns([path])
    assert isinstance(one.reading, ContactReading)
    for k, step in enumerate(steps):
        count = len(step.reading.in_contact)
        assert torch.equal(index(one.reading, k).signals[:count], step.reading.in_contact)


def test_what_cannot_be_read_is_refused(tmp_path):
    with pytest.raises(UsageError, match="which is not there"):
        RecordedRuns([tmp_path / "nothing"])
    (tmp_path / "empty").mkdir()
    with pytest.raises(UsageError, match="no log"):
        RecordedRuns([tmp_path / "empty"])[0]
    with pytest.raises(UsageError, match="readings of a rummaging task, got none"):
        Episode.of([])
