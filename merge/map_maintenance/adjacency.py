"""The links of a merged map by their nodes, kept from merged map to merged map: most stay what they are."""

from collections.abc import Collection, Iterable, Iterator

from mapweave.hybridmap.ids import NodeId
from mapweave.merge.pose_graph.candidates import Pair
from mapweave.merge.pose_graph.links import Link


class Adjacency:
    """Which links there are at a node. Only what has come or gone costs more than a glance.

    Attributes:
        touched: nodes at which links have come or gone with the last merged map.
        cut: pairs that were linked before it; some may be linked again.
    """

    def __init__(self) -> None:
        """No links yet."""
        self.touched: set[NodeId] = set()
        self.cut: list[Pair] = []
        self._links: dict[int, Link] = {}
        self._at: dict[NodeId, dict[NodeId, Link]] = {}

    def __iter__(self) -> Iterator[Link]:
        """All links of the newest merged map."""
        return iter(self._links.values())

    def follow(self, links: Iterable[Link]) -> list[Link]:
        """Take those of the next merged map, and no others.

        Returns:
            Those of pairs that were not linked before.
        """
        now = {id(link): link for link in links}
        removed = [link for key, link in self._links.items() if key not in now]
        come = [link for key, link in now.items() if key not in self._links]
        fresh = [link for link in come if self.between(link.a, link.b) is None]
        self.cut = [link.pair for link in removed]
        self.touched = {node for link in (*removed, *come) for node in link.pair}
        for link in removed:
            for a, b in (link.pair, link.pair[::-1]):
                del self._at[a][b]
                if not self._at[a]:
                    del self._at[a]
        for link in come:
            for a, b in (link.pair, link.pair[::-1]):
                self._at.setdefault(a, {})[b] = link
        self._links = now
        return fresh

    def at(self, node: NodeId) -> Collection[Link]:
        """Links with an end at a node."""
        return self._at.get(node, {}).values()

    def between(self, a: NodeId, b: NodeId) -> Link | None:
        """The link of two nodes, in either order."""
        return self._at.get(a, {}).get(b)
