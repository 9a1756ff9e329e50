"""Merging with false links, by every way there is: who keeps the true ones, and how far off the map then is.

    python -m benchmarks.merge [--seed N] [--runs N] [--g2o FILE ...] [--split N]
        [--robots FOLDER ...] [--json]
    python -m benchmarks.merge --scale [NODES ...] [--seed N] [--json]

Synthetic fleets of four robots (see `synthetic.fleet`) with 0, 50, 80 and 90 % false links, `--runs`
of each. `ate_ratio`: error of all nodes after one alignment of the whole fleet over that of plain least
squares which knows the true links, median; a robot that is left apart counts with where its own map is, so
that one fleet of twenty that stays in two pieces decides the mean (`ate_ratio_mean`).
`link_precision` and `link_recall` are means; `whole`, `good` and `joined_falsely` are the shares of fleets
that became one map, whose ratio is at most 1.1, and in which robots are joined by no true link. False links
come in sets of up to four that agree with each other; under `independent` are the same figures where each is
false for itself, as is usual in the literature. Side by side: plain least squares, graduated non-convexity
alone (GNC), pairwise consistency alone (PCM), the two together, and Mapweave.

Drives through a city of square blocks (see `synthetic.city`), and with `--g2o FILE` the graphs in
files, are split among `--split` robots and merged: `cost_ratio` is the chi-square of all edges, refused ones
too, over that of GTSAM's batch optimum; null where the graph ended in pieces. With `--robots FOLDER`, which
holds one g2o file of a graph in space for each robot: how many links between robots there are, and which of
them pairwise consistency keeps, as pairs of keys.

With `--scale` only that is measured: fleets of maps of 100 nodes (see `benchmarks.merge.scale`), and by the
number of nodes what a new node costs, verification included, and a merge: median and 95th percentile in ms by
the clock, of the processor on average, the memory held, and what came out. 1000 nodes take about two minutes
on a quiet machine, 100000 much longer.
"""

import argparse
import json
import os
import statistics
import time
from collections.abc import Sequence
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from benchmarks.command_line import at_least, command_line, failing_in_one_line
from benchmarks.merge.robots import kept_links
from benchmarks.merge.scale import scale
from mapweave.formats.g2o import G2oGraph, read_g2o
from mapweave.hybridmap.errors import InvalidValue
from synthetic.city import HEADING_SIGMAS, draw_grid
from synthetic.fleet import FleetSettings, draw_fleet
from synthetic.merge_rivals import MAPWEAVE, RIVALS, error, joined_falsely, oracle, precision_recall
from synthetic.pose_graph import batch_optimum, chi2_of, factors_of, split

SHARES = (0, 50, 80, 90)
"""Of false links, per cent."""
SIZES = (300, 1000)
"""Nodes of fleets at scale, unless others are asked for."""
GRID_NODES = 400
"""Of the drives through a city."""
GOOD = 1.1
"""An `ate_ratio` that is as good as knowing the true links."""
Figures = dict[str, dict[str, float | None]]
"""By figure, then by the share of false links or the file."""


def main() -> None:
    """Merge, compare and print."""
    arguments = _arguments()
    console = Console(stderr=arguments.json)
    with failing_in_one_line("merge"):
        if arguments.scale is not None and (arguments.g2o or arguments.robots):
            raise InvalidValue("--scale runs by itself: leave out --g2o and --robots")
        if arguments.scale is not None:
            _scale(arguments, console)
            return
        # Unreadable files are reported before the long work.
        folders = {str(folder): kept_links(folder) for folder in arguments.robots}
        graphs = {path.stem: read_g2o(path) for path in arguments.g2o}
        with Progress(console=console) as progress:
            found = with_false_links(arguments.seed, arguments.runs, FleetSettings(), progress)
            alone = FleetSettings(most_alike=1)
            independent = with_false_links(arguments.seed, arguments.runs, alone, progress)
            for k, (title, sigma) in enumerate(HEADING_SIGMAS.items()):
                city = draw_grid(GRID_NODES, sigma, np.random.default_rng([arguments.seed, k]))
                graphs.setdefault(title, city)
            for title, graph in graphs.items():
                for name, figures in standard_set(title, graph, arguments.split, progress).items():
                    for figure, value in figures.items():
                        found[name].setdefault(figure, {})[title] = value
    for figure in found[MAPWEAVE]:
        console.print(_table(figure, found))
    for figure in independent[MAPWEAVE]:
        console.print(_table(figure, independent, ", each false link for itself"))
    for folder, (links, kept) in folders.items():
        console.print(f"{folder}: {len(kept)} of {len(links)} links between robots are kept")
    if arguments.json:
        spatial = {
            "robots": {
                folder: {"links": len(links), "kept": len(kept), "kept_links": kept}
                for folder, (links, kept) in folders.items()
            }
        }
        out = {
            "seed": arguments.seed,
            "runs": arguments.runs,
            **_with_rivals(found),
            "independent": _with_rivals(independent),
            **spatial,
        }
        print(json.dumps(out))


