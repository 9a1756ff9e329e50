"""A map server that is missing is reported once, and so is that it is there again."""

from mapweave.processes.server_watch import PATIENCE, ServerWatch


def test_a_missing_server_is_reported_once():
    watch, long = ServerWatch("s0"), PATIENCE + 1.0
    lines = [watch.see(False, now) for now in (0.0, 0.5 * long, long, 2.0 * long)]
    assert [bool(line) for line in lines] == [False, False, True, False] and "mapweave server" in lines[2]
    assert watch.see(True, 3 * long) == "map server s0 is in reach" and not watch.see(True, 4 * long)
    assert not watch.see(False, 4 * long + 1.0) and watch.see(False, 6 * long)
