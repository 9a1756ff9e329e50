"""The ways to merge that `benchmarks.merge` compares, all by the same code with parts of it left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.merge_fleets import SyntheticFleet
from hybridmap.node import NodeId
from hybridmap.pose import Array, Pose2
from mapweave.scoring import align
from merge.joining import Outliers
from merge.links import Link
from merge.merged import MergedMap
from merge.merging import MergeSettings, merge_maps

MAPWEAVE = "mapweave"
"""The settings that are the default."""


def settings_of(cliques: bool, outliers: Outliers) -> MergeSettings:
    """The default with these parts."""
    default = MergeSettings()
    consistency = replace(default.consistency, cliques=cliques)
    return replace(default, consistency=consistency, outliers=outliers)


RIVALS: dict[str, MergeSettings] = {
    "least_squares": settings_of(False, Outliers.NONE),
    "gnc": settings_of(False, Outliers.GRADUATED),
    "pcm": settings_of(True, Outliers.NONE),
    "pcm_huber": settings_of(True, Outliers.WORST_FIRST),
    "pcm_gnc": settings_of(True, Outliers.GRADUATED),
    MAPWEAVE: MergeSettings(),
}
"""By name. `pcm_huber` limits the pull of links and refuses the worst, one after the other."""


def oracle(fleet: SyntheticFleet) -> MergedMap:
    """What who knows the true links makes of them, by plain least squares."""
    links = [link for link in fleet.links if link.pair in fleet.true]
    return merge_maps(fleet.maps, links, settings=RIVALS["least_squares"])


def error(merged: MergedMap, truth: dict[NodeId, Pose2]) -> float:
    """Root mean square position error after one rigid alignment of the whole fleet, m.

    The alignment is that of the largest component. A map that is not joined with it stays where its own frame
    puts it: not to merge is no way to be right.
    """
    nodes = sorted(truth)
    estimated = positions(merged, nodes)
    true = np.array([[truth[node].x, truth[node].y] for node in nodes])
    largest = np.array([node in merged.components[0] for node in nodes])
    world_from_merged = align(estimated[largest], true[largest])
    off = world_from_merged.apply(estimated) - true
    return float(np.sqrt((off**2).sum(axis=1).mean()))


def positions(merged: MergedMap, nodes: list[NodeId]) -> Array:
    """(N, 2) m, each in its component's frame."""
    means = [merged.postures[node].merged_from_robot.mean for node in nodes]
    return np.array([[mean.x, mean.y] for mean in means])


def precision_recall(links: tuple[Link, ...], fleet: SyntheticFleet) -> tuple[float, float]:
    """The share of the kept links that are true (1 if there is none), and of the true ones that are kept."""
    kept = {link.pair for link in links}
    good = len(kept & fleet.true)
    return good / len(kept) if kept else 1.0, good / len(fleet.true) if fleet.true else 1.0