def _scale(arguments: argparse.Namespace, console: Console) -> None:
    with Progress(console=console) as progress:
        found = scale(arguments.scale or SIZES, arguments.seed, progress)
    sizes = list(next(iter(found.values())))
    table = Table("", *(f"{size} nodes" for size in sizes), title="the merge at scale")
    for figure, values in found.items():
        table.add_row(figure, *(f"{values[size]:.4g}" for size in sizes))
    console.print(table)
    if arguments.json:
        print(json.dumps({"seed": arguments.seed, "scale": found}))


def _with_rivals(found: dict[str, Figures]) -> dict[str, object]:
    """Mapweave's figures, and those of its rivals beside them."""
    return {**found[MAPWEAVE], "rivals": {name: f for name, f in found.items() if name != MAPWEAVE}}


def with_false_links(seed: int, runs: int, settings: FleetSettings, progress: Progress) -> dict[str, Figures]:
    """The figures of each rival by the share of false links."""
    task = progress.add_task(
        f"false links, up to {settings.most_alike} alike", total=len(SHARES) * runs * len(RIVALS)
    )
    found: dict[str, Figures] = {name: {} for name in RIVALS}
    for share in SHARES:
        rows: dict[str, list[tuple[float, ...]]] = {name: [] for name in RIVALS}
        for run in range(runs):
            fleet = draw_fleet(share / 100.0, np.random.default_rng([seed, run, share]), settings)
            best = error(oracle(fleet), fleet.truth)
            for name, merge in RIVALS.items():
                began = time.perf_counter()
                merged = merge(fleet.maps, fleet.links)
                took = 1e3 * (time.perf_counter() - began)
                ratio = error(merged, fleet.truth) / best
                outcome = len(merged.components) == 1, ratio <= GOOD, joined_falsely(merged, fleet)
                links = precision_recall(merged.links, fleet)
                rows[name].append((ratio, *links, *(float(one) for one in outcome), took))
                progress.advance(task)
        for name, values in rows.items():
            ratios, precisions, recalls, wholes, goods, falsely, times = zip(*values, strict=True)
            for figure, value in (
                ("ate_ratio", statistics.median(ratios)),
                ("ate_ratio_mean", statistics.mean(ratios)),
                ("link_precision", statistics.mean(precisions)),
                ("link_recall", statistics.mean(recalls)),
                ("whole", statistics.mean(wholes)),
                ("good", statistics.mean(goods)),
                ("joined_falsely", statistics.mean(falsely)),
                ("merge_ms", statistics.median(times)),
            ):
                found[name].setdefault(figure, {})[str(share)] = round(value, 4)
    return found


def standard_set(
    title: str, graph: G2oGraph, robots: int, progress: Progress
) -> dict[str, dict[str, float | None]]:
    """How much more than GTSAM's batch optimum each rival's merge of a split graph costs."""
    factors = factors_of(graph)
    best = batch_optimum(graph)
    maps, links, nodes = split(graph, robots)
    task = progress.add_task(title, total=len(RIVALS))
    found: dict[str, dict[str, float | None]] = {}
    for name, merge in RIVALS.items():
        merged = merge(maps, links)
        chi2 = chi2_of(factors, merged, nodes)
        found[name] = {
            "cost_ratio": None if chi2 is None else round(chi2 / best, 6),
            "links_kept": round(len(merged.links) / len(links), 4),
            "optimum": round(best, 4),
        }
        progress.advance(task)
    return found


def _table(figure: str, found: dict[str, Figures], of_what: str = "") -> Table:
    columns: Sequence[str] = list(found[MAPWEAVE][figure])
    table = Table("", *(f"{c} %" if c.isdigit() else c for c in columns), title=figure + of_what)
    for name, figures in found.items():
        values = [figures[figure][column] for column in columns]
        table.add_row(name, *("in pieces" if value is None else f"{value:.4g}" for value in values))
    return table


def _arguments() -> argparse.Namespace:
    parser = command_line("merge", __doc__, "of the fleets")
    parser.add_argument("--runs", type=at_least(1), default=5, help="fleets of each share (default 5)")
    parser.add_argument(
        "--g2o", type=Path, nargs="*", default=[], help="planar pose graphs to split and merge"
    )
    parser.add_argument(
        "--split", type=at_least(2), default=4, help="robots among which they are split (default 4)"
    )
    parser.add_argument("--robots", type=Path, nargs="*", default=[], help="folders of one g2o file a robot")
    parser.add_argument(
        "--scale",
        type=int,
        nargs="*",
        help="nodes of fleets at scale, in hundreds (300 1000); by itself",
    )
    return parser.parse_args()
