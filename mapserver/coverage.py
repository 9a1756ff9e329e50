"""Fleet coverage: what other robots have mapped around a robot, in its own map."""

import math

import numpy as np

from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.query import MAX_KNOWN, KnownAnswer
from mapweave.merge.pose_graph.merged_map import MergedMap


class SharedCoverage:
    """Answers what others have mapped. It belongs to one merged map; make another for the next."""

    def __init__(self, merged: MergedMap) -> None:
        self._merged = merged

    def answer(self, asking: MapId, position: tuple[float, float], reach: float) -> KnownAnswer:
        """Views of all other maps that are joined to the asking robot's, near a position.

        The robot's own map and the merged one bend differently. So each view is placed relative to the
        nearest node of the robot's own: around that node the two agree best.

        Args:
            asking: the robot's own map.
            position: (x, y) m, in that map.
            reach: how far around, m.
        """
        if asking not in self._merged.maps:
            return KnownAnswer(np.zeros((0, 4), np.float32), f"map {asking} is not in the merged map")
        views = [view for component in self._merged.components for view in self._views(asking, component)]
        # A view whose principal point is outside of its image covers nothing.
        nearby = [view for view in views if view[3] > 0.0 and math.dist(view[:2], position) <= reach]
        nearby.sort(key=lambda view: math.dist(view[:2], position))
        views_sent = nearby[:MAX_KNOWN]
        if not views:
            reason = f"no other map is joined to {asking} yet"
        else:
            reason = f"{len(views_sent)} of {len(views)} views of others within {reach:.1f} m"
        return KnownAnswer(np.array(views_sent, np.float32).reshape(-1, 4), reason)

    def _views(self, asking: MapId, component: frozenset[NodeId]) -> list[tuple[float, float, float, float]]:
        """[x m, y m, heading rad, semi-aperture rad], in the asking map, of a component's foreign nodes."""
        from scipy.spatial import cKDTree

        merged = self._merged
        own = sorted(node for node in component if node.map == asking)
        other_nodes = sorted(node for node in component if node.map != asking)
        if not own or not other_nodes:
            return []
        poses = {node: merged.pose(node) for node in component}
        tree = cKDTree([[poses[node].x, poses[node].y] for node in own])
        _, nearest = tree.query([[poses[node].x, poses[node].y] for node in other_nodes])
        views = []
        for node, k in zip(other_nodes, np.atleast_1d(nearest), strict=True):
            map_from_own = merged.maps[asking].nodes[own[int(k)]].map_from_robot.mean
            place = map_from_own @ poses[own[int(k)]].inverse() @ poses[node]
            views.append(
                (place.x, place.y, place.heading, merged.maps[node.map].nodes[node].camera.semi_aperture)
            )
        return views
