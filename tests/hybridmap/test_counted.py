"""Counts in messages for people."""

from mapweave.hybridmap.counted import counted


def test_one_of_a_thing_has_no_s():
    assert [counted(count, "node") for count in (0, 1, 2)] == ["0 nodes", "1 node", "2 nodes"]
