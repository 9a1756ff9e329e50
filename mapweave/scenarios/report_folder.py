"""A trial's folder: figures, page, pictures, trajectories, the merged map."""

import json
from pathlib import Path

import numpy as np

from mapweave.drawing.map_picture import DrawnDrive, MapPicture, draw_map, outline_of
from mapweave.evaluation.map_score import MapScore, is_false, score_map, write_tum
from mapweave.hybridmap.errors import InvalidFile
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import EdgeKind
from mapweave.hybridmap.pose import Pose2
from mapweave.scenarios.error_plot import draw_errors
from mapweave.scenarios.figures import Figures
from mapweave.scenarios.recording import Lost, TrialRecording, TrialTrajectory
from mapweave.scenarios.report_page import report_page
from mapweave.scenarios.score import TrialResult, node_truth
from mapweave.scenarios.trajectories import score_trajectory
from mapweave.storage.atomic_file import write_whole
from mapweave.storage.map_file import write_map_file

FIGURES = "figures.json"
"""Written last: where it is, the folder is whole."""
OWN = ("*.tum", "merged.mapweave", "map.png", "errors.png", "report.md", "scenario.toml", FIGURES)
"""What is written here; of these, an earlier trial's are removed first."""


def write_folder(out: Path, trial: TrialResult, scenario_text: str) -> None:
    """Write everything that a trial measured; a crash leaves whole files only, and no `figures.json`.

    | file | what |
    |---|---|
    | `figures.json` | `scenario`, `seed`, `passed`, `figures`, `verdicts` |
    | `report.md` | the same to be read, with pictures and what happened |
    | `map.png` | the merged map over the floor plan |
    | `errors.png` | position error over time |
    | `scenario.toml` | the scenario, to run it again |
    | `merged.mapweave` | the merged map |
    | `r0.truth.tum` | the robot's true trajectory, in world |
    | `r0.map-1.tum` | its estimate in its map of epoch 1, in that map's frame |
    | `r0.nodes.tum` | its places in the merged map, each component aligned with the world |

    Args:
        out: the folder; it is made. A `film.webm` in it is mentioned and left alone.
        trial: what came of it.
        scenario_text: the scenario's file.

    Raises:
        InvalidFile: the disk does not take it.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        for old in (path for pattern in reversed(OWN) for path in out.glob(pattern)):
            old.unlink()
        _write_all(out, trial, scenario_text)
    except OSError as error:
        raise InvalidFile(f"{out}: the report cannot be written ({error.strerror})") from None


def _write_all(out: Path, trial: TrialResult, scenario_text: str) -> None:
    recording, figures, verdicts = trial.recording, trial.figures, trial.verdicts
    whole, truth = HybridMap(recording.merged.changes), node_truth(recording)
    poses = {n: (c, p.mean) for n, (c, p) in recording.merged.poses.items()}
    links = [e for e in whole.edges.values() if e.kind is EdgeKind.MERGED]
    merged = score_map(poses, links, truth)
    places = {n: merged.world_from_component[c] @ p for n, (c, p) in poses.items() if n in truth}
    scores = {}
    for robot, record in recording.robots.items():
        _write_tum(out / f"{robot}.truth.tum", record.truth)
        _write_tum(out / f"{robot}.nodes.tum", _node_trajectory(whole, places, robot))
        for map_id, estimate in record.estimates.items():
            if len(estimate.stamps_ns):
                _write_tum(out / _estimate_name(map_id), estimate)
                scores[map_id] = score_trajectory(record.truth, estimate)
    write_map_file(out / "merged.mapweave", recording.merged)
    write_whole(out / "scenario.toml", scenario_text.encode())
    draw_map(_map_picture(recording, figures, whole, places, truth, merged), out / "map.png")
    draw_errors(scores, recording.moments, recording.lost, out / "errors.png")
    files = {m: (f"{m.agent}.truth.tum", _estimate_name(m)) for m in scores}
    page = report_page(recording, figures, verdicts, files, (out / "film.webm").exists())
    write_whole(out / "report.md", page.encode())
    write_whole(out / FIGURES, f"{json.dumps(trial.as_dict(), indent=2, allow_nan=False)}\n".encode())


def _map_picture(
    recording: TrialRecording,
    figures: Figures,
    whole: HybridMap,
    places: dict[NodeId, Pose2],
    truth: dict[NodeId, Pose2],
    merged: MapScore,
) -> MapPicture:
    ate = "-" if figures.merged_ate_m is None else f"{figures.merged_ate_m:.3f} m"
    recall = "-" if figures.link_recall is None else f"{figures.link_recall:.0%}"
    parts = "1 component" if merged.components == 1 else f"{merged.components} components"
    title = (
        f"{recording.scenario}, seed {recording.seed}: {figures.nodes} nodes, {parts}, {merged.links} links "
        f"({merged.false_links} false, recall {recall}), ATE {ate}"
    )
    starts = {
        name: Pose2.from_vector(r.truth.poses[0])
        for name, r in recording.robots.items()
        if len(r.truth.poses)
    }
    with_truth = [e for e in whole.edges.values() if e.a in truth and e.b in truth]
    return MapPicture(
        title=title,
        poses=places,
        edges=list(whole.edges.values()),
        outline=outline_of(recording.plan),
        drives=[_drive(lost, recording.robots[lost.robot].truth, truth) for lost in recording.lost],
        starts=starts,
        false=frozenset(e.id for e in with_truth if is_false(e, truth)),
    )


def _drive(lost: Lost, truth: TrialTrajectory, nodes: dict[NodeId, Pose2]) -> DrawnDrive:
    """Where a robot went from where it was put down, until it arrived."""
    last = int(truth.stamps_ns[-1]) if lost.arrived_ns is None else lost.arrived_ns
    # At the stamp itself it may still have been where it came from.
    during = (truth.stamps_ns > lost.stamp_ns) & (truth.stamps_ns <= last)
    goal = nodes.get(lost.goal) if lost.goal is not None else None
    return DrawnDrive(
        truth.poses[during, :2], lost.world_from_robot, goal, f"drive of {lost.robot}", lost.robot
    )


def _node_trajectory(whole: HybridMap, places: dict[NodeId, Pose2], robot: str) -> TrialTrajectory:
    """A robot's places in the order in which it saw them."""
    own = sorted((node for node in places if node.agent == robot), key=lambda n: (whole.nodes[n].stamp_ns, n))
    stamps = np.array([whole.nodes[node].stamp_ns for node in own], np.int64)
    return TrialTrajectory(stamps, np.array([places[node].vector for node in own]).reshape(-1, 3))


def _estimate_name(map_id: MapId) -> str:
    return f"{map_id.agent}.map-{map_id.epoch}.tum"


def _write_tum(path: Path, trajectory: TrialTrajectory) -> None:
    """No file for an empty one: others' tools do not take it."""
    if len(trajectory.stamps_ns):
        write_tum(path, trajectory.stamps_ns, trajectory.poses)
