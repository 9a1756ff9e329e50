"""Maps whose lengths are all too long, or too short, by one factor: found by their links, and undone.

All lengths that a robot measures are multiples of what its wheels count, so wheels of another size than it
supposes make its map right but for one factor. A monocular map has the same freedom (Strasdat et al., *Scale
drift-aware large scale monocular SLAM*, 2010); here one factor a map is enough, as a map has one set of
wheels.

*Of two maps.* Two links between them close a loop. Its misclosure is linear in the logarithm of the factor:
ways through the second map shrink, and a link's own pose changes as well, since registration compromises
between the depths of both sides (`mapweave.registration.recognition.by_scales`). The factor under which most
loops close is refined by least squares with the covariances of both maps. It is no factor of lengths if the
ways and the depths of the map say different ones.

*Of all.* The factors between maps give one for each but for a common one, which nothing shows: a prior holds
them near 1. It is convex and its tails are heavy, so that of two maps both give way, and of four the one that
is off. Factors that are clear are undone, in steps, in edges, nodes, depths and links, before any link is
decided. So all that follows, covariances included, is as if the robot had measured with the right wheels. How
uncertain the factor is, is part of no covariance: neither is what all wheels of a fleet have in common.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.change import EdgePut, NodePut
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.node import Edge, Node
from mapweave.hybridmap.pose import Array, Pose2, PoseGaussian
from mapweave.merge.pose_graph.factors import LOOP_FLOOR, believable
from mapweave.merge.pose_graph.fragments import Fragment
from mapweave.merge.pose_graph.links import Link, thinned
from mapweave.merge.pose_graph.verdicts import MapPair
from mapweave.registration.pose_arrays import PoseGaussians, adjoints, compose_poses, inverse_poses
from mapweave.registration.recognition import by_scales

Logs = tuple[float, float]
"""Logarithms of factors of the two ends of a link."""
Used = tuple[Fragment | Link, ...]
"""What a ratio was found from."""

MOST_LINKS = 60
"""Links between two maps that are used, evenly chosen: pairs of links grow by the square."""
LEAST_LINKS = 12
"""Fewer say nothing about the factor."""
LEAST_SHARE = 0.6
"""Share of them that agree under one factor; with less, false links could find one that suits them."""
MOST_LOG, GRID = 0.1, 0.0025
"""Logarithms of factors that are tried at first."""
FACTORS = "lengths_a", "lengths_b"
"""Names among the evidence of a link: factors that were undone in the maps of its a and its b; absent if none
was in either."""
GATE = 11.34
"""Chi-square 99 % point for 3 degrees of freedom, from which on a loop is open."""
MOST_SIGMA = 0.01
"""Standard deviation of a factor that is used: links of one place hardly show it."""
APART = 4.0
"""Standard deviations by which ways and depths of one map may differ in their factors."""
WHEELS, TAILS = 0.01, 0.005
"""Prior of a factor: standard deviation, as of wheels that were measured; and where its tails begin."""
LEAST_LOG, STEP, CLEAR = 0.01, 0.005, 4.0
"""Factors that are undone: at least so far from 1 and by so many standard deviations; and in such steps, so
that nothing is decided again for each new link."""
ENOUGH_MORE = 1.2
"""Growth of the links between two maps of a large island from which on they are compared again."""
ROUNDS = 50


@dataclass(frozen=True)
class LengthRatio:
    """How much longer the lengths of one map are than those of another one.

    Attributes:
        log: natural logarithm of the lengths of the second over those of the first.
        sigma: its standard deviation.
        apart: by how many standard deviations the ways of the second map and its depths differ in it.
    """

    log: float
    sigma: float
    apart: float

    @property
    def usable(self) -> bool:
        """Whether it is a ratio of all lengths, and known."""
        return self.apart < APART and self.sigma < MOST_SIGMA


@dataclass(frozen=True)
class MapScale:
    """By how much the lengths of a map are too long.

    Attributes:
        log: natural logarithm of the factor, against the fleet.
        sigma: standard deviation of what the links say of it.
        others: maps that it was compared with.
    """

    log: float
    sigma: float
    others: tuple[MapId, ...]

    @property
    def undone(self) -> float:
        """What is undone of it: the logarithm in whole steps, or 0."""
        if abs(self.log) < max(LEAST_LOG, CLEAR * self.sigma):
            return 0.0
        return STEP * round(self.log / STEP)


class MapScales:
    """Finds the factors; what was found out of pieces and links that did not change is kept."""

    def __init__(self) -> None:
        self._derivatives: WeakKeyDictionary[Link, tuple[Node, Node, Array | None]] = WeakKeyDictionary()
        self._corrected: WeakKeyDictionary[Link, tuple[Logs, Link]] = WeakKeyDictionary()
        self._ratios: dict[MapPair, tuple[Used, int, LengthRatio | None]] = {}
        self._maps: dict[MapId, tuple[HybridMap, float, HybridMap]] = {}

    def of(
        self,
        maps: Mapping[MapId, HybridMap],
        fragments: Iterable[Fragment],
        links: Iterable[Link],
        exact: bool = True,
    ) -> dict[MapId, MapScale]:
        """The factors of maps that can be compared with others.

        Args:
            maps: by id; never changed, only replaced.
            fragments: their pieces.
            links: between them, true and false ones; none by hand.
            exact: else a ratio is kept until the links between its maps are a fifth more, or fewer.
        """
        largest: dict[MapId, Fragment] = {}
        for fragment in fragments:
            if len(fragment) > len(largest.get(fragment.name.map, ())):
                largest[fragment.name.map] = fragment
        between: dict[MapPair, list[Link]] = {}
        for link in links:
            link = link.canonical()
            if not link.within and all(
                end.map in largest and end in largest[end.map].graph.rows for end in link.pair
            ):
                between.setdefault(link.maps, []).append(link)
        known, self._ratios = self._ratios, {}
        for pair, some in sorted(between.items()):
            if len(some) < LEAST_LINKS:
                continue
            entry = known.get(pair)
            if exact or entry is None or not entry[1] <= len(some) < ENOUGH_MORE * entry[1]:
                first, second = largest[pair[0]], largest[pair[1]]
                used = thinned(some, MOST_LINKS)
                key: Used = (first, second, *used)
                if entry is None or not _same(entry[0], key):
                    by_scale = [self._by_scales(link, maps) for link in used]
                    entry = key, len(some), length_ratio(used, by_scale, first, second)
            self._ratios[pair] = entry
        ratios = {pair: entry[2] for pair, entry in self._ratios.items() if entry[2] is not None}
        return combined({pair: ratio for pair, ratio in ratios.items() if ratio.usable})

    def corrected_maps(
        self, maps: Mapping[MapId, HybridMap], logs: Mapping[MapId, float]
    ) -> dict[MapId, HybridMap]:
        """Maps without factors of their lengths; the same objects as long as nothing changes.

        Args:
            maps: by id.
            logs: of each that is to be corrected, the logarithm of its factor.
        """
        out: dict[MapId, tuple[HybridMap, float, HybridMap]] = {}
        for which, log in logs.items():
            known = self._maps.get(which)
            if known is None or known[0] is not maps[which] or known[1] != log:
                known = maps[which], log, scaled_map(maps[which], math.exp(-log))
            out[which] = known
        self._maps = out
        return {which: known[2] for which, known in out.items()}

    def corrected_link(self, link: Link, maps: Mapping[MapId, HybridMap], logs: Logs) -> Link:
        """A link as it is between maps without factors; likewise.

        Args:
            link: with geometry that was registered, between nodes that are there.
            maps: as they were measured.
            logs: logarithms of the factors of the maps of its a, and of its b.
        """
        known = self._corrected.get(link)
        if known is None or known[0] != logs:
            mean, by = link.a_from_b.mean, None if link.within else self._by_scales(link, maps)
            if by is None:
                mean = _scaled(mean, math.exp(-0.5 * sum(logs)))
            else:
                mean = mean @ Pose2.from_vector(-(by @ np.array(logs)))
            factors = dict(zip(FACTORS, map(math.exp, logs), strict=True))
            pose = PoseGaussian(mean, link.a_from_b.covariance)
            corrected = replace(link, a_from_b=pose, evidence={**link.evidence, **factors})
            known = self._corrected[link] = logs, corrected
        return known[1]

    def _by_scales(self, link: Link, maps: Mapping[MapId, HybridMap]) -> Array | None:
        """(3, 2) see `mapweave.registration.recognition.by_scales`."""
        a, b = (maps[end.map].nodes[end] for end in link.pair)
        known = self._derivatives.get(link)
        if known is None or known[0] is not a or known[1] is not b:
            known = self._derivatives[link] = a, b, by_scales(a, b, link.shared, link.a_from_b.mean)
        return known[2]


def _same(first: Used, second: Used) -> bool:
    return len(first) == len(second) and all(a is b for a, b in zip(first, second, strict=True))


def undone_in(links: Iterable[Link]) -> dict[MapId, float]:
    """Logarithms of the factors that a merge has undone, as the evidence of its links says."""
    logs: dict[MapId, float] = {}
    for link in links:
        for end, name in zip(link.pair, FACTORS, strict=True):
            if name in link.evidence:
                # To the last bit what was undone, whatever a file has rounded.
                logs[end.map] = STEP * round(math.log(link.evidence[name]) / STEP)
    return {which: log for which, log in sorted(logs.items()) if log}


def corrected_again(
    maps: Mapping[MapId, HybridMap], links: Sequence[Link], about: Iterable[Link] = ()
) -> tuple[dict[MapId, HybridMap], list[Link]]:
    """Maps and links without the factors that a merge has undone, as the evidence of links says.

    Args:
        maps: as they were measured.
        links: of the merge, as they were measured.
        about: further links that say what was undone, as refused ones.
    """
    logs = {which: log for which, log in undone_in((*links, *about)).items() if which in maps}
    scales = MapScales()
    corrected = [
        scales.corrected_link(link, maps, (logs.get(link.a.map, 0.0), logs.get(link.b.map, 0.0)))
        if FACTORS[0] in link.evidence
        else link
        for link in links
    ]
    return {**maps, **scales.corrected_maps(maps, logs)}, corrected


def combined(ratios: Mapping[MapPair, LengthRatio]) -> dict[MapId, MapScale]:
    """The factor of each map, from ratios of two; by least squares and the prior."""
    which = sorted({map_id for pair in ratios for map_id in pair})
    row = {map_id: k for k, map_id in enumerate(which)}
    differences = np.zeros((len(ratios), len(which)))
    for k, (first, second) in enumerate(ratios):
        differences[k, row[first]], differences[k, row[second]] = -1.0, 1.0
    measured = np.array([ratio.log for ratio in ratios.values()])
    weights = np.array([ratio.sigma**-2 for ratio in ratios.values()])
    information = differences.T @ (weights[:, None] * differences)
    right = differences.T @ (weights * measured)
    logs = np.zeros(len(which))
    for _ in range(ROUNDS):
        prior = WHEELS**-2 / np.sqrt(1.0 + (logs / TAILS) ** 2)
        logs = np.linalg.solve(information + np.diag(prior), right)
    out = {}
    for map_id, k in row.items():
        others = tuple(sorted({one for pair in ratios if map_id in pair for one in pair} - {map_id}))
        # Against the maps that it was compared with: what all have in common is the prior's alone.
        sigma = float(weights[differences[:, k] != 0.0].sum() ** -0.5)
        out[map_id] = MapScale(float(logs[k]), sigma, others)
    return out


def length_ratio(
    links: Sequence[Link], by_scale: Sequence[Array | None], first: Fragment, second: Fragment
) -> LengthRatio | None:
    """How much longer the lengths of one piece of map are than those of another; None if links do not agree.

    Args:
        links: from `first` to `second`.
        by_scale: of each (3, 2), see `mapweave.registration.recognition.by_scales`.
        first: piece of map.
        second: piece of map.
    """
    known = [k for k, by in enumerate(by_scale) if by is not None]
    if len(known) < LEAST_LINKS:
        return None
    links = [links[k] for k in known]
    by_second = np.stack([by[:, 1] for by in by_scale if by is not None])
    log, agree = _most_agree(links, by_second, first, second)
    others = len(links) - 1
    kept = np.flatnonzero(agree.sum(axis=1) > 0.5 * others)
    if len(kept) < max(LEAST_LINKS, LEAST_SHARE * len(links)):
        return None
    return _refined([links[k] for k in kept.tolist()], by_second[kept], first, second, log)


def _most_agree(
    links: Sequence[Link], by_second: Array, first: Fragment, second: Fragment
) -> tuple[float, NDArray[np.bool_]]:
    """The logarithm under which the loops through two links close best, and (N, N) which do."""
    i, j = np.triu_indices(len(links), 1)
    a, b = first.graph.index([link.a for link in links]), second.graph.index([link.b for link in links])
    across = PoseGaussians(
        np.stack([link.a_from_b.mean.vector for link in links]),
        np.stack([link.a_from_b.covariance for link in links]),
    )
    through_first = first.graph.relative_rows(a[j], a[i])
    through_second = second.graph.relative_rows(b[i], b[j])

    def misclosures(log: float) -> PoseGaussians:
        moved = PoseGaussians(compose_poses(across.means, -log * by_second), across.covariances)
        shrunk = PoseGaussians(_shrunk(through_second.means, log), through_second.covariances)
        loop = moved.take(i) @ shrunk @ moved.take(j).inverse() @ through_first
        return PoseGaussians(_turns_wrapped(inverse_poses(loop.means)), loop.covariances + LOOP_FLOOR)

    now, more, less = (misclosures(log) for log in (0.0, GRID, -GRID))
    root = np.linalg.cholesky(now.covariances)
    white, slope = (
        np.linalg.solve(root, column[:, :, None])[:, :, 0]
        for column in (now.means, (more.means - less.means) / (2.0 * GRID))
    )
    steps = round(MOST_LOG / GRID)
    grid = GRID * np.arange(-steps, steps + 1)[:, None]
    distances2 = (
        (white**2).sum(axis=1) + 2.0 * grid * (white * slope).sum(axis=1) + grid**2 * (slope**2).sum(axis=1)
    )
    best = int(np.minimum(distances2, GATE).sum(axis=1).argmin())
    agree = np.zeros((len(links), len(links)), np.bool_)
    agree[i, j] = agree[j, i] = distances2[best] < GATE
    return float(grid[best, 0]), agree


def _refined(
    links: Sequence[Link], by_second: Array, first: Fragment, second: Fragment, log: float
) -> LengthRatio:
    """The logarithm by least squares over links that agree, with where the pieces lie to each other."""
    n = len(links)
    starts, ends = sorted({link.a for link in links}), sorted({link.b for link in links})
    at_a, at_b = {node: k for k, node in enumerate(starts)}, {node: k for k, node in enumerate(ends)}
    ia, ib = np.array([at_a[link.a] for link in links]), np.array([at_b[link.b] for link in links])
    places_a = first.graph.means[first.graph.index(starts)][ia]
    places_b = second.graph.means[second.graph.index(ends)][ib]
    measured = np.stack([link.a_from_b.mean.vector for link in links])
    of_links = believable(np.stack([link.a_from_b.covariance for link in links]))
    joint_a, joint_b = first.graph.covariance(starts), second.graph.covariance(ends)
    middle = compose_poses(
        compose_poses(places_a, compose_poses(measured, -log * by_second)),
        inverse_poses(_shrunk(places_b, log)),
    )
    turn = math.atan2(float(np.sin(middle[:, 2]).mean()), float(np.cos(middle[:, 2]).mean()))
    first_from_second = np.array([[*np.median(middle[:, :2], axis=0), turn]])
    for _ in range(ROUNDS):
        shrunk = _shrunk(places_b, log)
        predicted = compose_poses(inverse_poses(places_a), compose_poses(first_from_second, shrunk))
        corrected = compose_poses(measured, -log * by_second)
        off = _turns_wrapped(compose_poses(inverse_poses(corrected), predicted))
        by_a = -adjoints(inverse_poses(predicted))
        cos, sin = np.cos(shrunk[:, 2]), np.sin(shrunk[:, 2])
        by_way = -np.stack(
            [cos * shrunk[:, 0] + sin * shrunk[:, 1], cos * shrunk[:, 1] - sin * shrunk[:, 0], np.zeros(n)], 1
        )
        by = np.concatenate([adjoints(inverse_poses(shrunk)), by_way[:, :, None], by_second[:, :, None]], 2)
        spread = np.einsum("nij,njmk,mlk->niml", by_a, joint_a[ia][:, :, ia], by_a)
        spread += joint_b[ib][:, :, ib]
        spread[np.arange(n), :, np.arange(n)] += of_links
        root = np.linalg.cholesky(spread.reshape(3 * n, 3 * n))
        white = np.linalg.solve(root, by.reshape(3 * n, 5))
        residual = np.linalg.solve(root, off.ravel())
        together = np.column_stack([white[:, :3], white[:, 3] + white[:, 4]])
        inverse = np.linalg.inv(together.T @ together)
        change = -inverse @ (together.T @ residual)
        first_from_second = compose_poses(first_from_second, change[None, :3])
        log += float(change[3])
        if np.abs(change).max() < 1e-7:
            break
    residual = residual + together @ change
    excess = max(1.0, float(residual @ residual) / (3 * n - 4))
    each = np.linalg.inv(white.T @ white)
    difference = np.array([0.0, 0.0, 0.0, -1.0, 1.0])
    apart = float(difference @ each @ (white.T @ residual)) / math.sqrt(
        difference @ each @ difference * excess
    )
    return LengthRatio(log, math.sqrt(inverse[3, 3] * excess), abs(apart))


def scaled_map(hybrid_map: HybridMap, factor: float) -> HybridMap:
    """A map with all lengths multiplied by a factor: poses, depths and edges."""
    out = HybridMap()
    for node in hybrid_map.nodes.values():
        out.apply(NodePut(_scaled_node(node, factor)))
    for edge in hybrid_map.edges.values():
        out.apply(EdgePut(_scaled_edge(edge, factor)))
    return out


def _scaled_node(node: Node, factor: float) -> Node:
    marks = node.landmarks
    depths, sigmas = ((factor * one).astype(np.float32) for one in (marks.depths, marks.depth_sigmas))
    place = node.map_from_robot
    return replace(
        node,
        map_from_robot=PoseGaussian(_scaled(place.mean, factor), place.covariance),
        landmarks=replace(marks, depths=depths, depth_sigmas=sigmas),
    )


def _scaled_edge(edge: Edge, factor: float) -> Edge:
    way = edge.a_from_b
    return replace(edge, a_from_b=PoseGaussian(_scaled(way.mean, factor), way.covariance))


def _scaled(pose: Pose2, factor: float) -> Pose2:
    return Pose2(factor * pose.x, factor * pose.y, pose.heading)


def _shrunk(poses: Array, log: float) -> Array:
    """(N, 3) poses with lengths that were too long."""
    shrunk: Array = poses * np.array([math.exp(-log), math.exp(-log), 1.0])
    return shrunk


def _turns_wrapped(poses: Array) -> Array:
    """(N, 3) poses, their headings in -pi..pi."""
    poses[:, 2] = (poses[:, 2] + np.pi) % (2.0 * np.pi) - np.pi
    return poses
