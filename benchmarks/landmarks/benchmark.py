"""What a node's landmarks cost on the wire, and how many matches they keep, beside other ways to keep a view.

    python -m benchmarks.landmarks [--images DIR] [--pairs N] [--places N] [--seed N] [--json]

Pairs of views of the same thing: of a folder of photographs of one scene (a match is right if it agrees with
the others on one fundamental matrix), or, without one, images that no table was trained on under known warps,
and simulated rooms (there it is right if it is). At most 150 features a view, chosen as robots choose them;
all ways keep the same ones, except ORB, which has its own, and JPEG, after which they are detected again.

`bytes_per_node` is a whole node on the wire, framing included, at 150 landmarks;
`inliers_ratio_to_float_sift` the right matches as a share of those that SIFT in floats (RootSIFT, the same
matcher) has on the same pairs; `pairs_matched_ratio` the pairs with at least 15 right matches as a share of
those of SIFT in floats.

Then, in simulated places, how often a view from up to half a metre and 20 degrees away is recognised, and its
pose right within 0.25 m and 5 degrees, over what the node may cost (`--places 0` leaves it out).
"""

import argparse
import json
import os
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

# numpy reads it when it is imported. One thread for algebra and images, as in Mapweave's own processes.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from benchmarks.command_line import at_least, command_line, failing_in_one_line
from benchmarks.landmarks.curve import LABELS, recall_curve
from benchmarks.landmarks.pairs import Pair, folder_pairs, known_pairs
from benchmarks.landmarks.rivals import MOST, Packed, features, keep_all, matched, pack
from mapweave.hybridmap.errors import InvalidFile

LEAST_RIGHT = 15
"""Right matches that make a pair count as matched."""

FLOAT, OURS = "float sift", "ours"


@dataclass(eq=False)
class KeptMatches:
    """What one way has kept, over pairs.

    Attributes:
        right: right matches, for each pair.
        matches: all matches, for each pair.
        sizes: of the view that was kept, bytes.
        sources: of the pairs.
    """

    right: list[int] = field(default_factory=list)
    matches: list[int] = field(default_factory=list)
    sizes: list[int] = field(default_factory=list)
    sources: list[str] = field(default_factory=list)


def measure(pairs: Iterable[Pair], seed: int) -> tuple[dict[str, KeptMatches], list[Packed]]:
    """Keep all views in all ways, and match."""
    rng = np.random.default_rng([seed, 3])
    tallies: dict[str, KeptMatches] = {}
    nodes: list[Packed] = []
    for pair in pairs:
        found = [features(image, pair.camera) for image in (pair.first, pair.second)]
        if any(len(pixels) == 0 for pixels, _ in found):
            continue
        packed = pack(*found[0], pair, rng)
        nodes.append(packed)
        for name, (first, second) in keep_all(pair, packed, found).items():
            tally = tallies.setdefault(name, KeptMatches())
            matches, right = matched(name, pair, first, second)
            tally.right.append(right)
            tally.matches.append(matches)
            tally.sizes.append(first.size)
            tally.sources.append(pair.source)
    return tallies, nodes


def figures(tallies: dict[str, KeptMatches]) -> dict[str, dict[str, float]]:
    """Each way beside SIFT in floats, on the pairs that that one matches."""
    best = np.array(tallies[FLOAT].right)
    good = best >= LEAST_RIGHT
    out = {}
    for name, tally in tallies.items():
        right, matches = np.array(tally.right), np.array(tally.matches)
        out[name] = {
            "bytes": round(float(np.mean(tally.sizes)), 1),
            "inliers_ratio": round(float(right[good].sum() / best[good].sum()), 4),
            "pairs_matched_ratio": round(float((right >= LEAST_RIGHT).sum() / good.sum()), 4),
            "precision": round(float(right[good].sum() / max(matches[good].sum(), 1)), 4),
        }
    return out


def node_figures(nodes: list[Packed]) -> dict[str, Any]:
    """What our nodes cost. Where no view shows 150 features, 150 average landmarks are added to the rest."""
    each = sum(n.landmark_bytes for n in nodes) / sum(n.landmarks for n in nodes)
    full = [n.size for n in nodes if n.landmarks == MOST]
    reckoned = [n.size - n.landmark_bytes + MOST * n.landmark_bytes / n.landmarks for n in nodes]
    sizes = full or reckoned
    return {
        "bytes_per_node": round(float(np.mean(sizes)), 1),
        "bytes_per_node_most": round(float(np.max(sizes)), 1),
        "nodes_of_150": len(full),
        "bytes_per_landmark": round(each, 3),
        "encode_ms": round(float(np.median([n.encode_ms for n in nodes])), 3),
        "decode_ms": round(float(np.median([n.decode_ms for n in nodes])), 3),
    }


