"""Fading: landmarks that later views should have shown again and again, and did not, are thought to be gone.

A landmark is there or it is not. From one view of its place to the next it may have gone, or come back. A
view that should show it finds it with a probability q if it is there, and by mistake with a small one if it
is not. So what is believed of it is a hidden Markov chain of two states, filtered forward from view to view
(compare the persistence filter of Rosen, Mason and Leonard, ICRA 2016). How often a landmark that is there is
found again is measured in each view by all that it should show: descriptors fail, and nodes keep only some of
what they saw. The views are those of verified links, whose relative postures the merged map knows.

A view should show a landmark if it projects well into the image, from a distance and direction from which it
looks alike, and nothing that the view knows the depth of stands before it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybridmap.node import Node, NodeId
from hybridmap.pose import Array, Pose2
from merge.graph.links import Link
from merge.graph.merged import MergedMap
from merge.graph.posegraph import PoseGraph
from merge.life.ages import is_older


@dataclass(frozen=True)
class FadingSettings:
    """When a landmark has faded.

    Attributes:
        margin_px: it should be seen if it projects this far inside the image.
        scale: and if its distance has changed by at most this factor.
        aside: and if it is seen from a direction that differs by at most this, rad.
        before_px: something hides it that is seen this near to it in the image,
        before: at less than this share of its distance.
        rates: within which the share is held that a view finds of what it should show.
        least_shown: a view that should show fewer landmarks tells nothing.
        mistaken: probability that a landmark that is gone is found all the same.
        goes: probability that a landmark has gone from one view to the next.
        comes: that one that had gone is back.
        at_first: probability that it was really there when it was mapped.
        faint: a landmark that is there with less than this has faded.
        moved: m, by which two nodes may move to each other before their views are compared anew.
    """

    margin_px: float = 12.0
    scale: float = 1.6
    aside: float = math.radians(25.0)
    before_px: float = 12.0
    before: float = 0.8
    rates: tuple[float, float] = (0.1, 0.9)
    least_shown: int = 15
    mistaken: float = 0.02
    goes: float = 0.02
    comes: float = 0.02
    at_first: float = 0.95
    faint: float = 0.2
    moved: float = 0.05


@dataclass(frozen=True, eq=False)
class Look:
    """What one later view tells of a node's landmarks.

    Attributes:
        link: between the node and the view.
        between: node_from_view by which it was worked out.
        expected: (N,) which landmarks the view should show.
        found: (N,) which it shows.
    """

    link: Link
    between: Pose2
    expected: NDArray[np.bool_]
    found: NDArray[np.bool_]


class Fader:
    """Goes from merged map to merged map with what later views tell: each is compared once."""

    def __init__(self, settings: FadingSettings | None = None) -> None:
        """Begin with nothing seen again.

        Args:
            settings: when a landmark has faded.
        """
        self._settings = settings or FadingSettings()
        self._looks: dict[NodeId, list[Look]] = {}
        self._faded: dict[NodeId, NDArray[np.bool_]] = {}
        self._graphs: tuple[PoseGraph, ...] = ()

    def fade(self, merged: MergedMap) -> MergedMap:
        """The same map with the landmarks that have faded.

        Args:
            merged: the next merged map of the same fleet.
        """
        solved = {id(graph) for graph in self._graphs}
        changed = [node for graph in merged.graphs if id(graph) not in solved for node in graph.nodes]
        here = frozenset(changed)
        self._graphs = merged.graphs
        later: dict[NodeId, list[tuple[Node, Link]]] = {}
        for link in merged.links:
            if link.a in here:
                a, b = (merged.maps[end.map].nodes[end] for end in link.pair)
                old, new = (a, b) if is_older(a, b) else (b, a)
                later.setdefault(old.id, []).append((new, link))
        for table in (self._looks, self._faded):
            for node_id in [node_id for node_id in table if merged.component_of(node_id) is None]:
                del table[node_id]
        for node_id in changed:
            node = merged.maps[node_id.map].nodes[node_id]
            views = sorted(later.get(node_id, ()), key=lambda view: (view[0].stamp_ns, view[0].id))
            before = {id(look.link): look for look in self._looks.get(node_id, ())}
            looks = [self._look(merged, node, new, link, before.get(id(link))) for new, link in views]
            self._looks[node_id] = looks
            gone = presence(len(node.landmarks), looks, self._settings) < self._settings.faint
            self._faded.pop(node_id, None)
            if gone.any():
                self._faded[node_id] = gone
        living = {one: gone for one, gone in sorted(self._faded.items()) if one not in merged.superseded}
        return replace(merged, faded=living)

    def _look(self, merged: MergedMap, old: Node, new: Node, link: Link, known: Look | None) -> Look:
        between = merged.pose(old.id).inverse() @ merged.pose(new.id)
        if known is not None:
            off = known.between.inverse() @ between
            if max(off.distance(Pose2()), abs(off.heading)) < self._settings.moved:
                return known
        found = np.zeros(len(old.landmarks), np.bool_)
        found[link.shared[:, 0 if link.a == old.id else 1]] = True
        return Look(link, between, expected(old, new, between, self._settings), found)


def expected(old: Node, new: Node, old_from_new: Pose2, s: FadingSettings) -> NDArray[np.bool_]:
    """(N,) which landmarks of a node another view should show.

    Args:
        old: the node.
        new: the view.
        old_from_new: how they stand.
        s: when a landmark should be seen.
    """
    points = old.points_in_robot
    from_new = old_from_new.inverse().apply(points)
    pixels = new.camera.project(from_new)
    eye_old = np.array([old.camera.mount_forward, 0.0])
    eye_new = old_from_new.apply(np.array([[new.camera.mount_forward, 0.0, 0.0]]))[0, :2]
    ray_old, ray_new = points[:, :2] - eye_old, points[:, :2] - eye_new
    far_old, far_new = np.linalg.norm(ray_old, axis=1), np.linalg.norm(ray_new, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.maximum(far_old, far_new) / np.minimum(far_old, far_new)
        cosine = (ray_old * ray_new).sum(axis=1) / (far_old * far_new)
        alike = (ratio < s.scale) & (cosine > math.cos(s.aside))
    shown: NDArray[np.bool_] = new.camera.contains(pixels, s.margin_px) & alike
    candidates = np.flatnonzero(shown)
    if len(candidates):
        depth = from_new[candidates, 0] - new.camera.mount_forward
        known = new.landmarks.take(new.landmarks.has_depth)
        apart = np.linalg.norm(pixels[candidates, None] - known.pixels[None], axis=2)
        before = (apart < s.before_px) & (known.depths[None] < s.before * depth[:, None])
        shown[candidates[before.any(axis=1)]] = False
    return shown


def presence(count: int, looks: Iterable[Look], s: FadingSettings) -> Array:
    """(count,) probability that each landmark is still there after some views, the earliest first.

    Args:
        count: landmarks of the node.
        looks: later views of it.
        s: how landmarks come and go.
    """
    there = np.full(count, s.at_first)
    for look in looks:
        shown = look.expected | look.found
        if look.expected.sum() < s.least_shown:
            continue
        rate = float(np.clip((look.found & look.expected).sum() / look.expected.sum(), *s.rates))
        there = np.where(shown, there * (1.0 - s.goes) + (1.0 - there) * s.comes, there)
        if_there = np.where(look.found, rate, 1.0 - rate)
        if_gone = np.where(look.found, s.mistaken, 1.0 - s.mistaken)
        both = there * if_there + (1.0 - there) * if_gone
        there = np.where(shown, there * if_there / both, there)
    return there
