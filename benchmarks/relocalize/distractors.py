"""Places of a large fleet, made of real ones: the left of one real view beside the right of another.

A landmark keeps its real pixel and depth; its descriptor is changed by a difference that a real landmark had
between two real views. So distractors look like each other as much as real places do, with real geometry in
either half.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.relocalize.pictures import Wish
from benchmarks.relocalize.places import (
    CLEARANCE,
    LEAST_LANDMARKS,
    Progress,
    TruePlace,
    donor_sites,
    photographed,
    placed,
)
from mapweave.hybridmap.descriptor import decode, quantise
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Landmarks, Node
from mapweave.registration.matching import match

AGENT = "d"
"""Of all distractors."""
NO_SITE = -1
"""Number of the building that donors and distractors are in."""
CUT = (0.25, 0.75)
"""Where the cut between the two views may be, as shares of the width."""
PIXEL_SIGMA, DEPTH_SIGMA = 1.0, 0.03
"""px, and share of the depth, by which landmarks move."""


@dataclass(frozen=True, eq=False)
class Differences:
    """What real landmarks' descriptors differed by between two real views.

    Attributes:
        vectors: (M, 32) float32, of decoded descriptors.
        sift: (M, 128) int16, of whole ones, in the same order.
    """

    vectors: NDArray[np.float32]
    sift: NDArray[np.int16]


@dataclass(frozen=True, eq=False)
class Distractors:
    """Places that are nowhere, as many as are wanted; number k is always the same.

    Attributes:
        donors: places that a robot would make of real views.
        differences: that are put upon their descriptors.
        seed: of all.
    """

    donors: Sequence[TruePlace]
    differences: Differences
    seed: int

    def place(self, number: int) -> TruePlace:
        """A place, with whole descriptors too; its true pose is unknown."""
        rng = np.random.default_rng([self.seed, 0xD157, number])
        i, j = rng.choice(len(self.donors), 2, replace=False).tolist()
        left, right = self.donors[i], self.donors[j]
        cut = left.node.camera.width * rng.uniform(*CUT)
        a, b = left.node.landmarks, right.node.landmarks
        of_left, of_right = a.pixels[:, 0] < cut, b.pixels[:, 0] >= cut
        a, b = a.take(of_left), b.take(of_right)
        n = len(a) + len(b)
        chosen = rng.integers(0, len(self.differences.vectors), n)
        vectors = decode(np.concatenate([a.codes, b.codes])) + self.differences.vectors[chosen]
        sift = np.concatenate([left.sift[of_left], right.sift[of_right]]) + self.differences.sift[chosen]
        pixels = np.concatenate([a.pixels, b.pixels]) + rng.normal(0, PIXEL_SIGMA, (n, 2)).astype(np.float32)
        scales = (1 + rng.normal(0, DEPTH_SIGMA, n)).astype(np.float32)
        landmarks = Landmarks(
            pixels, quantise(vectors), np.concatenate([a.depths, b.depths]) * scales,
            np.concatenate([a.depth_sigmas, b.depth_sigmas]) * scales,
        )  # fmt: skip
        node = Node(NodeId(AGENT, 1, number), 0, left.node.map_from_robot, left.node.camera, landmarks)
        return TruePlace(node, left.world_from_node, NO_SITE, np.clip(sift, 0, 255).astype(np.uint8))

    def node(self, number: int) -> Node:
        """A place's node."""
        return self.place(number).node


def gather(count: int, places: Sequence[TruePlace], seed: int, progress: Progress) -> Distractors:
    """Look at buildings that are neither mapped nor asked about.

    Args:
        count: views of them.
        places: real nodes, of whose neighbours the differences are taken.
        seed: of the buildings.
        progress: called once a view.
    """
    donors: list[TruePlace] = []
    for number, site in enumerate(donor_sites(seed)):
        rng = np.random.default_rng([seed, 0xD0, number])
        wishes = [
            Wish(site.world.plan.random_free_pose(rng, CLEARANCE)) for _ in range(round(site.share * count))
        ]
        made = [placed(p, NodeId("donor", 1, 1), NO_SITE, rng) for p in photographed(site, wishes, progress)]
        donors += [place for place in made if len(place.node.landmarks) >= LEAST_LANDMARKS]
    return Distractors(donors, differences(places, seed), seed)


def differences(places: Sequence[TruePlace], seed: int, pairs: int = 200) -> Differences:
    """Differences of landmarks that two nodes share, by matches that the geometry confirms."""
    rng = np.random.default_rng([seed, 0xD1F])
    found, whole = list[NDArray[np.float32]](), list[NDArray[np.int16]]()
    for k in rng.permutation(len(places))[: 4 * pairs].tolist():
        one = places[k]
        near = [
            other for other in places
            if other is not one and other.site == one.site and _alike(one, other)
        ]  # fmt: skip
        if not near:
            continue
        other = near[int(rng.integers(len(near)))]
        matches = match(one.node.landmarks.codes, other.node.landmarks.codes)
        a, b = one.node.landmarks.take(matches[:, 0]), other.node.landmarks.take(matches[:, 1])
        there = one.world_from_node.inverse() @ other.world_from_node
        at = other.node.camera.project(there.inverse().apply(a.points_in_robot(one.node.camera)))
        right = np.linalg.norm(at - b.pixels, axis=1) < 4.0
        found.append((decode(a.codes[right]) - decode(b.codes[right])).astype(np.float32))
        mine, theirs = matches[right].T
        whole.append(one.sift[mine].astype(np.int16) - other.sift[theirs].astype(np.int16))
        if len(found) == pairs:
            break
    return Differences(np.concatenate(found), np.concatenate(whole))


def _alike(a: TruePlace, b: TruePlace) -> bool:
    between = a.world_from_node.inverse() @ b.world_from_node
    return abs(between.heading) < 0.5 and abs(between.x) < 1.0 and abs(between.y) < 1.0
