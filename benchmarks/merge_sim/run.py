"""One run of `benchmarks.merge_sim`, as a process of its own: a trial, then what its merged map is worth.

    python -m benchmarks.merge_sim.run SCENARIO SEED [--set KEY=VALUE ...]

Prints one JSON object. It is a process so that a run that is killed, or runs out of memory, is one run less.
"""

import argparse
import json
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from pathlib import Path

import numpy as np

from mapweave.evaluation.map_score import FALSE_LINK, FALSE_LINK_TURN, align, pose_error
from mapweave.hybridmap.errors import MapweaveError
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.scenarios.run import TrialOptions, run_trial
from mapweave.scenarios.scenario import Scenario, load_scenario, scenario_path
from mapweave.scenarios.score import node_truth


@dataclass(frozen=True)
class MergeRun:
    """What one run has come to.

    Attributes:
        scenario: its name.
        seed: of everything.
        nodes: of the merged map.
        maps: that have nodes.
        components: of the merged map.
        merged_ate_m: root mean square error of the nodes after one rigid alignment a component, m.
        links: between maps.
        false_links: of these, off by more than 0.5 m or 15 degrees.
        false_merges: pairs of maps in one component that stand to each other wrongly, by as much.
        link_recall: as `mapweave sim run` has it: share of the chances to join a node's place to another
            map's that are taken; None without any.
        sim_s: simulated time, s.
        wall_s: how long that took, s.
    """

    scenario: str
    seed: int
    nodes: int
    maps: int
    components: int
    merged_ate_m: float | None
    links: int
    false_links: int
    false_merges: int
    link_recall: float | None
    sim_s: float
    wall_s: float


def run_one(scenario: Scenario, seed: int, out: Path) -> MergeRun:
    """Simulate and score.

    Raises:
        MapweaveError: the trial could not be run.
    """
    trial = run_trial(scenario, TrialOptions(seed, out, processes=False, film_every=0.0, quiet=True))
    recording, figures = trial.recording, trial.figures
    truth = node_truth(recording)
    return MergeRun(
        scenario=scenario.name,
        seed=seed,
        nodes=figures.nodes,
        maps=figures.maps,
        components=figures.components,
        merged_ate_m=figures.merged_ate_m,
        links=figures.links,
        false_links=figures.false_links,
        false_merges=false_merges(
            {node: (component, pose.mean) for node, (component, pose) in recording.merged.poses.items()},
            truth,
        ),
        link_recall=figures.link_recall,
        sim_s=figures.sim_s,
        wall_s=round(figures.wall_s, 1),
    )


def false_merges(poses: Mapping[NodeId, tuple[int, Pose2]], truth: Mapping[NodeId, Pose2]) -> int:
    """How many pairs of maps are joined wrongly.

    The part of a map in a component is laid over the truth by itself. Two maps in one component are joined
    wrongly if a node of the one, laid over the truth with its own map and with the other's, is off by more
    than 0.5 m or 15 degrees: the median of both maps' nodes decides.

    Args:
        poses: component and merged pose of each node.
        truth: `world_from_robot` of each.
    """
    parts: dict[int, dict[MapId, list[NodeId]]] = {}
    for node, (component, _) in sorted(poses.items()):
        if node in truth:
            parts.setdefault(component, {}).setdefault(node.map, []).append(node)
    wrong: set[tuple[MapId, MapId]] = set()
    for maps in parts.values():
        laid = {one: _world_from_merged(nodes, poses, truth) for one, nodes in maps.items()}
        for one, other in combinations(sorted(maps), 2):
            off = [
                pose_error(laid[one] @ poses[node][1], laid[other] @ poses[node][1])
                for node in (*maps[one], *maps[other])
            ]
            metres, turn = np.median(np.array(off), axis=0)
            if metres > FALSE_LINK or turn > FALSE_LINK_TURN:
                wrong.add((one, other))
    return len(wrong)


def _world_from_merged(
    nodes: Sequence[NodeId],
    poses: Mapping[NodeId, tuple[int, Pose2]],
    truth: Mapping[NodeId, Pose2],
) -> Pose2:
    if len(nodes) == 1:
        return truth[nodes[0]] @ poses[nodes[0]][1].inverse()
    estimated: Array = np.array([[poses[n][1].x, poses[n][1].y] for n in nodes])
    return align(estimated, np.array([[truth[n].x, truth[n].y] for n in nodes]))


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.merge_sim.run", description=__doc__.splitlines()[0]
    )
    parser.add_argument("scenario", help="a .toml file, or a name from `mapweave sim list`")
    parser.add_argument("seed", type=int, help="of everything")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="overrides")
    arguments = parser.parse_args()
    try:
        scenario = load_scenario(scenario_path(arguments.scenario), arguments.overrides)
        with tempfile.TemporaryDirectory() as folder:
            run = run_one(scenario, arguments.seed, Path(folder))
    except MapweaveError as problem:
        print(problem, file=sys.stderr)
        raise SystemExit(1) from None
    print(json.dumps(asdict(run), allow_nan=False))


if __name__ == "__main__":
    main()
