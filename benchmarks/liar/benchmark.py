"""Fleets of four robots of which one lies, in many ways: what becomes of the other three.

    python -m benchmarks.liar [--seed N] [--ways NAME ...] [--without RULE] [--json]

Nothing is rendered (see `synthetic.wrong_geometry`); server, ingest, merge and relocalization are the real
ones, and all that robots send and ask goes over a bus. Three robots map a house. A fourth one then sends its
log, with one lie in it. When all is merged, and once more after the server was started again, the three are
compared with what they have without the fourth robot: the links among their maps, the poses of their nodes,
and the answers to lost robots; views to which an honest fourth robot changes the answer are left out. A lie
is contained if links and answers are the same and no node has moved by more than 5 cm: an honest fourth one
moves them by 2 to 3 cm. It is named if the history that the page shows holds it against the robot. Two ways
cannot be found out (`UNDECIDABLE`): they are measured, and not counted.
"""

from __future__ import annotations

import json
import logging
import resource
import shutil
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import Progress

from benchmarks.command_line import command_line
from benchmarks.liar.lies import UNDECIDABLE, WAYS, Lie, Map, Setting, bodies, honest, messages
from benchmarks.liar.server import Answer, Seen, Served, difference
from benchmarks.rules.switches import Switch, switched_off
from mapweave.hybridmap.node import MapId
from mapweave.mapserver import active_nodes
from mapweave.mapserver.log import entry
from mapweave.mapserver.merging import merger
from mapweave.mapserver.merging.copies import Copies
from mapweave.merge.mutual_exclusion import trajectories
from mapweave.merge.outlier_rejection import distinctness, wrong_geometry
from mapweave.merge.outlier_rejection.wrong_geometry import WrongGeometrySearch
from synthetic.wrong_geometry import ODD, SCENES, Fault, Fleet, draw_fleet, lost_views

SCENE = "house"
CLOCK, RADIUS, APART_S = "utc", 0.16, 10_000
"""All robots have one clock; the honest ones drive one after the other."""
MOVED_M = 0.05
"""More than this moves no node of the others, m."""


EVERY = {**WAYS, **UNDECIDABLE}
RULES: dict[str, tuple[Switch, ...]] = {
    "two sources of aliasing": ((distinctness, "ENOUGH", 1),),
    "wrong geometry": ((WrongGeometrySearch, "wrong", lambda *_: {}),),
    "bent maps": ((wrong_geometry, "is_bent", lambda *_: False),),
    "shuffled maps": ((wrong_geometry, "is_shuffled", lambda *_: False),),
    "unreliable robots": ((active_nodes, "unreliable_robots", lambda *_: {}),),
    "copies": ((Copies, "maps", lambda *_: {}),),
    "implausible maps": (
        (merger, "implausible", lambda _: ""),
        (merger, "scattered", lambda _: {}),
        (merger.Merger, "note_refusal", lambda *_: None),
    ),
    "fragments": ((active_nodes, "fragments", lambda _: []),),
    "unmeasurable edges": ((entry, "unmeasurable", lambda _: ""),),
    "clocks that run backwards": ((trajectories, "runs_backwards", lambda _: False),),
}
"""What contains lies, each with what takes its place when it is switched off."""


Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Outcome:
    """What became of the others.

    Attributes:
        contained: whether they have what they would have without the robot that lies.
        named: what the page says against that; empty if nothing.
        max_pose_difference_m: of their nodes.
        answers_changed: of those to lost robots.
        links_changed: among their maps, gone or come.
        alive: whether the server took all and answers.
        seconds: until all was merged.
    """

    contained: bool
    named: str
    max_pose_difference_m: float
    answers_changed: int
    links_changed: int
    alive: bool
    seconds: float


def draw(seed: int) -> tuple[Fleet, dict[MapId, Map]]:
    """A fleet whose robots have clocks and footprints."""
    fleet = draw_fleet(seed, SCENES[SCENE], Fault.NONE, stops=3)
    maps: dict[MapId, Map] = {}
    for number, (map_id, (nodes, edges)) in enumerate(fleet.maps.items()):
        later = number * APART_S * 1_000_000_000
        maps[map_id] = (
            [replace(n, stamp_ns=n.stamp_ns + later, clock=CLOCK, radius=RADIUS) for n in nodes],
            edges,
        )
    return fleet, maps


def changed_answer(before: Answer, after: Answer) -> bool:
    """Whether a lost robot is sent less, something else, or something that is not true.

    An answer where there was none is one more if it is right: true views of the fourth robot are no lie.
    """
    if before.found:
        return not after.found or not before.agrees(after) or before.right > after.right
    return after.found and not after.right


def compared(before: Seen, after: Seen) -> tuple[float, Bools, int]:
    """Greatest difference of a pose, m; which answers differ; links that do."""
    if before.components != after.components:
        moved = float("inf")
    else:
        moved = max(difference(pose, after.poses[node]) for node, pose in before.poses.items())
    changed = [changed_answer(*pair) for pair in zip(before.answers, after.answers, strict=True)]
    return moved, np.array(changed), len(before.links ^ after.links)


