"""Explanations of two nodes: why they are linked, or are not, with every number behind it."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.constraint_subject import Linked
from mapweave.hybridmap.counted import counted
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.explanation import LinkAgreement, Misfit, PairExplanation, Standing
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.manual_constraint import reason_of, retired_words
from mapweave.hybridmap.node import Edge, Node
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.merge.explanation.own_edges import claims, consequences, edge_in_words, own_edge
from mapweave.merge.manual_constraints import apply_constraints
from mapweave.merge.outlier_rejection.link_probability import prior_odds, probability, standpoints
from mapweave.merge.outlier_rejection.loop_closures import CLAIMS
from mapweave.merge.outlier_rejection.pairwise_consistency import group_links, loop_distances2
from mapweave.merge.outlier_rejection.segmentation import fragments_of
from mapweave.merge.pose_graph.fragments import fragment_by_node
from mapweave.merge.pose_graph.links import Link, RefusedLink, link_of
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.pose_graph.verification import examine, verify
from mapweave.merge.settings import ConsistencySettings
from mapweave.registration.matching import match
from mapweave.registration.recognition import RecognitionSettings


def explain_nodes(
    merged: MergedMap,
    a: NodeId,
    b: NodeId,
    verification: RecognitionSettings | None = None,
    consistency: ConsistencySettings | None = None,
) -> PairExplanation:
    """Explain two nodes.

    Raises:
        InvalidValue: the same node twice, or one that is not there.
    """
    if a == b:
        raise InvalidValue(f"{a} twice: give two nodes")
    first, second = (node_of(merged, node) for node in sorted((a, b)))
    link, own = _link(merged, first.id, second.id), own_edge(merged, first.id, second.id)
    refusal = _refusal(merged, first.id, second.id, own is not None)
    geometry = link or (refusal.link if refusal else None)
    if geometry is not None:
        own = None
    elif own is not None:
        geometry = link_of(own)
    explanation = replace(
        _evidence(first, second, geometry, verification),
        claims=(*claims(merged, first.id, second.id, own), *consequences(merged, link, first.id, second.id)),
        constraints=merged.constraints.about(first.id, second.id),
    )
    retired = merged.constraints.retires(first.id) or merged.constraints.retires(second.id)
    if retired is not None:
        return replace(explanation, standing=Standing.UNDONE, reason=retired_words(retired))
    other_links: tuple[LinkAgreement, ...] = ()
    verified = geometry is not None and (own is None or own.kind in CLAIMS)
    if geometry is None and explanation.a_from_b is not None:
        geometry = Link(first.id, second.id, explanation.a_from_b, explanation.shared, explanation.evidence)
    if geometry is not None and (own is None or own.kind in CLAIMS):
        other_links = _other_links(merged, geometry, consistency)
    standing, reason = _verdict(merged, (first, second), link, own, refusal, other_links, verification)
    explanation = replace(explanation, standing=standing, reason=reason, other_links=other_links)
    if geometry is None:
        return explanation
    misfit, link_probability_ = _judged(merged, geometry, kept=link is not None or own is not None)
    return replace(explanation, misfit=misfit, probability=link_probability_ if verified else None)


def _verdict(
    merged: MergedMap,
    ends: tuple[Node, Node],
    link: Link | None,
    own: Edge | None,
    refusal: RefusedLink | None,
    other_links: tuple[LinkAgreement, ...],
    verification: RecognitionSettings | None,
) -> tuple[Standing, str]:
    """What has become of two nodes, and why, in words."""
    first, second = ends
    if link is not None:
        by_hand = merged.constraints.links.get(link.pair)
        if by_hand is not None:
            return Standing.LINKED, _by_hand_in_words(merged, by_hand)
        count = sum(w.agrees and w.kept for w in other_links)
        return Standing.LINKED, f"{_landmarks(link)}, {_other_links_in_words(count)}"
    constraint = merged.constraints.against(first.id, second.id)
    if constraint is not None and refusal is not None and refusal.link is not None:
        return Standing.UNDONE, reason_of(constraint)
    if own is not None:
        more = f"; the merge has compared them too: {refusal.reason}" if refusal else ""
        return Standing.OWN, f"{edge_in_words(own)}{more}"
    if refusal is not None:
        return Standing.REFUSED, refusal.reason
    fresh = verify(first, second, verification)
    words = fresh.reason if isinstance(fresh, RefusedLink) else _landmarks(fresh)
    return Standing.UNCOMPARED, f"they share too little, or others share more; compared now: {words}"


def node_of(merged: MergedMap, node: NodeId) -> Node:
    """A node of a merged map.

    Raises:
        InvalidValue: unknown; the message lists what there is.
    """
    merged.check(node)
    return merged.maps[node.map].nodes[node]


def residuals_px(a: Node, b: Node, a_from_b: Pose2, shared: NDArray[np.int64]) -> Array:
    """(K,) px, how far shared landmarks are from where a pose predicts them.

    A landmark of a that has a depth is projected into b's image, one that only b knows the depth of into a's.

    Args:
        a: one node.
        b: another one.
        a_from_b: pose of b in a.
        shared: (K, 2) indices of landmarks in a and in b.
    """
    in_a, in_b = a.landmarks.take(shared[:, 0]), b.landmarks.take(shared[:, 1])
    to_b = b.camera.project(a_from_b.inverse().apply(in_a.points_in_robot(a.camera)))
    to_a = a.camera.project(a_from_b.apply(in_b.points_in_robot(b.camera)))
    off = np.where(in_a.has_depth[:, None], to_b - in_b.pixels, to_a - in_a.pixels)
    out: Array = np.linalg.norm(off.reshape(-1, 2), axis=1)
    return out


def _evidence(
    a: Node, b: Node, link: Link | None, verification: RecognitionSettings | None
) -> PairExplanation:
    """The evidence of the landmarks. A link has its pose; else the nodes are compared again.

    So a refusal for too few inliers is explained with these inliers.
    """
    s = verification or RecognitionSettings()
    matches = match(a.landmarks.codes, b.landmarks.codes, s.matching)
    nothing = np.zeros((0, 2), np.int64)
    out = PairExplanation(a, b, Standing.UNCOMPARED, "", matches, nothing, np.zeros(0))
    if link is not None:
        pose, shared, evidence = link.a_from_b, link.shared, link.evidence
    else:
        verdict = examine(a, b, s)
        if verdict.node_from_robot is None:
            return out
        pose, shared, evidence = verdict.node_from_robot, verdict.pairs, verdict.evidence
    off = residuals_px(a, b, pose.mean, shared)
    return replace(out, a_from_b=pose, shared=shared, evidence=dict(evidence), residuals_px=off)


def _link(merged: MergedMap, a: NodeId, b: NodeId) -> Link | None:
    return next((link for link in merged.links if link.pair == (a, b)), None)


def _refusal(merged: MergedMap, a: NodeId, b: NodeId, joined: bool) -> RefusedLink | None:
    """What became of a comparison of the two; else of what the robot claimed."""
    refusals = [r for r in merged.refused if r.pair == (a, b) and (r.edge is None or not joined)]
    return max(refusals, key=lambda r: (r.edge is None, r.link is not None, r.edge or a), default=None)


def _landmarks(link: Link) -> str:
    if not link.aliased:
        return f"{link.weight} landmarks agree on one pose"
    inliers = link.weight + link.aliased
    return f"{inliers} landmarks agree on one pose, {link.aliased} of them found at other places too"


def _by_hand_in_words(merged: MergedMap, linked: Linked) -> str:
    constraint = merged.constraints.standing(linked)
    assert constraint is not None, "it is in force"
    inliers = int(dict(linked.evidence).get("inliers", 0))
    support = f"{inliers} landmarks of the images agree on the pose" if inliers else "the pose is a person's"
    against = merged.contradicted.get((linked.a, linked.b))
    return f"{reason_of(constraint)}; {support}{f'; {against}' if against else ''}"


def _other_links_in_words(count: int) -> str:
    return (
        f"and {counted(count, 'more link')} between the same pieces of map agree{'s' if count == 1 else ''}"
    )


def _judged(merged: MergedMap, link: Link, kept: bool) -> tuple[Misfit | None, float | None]:
    component = merged.component_of(link.a)
    if component is None or component != merged.component_of(link.b):
        # The share of accepted links says nothing of these: aliased maps have many links.
        return None, None
    (standpoint,) = standpoints([link], merged.graphs[component], kept=kept)
    misfit = Misfit(standpoint.merged_a_from_b, standpoint.off, standpoint.strain2, standpoint.alone)
    return misfit, probability(standpoint.log_factor, prior_odds(merged))


def _other_links(
    merged: MergedMap, link: Link, consistency: ConsistencySettings | None
) -> tuple[LinkAgreement, ...]:
    """All other links that were found between the two pieces of map, as the merge compares them."""
    s = consistency or ConsistencySettings()
    maps = {map_id: merged.maps[map_id] for map_id in {link.a.map, link.b.map}}
    pieces = fragment_by_node(fragments_of(_without_undone(merged, maps), s))
    ends = {pieces[link.a].name, pieces[link.b].name}
    kept = {candidate.pair for candidate in merged.links}
    links = [*merged.links, *(r.link for r in merged.refused if r.link is not None and r.edge is None)]
    near_links = [
        candidate
        for candidate in links
        if candidate.pair != link.pair
        and candidate.a in pieces
        and candidate.b in pieces
        and {pieces[candidate.a].name, pieces[candidate.b].name} == ends
    ]
    ((names, group),) = group_links([link, *near_links], pieces).items()
    distances2 = loop_distances2(group, pieces[names[0]], pieces[names[1]])
    own = next(k for k, candidate in enumerate(group) if candidate.key == link.key)
    return tuple(
        LinkAgreement(
            *candidate.pair,
            float(distances2[own, k]),
            bool(distances2[own, k] < s.gate),
            candidate.key in kept,
        )
        for k, candidate in enumerate(group)
        if k != own
    )


def _without_undone(merged: MergedMap, maps: dict[MapId, HybridMap]) -> dict[MapId, HybridMap]:
    return dict(apply_constraints(maps, (), merged.constraints).maps)
