"""Fleets with one robot whose map has wrong geometry and true views: answers to lost robots then.

    python -m benchmarks.wrong_geometry [--runs N] [--kinds slip carried long turns] [--seed N] [--json]

Nothing is rendered (see `synthetic.wrong_geometry`). Three sound robots map a house; a fourth maps the same
house with one of four faults of its odometry. Lost robots then ask where they are: without the fourth robot's
map, with it, and with it while no map is looked for that has wrong geometry. The house may have two rooms
that look the same: answers there must not become more certain.
"""

import json
from collections import Counter
from itertools import product

from rich.console import Console
from rich.progress import Progress

from benchmarks.command_line import at_least, command_line, figure_table
from benchmarks.rules.switches import Switch, switched_off
from mapweave.merge.outlier_rejection.wrong_geometry import WrongGeometrySearch
from synthetic.wrong_geometry import (
    ODD,
    SCENES,
    AnswerOutcome,
    OdometryFault,
    draw_fleet,
    lost_views,
    outcome,
)

WITHOUT, WITH, UNSEARCHED = "without_the_map", "with_the_map", "rule_off"
NO_SEARCH: tuple[Switch, ...] = ((WrongGeometrySearch, "wrong", lambda *_: {}),)


def measured(
    seed: int, runs: int, kinds: list[str], scenes: list[str], queries: int, progress: Progress
) -> dict[str, dict[str, int]]:
    """Answers of each sort; fleets; those whose sound maps are in pieces; maps that are found wrong."""
    out: dict[str, Counter[str]] = {name: Counter() for name in (WITHOUT, WITH, UNSEARCHED)}
    task = progress.add_task("fleets", total=runs * len(kinds) * len(scenes))
    for name, run, kind in product(scenes, range(runs), kinds):
        fleet = draw_fleet(seed + run, SCENES[name], OdometryFault(kind))
        views = lost_views(fleet, SCENES[name], queries, seed + run)
        outcomes = {WITHOUT: outcome(fleet, views, frozenset({ODD})), WITH: outcome(fleet, views)}
        with switched_off(NO_SEARCH):
            outcomes[UNSEARCHED] = outcome(fleet, views)
        for way, one in outcomes.items():
            answers = {str(sort): one[str(sort)] for sort in AnswerOutcome}
            out[way].update(
                answers | {"fleets": 1, "in_pieces": int(one["parts"] > 1), "found": len(one["found"])}
            )
        progress.advance(task)
    return {way: dict(figures) for way, figures in out.items()}


def main() -> None:
    """Run and print."""
    parser = command_line("wrong_geometry", __doc__, "of the first fleet")
    faults = [str(one) for one in OdometryFault if one is not OdometryFault.NONE]
    parser.add_argument(
        "--runs", type=at_least(1), default=3, help="fleets of each kind and scene (default 3)"
    )
    parser.add_argument("--kinds", nargs="+", default=faults, choices=faults)
    parser.add_argument("--scenes", nargs="+", default=["room", "house"], choices=list(SCENES))
    parser.add_argument(
        "--queries", type=at_least(1), default=24, help="of lost robots, each fleet (default 24)"
    )
    arguments = parser.parse_args()
    console = Console(stderr=arguments.json)
    with Progress(console=console) as progress:
        found = measured(
            arguments.seed, arguments.runs, arguments.kinds, arguments.scenes, arguments.queries, progress
        )
    console.print(figure_table(found, "three sound robots and one with a fault"))
    if arguments.json:
        print(json.dumps({"seed": arguments.seed, "runs": arguments.runs, **found}))
