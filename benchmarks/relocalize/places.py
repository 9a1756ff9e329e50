"""Buildings as a fleet has mapped them: nodes about as robots make them, and the map that joins them."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from benchmarks.relocalize.pictures import Photographer, RenderedPicture, Wish, taken
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Landmarks, Node
from mapweave.hybridmap.pose import Array, Pose2, PoseGaussian
from mapweave.hybridmap.quantization import settle
from mapweave.merge.pose_graph.component import solve_graph
from mapweave.merge.pose_graph.factors import RelativePose
from mapweave.merge.pose_graph.merged_map import MergedMap, Placement
from mapweave.sim.world import World
from mapweave.sim.worlds.catalog import make_world

CLEARANCE = 0.22
"""Middles of robots are so far from walls, m."""
VIEWS = 7
"""Directions in which a robot looks at a place before it goes on: it turns until four features are left."""
SEEN_AGAIN = 0.85
"""Share of the features whose tracks last until their depths are known."""
DEPTH_SHARE = 0.02
"""What the filter leaves of a depth's uncertainty, as a share of the depth; then a robot adds a floor."""
DEPTH_FLOOR = (0.01, 0.015)
"""m, and share of the depth, see mapweave.agent.mapping.keyframe_builder."""
COMMON_SCALE = 0.01
"""Depths of one node are wrong together by this share, as the wheels of its drive are."""
SPARE = 1.4
"""More places are looked at than become nodes."""
LEAST_LANDMARKS = 20
WAY_XY, WAY_HEADING = 0.004, 0.008
"""What a robot knows of its way from one node to the next, as a share of the way, and in rad."""


@dataclass(frozen=True)
class Site:
    """One building.

    Attributes:
        kind: of world.
        seed: of it.
        share: of all real nodes that are there.
        parameters: of the kind.
    """

    kind: str
    seed: int
    share: float = 1.0
    parameters: tuple[tuple[str, int], ...] = ()

    @property
    def name(self) -> str:
        """The place's name, for example `office-7`."""
        return f"{self.kind}-{self.seed}"

    @cached_property
    def world(self) -> World:
        """The building itself."""
        return make_world(self.kind, self.seed, **dict(self.parameters))


def mapped_sites(seed: int) -> tuple[Site, ...]:
    """What the fleet has mapped."""
    base = 40_000 + 100 * seed
    rooms = (("rooms", 4),)
    return (
        Site("office", base, 0.22, rooms), Site("office", base + 1, 0.22, rooms),
        Site("office", base + 2, 0.20, rooms), Site("warehouse", base + 3, 0.15),
        Site("corridor", base + 4, 0.09), Site("twins", base + 5, 0.06), Site("twins", base + 6, 0.06),
    )  # fmt: skip


def unknown_sites(seed: int) -> tuple[Site, ...]:
    """Unmapped buildings."""
    base = 40_050 + 100 * seed
    return (
        Site("office", base, 0.4), Site("office", base + 1, 0.2), Site("warehouse", base + 2, 0.2),
        Site("corridor", base + 3, 0.2),
    )  # fmt: skip


def donor_sites(seed: int) -> tuple[Site, ...]:
    """Whose views stand behind the places of a large fleet."""
    base = 40_070 + 100 * seed
    kinds = ("office", "office", "warehouse", "office", "corridor", "office", "office", "warehouse")
    return tuple(Site(kind, base + k, 1 / len(kinds)) for k, kind in enumerate(kinds))


@dataclass(frozen=True, eq=False)
class TruePlace:
    """A node and the truth about it.

    Attributes:
        node: as a robot has made it.
        world_from_node: where it truly is.
        site: number of its building.
        sift: (N, 128) uint8, whole descriptors of the node's landmarks, in their order.
    """

    node: Node
    world_from_node: Pose2
    site: int
    sift: NDArray[np.uint8]


Progress = Callable[[], None]


