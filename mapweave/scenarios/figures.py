"""The figures of a trial: what it measured, flat and ready for JSON."""

import math
import typing
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any

MORE_IS_BETTER = frozenset(
    {"link_precision", "link_recall", "explored_share", "longest_loop_m", "real_time_factor"}
)
"""Of the measured figures; all others are errors, times and bytes: less is better."""


@dataclass(frozen=True)
class RobotFigures:
    """One robot's share.

    Attributes:
        maps: that it began and that have nodes in the merged map.
        nodes: of these.
        trajectory_ate_m: of its worst map, see Figures; None if it never mapped.
        rpe_m: likewise; None if no map was driven for a metre.
        rpe_deg: likewise.
        collisions: how often it ran into something.
        map_bytes: of changes as they went over the wire.
        wire_bytes: of everything that it sent or received over the fleet's network.
        unsaved_changes: in its journal that the server does not have.
        map_hash: SHA-256 over its own maps as they would be sent.
    """

    maps: int
    nodes: int
    collisions: int
    map_bytes: int
    wire_bytes: int
    unsaved_changes: int
    map_hash: str
    trajectory_ate_m: float | None = None
    rpe_m: float | None = None
    rpe_deg: float | None = None


@dataclass(frozen=True)
class Figures:
    """Everything that a trial measured; None where a figure does not apply. Never "not a number".

    The *worst* of several lost robots is None as soon as one of them has no such figure: a missing result
    is no good result. A robot that never mapped does not count for the worst trajectory.

    Attributes:
        components: connected components of the merged map that hold nodes.
        maps: with nodes in the merged map (a robot that had to begin a new map has several).
        nodes: of the merged map.
        edges: within one map.
        false_edges: of these, off by more than 0.5 m or 15 degrees.
        loops: of the edges within one map, those found by recognising a place.
        false_loops: of the loops, off by more than 0.5 m or 15 degrees.
        longest_loop_m: the longest way that a robot drove before one of its true loops was closed, m; None
            without loops.
        explored_share: share of the robot-accessible floor within 1.5 m of a node with no wall between.
        links: between maps.
        false_links: of these, off by more than 0.5 m or 15 degrees.
        link_precision: share of the links that is not false; None without links.
        link_recall: share of the shared places that are linked, see
            `mapweave.evaluation.map_score.link_recall`; None where no two maps share a place.
        merged_ate_m: root mean square position error of the merged map's nodes after one planar alignment a
            component, m.
        trajectory_ate_m: absolute trajectory error by evo (APE, translation, RMSE) of what the robots
            estimated while mapping, after one planar alignment a map without scale; the worst map of all, m.
        rpe_m: relative pose error by evo (RPE, translation, RMSE) over 1 m of the true path; the worst, m.
        rpe_deg: likewise, rotation, degrees.
        collisions: of all robots.
        found: whether every lost robot was localized, by itself or the fleet: its first answer was right to
            0.25 m and 5 degrees. None if no robot was lost.
        found_error_m: of the worst first answer, m.
        found_error_deg: likewise, degrees.
        found_s: from the kidnapping to the first answer, the worst, simulated s.
        reached: whether every lost robot with a goal reported that it is there, and was within 0.05 m and 3
            degrees of where the goal's image was taken. None without goals.
        goal_error_m: of the worst such robot, where it arrived or was given up, m.
        goal_error_deg: likewise, degrees.
        goal_s: from the kidnapping to the arrival, the worst, simulated s.
        lies: ways in which a robot has lied; of the ways that cannot be found out none counts. None: no robot
            has lied.
        lies_not_contained: of these, those by which the others ended with other links, answers or poses.
        lies_not_named: of these, those of which neither page nor status says who lied.
        lies_moved_m: how far a node of the others moved at most, m.
        lies_answers_changed: answers to lost robots that became less, other or false, over all ways.
        troubles: how often the scenario did not go as it was meant to: something had not come true in time,
            or could not happen.
        unsaved_changes: changes in journals of robots that the server does not have.
        recovery_s: wall time from the return of a network, server or agent until all was well, the worst, s.
        bytes_per_node: bytes of changes on the wire over nodes of the merged map, edges included.
        map_bytes_per_robot_minute: bytes of changes, a robot and simulated minute.
        wire_bytes_per_robot_minute: bytes of everything on the fleet's network, likewise.
        map_hash: SHA-256 over the robots' hashes in order of their names.
        sim_s: simulated time, s.
        wall_s: how long that took, s.
        real_time_factor: `sim_s / wall_s`.
        robots: the same by robot.
    """

    components: int
    maps: int
    nodes: int
    edges: int
    false_edges: int
    loops: int
    false_loops: int
    links: int
    false_links: int
    collisions: int
    unsaved_changes: int
    troubles: int
    map_hash: str
    sim_s: float
    wall_s: float
    longest_loop_m: float | None = None
    explored_share: float | None = None
    link_precision: float | None = None
    link_recall: float | None = None
    merged_ate_m: float | None = None
    trajectory_ate_m: float | None = None
    rpe_m: float | None = None
    rpe_deg: float | None = None
    found: bool | None = None
    found_error_m: float | None = None
    found_error_deg: float | None = None
    found_s: float | None = None
    reached: bool | None = None
    goal_error_m: float | None = None
    goal_error_deg: float | None = None
    goal_s: float | None = None
    lies: int | None = None
    lies_not_contained: int | None = None
    lies_not_named: int | None = None
    lies_moved_m: float | None = None
    lies_answers_changed: int | None = None
    recovery_s: float | None = None
    bytes_per_node: float | None = None
    map_bytes_per_robot_minute: float | None = None
    wire_bytes_per_robot_minute: float | None = None
    real_time_factor: float | None = None
    robots: Mapping[str, RobotFigures] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """The figures for JSON."""
        table = asdict(self)
        # The key is an agent's name: to be found again by eye, whatever order the robots came in.
        table["robots"] = {name: table["robots"][name] for name in sorted(table["robots"])}
        return table


def kinds() -> dict[str, type]:
    """Name and type (int, float, bool or str) of each figure of a whole trial, in the order of the class."""
    hints = typing.get_type_hints(Figures)
    return {item.name: _kind(hints[item.name]) for item in fields(Figures) if item.name != "robots"}


def measured(value: float) -> float | None:
    """The value, or None if it is no number: JSON knows no NaN."""
    return float(value) if math.isfinite(value) else None


def as_text(value: float | str | None) -> str:
    """A figure for people: 4 significant digits, `yes` and `no`, a dash for what was not measured."""
    match value:
        case None:
            return "-"
        case bool():
            return "yes" if value else "no"
        case float():
            return f"{value:.4g}" if abs(value) < 1e4 else f"{value:.0f}"
        case _:
            return str(value)


def _kind(hint: Any) -> type:
    """The type behind `float | None`."""
    types = [kind for kind in (typing.get_args(hint) or (hint,)) if kind is not type(None)]
    return typing.cast(type, types[0])
