"""Loading a command: the garbage collector waits for it."""

import gc

from rumi.cli import main


def test_what_is_loaded_for_a_command_is_left_alone_by_the_collector_where_the_process_ends_with_it(monkeypatch):
    seen = []

    def tasks(_):
        seen.append((gc.get_freeze_count() > 0, gc.isenabled()))
        return 0

    monkeypatch.setattr("rumi.commands.tasks.tasks", tasks)
    monkeypatch.setattr("sys.argv", ["rumi", "tasks"])
    try:
        for arguments in (["tasks"], None):
            assert main(arguments) == 0
    finally:
        gc.unfreeze()
    assert seen == [(False, True), (True, True)]
