"""What follows from the content of a map file; each part is worked out when it is first asked for."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

from mapweave.extras import need
from mapweave.hybridmap.annotation import Annotations
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.floor_plan import PlacedPlans
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pose import PoseGaussian
from mapweave.mapserver.content_hash import content_hash
from mapweave.merge.settings import MergeSettings
from mapweave.node_table import NodeTable
from mapweave.storage.map_file import MapFile

if TYPE_CHECKING:
    from mapweave.mapserver.relocalization.relocalizer import Relocalizer
    from mapweave.mapserver.routes import Router
    from mapweave.merge.pose_graph.merged_map import MergedMap


class MapReading:
    """A map as it was read.

    Attributes:
        content: of the map file.
        settings: how it is explained; as it was merged.
    """

    def __init__(
        self,
        content: MapFile,
        settings: MergeSettings | None = None,
        solve: Callable[[], MergedMap] | None = None,
    ) -> None:
        """Take a content. Nothing is worked out yet.

        Args:
            content: of the map file.
            settings: see the class.
            solve: gives the merged map; by default that of a file, as it was decided when it was written.
        """
        self.content = content
        self.settings = settings or MergeSettings()
        self._solve = solve

    def with_content(self, content: MapFile) -> MapReading:
        """Another content with the same measurements and pins: what follows from those is kept.

        Args:
            content: of which no more differs than annotations without pins, images and poses.
        """
        other = MapReading(content, self.settings, self._solve)
        same = ("graph", "merged", "router", "relocalizer")
        vars(other).update({name: value for name, value in vars(self).items() if name in same})
        return other

    @cached_property
    def graph(self) -> HybridMap:
        """Nodes and edges; links of a merged map are edges among them."""
        return HybridMap(self.content.changes)

    @cached_property
    def placed(self) -> Mapping[NodeId, tuple[int, PoseGaussian]]:
        """Component and pose of each node.

        A merged map's file has them. Those of a robot's own map are optimised first.

        Raises:
            MissingExtra: that needs the extra "server".
        """
        return self.content.poses if self.content.kind == "merged" else self.merged.poses

    @cached_property
    def nodes(self) -> NodeTable:
        """All nodes, in columns."""
        return NodeTable.of(self.graph.nodes, self.placed, self.content.superseded)

    def nodes_on(self, plan: str) -> NodeTable:
        """The nodes of the components under which a floor plan lies, with their poses on it; see `plans`.

        Raises:
            Refused: there is no such plan.
        """
        on_plan = {part.component: part.plan_from_merged for part in self.plans.plan(plan).parts}
        placed = {
            node: (component, replace(pose, mean=on_plan[component] @ pose.mean))
            for node, (component, pose) in self.placed.items()
            if component in on_plan
        }
        return NodeTable.of(self.graph.nodes, placed, self.content.superseded)

    @cached_property
    def merged(self) -> MergedMap:
        """The map solved again.

        Raises:
            MissingExtra: that needs the extra "server".
            InvalidFile: its measurements determine no poses.
        """
        need("server")
        if self._solve is not None:
            return self._solve()
        from mapweave.mapserver.map_files import merged_of

        return merged_of(self.content, self.settings)

    @cached_property
    def plans(self) -> PlacedPlans:
        """Floor plans under the map; see `merged`."""
        merged = self.merged
        from mapweave.mapserver.floor_plans import placed_plans

        return placed_plans(Annotations(self.content.annotations), merged)

    @cached_property
    def router(self) -> Router:
        """Finds routes; see `merged`."""
        merged = self.merged
        from mapweave.mapserver.routes import Router

        return Router(merged)

    @cached_property
    def relocalizer(self) -> Relocalizer:
        """Says where views were taken; see `merged`."""
        merged = self.merged
        from mapweave.offline_relocalization import relocalizer_in

        return relocalizer_in(merged)

    @cached_property
    def hash(self) -> str:
        """See mapweave.mapserver.content_hash."""
        return content_hash(self.content)

    def node(self, node: NodeId) -> Node:
        """A node.

        Raises:
            InvalidValue: it is not there.
        """
        found = self.graph.nodes.get(node)
        if found is None:
            raise InvalidValue(f"the map has no node {node}")
        return found
