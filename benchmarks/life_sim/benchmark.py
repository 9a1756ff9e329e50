"""Furniture that moves: what fades of it, and what of the rest, in images of the simulator?

    python -m benchmarks.life_sim [--seed N] [--drives N] [--rooms N] [--stops N] [--queries N] [--json]

An office is mapped by one drive; then a third of its furniture stands elsewhere, and N drives follow, each a
new epoch with newly drawn stops, with a full turn at each. The simulator's camera takes the images and the
robot's own eyes find the features; depths are true but for noise as a robot's, and so is the way. All goes
through the server's own merger, with a merge after every drive. Printed are, after each later drive, shares
of the first drive's landmarks in active nodes that have faded: of those on what was moved, of these those
that views of two later drives or more should have shown, and of all others. And how many of the views taken
beside nodes that show what was moved, and beside the others, are answered rightly (within 0.25 m and 8
degrees) in the end, with fading and without. Truth is for scoring alone. Takes about a minute.
"""

from __future__ import annotations

import json
import math
import sys
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table

from benchmarks.command_line import command_line
from benchmarks.images.surface_points import Surfaces
from benchmarks.life.benchmark import answered
from benchmarks.relocalize.pictures import Photographer, Wish
from benchmarks.relocalize.places import LEAST_LANDMARKS, WAY_HEADING, WAY_XY, lookouts, placed
from benchmarks.relocalize.queries import beside
from mapweave.hybridmap.change import Change, ChangeBody, EdgePut, NodePut
from mapweave.hybridmap.node import Edge, EdgeKind, MapId, Node, NodeId
from mapweave.hybridmap.pose import Array, Pose2, PoseGaussian
from mapweave.hybridmap.query import View
from mapweave.mapserver.merging.merger import Merger
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.registration.selection import choose
from mapweave.sim.world import World
from mapweave.sim.worlds.catalog import make_world

SHARE = 0.33
"""Of the furniture that is moved."""
VIEWS = 7
"""At each stop."""
SHOWS = 10
"""A node shows what was moved if so many of its landmarks are on it."""
SCALE, ASIDE = 1.6, math.radians(25.0)
"""A later view should show a place from a distance within this factor, and from a direction within this."""
NEAR = 0.05
"""m along the optical axis by which two rays may end apart, and have met the same thing."""


@dataclass(frozen=True)
class Faded:
    """What has faded after a drive, of the first drive's landmarks in active nodes.

    Attributes:
        moved: landmarks on what was moved.
        moved_faded: of these.
        seen: of these, landmarks that views of two later drives or more should have shown.
        seen_faded: of these.
        others: landmarks on what has stood still.
        others_faded: of these.
    """

    moved: int = 0
    moved_faded: int = 0
    seen: int = 0
    seen_faded: int = 0
    others: int = 0
    others_faded: int = 0


