"""Who maps when, and what the floor sees of it."""

from mapweave.agent.calibration.online import OnlineCalibration
from mapweave.agent.map_making import MapMaking
from mapweave.agent.mapping.mapper import Mapper
from mapweave.agent.settings import AgentSettings
from mapweave.hybridmap.change import NodePut
from mapweave.hybridmap.ids import MapId


def test_the_floor_sees_a_node_that_is_put_again_once(walls, description, monkeypatch) -> None:
    """Its image shows no more free floor, nor more obstacles, when its lengths are corrected."""
    node = walls.mapped(Mapper(MapId("r0", 1), description))
    made = MapMaking(MapId("r0", 1), OnlineCalibration(description), AgentSettings())
    seen: list[int] = []
    monkeypatch.setattr(made.floor, "see_node", lambda one: seen.append(one.id.number))
    for _ in range(2):
        made.mapper.drove(None, node)
        assert made.take_changes() == (NodePut(node),)
    assert seen == [node.id.number]
