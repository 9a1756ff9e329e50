"""Synthetic fleets merged with all rules, and without each."""

import statistics
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from mapweave.formats.g2o import G2oGraph
from mapweave.merge.merging import merge_maps
from synthetic.fleet import FleetSettings, draw_fleet
from synthetic.merge_rivals import error, joined_falsely, oracle, precision_recall
from synthetic.pose_graph import batch_optimum, chi2_of, factors_of, split

SHARES = (50, 80, 90)
"""Of false links, per cent."""
TWINS = FleetSettings(robots=2, nodes=40, true_links=8, most_alike=8)
"""Two robots with few links in a building in which another place may give as many."""
SINGLE = FleetSettings(robots=2, nodes=40, true_links=1, most_alike=1)
"""Two robots with one link."""
STRENGTH = 15, 90
"""Landmarks of links between views of one place from near and from far, and of as strong false ones."""
GOOD = 1.1
"""An error over that of least squares with the true links alone that is as good."""


def fleets(seed: int, count: int, step: Callable[[], None]) -> dict[str, dict[str, float]]:
    """What comes of so many fleets of each share of false links, by the share."""
    out = {}
    for share in SHARES:
        rows = []
        for run in range(count):
            fleet = draw_fleet(share / 100.0, np.random.default_rng([seed, run, share]), FleetSettings())
            merged = merge_maps(fleet.maps, fleet.links)
            ratio = error(merged, fleet.truth) / error(oracle(fleet), fleet.truth)
            _, recall = precision_recall(merged.links, fleet)
            false = sum(link.pair not in fleet.true for link in merged.links)
            rows.append((ratio <= GOOD, joined_falsely(merged, fleet), false, recall, ratio))
            step()
        good, falsely, false_links, recalls, ratios = zip(*rows, strict=True)
        out[str(share)] = {
            "good": sum(good),
            "joined_falsely": sum(falsely),
            "false_links": sum(false_links),
            "recall": round(statistics.mean(recalls), 4),
            "error_ratio_median": round(statistics.median(ratios), 4),
        }
    return out


def twins(seed: int, count: int) -> dict[str, int]:
    """What comes of so many pairs of robots, half of their links false and up to eight of these alike."""
    falsely = false = true = 0
    for run in range(count):
        fleet = draw_fleet(0.5, np.random.default_rng([seed, run]), TWINS)
        merged = merge_maps(fleet.maps, fleet.links)
        falsely += joined_falsely(merged, fleet)
        right = sum(link.pair in fleet.true for link in merged.links)
        true, false = true + right, false + len(merged.links) - right
    return {"fleets": count, "joined_falsely": falsely, "false_links": false, "true_links": true}


def single_links(seed: int, count: int) -> dict[str, int]:
    """What comes of so many pairs of robots with one true link, and of as many with a false one beside it."""
    out = {"fleets": count}
    for name, share in (("alone", 0.0), ("contradicted", 0.5)):
        rightly = falsely = 0
        for run in range(count):
            rng = np.random.default_rng([seed, run])
            fleet = draw_fleet(share, rng, SINGLE)
            links = [
                replace(link, evidence={**link.evidence, "inliers": float(rng.integers(*STRENGTH))})
                for link in fleet.links
            ]
            merged = merge_maps(fleet.maps, links)
            rightly += any(link.pair in fleet.true for link in merged.links)
            falsely += joined_falsely(merged, fleet)
        out |= {f"joined_{name}": rightly, f"joined_falsely_{name}": falsely}
    return out


def public_graphs(graphs: dict[str, G2oGraph], robots: int) -> dict[str, Any]:
    """Chi-square of each graph, split among robots and merged, over its batch optimum; null in pieces."""
    out = {}
    for name, graph in graphs.items():
        maps, links, nodes = split(graph, robots)
        chi2 = chi2_of(factors_of(graph), merge_maps(maps, links), nodes)
        out[name] = None if chi2 is None else round(chi2 / batch_optimum(graph), 6)
    return out
