"""A node keeps to its byte budget on the wire, and is the same node for all receivers."""

import numpy as np
import pytest

from mapweave import MapId, Node
from mapweave.agent.mapping.mapper import Mapper
from mapweave.agent.settings import AgentSettings
from mapweave.hybridmap.change import Change, NodePut
from mapweave.hybridmap.errors import InvalidValue, SettingsError
from mapweave.storage.settings_file import build
from mapweave.wire.codec import decode_body, encode_body, encode_change

FRAMING = 80
"""What the transport adds."""


def mapped(walls, description, most_bytes: int) -> Node:
    """A node of the walls, made under a budget as a settings file gives it."""
    table = {"landmarks": {"most_bytes": most_bytes}}
    mapper = Mapper(MapId("r0", 1), description, build(AgentSettings, table, "robot.toml"))
    return walls.mapped(mapper, reach=0.4)


def cost(node: Node) -> int:
    return len(encode_change(Change(node.id.map, 100_000, node.stamp_ns, NodePut(node)))) + FRAMING


def test_a_node_keeps_to_its_byte_budget(walls, description):
    large, small = (mapped(walls, description, most) for most in (3000, 900))
    assert cost(large) <= 3000
    assert 650 < cost(small) <= 900
    assert 15 < len(small.landmarks) < len(large.landmarks)
    # What a small node keeps is of the large one, and lies as far apart.
    assert {bytes(code) for code in small.landmarks.codes} <= {bytes(code) for code in large.landmarks.codes}
    assert (np.ptp(small.landmarks.pixels, axis=0) > 0.8 * np.ptp(large.landmarks.pixels, axis=0)).all()


def test_the_robot_uses_the_quantized_numbers(walls, description):
    node = mapped(walls, description, 3000)
    sent = decode_body(encode_body(NodePut(node)))
    assert isinstance(sent, NodePut)
    for name in ("pixels", "codes", "depths", "depth_sigmas"):
        assert np.array_equal(getattr(sent.node.landmarks, name), getattr(node.landmarks, name))
    assert (np.diff(node.landmarks.pixels[:, 1]) >= 0).all()


def test_a_budget_that_leaves_no_room_is_refused():
    with pytest.raises(InvalidValue, match="660 at least"):
        build(AgentSettings, {"landmarks": {"most_bytes": 100}}, "robot.toml")
    with pytest.raises(SettingsError, match="did you mean 'most_bytes'"):
        build(AgentSettings, {"landmarks": {"most_byte": 1000}}, "robot.toml")
