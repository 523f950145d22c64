"""Loading a command: the garbage collector waits for it."""

import gc

from rumi.cli import main


def test_what_is_loaded_for_a_command_is_left_alone_by_the_collector_where_the_process_ends_with_it(monkeypatch):
    seen, before = [], gc.get_freeze_count()

    def tasks(_):
        seen.append((gc.get_freeze_count() > before, gc.isenabled()))
        return 0

    monkeypatch.setattr("rumi.commands.tasks.tasks", tasks)
    monkeypatch.setattr("sys.argv", ["rumi", "tasks"])
    for arguments in (["tasks"], None):
        assert main(arguments) == 0
    assert seen == [(False, True), (True, True)]