class Fleet:
    """One robot that maps an office again and again, and the truth about it."""

    def __init__(self, seed: int, rooms: int, stops: int) -> None:
        """Build the office; it is unmapped.

        Args:
            seed: of everything.
            rooms: of the office.
            stops: on every drive.
        """
        self.before: World = make_world("office", seed, rooms=rooms)
        self.after = self.before.rearranged(seed, SHARE)
        pairs = zip(self.before.pieces, self.before.plan.furniture, self.after.plan.furniture, strict=True)
        moved = [piece for piece, old, new in pairs if old != new]
        panels = [self.before.panels[k] for piece in moved for k in piece.panels]
        self._whole, self._moved = Surfaces(self.before), Surfaces(replace(self.before, panels=tuple(panels)))
        self._now = Surfaces(self.after)
        self._seed, self._stops = seed, stops
        self._rng = np.random.default_rng([seed, 0x11F5])
        self.truth: dict[NodeId, Pose2] = {}
        self.merger = Merger()

    def drive(self, epoch: int) -> MergedMap:
        """One drive, and the merge after it; the first one is in the office as it was."""
        world, rng = self.before if epoch == 1 else self.after, self._rng
        artist = Photographer(world, (self._seed, epoch))
        looks = lookouts(world, self._stops * VIEWS, rng)
        map_from, known = PoseGaussian(Pose2(), np.zeros((3, 3))), list[tuple[Node, Pose2]]()
        bodies: list[ChangeBody] = []
        for here in _in_turn(looks):
            picture = artist.take(Wish(here))
            node = placed(picture, NodeId("r0", epoch, 2 * len(known) + 1), 0, rng).node
            if len(node.landmarks) < LEAST_LANDMARKS:
                continue
            kept = choose(node.landmarks, np.ones(len(node.landmarks)), node.camera)
            if known:
                true = known[-1][1].inverse() @ here
                sigma = WAY_XY * (1.0 + true.distance(Pose2()))
                noise = rng.normal(0, 1, 3) * [sigma, sigma, WAY_HEADING]
                step = PoseGaussian.from_sigmas(true @ Pose2.from_vector(noise), sigma, WAY_HEADING)
                map_from = map_from @ step
                kind = EdgeKind.TURNED if true.distance(Pose2()) < NEAR else EdgeKind.MAPPED
                edge = Edge(NodeId("r0", epoch, node.id.number - 1), known[-1][0].id, node.id, step, kind)
                bodies.append(EdgePut(edge))
            stamp = (epoch * 86_400 + len(known)) * 10**9
            node = replace(
                node, landmarks=node.landmarks.take(np.sort(kept)), map_from_robot=map_from, stamp_ns=stamp
            )
            known.append((node, here))
            bodies.append(NodePut(node))
        self.truth |= {node.id: here for node, here in known}
        # An edge comes after both of its nodes.
        bodies.sort(key=lambda body: isinstance(body, EdgePut))
        for number, body in enumerate(bodies, start=1):
            self.merger.on_change(Change(MapId("r0", epoch), number, 0, body))
        return self.merger.merged()

    def on_moved(self, node: Node) -> NDArray[np.bool_]:
        """(N,) which landmarks of a node of the first drive are on what was moved."""
        here, pixels = self.truth[node.id], node.landmarks.pixels.astype(np.float64)
        first, thing = (s.see(here, node.camera, pixels).depths for s in (self._whole, self._moved))
        on: NDArray[np.bool_] = np.isfinite(thing) & (thing <= first + 1e-6)
        return on

    def shown_since(self, node: Node) -> NDArray[np.int64]:
        """(N,) on how many later drives a view truly looked at where a node's landmarks were."""
        points = self._whole.see(
            self.truth[node.id], node.camera, node.landmarks.pixels.astype(np.float64)
        ).points
        shown = {epoch: np.zeros(len(points), np.bool_) for epoch in {one.epoch for one in self.truth}}
        eye = self.truth[node.id].apply(np.array([[node.camera.mount_forward, 0.0, 0.0]]))[0, :2]
        for other, here in self.truth.items():
            if other.epoch <= node.id.epoch:
                continue
            in_robot = np.column_stack([here.inverse().apply(points[:, :2]), points[:, 2]])
            pixels = node.camera.project(in_robot)
            there = here.apply(np.array([[node.camera.mount_forward, 0.0, 0.0]]))[0, :2]
            seen = node.camera.contains(pixels, 12.0) & _alike(points[:, :2], eye, there)
            ask = np.flatnonzero(seen)
            if len(ask):
                depths = self._now.see(here, node.camera, pixels[ask]).depths
                shown[other.epoch][ask] |= depths > in_robot[ask, 0] - node.camera.mount_forward - NEAR
        counts: NDArray[np.int64] = np.sum(list(shown.values()), axis=0)
        return counts

    def faded(self, merged: MergedMap) -> Faded:
        """What has faded by now."""
        sums = np.zeros(6, np.int64)
        for node in merged.maps[MapId("r0", 1)].nodes.values():
            if node.id in merged.superseded:
                continue
            gone = merged.faded.get(node.id, np.zeros(len(node.landmarks), np.bool_))
            on, seen = self.on_moved(node), self.shown_since(node) >= 2
            parts = (on, on & gone, on & seen, on & seen & gone, ~on, ~on & gone)
            sums += [int(part.sum()) for part in parts]
        return Faded(*map(int, sums))

    def views(self, count: int, of_moved: bool) -> list[tuple[View, Pose2]]:
        """What robots see now beside nodes of the first drive that show what was moved, or do not."""
        first = [
            node
            for node in self.merger.maps[MapId("r0", 1)].nodes.values()
            if (self.on_moved(node).sum() >= SHOWS) == of_moved
        ]
        artist, views = Photographer(self.after, (self._seed, 99)), list[tuple[View, Pose2]]()
        for _ in range(20 * count if first else 0):
            node = first[int(self._rng.integers(len(first)))]
            spot = beside(self.truth[node.id], self.after, False, self._rng)
            if spot is not None and len(views) < count:
                views.append((artist.take(Wish(spot)).view, spot))
        return views


