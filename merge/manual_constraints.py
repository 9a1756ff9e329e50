"""Apply manual constraints: excluded links take no part in the merge; refusals say who, when and why."""

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
        maps: without the edges that are excluded; maps with none of these are the very same objects.
        links: without those that are excluded.
        refused: what was taken away, with reasons.
        whole: the maps as they came.
        constraints: manual constraints, in force or not.
    """

    maps: Mapping[MapId, HybridMap]
    links: tuple[Link, ...]
    refused: tuple[RefusedLink, ...]
    whole: Mapping[MapId, HybridMap]
    constraints: ManualConstraints

    def completed(self, merged: MergedMap) -> MergedMap:
        """The merge of the rest, with the original maps, so that a constraint can be withdrawn.

        Args:
            merged: the merge of `maps`, `links` and `refused`.
        """
        return replace(merged, maps=dict(sorted(self.whole.items())), constraints=self.constraints)


def apply_constraints(
    maps: Mapping[MapId, HybridMap], links: Iterable[Link], constraints: ManualConstraints
) -> AppliedConstraints:
    """Remove what is excluded: retired maps, links, and a robot's own loop closures.

    Drives and turns that a robot measured while it mapped are kept.

    Args:
        maps: by id; they are not changed.
        links: verified.
        constraints: manual constraints.
    """
    if not constraints.in_force:
        return AppliedConstraints(maps, tuple(links), (), maps, constraints)
    kept: list[Link] = []
    refused: list[RefusedLink] = []
    for link in links:
        constraint = constraints.against(*link.pair)
        if constraint is None:
            kept.append(link)
        else:
            refused.append(refuse(link, reason_of(constraint)))
    retired = constraints.retired
    left = {map_id: hybrid_map for map_id, hybrid_map in maps.items() if map_id not in retired}
    kept = [link for link in kept if link.a.map not in retired and link.b.map not in retired]
    for map_id, hybrid_map in tuple(left.items()):
        out = [
            (edge, constraint)
            for edge in hybrid_map.edges.values()
            if edge.kind in CLAIMS and (constraint := constraints.against(edge.a, edge.b)) is not None
        ]
        if out:
            removed = {edge.id for edge, _ in out}
            refused += [refuse_edge(edge, reason_of(constraint)) for edge, constraint in out]
            left[map_id] = HybridMap(
                change
                for change in hybrid_map.contents()
                if not (isinstance(change, EdgePut) and change.edge.id in removed)
            )
    return AppliedConstraints(left, tuple(kept), tuple(refused), maps, constraints)


def check_manual_constraint(
    merged: MergedMap,
    constraints: ManualConstraints,
    constraint: ManualConstraint,
    existing_maps: Container[MapId] = (),
) -> None:
    """Refuse a constraint that would change nothing: it is a mistake.

    Args:
        merged: what it is made about.
        constraints: earlier constraints, merged already or not.
        constraint: the new one.
        existing_maps: that are there, in the merged map or not: any of them can be retired.

    Raises:
        InvalidValue: there is nothing to undo, or nothing to take back.
    """
    first, second = constraint.ends
    in_force = next((r for r in constraints.in_force if r.ends == constraint.ends), None)
    if constraint.retires is not None:
        if constraint.retires not in existing_maps:
            merged.check(constraint.retires)
        _check_retirement(in_force, constraint, constraint.retires)
        return
    if not constraint.apart:
        if in_force is None:
            raise InvalidValue(f"no manual constraint keeps {first} and {second} apart")
        return
    if in_force is not None:
        raise InvalidValue(f"{first} and {second} are apart already: {reason_of(in_force)}")
    for end in (first, second):
        merged.check(end)
    pairs = [link.pair for link in merged.links]
    false = {refusal.edge for refusal in merged.refused}
    pairs += [
        (edge.a, edge.b)
        for hybrid_map in merged.maps.values()
        for edge in hybrid_map.edges.values()
        if edge.kind in CLAIMS and edge.id not in false
    ]
    for a, b in pairs:
        if {a, b} == {first, second} or {a.map, b.map} == {first, second}:
            return
    for edge in merged.maps[MapId(*first[:2])].edges.values():
        if {edge.a, edge.b} == {first, second} and edge.kind not in CLAIMS:
            way = f"their robot's way (edge {edge.id}, {edge.kind})"
            raise InvalidValue(
                f"{first} and {second} are joined by {way}, and that measurement cannot be undone; a map "
                "that is wrong as a whole can be retired"
            )
    raise InvalidValue(f"no link joins {first} and {second}: there is nothing to undo")


def _check_retirement(in_force: ManualConstraint | None, constraint: ManualConstraint, which: MapId) -> None:
    if constraint.apart and in_force is not None:
        raise InvalidValue(f"map {which} is retired already: {reason_of(in_force)}")
    if not constraint.apart and in_force is None:
        raise InvalidValue(f"map {which} is not retired")
