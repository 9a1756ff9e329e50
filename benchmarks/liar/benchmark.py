"""Fleets of four robots of which one lies, in many ways: what becomes of the other three.

    python -m benchmarks.liar [--seed N] [--ways NAME ...] [--without RULE] [--json]
    python -m benchmarks.liar --rules [--seed N] [--ways NAME ...] [--jobs N] [--json]
    python -m benchmarks.liar --margins [--seed N] [--json]
    python -m benchmarks.liar --recovery [--seed N] [--ways NAME ...] [--json]

Nothing is rendered (see `synthetic.wrong_geometry`); server, ingest, merge and relocalization are the real
ones, and all that robots send and ask goes over a bus. Three robots map a house. A fourth one then sends its
log, with one lie in it. When all is merged, and once more after the server was started again, the three are
compared with what they have without the fourth robot: the links among their maps, the poses of their nodes,
and the answers to lost robots; views to which an honest fourth robot changes the answer are left out. A lie
is contained if links and answers are the same and no node has moved by more than 5 cm: an honest fourth one
moves them by 2 to 3 cm. It is named if the history that the page shows holds it against the robot. Some ways
cannot be found out (`UNDECIDABLE`), and some are merged and not named (`OPEN`): they are measured, and
not counted.

With `--rules` all ways that can be found out are tried with all rules, and without each. With `--margins` the
ways of `margins.py` are, each without the one rule that contains it. With `--recovery` a person retires what
the robot that lies has sent, and the three are compared, node by node, with what they had without it.
"""

import argparse
import json
import logging
import resource
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress

from benchmarks.command_line import at_least, command_line
from benchmarks.liar.margins import MARGINS
from benchmarks.liar.recovery import RecoveryOutcome, RecoveryTrial, recovery_row
from benchmarks.rules.switches import ALL, Switch, switched_off
from mapweave.hybridmap.ids import MapId
from mapweave.mapserver import active_nodes, answers
from mapweave.mapserver.log import entry
from mapweave.mapserver.merging import implausible_maps
from mapweave.mapserver.merging.copies import Copies
from mapweave.mapserver.merging.own_views_search import OwnViewsSearch
from mapweave.merge.mutual_exclusion import trajectories
from mapweave.merge.outlier_rejection import distinctness, wrong_geometry
from mapweave.merge.outlier_rejection.fleet_chance import FleetChance
from mapweave.merge.outlier_rejection.wrong_geometry import WrongGeometrySearch
from mapweave.merge.pose_graph.staged_optimization import StagedOptimization
from mapweave.scenarios.liar.lies import EVERY, WAYS, Map, honest
from mapweave.scenarios.liar.trial import ContainmentOutcome, row, totals
from synthetic.wrong_geometry import ODD, SCENES, FaultyFleet, OdometryFault, draw_fleet, lost_views

SCENE = "house", 3
"""Which, and how often robots stop in it."""
CLOCK, RADIUS, APART_S = "utc", 0.16, 10_000
"""All robots have one clock; the honest ones drive one after the other."""
HONEST = "(an honest fourth robot)"
"""What becomes of the three beside it."""

RULES: dict[str, tuple[Switch, ...]] = {
    "two sources of aliasing": ((distinctness, "ENOUGH", 1),),
    "wrong geometry": ((WrongGeometrySearch, "wrong", lambda *_: {}),),
    "bent maps": ((wrong_geometry, "is_bent", lambda *_: False),),
    "shuffled maps": ((wrong_geometry, "is_shuffled", lambda *_: False),),
    "unreliable robots": ((active_nodes, "unreliable_robots", lambda *_: {}),),
    "copies": ((Copies, "maps", lambda *_: {}),),
    "implausible maps": (
        (implausible_maps, "implausible", lambda _: ""),
        (implausible_maps, "scattered", lambda *_: {}),
        (implausible_maps.ImplausibleMaps, "note_refusal", lambda *_: False),
    ),
    "maps that contradict themselves": (
        (implausible_maps, "contradict_themselves", lambda _: {}),
        (implausible_maps, "contradict_each_other", lambda _: {}),
    ),
    "views that contradict the way": ((OwnViewsSearch, "reason", lambda *_: ""),),
    "false places of one robot": ((FleetChance, "_all_at_one_robot", lambda *_: False),),
    "optimisation in two stages": ((StagedOptimization, "solved", lambda _self, merged, *_: merged),),
    "torn maps": ((wrong_geometry, "is_torn", lambda *_: False),),
    "answers without implausible maps": ((answers, "doubted", lambda _: []),),
    "fragments": ((active_nodes, "fragments", lambda *_: []),),
    "unmeasurable edges": ((entry, "unmeasurable", lambda *_: ""),),
    "clocks that run backwards": ((trajectories, "runs_backwards", lambda *_: False),),
}
"""What contains lies, each with what takes its place when it is switched off."""


def draw(seed: int, scene: tuple[str, int] = SCENE) -> tuple[FaultyFleet, dict[MapId, Map]]:
    """A fleet whose robots have clocks and footprints."""
    name, stops = scene
    fleet = draw_fleet(seed, SCENES[name], OdometryFault.NONE, stops=stops)
    maps: dict[MapId, Map] = {}
    for number, (map_id, (nodes, edges)) in enumerate(fleet.maps.items()):
        later = number * APART_S * 1_000_000_000
        maps[map_id] = (
            [replace(n, stamp_ns=n.stamp_ns + later, clock=CLOCK, radius=RADIUS) for n in nodes],
            edges,
        )
    return fleet, maps