def _in_turn(looks: list[Pose2]) -> list[Pose2]:
    """Stop by stop, always the nearest that is left."""
    stops = [looks[k : k + VIEWS] for k in range(0, len(looks), VIEWS)]
    tour = [stops.pop(0)]
    while stops:
        at = tour[-1][0]
        tour.append(stops.pop(min(range(len(stops)), key=lambda k: at.distance(stops[k][0]))))
    return [look for stop in tour for look in stop]


def _alike(points: Array, a: Array, b: Array) -> NDArray[np.bool_]:
    """(N,) which points two eyes see alike, all (., 2) m."""
    rays = points - a, points - b
    far = [np.linalg.norm(ray, axis=1) for ray in rays]
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.maximum(*far) / np.minimum(*far)
        cosine = (rays[0] * rays[1]).sum(axis=1) / (far[0] * far[1])
        alike: NDArray[np.bool_] = (ratio < SCALE) & (cosine > math.cos(ASIDE))
    return alike


def main() -> None:
    """Drive, move, drive, ask, print."""
    parser = command_line("life_sim", __doc__, "of office, stops and noise")
    parser.add_argument("--drives", type=int, default=4, help="after the furniture was moved (default 4)")
    parser.add_argument("--rooms", type=int, default=2, help="of the office (default 2)")
    parser.add_argument("--stops", type=int, default=10, help="on every drive (default 10)")
    parser.add_argument("--queries", type=int, default=40, help="views of either kind (default 40)")
    a = parser.parse_args()
    if min(a.drives, a.rooms, a.stops, a.queries) < 1:
        print("life_sim: at least one drive, room, stop and query", file=sys.stderr)
        raise SystemExit(2)
    console = Console(stderr=a.json)
    fleet = Fleet(a.seed, a.rooms, a.stops)
    merged, curve = fleet.drive(1), list[Faded]()
    for epoch in track(range(2, a.drives + 2), "driving", console=console):
        merged = fleet.drive(epoch)
        curve.append(fleet.faded(merged))
    names = "moved", "faded", "shown twice", "faded", "others", "faded"
    table = Table("drive", *names, title=f"seed {a.seed}: landmarks of the first drive in active nodes")
    for number, one in enumerate(curve, start=1):
        table.add_row(str(number), *(str(count) for count in one.__dict__.values()))
    console.print(table)
    last = curve[-1]
    figures: dict[str, object] = {
        "nodes": len(merged.poses),
        "active": len(merged.poses) - len(merged.superseded),
        "components": len(merged.components),
        "moved_faded": [_share(one.moved_faded, one.moved) for one in curve],
        "shown_twice_faded": [_share(one.seen_faded, one.seen) for one in curve],
        "others_faded": [_share(one.others_faded, one.others) for one in curve],
        "moved": last.moved,
        "shown_twice": last.seen,
        "others": last.others,
    }
    hidden, plain = frozenset(merged.superseded), replace(merged, faded={})
    for where, of_moved in (("moved", True), ("others", False)):
        asked = fleet.views(a.queries, of_moved)
        if not asked:
            continue
        for how, shown in (("", merged), ("_unfaded", plain)):
            right, wrong = answered(fleet.merger, shown, hidden, asked, fleet.truth)
            figures |= {f"recall_{where}{how}": right, f"wrong_{where}{how}": wrong}
    totals = Table("figure", "value")
    for name, value in figures.items():
        totals.add_row(name, str(value))
    console.print(totals)
    if a.json:
        print(json.dumps({"seed": a.seed, **figures}))


def _share(part: int, whole: int) -> float | None:
    return round(part / whole, 3) if whole else None