def lookouts(world: World, count: int, rng: np.random.Generator) -> list[Pose2]:
    """Places all over the free floor, as far from each other as can be, with VIEWS directions each."""
    stops = -(-count // VIEWS)
    regions = [part for part in world.plan.free_regions(CLEARANCE) if len(part) > 20]
    total = sum(len(part) for part in regions)
    poses: list[Pose2] = []
    for part in regions:
        points = spread_out(part, max(1, round(stops * len(part) / total)), rng)
        for x, y in points.tolist():
            start = rng.uniform(-math.pi, math.pi)
            turns = start + np.arange(VIEWS) * math.tau / VIEWS + rng.normal(0, 0.1, VIEWS)
            poses += [Pose2(x, y, float(turn)) for turn in turns]
    return poses[:count]


def twin_lookouts(world: World, count: int, rng: np.random.Generator) -> list[Pose2]:
    """The same in both twin rooms but for a step and a look aside: robots do alike in rooms that look alike.

    What the one robot has seen the other has too, so nothing in the map tells the rooms apart.
    """
    east = world.plan.room("room 1").x - world.plan.room("room 0").x
    poses = [
        pose for pose in lookouts(world, 4 * count, rng) if world.plan.room_at(pose.x, pose.y) == "room 0"
    ]
    both: list[Pose2] = []
    for pose in poses:
        for shift in (0.0, east):
            aside = rng.uniform([-0.1, -0.1, -0.1], [0.1, 0.1, 0.1])
            there = Pose2(pose.x + shift, pose.y, pose.heading) @ Pose2.from_vector(aside)
            both.append(
                there
                if world.plan.is_free(there.x, there.y, 0.16)
                else Pose2(pose.x + shift, pose.y, pose.heading)
            )
    return both[:count]


def spread_out(points: Array, count: int, rng: np.random.Generator) -> Array:
    """(count, 2) of (N, 2) points, by farthest-point sampling from a random one."""
    chosen = [int(rng.integers(len(points)))]
    distance = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < min(count, len(points)):
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return points[chosen]


def photographed(
    site: Site, wishes: Sequence[Wish], progress: Progress, camera: str = "webcam"
) -> list[RenderedPicture]:
    """Pictures of a building as it was built."""
    name = f"{site} {camera}"
    return taken(name, lambda: Photographer(site.world, (site.seed, 1), camera), wishes, progress)


def mapped(sites: Sequence[Site], count: int, seed: int, progress: Progress) -> list[TruePlace]:
    """Nodes of all buildings, about as robots make them; where there is nothing to see they make none."""
    places: list[TruePlace] = []
    for number, site in enumerate(sites):
        rng = np.random.default_rng([seed, 0x3A9, number])
        wanted = round(site.share * count)
        look = twin_lookouts if site.kind == "twins" else lookouts
        poses = look(site.world, round(SPARE * wanted), rng)
        pictures = photographed(site, [Wish(pose) for pose in poses], progress)
        made = [
            placed(picture, NodeId(f"m{number}", 1, k + 1), number, rng) for k, picture in enumerate(pictures)
        ]
        good = [one for one in made if len(one.node.landmarks) >= LEAST_LANDMARKS]
        # Of twins the pairs stay together.
        chosen = np.arange(len(good)) if site.kind == "twins" else rng.permutation(len(good))
        places += [good[k] for k in sorted(chosen[:wanted].tolist())]
    return places


def placed(picture: RenderedPicture, node_id: NodeId, site: int, rng: np.random.Generator) -> TruePlace:
    """A node of a picture: depths as uncertain as a robot's, and wrong by about as much as they say."""
    true = picture.depths.astype(np.float64)
    known = np.flatnonzero(np.isfinite(true) & (rng.random(len(true)) < SEEN_AGAIN))
    true = true[known]
    filtered = DEPTH_SHARE * true
    sigmas = np.hypot(filtered, DEPTH_FLOOR[0] + DEPTH_FLOOR[1] * true)
    depths = true * (1 + rng.normal(0, COMMON_SCALE)) + rng.normal(0, 1, len(true)) * sigmas
    right = depths > 0.05
    known, depths, sigmas = known[right], depths[right], sigmas[right]
    landmarks = Landmarks(
        picture.pixels[known], picture.view.codes[known], depths.astype(np.float32), sigmas.astype(np.float32)
    )
    landmarks, order = settle(landmarks, picture.camera)
    pose = PoseGaussian.from_sigmas(picture.world_from_robot, 0.01, 0.01)
    node = Node(node_id, node_id.number * 1_000_000_000, pose, picture.camera, landmarks)
    return TruePlace(node, picture.world_from_robot, site, picture.sift[known][order])


def joined(places: Sequence[TruePlace], seed: int) -> MergedMap:
    """The merged map of the places: a graph for each building, of ways and turns measured as robots do."""
    graphs, poses = [], dict[NodeId, Placement]()
    for number in sorted({place.site for place in places}):
        rng = np.random.default_rng([seed, 0x10B, number])
        here = [place for place in places if place.site == number]
        graph = solve_graph(here[0].node.id, Pose2(), _ways(here, rng))
        graphs.append(graph)
        for node, pose in graph.poses().items():
            poses[node] = Placement(len(graphs) - 1, pose)
    components = tuple(frozenset(graph.nodes) for graph in graphs)
    return MergedMap({}, (), (), components, poses, tuple(graphs))


def _ways(here: Sequence[TruePlace], rng: np.random.Generator) -> list[RelativePose]:
    """A tree of shortest ways from place to place, and as many more between neighbours."""
    at = np.array([[p.world_from_node.x, p.world_from_node.y] for p in here])
    away = np.linalg.norm(at[:, None] - at[None], axis=2) + np.triu(np.full((len(at),) * 2, np.inf))
    measured = []
    for k in range(1, len(here)):
        for other in np.argsort(away[k, :k])[:2].tolist():
            true = here[other].world_from_node.inverse() @ here[k].world_from_node
            sigma = 0.004 + WAY_XY * math.hypot(true.x, true.y)
            noise = rng.normal(0, 1, 3) * [sigma, sigma, WAY_HEADING]
            pose = PoseGaussian.from_sigmas(true @ Pose2.from_vector(noise), sigma, WAY_HEADING)
            measured.append(RelativePose(here[other].node.id, here[k].node.id, pose))
    return measured
