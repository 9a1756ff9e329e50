"""Fits how probable a recognised place is, and shows on other buildings whether it holds.

The fit goes into mapweave.mapserver.relocalization.calibration.

    python -m benchmarks.fit_belief [--seeds N ...] [--check N ...] [--nodes N] [--queries N] [--json]

Each place recognised in a view of simulated buildings, disturbed ones and twin rooms included, is right
or wrong by the truth. Weights are those of a logistic regression, by Newton's method, weakly pulled to zero.
"""

import argparse
import json
from itertools import pairwise

import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from benchmarks.relocalize.places import TruePlace, joined, mapped, mapped_sites
from benchmarks.relocalize.queries import KINDS, Query, known, nowhere, twins
from benchmarks.relocalize.score import RIGHT_DEG, RIGHT_M, errors
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Array
from mapweave.mapserver.relocalization.calibration import COEFFICIENTS, HypothesisSupport, probabilities
from mapweave.mapserver.relocalization.candidates import MOST_COMPARED, RetrievedNodes
from mapweave.mapserver.relocalization.place_hypotheses import supported
from mapweave.mapserver.relocalization.relocalizer import Relocalizer
from mapweave.mapserver.retrieval.place_index import PlaceIndex

PULL = 1.0
"""Of each weight to zero, as if by so many views."""
BINS = (0.0, 0.2, 0.5, 0.8, 0.95, 0.99, 1.0)


Seen = list[tuple[list[HypothesisSupport], list[bool]]]
"""The places that were recognised in each view, and whether the robot was there."""


def gather(seed: int, nodes: int, queries: int, bar: Progress) -> Seen:
    """Ask all kinds of views."""
    sites = mapped_sites(seed)
    task = bar.add_task(f"seed {seed}", total=nodes + (len(KINDS) + 2) * queries)

    def step() -> None:
        bar.advance(task)

    places = mapped(sites, nodes, seed, step)
    asked: list[Query] = []
    for kind in KINDS:
        asked += known(kind, queries, sites, places, seed, step)
    asked += twins(queries, sites, places, seed, step) + nowhere(queries, seed, step)
    truth: dict[NodeId, TruePlace] = {place.node.id: place for place in places}
    index = PlaceIndex()
    index.extend(place.node for place in places)
    relocalizer = Relocalizer(index, lambda node: truth[node].node, joined(places, seed))
    found: Seen = []
    for query in asked:
        ranked = index.query(query.picture.view, MOST_COMPARED)
        registration = relocalizer.registration.register(RetrievedNodes(query.picture.view, ranked))
        seen = relocalizer.selection.places(registration)
        off = [errors(query, truth.get(place.best.node), place.best_from_robot) for place in seen]
        found.append((supported(seen), [m <= RIGHT_M and deg <= RIGHT_DEG for m, deg in off]))
    bar.update(task, completed=nodes + (len(KINDS) + 2) * queries)
    return found


def fit(seen: Seen) -> Array:
    """(6,) weights of the largest posterior."""
    x = np.array([one.numbers for supports, _ in seen for one in supports])
    y = np.array([there for _, right in seen for there in right], dtype=np.float64)
    weights = np.zeros(x.shape[1])
    for _ in range(50):
        p = 1.0 / (1.0 + np.exp(-x @ weights))
        gradient = x.T @ (y - p) - PULL * weights
        hessian = (x * (p * (1 - p))[:, None]).T @ x + PULL * np.eye(len(weights))
        step = np.linalg.solve(hessian, gradient)
        weights += step
        if np.abs(step).max() < 1e-9:
            break
    return weights


def reliability(seen: Seen, weights: Array) -> list[dict[str, float]]:
    """For each bin of predicted probability: count, mean prediction, share that is right."""
    predicted = np.array([p for supports, _ in seen for p in probabilities(supports, weights.tolist())])
    true = np.array([there for _, right in seen for there in right], dtype=np.float64)
    rows = []
    for low, high in pairwise(BINS):
        inside = (predicted >= low) & ((predicted < high) | (high == 1.0))
        n = int(inside.sum())
        rows.append({
            "from": low, "to": high, "places": n,
            "predicted": float(predicted[inside].mean()) if n else float("nan"),
            "right": float(true[inside].mean()) if n else float("nan"),
        })  # fmt: skip
    return rows


def main() -> None:
    """Fit and check."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.fit_belief", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[100], help="that are learned from")
    parser.add_argument("--check", type=int, nargs="+", default=[0], help="on which it is shown")
    parser.add_argument("--nodes", type=int, nargs=2, default=[300, 1000], help="to learn, and to check")
    parser.add_argument("--queries", type=int, nargs=2, default=[60, 200], help="of each kind, likewise")
    parser.add_argument("--json", action="store_true", help="last line of output: one JSON object")
    arguments = parser.parse_args()
    if set(arguments.seeds) & set(arguments.check):
        parser.error("--check needs seeds that are not in --seeds")
    if min(arguments.seeds + arguments.check) < 0 or min(arguments.nodes) < 100 or min(arguments.queries) < 4:
        parser.error("at least 100 nodes, 4 queries and seeds that are not negative are needed")
    console = Console(stderr=arguments.json)
    (nodes, more_nodes), (queries, more_queries) = arguments.nodes, arguments.queries
    with Progress(console=console) as bar:
        learned = [one for seed in arguments.seeds for one in gather(seed, nodes, queries, bar)]
        weights, count = fit(learned), sum(len(right) for _, right in learned)
        wrong = count - sum(sum(right) for _, right in learned)
        console.print(f"{count} places, {wrong} wrong; weights", np.round(weights, 3).tolist())
        others = [one for seed in arguments.check for one in gather(seed, more_nodes, more_queries, bar)]
    shipped = np.array(COEFFICIENTS)
    rows = reliability(others, shipped)
    out = {
        "weights": np.round(weights, 4).tolist(), "shipped": list(COEFFICIENTS), "places": count,
        "fitted": reliability(others, weights), "as_shipped": rows,
    }  # fmt: skip
    title = f"shipped weights, {len(others)} other views"
    table = Table("predicted from", "to", "places", "predicted", "right", title=title)
    for row in rows:
        table.add_row(*(f"{value:.3g}" for value in row.values()))
    console.print(table)
    if arguments.json:
        print(json.dumps(out))
