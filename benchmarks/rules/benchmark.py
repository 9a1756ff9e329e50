"""What fails without each rule that rejects links, answers or frames.

    python -m benchmarks.rules --fleets N [--g2o FILE ...] [--seed N] [--json]
    python -m benchmarks.rules --twins N [--seed N] [--json]
    python -m benchmarks.rules --singles N [--seed N] [--json]
    python -m benchmarks.rules --trials SCENARIO ... [--runs N] [--seed N] [--json]
    python -m benchmarks.rules --places N [--seed N] [--json]
    python -m benchmarks.rules --loops N [--seed N] [--json]
    python -m benchmarks.rules --pairs N [--seed N] [--json]
    python -m benchmarks.rules --drives N [--seed N] [--json]

Each rule is switched off by itself, and the same is measured as with all rules. Fleets are those of
`benchmarks.merge`, 50, 80 and 90 % of their links false: how many are as good as least squares with the true
links alone (`good`), joined by no true link (`joined_falsely`), and how many false links are believed. Twins
are pairs of robots where another place may give as many links, which agree, as the right one. Singles are
pairs of robots with one true link, or that and a false one as strong. Graphs in files are split among four
robots: chi-square over the batch optimum. Trials are those of `benchmarks.merge_sim`; what their robots
mapped is merged once more without each rule. Places are those of `benchmarks.relocalize`: recall of near
views, and the share of views of twin rooms and of unknown buildings that are answered with a place.
Loops are those of one robot, 20, 50 and 80 % of them false, in a map of one piece and in one that was resumed
elsewhere three times: how many are believed, and the error of the map.
Pairs are nodes that are compared, of one place and of two that look alike: how many are linked, and wrongly.
Drives are explorations of offices, 90 s each; images or wheels are spoiled, and the drive is mapped with all
rules, and without those that the fault needs: how many edges are wrong, maps begun, ticks used.
"""

import json
import os
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from rich.console import Console
from rich.progress import Progress

from benchmarks.command_line import at_least, command_line, failing_in_one_line
from benchmarks.merge_sim.benchmark import SCENARIOS, SEEDS_APART
from benchmarks.relocalize.fleet import Bench
from benchmarks.relocalize.score import figures, wrong_by_kind
from benchmarks.rules.drives import TRIALS, drives
from benchmarks.rules.fleets import SHARES, fleets, public_graphs, single_links, twins
from benchmarks.rules.look_alikes import look_alikes
from benchmarks.rules.own_loops import own_loops
from benchmarks.rules.switches import (
    LOOP_RULES,
    MERGE_RULES,
    PLACE_RULES,
    RECOGNITION_RULES,
    SINGLE_RULES,
    by_rule,
)
from benchmarks.rules.trials import total, trial
from mapweave.formats.g2o import read_g2o
from mapweave.mapserver.relocalization.relocalizer import Relocalizer
from mapweave.mapserver.retrieval.place_index import PlaceIndex

ROBOTS = 4
"""Among which graphs in files are split."""
QUERIES = 200
"""Of each kind to lost robots."""


def places(seed: int, count: int, progress: Progress) -> dict[str, dict[str, Any]]:
    """Answers to lost robots on a map of so many real places."""
    bench = Bench(seed, count, QUERIES, progress)
    index = PlaceIndex()
    index.extend(list(bench.nodes(count)))

    def answers() -> dict[str, Any]:
        replies = bench.asked("questions", Relocalizer(index, bench.node, bench.merged))
        values = figures(replies)
        wanted = ("recall_at_1", "false_accept", "wrong_place", "ambiguous", "cpu_p50_ms")
        return {**{name: values[name] for name in wanted}, "wrong": wrong_by_kind(replies)}

    return by_rule(PLACE_RULES, answers)


def main() -> None:
    """Measure and print."""
    parser = command_line("rules", __doc__)
    parser.add_argument(
        "--fleets", type=at_least(0), default=0, metavar="N", help="of each share of false links"
    )
    parser.add_argument("--twins", type=at_least(0), default=0, metavar="N", help="pairs of robots")
    parser.add_argument(
        "--singles", type=at_least(0), default=0, metavar="N", help="pairs of robots with one link"
    )
    parser.add_argument("--g2o", type=Path, nargs="*", default=[], metavar="FILE", help="planar pose graphs")
    parser.add_argument("--trials", nargs="+", default=[], choices=list(SCENARIOS), metavar="SCENARIO")
    parser.add_argument("--runs", type=at_least(1), default=1, help="of each scenario (default 1)")
    parser.add_argument("--places", type=at_least(0), default=0, metavar="N", help="real ones on the map")
    parser.add_argument(
        "--loops", type=at_least(0), default=0, metavar="N", help="robots of each share of false loops"
    )
    parser.add_argument("--pairs", type=at_least(0), default=0, metavar="N", help="of nodes, of each kind")
    parser.add_argument("--drives", type=at_least(0), default=0, metavar="N", help="of each fault")
    arguments = parser.parse_args()
    console = Console(stderr=True)
    found: dict[str, Any] = {"seed": arguments.seed}
    with failing_in_one_line("rules"):
        graphs = {path.stem: read_g2o(path) for path in arguments.g2o}
        with Progress(console=console) as progress:
            if arguments.fleets:
                wanted = len(SHARES) * arguments.fleets * (1 + len(MERGE_RULES))
                task = progress.add_task("fleets", total=wanted)
                found["fleets"] = by_rule(
                    MERGE_RULES,
                    lambda: fleets(arguments.seed, arguments.fleets, lambda: progress.advance(task)),
                )
            if arguments.twins:
                found["twins"] = by_rule(MERGE_RULES, lambda: twins(arguments.seed, arguments.twins))
            if arguments.singles:
                found["singles"] = by_rule(
                    SINGLE_RULES, lambda: single_links(arguments.seed, arguments.singles)
                )
            if graphs:
                found["graphs"] = by_rule(MERGE_RULES, lambda: public_graphs(graphs, ROBOTS))
            if arguments.places:
                found["places"] = places(arguments.seed, arguments.places, progress)
            if arguments.loops:
                found["loops"] = by_rule(LOOP_RULES, lambda: own_loops(arguments.seed, arguments.loops))
            if arguments.pairs:
                found["pairs"] = by_rule(
                    RECOGNITION_RULES, lambda: look_alikes(arguments.seed, arguments.pairs)
                )
            if arguments.drives:
                wanted = arguments.drives * sum(1 + len(rules) for rules in TRIALS.values())
                task = progress.add_task("drives", total=wanted)
                found["drives"] = drives(arguments.seed, arguments.drives, lambda: progress.advance(task))
            task = progress.add_task("trials", total=len(arguments.trials) * arguments.runs)
            for name in arguments.trials:
                done = []
                for run in range(arguments.runs):
                    done.append(trial(name, SEEDS_APART * arguments.seed + run))
                    progress.advance(task)
                found.setdefault("trials", {})[name] = total(done)
    console.print_json(data=found)
    if arguments.json:
        print(json.dumps(found))
