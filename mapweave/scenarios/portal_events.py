"""Floors with lifts between them, and robots that are taken through: truth sets the stage, no more."""

from collections.abc import Callable, Mapping

from mapweave.fleet import Fleet as Person
from mapweave.hybridmap.agent_status import AgentStatus
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Node
from mapweave.scenarios.fleet import FLEET, TrialFleet, TrialStage
from mapweave.storage.map_file import MapFile

CLEAR = 0.8
"""m; so far from all robots a robot is put down, or sent."""


class PortalEvents:
    """What people do about floors: by the same means as any person.

    Attributes:
        goal: a node beyond the lift, clear of robots.
    """

    def __init__(self, stage: TrialStage, fleet: TrialFleet, note: Callable[[str, bool], None]) -> None:
        """Start without floors."""
        self._stage, self._fleet, self._note = stage, fleet, note
        self._person = Person(fleet=FLEET, by="scenario", bus=fleet.bus)
        self.goal: NodeId | None = None

    def label(self, merged: MapFile) -> None:
        """Each robot's map is a floor of its own; a lift leads from the first to the second."""
        whole = HybridMap(merged.changes)
        sides = []
        for number, robot in enumerate(self._stage.robots, start=1):
            clear = self._clear_nodes(whole, robot)
            which = clear[0].id
            why = "each robot has a floor of its own"
            self._person.annotate("floor", str(which.map), why, node=str(which), label=str(number))
            sides.append(clear)
        a, b = sides[0][0].id, sides[1][0].id
        self._person.annotate("portal", "lift", a=str(a), b=str(b), means="lift")
        self.goal = max(sides[1], key=lambda node: _apart(whole, node.id, b)).id
        self._note(f"a lift leads from {a} on floor 1 to {b} on floor 2", False)

    def waiting(self, agents: Mapping[str, AgentStatus]) -> list[str]:
        """The robots that ask to be taken through a portal."""
        return [name for name, one in agents.items() if one.status.portal and not one.status.portal.done]

    def take_through(self, agents: Mapping[str, AgentStatus], merged: MapFile) -> list[str]:
        """Put the robots that ask at the other side, and say so; returns their names."""
        whole, names = HybridMap(merged.changes), self.waiting(agents)
        for name in names:
            wait = agents[name].status.portal
            assert wait is not None, "it asks"
            (there,) = self._fleet.control.truth_of([whole.nodes[wait.portal.exit]]).values()
            self._fleet.control.kidnap(name, there)
            self._note(self._person.portal_done(name), False)
        return names

    def _clear_nodes(self, whole: HybridMap, robot: str) -> list[Node]:
        """A robot's nodes that are clear of all robots; most landmarks first."""
        standing = [one.world_from_robot for one in self._fleet.control.status().robots.values()]
        nodes = [node for node in whole.nodes.values() if node.id.agent == robot]
        truth = self._fleet.control.truth_of(nodes)
        clear = [n for n in nodes if min(truth[n.id].distance(pose) for pose in standing) > CLEAR]
        return sorted(clear, key=lambda node: (-len(node.landmarks), node.id))


def _apart(whole: HybridMap, a: NodeId, b: NodeId) -> float:
    return whole.nodes[a].map_from_robot.mean.distance(whole.nodes[b].map_from_robot.mean)