def run(arguments: argparse.Namespace, console: Console) -> dict[str, Any]:
    """All figures.

    Raises:
        InvalidFile: the folder has no photographs that show the same.
    """
    if arguments.images is not None:
        pairs: Iterable[Pair] = folder_pairs(arguments.images, arguments.seed, arguments.pairs)
        total = len(list(pairs))
    else:
        pairs, total = known_pairs(arguments.seed, arguments.pairs), arguments.pairs
    tallies, nodes = measure(track(pairs, "pairs", total=total, console=console), arguments.seed)
    if not tallies or max(tallies[FLOAT].right) < LEAST_RIGHT:
        shown = arguments.images or "pairs"
        raise InvalidFile(f"{shown}: no two views show the same, as far as SIFT can tell")
    by_way = figures(tallies)
    sources = sorted(set(tallies[OURS].sources))
    by_source = {source: figures(_of(tallies, source)) for source in sources if _matched(tallies, source)}
    result = {
        "seed": arguments.seed,
        "pairs": len(nodes),
        "pairs_of_float_sift": int((np.array(tallies[FLOAT].right) >= LEAST_RIGHT).sum()),
        **node_figures(nodes),
        "inliers_ratio_to_float_sift": by_way[OURS]["inliers_ratio"],
        "pairs_matched_ratio": by_way[OURS]["pairs_matched_ratio"],
        "ways": by_way,
        "by_source": {source: ways[OURS] for source, ways in by_source.items()},
    }
    if arguments.places:
        result["recall"] = recall_curve(arguments.seed, arguments.places, console)
    return result


def _of(tallies: dict[str, KeptMatches], source: str) -> dict[str, KeptMatches]:
    """The tallies of one kind of pairs."""
    out = {}
    for name, tally in tallies.items():
        those = [k for k, one in enumerate(tally.sources) if one == source]
        right, matches, sizes = ([c[k] for k in those] for c in (tally.right, tally.matches, tally.sizes))
        out[name] = KeptMatches(right, matches, sizes)
    return out


def _matched(tallies: dict[str, KeptMatches], source: str) -> bool:
    return max(_of(tallies, source)[FLOAT].right) >= LEAST_RIGHT


def show(result: dict[str, Any], console: Console) -> None:
    """Show the figures to people."""
    ways = Table("kept as", "bytes a view", "right matches", "pairs matched", "precision")
    for name, one in result["ways"].items():
        ways.add_row(
            name, f"{one['bytes']:.0f}", f"{one['inliers_ratio']:.1%}", f"{one['pairs_matched_ratio']:.1%}",
            f"{one['precision']:.1%}",
        )  # fmt: skip
    console.print(ways)
    for name in ("bytes_per_node", "bytes_per_node_most", "bytes_per_landmark", "encode_ms", "decode_ms"):
        console.print(f"{name:22} {result[name]:g}")
    for source, one in result["by_source"].items():
        console.print(f"{source:22} {one['inliers_ratio']:.1%} of the right matches")
    if "recall" in result:
        curve = Table("a node may cost", *LABELS.values(), title="recall")
        for size in next(iter(result["recall"].values())):
            curve.add_row(f"{size} bytes", *(f"{result['recall'][one][size]:.1%}" for one in LABELS))
        console.print(curve)


def main() -> None:
    """Run and print."""
    parser = command_line("landmarks", __doc__, "changes pairs and places", whole=True)
    parser.add_argument("--images", type=Path, metavar="DIR", help="photographs of one scene")
    parser.add_argument("--pairs", type=at_least(2), default=60, help="of views, at most (default 60)")
    parser.add_argument(
        "--places", type=at_least(0), default=40, help="simulated, for the recall (default 40)"
    )
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    console = Console(stderr=arguments.json)
    with failing_in_one_line("landmarks"):
        result = run(arguments, console)
    show(result, console)
    if arguments.json:
        print(json.dumps(result))
