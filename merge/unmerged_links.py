"""Links by hand that no merge has taken in yet: what is decided next must fit them, too."""

from dataclasses import replace

from mapweave.hybridmap.manual_constraint import ManualConstraints
from mapweave.merge.manual_constraints import apply_constraints, link_by_hand
from mapweave.merge.outlier_rejection.segmentation import fragments_of
from mapweave.merge.pose_graph.component_solver import ComponentSolver
from mapweave.merge.pose_graph.fragments import fragment_by_node
from mapweave.merge.pose_graph.map_scales import corrected_again
from mapweave.merge.pose_graph.merged_map import MergedMap, NodePoses
from mapweave.merge.settings import ConsistencySettings


def with_unmerged_links(
    merged: MergedMap, constraints: ManualConstraints, settings: ConsistencySettings
) -> MergedMap:
    """The merged map as links by hand join it that it lacks; where it lacks none, the very same object.

    Only what these links join is optimised again, and no other link falls or is found.
    """
    known, links_by_hand = merged.constraints.links, constraints.links
    lacking = [linked for pair, linked in links_by_hand.items() if known.get(pair) != linked]
    if not lacking:
        return merged
    made = [constraint for constraint in constraints.in_force if constraint.about in lacking]
    whole = {**merged.copies, **merged.maps}
    joined = {merged.component_of(node) for linked in lacking for node in (linked.a, linked.b)} - {None}
    graphs = [graph for number, graph in enumerate(merged.graphs) if number in joined]
    # A copy is in no component: a link takes it in.
    inside = {which for graph in graphs for which in graph.maps}
    inside |= {which for linked in lacking for which in linked.maps if which in merged.copies}
    maps = {which: whole[which] for which in sorted(inside)}
    links = {link.pair: link for link in merged.links if any(link.a in graph.rows for graph in graphs)}
    in_force = apply_constraints(maps, (), merged.constraints).maps
    corrected, measured = corrected_again(in_force, [*links.values()])
    fragments = [
        fragment
        for fragment in fragments_of(corrected, settings)
        if fragment.name.map in merged.copies or any(fragment.name in graph.rows for graph in graphs)
    ]
    by_node = fragment_by_node(fragments)
    by_hand = {
        (linked.a, linked.b): link_by_hand(linked)
        for linked in lacking
        if linked.a in by_node and linked.b in by_node
    }
    links |= by_hand
    rest = [graph for number, graph in enumerate(merged.graphs) if number not in joined]
    together = {**{link.pair: link for link in measured}, **by_hand}
    solved = [*rest, *ComponentSolver(fragments).solve([*together.values()])]
    solved.sort(key=lambda graph: (-len(graph.nodes), graph.anchor))
    others = [link for link in merged.links if link.pair not in links]
    return replace(
        merged,
        links=tuple(sorted([*others, *links.values()], key=lambda link: link.pair)),
        components=tuple(frozenset(graph.nodes) for graph in solved),
        poses=NodePoses(solved),
        graphs=tuple(solved),
        constraints=ManualConstraints(
            [*merged.constraints.made, *made], merged.constraints.nodes, merged.constraints.floors
        ),
    )
