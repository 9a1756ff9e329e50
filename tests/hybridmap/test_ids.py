"""Ids of nodes and maps, as people write them."""

import pytest

from mapweave.hybridmap.constraint_subject import read_end
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.limits import MAX_NUMBER


def test_nodes_and_maps_are_read():
    assert read_end("r0.1.17") == NodeId("r0", 1, 17)
    assert read_end("r0.1") == MapId("r0", 1)
    assert read_end(f"r0.0.{MAX_NUMBER}") == NodeId("r0", 0, MAX_NUMBER)
    assert read_end(f"r0.{MAX_NUMBER}") == MapId("r0", MAX_NUMBER)


@pytest.mark.parametrize(
    "number", ["", "-1", "x", "1e3", "²", "٣", str(MAX_NUMBER + 1), "9" * 20, "9" * 5000]
)
def test_numbers_that_no_node_and_no_map_has_are_refused(number: str):
    """A larger one passed, and then no message could hold it."""
    for text in (f"r0.1.{number}", f"r0.{number}.1"):
        with pytest.raises(InvalidValue, match=r"is no node id; they look like r0\.1\.17"):
            NodeId.parse(text)
    with pytest.raises(InvalidValue, match="is neither a node nor a map"):
        read_end(f"r0.{number}")
