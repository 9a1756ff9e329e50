"""Undoing: links that a person has ruled out take no part in the merge, and say who, when and why."""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping
from dataclasses import dataclass, replace

from mapweave.hybridmap.change import EdgePut
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.manual_constraint import ManualConstraint, ManualConstraints, reason_of
from mapweave.hybridmap.node import MapId
from mapweave.merge.outlier_rejection.loop_closures import CLAIMS
from mapweave.merge.pose_graph.links import Link, RefusedLink, refuse, refuse_edge
from mapweave.merge.pose_graph.merged_map import MergedMap


@dataclass(frozen=True, eq=False)
class AppliedConstraints:
    """What is left to merge.

    Attributes:
        maps: without the claims that are ruled out; maps with none of these are the very same objects.
        links: without those that are ruled out.
        refused: what was taken away, with reasons.
        whole: the maps as they came.
        rulings: of people, in force or not.
    """

    maps: Mapping[MapId, HybridMap]
    links: tuple[Link, ...]
    refused: tuple[RefusedLink, ...]
    whole: Mapping[MapId, HybridMap]
    rulings: ManualConstraints

    def completed(self, merged: MergedMap) -> MergedMap:
        """The merge of what was left, holding the maps as they came, so that a ruling can be taken back.

        Args:
            merged: the merge of `maps`, `links` and `refused`.
        """
        return replace(merged, maps=dict(sorted(self.whole.items())), rulings=self.rulings)


def apply_constraints(
    maps: Mapping[MapId, HybridMap], links: Iterable[Link], rulings: ManualConstraints
) -> AppliedConstraints:
    """Take away what is ruled out: retired maps, links, and what a robot itself claims to have recognised.

    How a robot drove and turned while it mapped is measured and stands.

    Args:
        maps: by id; they are not changed.
        links: verified.
        rulings: of people.
    """
    if not rulings.in_force:
        return AppliedConstraints(maps, tuple(links), (), maps, rulings)
    kept: list[Link] = []
    refused: list[RefusedLink] = []
    for link in links:
        ruling = rulings.against(*link.pair)
        if ruling is None:
            kept.append(link)
        else:
            refused.append(refuse(link, reason_of(ruling)))
    retired = rulings.retired
    left = {map_id: one for map_id, one in maps.items() if map_id not in retired}
    kept = [link for link in kept if link.a.map not in retired and link.b.map not in retired]
    for map_id, one in tuple(left.items()):
        out = [
            (edge, ruling)
            for edge in one.edges.values()
            if edge.kind in CLAIMS and (ruling := rulings.against(edge.a, edge.b)) is not None
        ]
        if out:
            gone = {edge.id for edge, _ in out}
            refused += [refuse_edge(edge, reason_of(ruling)) for edge, ruling in out]
            left[map_id] = HybridMap(
                body for body in one.contents() if not (isinstance(body, EdgePut) and body.edge.id in gone)
            )
    return AppliedConstraints(left, tuple(kept), tuple(refused), maps, rulings)


def check_manual_constraint(
    merged: MergedMap, rulings: ManualConstraints, ruling: ManualConstraint, known_maps: Container[MapId] = ()
) -> None:
    """Refuse a ruling that would change nothing: it is meant otherwise.

    Args:
        merged: what it is made about.
        rulings: that were made before, merged already or not.
        ruling: the new one.
        known_maps: that are there, in the merged map or not: any of them can be retired.

    Raises:
        InvalidValue: there is nothing to undo, or nothing to take back.
    """
    first, second = ruling.ends
    known = next((r for r in rulings.in_force if r.ends == ruling.ends), None)
    if ruling.retires is not None:
        if ruling.retires not in known_maps:
            merged.check(ruling.retires)
        _check_retirement(known, ruling, ruling.retires)
        return
    if not ruling.apart:
        if known is None:
            raise InvalidValue(f"nothing that people have ruled keeps {first} and {second} apart")
        return
    if known is not None:
        raise InvalidValue(f"{first} and {second} are apart already: {reason_of(known)}")
    for end in (first, second):
        merged.check(end)
    pairs = [link.pair for link in merged.links]
    false = {refusal.edge for refusal in merged.refused}
    pairs += [
        (edge.a, edge.b)
        for one in merged.maps.values()
        for edge in one.edges.values()
        if edge.kind in CLAIMS and edge.id not in false
    ]
    for a, b in pairs:
        if {a, b} == {first, second} or {a.map, b.map} == {first, second}:
            return
    for edge in merged.maps[MapId(*first[:2])].edges.values():
        if {edge.a, edge.b} == {first, second} and edge.kind not in CLAIMS:
            way = f"their robot's way (edge {edge.id}, {edge.kind})"
            raise InvalidValue(
                f"{first} and {second} are joined by {way}, and what was measured on it stands; a map "
                "that is wrong as a whole can be retired"
            )
    raise InvalidValue(f"no link joins {first} and {second}: there is nothing to undo")


def _check_retirement(known: ManualConstraint | None, ruling: ManualConstraint, which: MapId) -> None:
    if ruling.apart and known is not None:
        raise InvalidValue(f"map {which} is retired already: {reason_of(known)}")
    if not ruling.apart and known is None:
        raise InvalidValue(f"map {which} is not retired")
