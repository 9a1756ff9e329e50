"""Simulated trials whose maps are merged once more with all rules, and without each."""

import tempfile
from collections import Counter
from pathlib import Path

from benchmarks.merge_sim.benchmark import SCENARIOS
from benchmarks.merge_sim.run import false_merges
from benchmarks.rules.switches import TRIAL_RULES, by_rule
from mapweave.evaluation.map_score import is_false
from mapweave.hybridmap.change import ChangeBody, EdgePut, NodePut
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.node import EdgeKind
from mapweave.mapserver.merging.merger import Merger
from mapweave.scenarios.run import TrialOptions, run_trial
from mapweave.scenarios.scenario import load_scenario, scenario_path
from mapweave.scenarios.score import node_truth


def trial(name: str, seed: int) -> dict[str, dict[str, int]]:
    """Run a scenario of `benchmarks.merge_sim`, then merge its maps with all rules, and without each.

    Raises:
        MapweaveError: the trial could not be run.
    """
    scenario, *overrides = SCENARIOS[name]
    loaded = load_scenario(scenario_path(scenario), [one for one in overrides if one != "--set"])
    with tempfile.TemporaryDirectory() as folder:
        options = TrialOptions(seed, Path(folder), processes=False, film_every=0.0, quiet=True)
        recording = run_trial(loaded, options).recording
    truth = node_truth(recording)
    log = _own_changes(HybridMap(recording.merged.changes))
    first = Merger()
    first.read(log)
    first.merged()
    findings = first.findings()

    def merged() -> dict[str, int]:
        merger = Merger()
        merger.recollect(findings)
        merger.read(log)
        found = merger.merged()
        poses = {node: (one.component, one.merged_from_robot.mean) for node, one in found.poses.items()}
        return {
            "links": len(found.links),
            "false_links": sum(is_false(link.edge(), truth) for link in found.links),
            "false_merges": false_merges(poses, truth),
            "components": len(found.components),
        }

    return by_rule(TRIAL_RULES, merged)


def _own_changes(whole: HybridMap) -> list[tuple[MapId, ChangeBody]]:
    """The robots' logs, without the results of the merge."""
    out: list[tuple[MapId, ChangeBody]] = [
        (node.id.map, NodePut(node)) for _, node in sorted(whole.nodes.items())
    ]
    edges = (edge for _, edge in sorted(whole.edges.items()) if edge.kind is not EdgeKind.MERGED)
    return out + [(MapId(edge.id.agent, edge.id.epoch), EdgePut(edge)) for edge in edges]


def total(trials: list[dict[str, dict[str, int]]]) -> dict[str, dict[str, int]]:
    """Sums over trials, by rule."""
    out: dict[str, Counter[str]] = {}
    for one in trials:
        for rule, figures in one.items():
            out.setdefault(rule, Counter()).update(figures)
    return {rule: dict(figures) for rule, figures in out.items()}