class Trial:
    """Three honest robots whose maps are on a server's disk, and a fourth one."""

    def __init__(self, seed: int, queries: int, folder: Path) -> None:
        """Let the three map the house."""
        fleet, self._maps = draw(seed)
        self._others = {map_id: self._maps[map_id] for map_id in self._maps if map_id != ODD}
        honest_truth = {node: pose for node, pose in fleet.truth.items() if node.map != ODD}
        views = lost_views(replace(fleet, truth=honest_truth), SCENES[SCENE], queries, seed)
        self._queries, self._truth = views, honest_truth
        self._seed, self._folder = seed, folder
        self._base = folder / "base"
        with Served(self._base / "s0.sqlite") as served:
            served.send({m: messages(m, bodies(content)) for m, content in self._others.items()})
            served.settle()
            self.before = served.seen(self._others, self._queries, self._truth)
        self._left_out = np.zeros(queries, np.bool_)
        self.beside, self._left_out = self._outcome(honest)

    def outcome(self, lie: Callable[[Setting], Lie]) -> Outcome:
        """Add the fourth robot with a lie. Views that an honest one changes the answers to are left out."""
        return self._outcome(lie)[0]

    def _outcome(self, lie: Callable[[Setting], Lie]) -> tuple[Outcome, Bools]:
        """Add the fourth robot, and compare; and again when the server was started again."""
        rng = np.random.default_rng([self._seed, 0x11E])
        sent = lie(Setting(ODD, self._maps[ODD], self._others, rng))
        folder = self._folder / "way"
        shutil.copytree(self._base, folder)
        began = time.monotonic()
        with Served(folder / "s0.sqlite") as served:
            taken = served.settle() and served.send(sent.logs, sent.extra) and served.settle()
            seconds = time.monotonic() - began
            alive = taken and served.alive()
            first = compared(self.before, served.seen(self._others, self._queries, self._truth))
        with Served(folder / "s0.sqlite") as served:
            alive = served.settle() and alive
            again = compared(self.before, served.seen(self._others, self._queries, self._truth))
            named = served.named(ODD.agent)
        shutil.rmtree(folder)
        moved, links = max(first[0], again[0]), max(first[2], again[2])
        changed = (first[1] | again[1]) & ~self._left_out
        contained = alive and moved <= MOVED_M and not changed.any() and not links
        seconds = round(seconds, 2)
        return Outcome(contained, named, round(moved, 4), int(changed.sum()), links, alive, seconds), changed


def row(name: str, one: Outcome) -> str:
    """An outcome as a line."""
    figures = (
        f"{one.max_pose_difference_m:.3f} m, {one.answers_changed} answers, {one.links_changed} links changed"
    )
    verdict = "contained" if one.contained else "NOT CONTAINED"
    return f"{name}: {verdict}, {figures}, {one.seconds:.0f} s; {one.named or 'not named'}"


def totals(outcomes: Mapping[str, Outcome]) -> dict[str, object]:
    """Of the ways that can be found out, and which of them were not."""
    listed = {name: one for name, one in outcomes.items() if name in WAYS}
    return {
        "ways": len(listed),
        "contained": sum(one.contained for one in listed.values()),
        "named": sum(bool(one.named) for one in listed.values()),
        "max_pose_difference_m": max((one.max_pose_difference_m for one in listed.values()), default=0.0),
        "answers_changed": sum(one.answers_changed for one in listed.values()),
        "not_contained": [name for name, one in listed.items() if not one.contained],
        "not_named": [name for name, one in listed.items() if not one.named],
    }


def main() -> None:
    """Run and print."""
    parser = command_line("liar", __doc__, "of the fleet")
    parser.add_argument("--queries", type=int, default=12, help="of lost robots (default 12)")
    parser.add_argument("--ways", nargs="+", default=list(EVERY), choices=list(EVERY), metavar="NAME")
    parser.add_argument("--without", choices=list(RULES), metavar="RULE", help="switch a rule off: see RULES")
    arguments = parser.parse_args()
    if arguments.queries < 1:
        parser.error("--queries must be at least 1")
    logging.disable(logging.WARNING)
    console = Console(stderr=arguments.json)
    outcomes: dict[str, Outcome] = {}
    off = switched_off(RULES.get(arguments.without, ()))
    with off, tempfile.TemporaryDirectory() as folder, Progress(console=console) as progress:
        task = progress.add_task("ways", total=len(arguments.ways) + 1)
        trial = Trial(arguments.seed, arguments.queries, Path(folder))
        beside = trial.beside
        console.print(row("(an honest fourth robot)", beside))
        for name in arguments.ways:
            progress.advance(task)
            outcomes[name] = trial.outcome(EVERY[name])
            console.print(row(name, outcomes[name]))
        peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    if arguments.json:
        print(json.dumps({"seed": arguments.seed, "without": arguments.without, **totals(outcomes),
            "peak_rss_mb": round(peak_mb), "honest": asdict(beside),
            "by_way": {name: asdict(one) for name, one in outcomes.items()},
        }))  # fmt: skip
