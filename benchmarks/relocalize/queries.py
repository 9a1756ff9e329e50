"""Views of mapped places, undisturbed and disturbed, of twin rooms, and of unmapped places."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.relocalize.pictures import Photographer, RenderedPicture, ViewDisturbance, Wish, taken
from benchmarks.relocalize.places import CLEARANCE, Progress, Site, TruePlace, photographed, unknown_sites
from mapweave.hybridmap.pose import Pose2
from mapweave.sim.world import World

NEAR, NEAR_TURN = 0.3, math.radians(10.0)
"""m and rad: most that a view is off the pose that was mapped."""
FAR, FAR_TURN = 0.5, math.radians(20.0)
"""Exactly so far off."""
MOVED = 0.5
"""Share of the furniture that stands elsewhere."""


@dataclass(frozen=True, eq=False)
class Query:
    """A question with its answer.

    Attributes:
        kind: one of KINDS, `nowhere` or `twins`.
        picture: what is asked.
        site: number of the mapped building in which it was taken, -1 in an unmapped one.
    """

    kind: str
    picture: RenderedPicture
    site: int


def _none(rng: np.random.Generator) -> ViewDisturbance:
    return ViewDisturbance()


def _person(rng: np.random.Generator) -> ViewDisturbance:
    return ViewDisturbance(person=True)


def _exposure(rng: np.random.Generator) -> ViewDisturbance:
    """Up to a stop darker or brighter, with another tone curve."""
    return ViewDisturbance(
        gain=round(2.0 ** float(rng.uniform(-1, 1)), 3), gamma=round(float(rng.uniform(0.7, 1.4)), 3)
    )


def _blur(rng: np.random.Generator) -> ViewDisturbance:
    """Turning at 0.4 to 0.8 rad/s with the shutter open for 20 ms, 2 to 4.5 px; a little out of focus."""
    turn = float(rng.uniform(0.4, 0.8)) * float(rng.choice([-1.0, 1.0]))
    return ViewDisturbance(turn_rate=round(turn, 3), shutter=0.02, blur=0.8)


KINDS: dict[str, Callable[[np.random.Generator], ViewDisturbance]] = {
    "near": _none, "far": _none, "person": _person, "exposure": _exposure, "blur": _blur,
    "furniture": _none, "camera": _none,
}  # fmt: skip
"""Kinds of views of mapped places, and what is in their way."""


def known(
    kind: str, count: int, sites: Sequence[Site], places: Sequence[TruePlace], seed: int, progress: Progress
) -> list[Query]:
    """Views near nodes, of buildings without twins."""
    rng = np.random.default_rng([seed, 0x0E5, *kind.encode()])
    numbers = [k for k, site in enumerate(sites) if site.kind != "twins"]
    if kind == "furniture":
        numbers = [k for k in numbers if any(piece.movable for piece in sites[k].world.pieces)]
    worlds = {k: sites[k].world for k in numbers}
    if kind == "furniture":
        worlds = {k: worlds[k].rearranged(sites[k].seed, MOVED) for k in numbers}
    chosen = [place for place in places if place.site in worlds]
    wishes: dict[int, list[Wish]] = {k: [] for k in numbers}
    while sum(map(len, wishes.values())) < count:
        place = chosen[int(rng.integers(len(chosen)))]
        spot = beside(place.world_from_node, worlds[place.site], kind == "far", rng)
        if spot is not None:
            wishes[place.site].append(Wish(spot, KINDS[kind](rng), int(rng.integers(12))))
    camera = "phone" if kind == "camera" else "webcam"
    queries = []
    for k, mine in wishes.items():
        world, site = worlds[k], sites[k]
        name = f"{site} {camera} {MOVED if kind == 'furniture' else 0}"
        pictures = taken(name, _photographer(world, site.seed, camera), mine, progress)
        queries += [Query(kind, picture, k) for picture in pictures]
    return queries


def _photographer(world: World, seed: int, camera: str) -> Callable[[], Photographer]:
    return lambda: Photographer(world, (seed, 2), camera)


def beside(place: Pose2, world: World, far: bool, rng: np.random.Generator) -> Pose2 | None:
    """Where a robot that asks may stand; None if something else stands there."""
    direction = float(rng.uniform(-math.pi, math.pi))
    away = FAR if far else NEAR * math.sqrt(float(rng.random()))
    turn = FAR_TURN * float(rng.choice([-1.0, 1.0])) if far else float(rng.uniform(-NEAR_TURN, NEAR_TURN))
    offset = Pose2(away * math.cos(direction), away * math.sin(direction), turn)
    spot = place @ offset
    return spot if world.plan.is_free(spot.x, spot.y, CLEARANCE - 0.04) else None


def nowhere(count: int, seed: int, progress: Progress) -> list[Query]:
    """Views from anywhere in unmapped buildings."""
    queries: list[Query] = []
    for number, site in enumerate(unknown_sites(seed)):
        rng = np.random.default_rng([seed, 0x0DD, number])
        wanted = round(site.share * count)
        wishes = [Wish(site.world.plan.random_free_pose(rng, CLEARANCE)) for _ in range(wanted)]
        queries += [Query("nowhere", picture, -1) for picture in photographed(site, wishes, progress)]
    return queries


def twins(
    count: int, sites: Sequence[Site], places: Sequence[TruePlace], seed: int, progress: Progress
) -> list[Query]:
    """Views in rooms that have a twin: which of the two cannot be known."""
    queries: list[Query] = []
    numbers = [k for k, site in enumerate(sites) if site.kind == "twins"]
    for k in numbers:
        rng = np.random.default_rng([seed, 0x771, k])
        here = [place for place in places if place.site == k]
        wishes: list[Wish] = []
        while len(wishes) < -(-count // len(numbers)):
            place = here[int(rng.integers(len(here)))]
            spot = beside(place.world_from_node, sites[k].world, False, rng)
            if spot is not None:
                wishes.append(Wish(spot))
        queries += [Query("twins", picture, k) for picture in photographed(sites[k], wishes, progress)]
    return queries[:count]
