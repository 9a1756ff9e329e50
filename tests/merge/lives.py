"""Random lives of fleets, whose merges from standing decisions are compared with fresh merges."""

import numpy as np

from mapweave.hybridmap.area import Area
from mapweave.hybridmap.change import EdgePut, EdgeRetired, NodePut, NodeRetired
from mapweave.hybridmap.constraint_subject import Apart, Linked, RetiredArea, RetiredNodes, Subject
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import EdgeId, MapId
from mapweave.hybridmap.manual_constraint import ManualConstraint, ManualConstraints
from mapweave.hybridmap.node import Edge, EdgeKind
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.merge.manual_constraints import apply_constraints
from mapweave.merge.merging import MergeCache, decide
from mapweave.merge.pose_graph.candidates import Pair
from mapweave.merge.pose_graph.links import Link, RefusedLink
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.pose_graph.verdicts import Verdict, Verdicts
from mapweave.merge.retired_nodes import retired_nodes
from mapweave.merge.settings import MergeSettings
from synthetic.fleet import FleetSettings, draw_fleet

SMALL = FleetSettings(robots=5, nodes=16, side=7.0, true_links=80, apart=6)

DENSE = FleetSettings(robots=4, nodes=30, side=4.0, true_links=200, apart=6)


class Life:
    """Maps that grow and change at random, and what is found of their pairs of nodes."""

    def __init__(self, seed: int, false_share: float, settings: FleetSettings = SMALL) -> None:
        self.rng = np.random.default_rng(seed)
        fleet = draw_fleet(false_share, self.rng, settings)
        self.bodies = {map_id: list(first.contents()) for map_id, first in fleet.maps.items()}
        for map_id in self.bodies:  # each node, then the edge that leads to it
            nodes = [b for b in self.bodies[map_id] if isinstance(b, NodePut)]
            edges = [b for b in self.bodies[map_id] if isinstance(b, EdgePut)]
            self.bodies[map_id] = [
                b for second in zip(nodes, [None, *edges], strict=True) for b in second if b
            ]
        self.coming = {link.pair: link for link in fleet.links}
        self.truth = fleet.truth
        self.maps: dict[MapId, HybridMap] = {}
        self.known: dict[Pair, Verdict] = {}
        self.verdicts = Verdicts()
        self.touched: set[MapId] = set()
        self.constraints = ManualConstraints()
        self.number = 0

    def there(self, pair: Pair) -> bool:
        return all(node.map in self.maps and node in self.maps[node.map].nodes for node in pair)

    def change(self, map_id: MapId, body: NodePut | EdgePut | NodeRetired | EdgeRetired) -> None:
        one = HybridMap(self.maps[map_id].contents()) if map_id in self.maps else HybridMap()
        one.apply(body)
        self.maps[map_id] = one
        self.touched.add(map_id)
        for pair in [pair for pair in self.known if not self.there(pair)]:
            self.tell(pair, None)

    def tell(self, pair: Pair, verdict: Verdict | None) -> None:
        if verdict is None:
            self.known.pop(pair, None)
            self.verdicts.drop(pair)
        else:
            self.known[pair] = verdict
            self.verdicts.put(pair, verdict)
        self.touched |= {pair[0].map, pair[1].map}

    def step(self, quiet: bool = False) -> None:
        """Something happens; most often the maps grow, always if it is quiet."""
        rng, what = self.rng, 0.0 if quiet else self.rng.random()
        open_ = [map_id for map_id, changes in self.bodies.items() if changes]
        known = list(self.known)
        if what < 0.7 and open_:
            map_id = open_[int(rng.integers(len(open_)))]
            for _ in range(min(4, len(self.bodies[map_id]))):
                self.change(map_id, self.bodies[map_id].pop(0))
            for pair in [pair for pair in self.coming if self.there(pair)]:
                self.tell(pair, self.coming.pop(pair))
        elif what < 0.78 and known:
            pair = known[int(rng.integers(len(known)))]
            self.tell(pair, RefusedLink(*pair, "looked again") if rng.random() < 0.5 else None)
        elif what < 0.86 and self.maps:
            map_id = sorted(self.maps)[int(rng.integers(len(self.maps)))]
            nodes = sorted(self.maps[map_id].nodes)
            if len(nodes) > 3:
                self.change(map_id, NodeRetired(nodes[int(rng.integers(len(nodes)))]))
        elif what < 0.94 and self.maps:
            self._loop()
        elif known:
            pair = known[int(rng.integers(len(known)))]
            ends = pair if rng.random() < 0.7 or pair[0].map == pair[1].map else (pair[0].map, pair[1].map)
            self.number += 1
            constraint = ManualConstraint(Apart(ends), bool(rng.random() < 0.6), "anna", self.number)
            self.constraints = self.constraints + ManualConstraints([constraint])

    def _loop(self) -> None:
        """A robot recognises a place of its own, or drives there, and may be mistaken."""
        rng = self.rng
        map_id = sorted(self.maps)[int(rng.integers(len(self.maps)))]
        nodes = sorted(self.maps[map_id].nodes)
        if len(nodes) < 4:
            return
        a, b = (nodes[k] for k in sorted(rng.choice(len(nodes), 2, replace=False)))
        off = Pose2.from_vector(rng.normal(0.0, 0.02 if rng.random() < 0.8 else 2.0, 3))
        a_from_b = PoseGaussian.from_sigmas(self.truth[a].inverse() @ self.truth[b] @ off, 0.03, 0.02)
        self.number += 1
        kind = EdgeKind.LOOP if rng.random() < 0.6 else EdgeKind.DRIVEN
        others = sorted(n for hybrid_map in self.maps.values() for n in hybrid_map.nodes if n.map != map_id)
        if kind is EdgeKind.DRIVEN and others and rng.random() < 0.5:
            b = others[int(rng.integers(len(others)))]
        edge = Edge(EdgeId(map_id.agent, 1, 1000 + self.number), a, b, a_from_b, kind)
        self.change(map_id, EdgePut(edge))

    def rebuilt(self) -> MergedMap:
        others = self.constraints.without(RetiredArea)
        others = others.with_nodes(retired_nodes(self.maps, others, ()))
        if others.made == self.constraints.made:
            return self._decided(others)
        graphs = self._decided(others).graphs
        return self._decided(self.constraints.with_nodes(retired_nodes(self.maps, self.constraints, graphs)))

    def _decided(self, constraints: ManualConstraints) -> MergedMap:
        links = [v for v in self.known.values() if isinstance(v, Link)]
        refused = [v for v in self.known.values() if isinstance(v, RefusedLink)]
        undone = apply_constraints(self.maps, links, constraints)
        everything = undone.maps, undone.links, [*refused, *undone.refused]
        merged, _ = decide(*everything, MergeSettings(), MergeCache(), certain=undone.certain)
        return undone.completed(merged)

    def correct(self, areas: bool) -> None:
        """A person links two nodes, rightly or by mistake, or retires some or an area; or takes it back."""
        rng = self.rng
        nodes = sorted(node for hybrid_map in self.maps.values() for node in hybrid_map.nodes)
        if len(nodes) < 2:
            return
        about: Subject
        made = [
            c.about
            for c in self.constraints.in_force
            if isinstance(c.about, Linked | RetiredNodes | RetiredArea)
        ]
        holds = not made or bool(rng.random() < 0.6)
        if not holds:
            about = made[int(rng.integers(len(made)))]
        elif rng.random() < 0.5:
            a, b = (nodes[k] for k in rng.choice(len(nodes), 2, replace=False))
            off = Pose2.from_vector(rng.normal(0.0, 0.02 if rng.random() < 0.7 else 1.0, 3))
            pose = self.truth[a].inverse() @ self.truth[b] @ off
            about = Linked.of(a, b, PoseGaussian.from_sigmas(pose, 0.05, 0.03))
        elif areas and rng.random() < 0.5:
            (x, y), anchor = rng.uniform(-2.0, 1.0, 2), nodes[int(rng.integers(len(nodes)))]
            about = RetiredArea(Area(anchor, ((x, y), (x + 1.5, y), (x + 1.5, y + 1.5), (x, y + 1.5))))
        else:
            about = RetiredNodes(tuple(nodes[k] for k in rng.choice(len(nodes), 2, replace=False)))
        self.number += 1
        constraint = ManualConstraint(about, holds, "anna", self.number)
        self.constraints = self.constraints + ManualConstraints([constraint])