def drawn_trial(seed: int, queries: int, folder: Path, scene: tuple[str, int] = SCENE) -> RecoveryTrial:
    """Three robots map the house, or another scene, and a fourth one is to lie."""
    fleet, maps = draw(seed, scene)
    honest_truth = {node: pose for node, pose in fleet.truth.items() if node.map != ODD}
    views = lost_views(replace(fleet, truth=honest_truth), SCENES[scene[0]], queries, seed)
    return RecoveryTrial(ODD, maps, views, honest_truth, seed, folder)


def tried(
    seed: int, queries: int, ways: Sequence[str], rule: str
) -> Iterator[tuple[str, ContainmentOutcome]]:
    """What becomes of an honest fourth robot and of each way to lie, without a rule; with all for `ALL`."""
    with switched_off(RULES.get(rule, ())), tempfile.TemporaryDirectory() as folder:
        trial = drawn_trial(seed, queries, Path(folder))
        yield HONEST, trial.beside
        for name in ways:
            yield name, trial.outcome(EVERY[name])


def margins(seed: int, queries: int) -> Iterator[tuple[str, dict[str, ContainmentOutcome]]]:
    """What becomes of each way that one rule contains, with all rules, and without that one."""
    with tempfile.TemporaryDirectory() as folder:
        trials = {
            scene: drawn_trial(seed, queries, Path(folder, scene[0]), scene)
            for scene in {scene: None for _, _, scene in MARGINS.values()}
        }
        for name, (rule, lie, scene) in MARGINS.items():
            trial = trials[scene]
            outcomes = {ALL: trial.outcome(lie)}
            with switched_off(RULES[rule]):
                yield name, {**outcomes, rule: trial.outcome(lie)}


def recoveries(seed: int, queries: int, ways: Sequence[str]) -> Iterator[tuple[str, RecoveryOutcome]]:
    """What is left of an honest fourth robot, and of each way to lie, once a person has retired it."""
    with tempfile.TemporaryDirectory() as folder:
        trial = drawn_trial(seed, queries, Path(folder))
        for name, lie in ((HONEST, honest), *((name, EVERY[name]) for name in ways)):
            yield name, trial.recovery(lie)


def _without(seed: int, queries: int, ways: Sequence[str], rule: str) -> dict[str, Any]:
    logging.disable(logging.WARNING)
    return totals(dict(tried(seed, queries, ways, rule)))


def main() -> None:
    """Run and print."""
    parser = command_line("liar", __doc__, "of the fleet")
    parser.add_argument("--queries", type=at_least(1), default=12, help="of lost robots (default 12)")
    parser.add_argument("--ways", nargs="+", default=list(EVERY), choices=list(EVERY), metavar="NAME")
    parser.add_argument("--without", choices=list(RULES), metavar="RULE", help="switch a rule off: see RULES")
    parser.add_argument("--rules", action="store_true", help="all rules, and without each of them")
    parser.add_argument("--margins", action="store_true", help="the ways that one rule alone contains")
    parser.add_argument("--recovery", action="store_true", help="what is left once a person has retired it")
    parser.add_argument("--jobs", type=at_least(1), default=1, help="processes, with --rules (default 1)")
    arguments = parser.parse_args()
    if arguments.rules and arguments.without:
        parser.error("--rules switches each rule off: leave out --without")
    if arguments.margins and (arguments.rules or arguments.without):
        parser.error("--margins has its own ways and rules: leave out --rules and --without")
    if arguments.recovery and (arguments.rules or arguments.without or arguments.margins):
        parser.error("--recovery is by all rules: leave out --rules, --without and --margins")
    logging.disable(logging.WARNING)
    console = Console(stderr=arguments.json)
    with Progress(console=console) as progress:
        if arguments.rules:
            found = _by_rule(arguments, progress)
        elif arguments.margins:
            found = {}
            each = margins(arguments.seed, arguments.queries)
            for name, by_rule in progress.track(each, len(MARGINS), description="ways"):
                found[name] = {rule: asdict(one) for rule, one in by_rule.items()}
                for rule, one in by_rule.items():
                    console.print(f"without {rule}: " if rule != ALL else "", row(name, one), sep="")
        elif arguments.recovery:
            found = {}
            left = recoveries(arguments.seed, arguments.queries, arguments.ways)
            for name, gone in progress.track(left, len(arguments.ways) + 1, description="ways"):
                found[name] = asdict(gone)
                console.print(recovery_row(name, gone))
        else:
            outcomes: dict[str, ContainmentOutcome] = {}
            rule = arguments.without or ALL
            ways = tried(arguments.seed, arguments.queries, arguments.ways, rule)
            for name, one in progress.track(ways, len(arguments.ways) + 1, description="ways"):
                outcomes[name] = one
                console.print(row(name, one))
            peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            found = {
                "without": arguments.without, **totals(outcomes), "peak_rss_mb": round(peak_mb),
                "honest": asdict(outcomes.pop(HONEST)),
                "by_way": {name: asdict(one) for name, one in outcomes.items()},
            }  # fmt: skip
    if arguments.json:
        print(json.dumps({"seed": arguments.seed, **found}))


def _by_rule(arguments: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """What becomes of the ways that can be found out, with all rules and without each."""
    ways = [name for name in arguments.ways if name in WAYS]
    found = {}
    with ProcessPoolExecutor(arguments.jobs) as pool:
        given = arguments.seed, arguments.queries, ways
        each = {rule: pool.submit(_without, *given, rule) for rule in (ALL, *RULES)}
        for rule, future in progress.track(each.items(), description="rules"):
            found[rule] = future.result()
            progress.console.print(f"{rule}: {found[rule]}")
    return found
