"""The figures of a demo: `report.json`, and a table for people."""

from typing import Any

from rich.table import Table

from mapweave.scenarios.score import TrialResult


def report_of(trial: TrialResult) -> dict[str, Any]:
    """The report on a trial of the scenario `demo`, for JSON.

    Returns:
        Figures of the trial under their names there. `nodes` by robot. `relocalization`: whether the lost
        robot was `found`, error of the pose in the frame of the `node` that was named, and simulated s from
        the kidnapping to the answer. `goal`: whether it reports that it is parked at a `node` that another
        robot mapped (`mapped_by`), and the truth agrees to 5 cm and 3 degrees; error from where the node's
        image was taken; `edges` of the route; s from the kidnapping to the end.
    """
    recording, figures = trial.recording, trial.figures
    wall_s, sim_s = round(recording.wall["whole"], 2), round(recording.sim_s, 1)
    lost = recording.lost[-1] if recording.lost else None
    fix, goal = (None, None) if lost is None else (lost.fix, lost.goal)
    return {
        "seed": recording.seed,
        "agents": list(recording.robots),
        "nodes": {name: robot.nodes for name, robot in figures.robots.items()},
        "bytes_per_node": round(figures.bytes_per_node or 0.0, 1),
        "components": figures.components,
        "links": figures.links,
        "false_links": figures.false_links,
        "merged_ate_m": _rounded(figures.merged_ate_m, 4),
        "relocalization": {
            "found": fix is not None,
            "error_m": _rounded(figures.found_error_m, 4),
            "error_deg": _rounded(figures.found_error_deg, 3),
            "seconds": _rounded(figures.found_s, 1),
            "node": "" if fix is None else str(fix.node),
        },
        "goal": {
            "reached": bool(figures.reached),
            "error_m": _rounded(figures.goal_error_m, 4),
            "error_deg": _rounded(figures.goal_error_deg, 3),
            "mapped_by": "" if goal is None else goal.agent,
            "edges": 0 if lost is None else max(lost.legs - 1, 0),
            "node": "" if goal is None else str(goal),
            "seconds": _rounded(figures.goal_s, 1),
        },
        "collisions": figures.collisions,
        "lost_robot": "" if lost is None else lost.robot,
        "put_down_in": "" if lost is None else lost.room,
        "notes": [moment.text for moment in recording.moments if moment.trouble],
        "wall_s": wall_s,
        "sim_s": sim_s,
        "real_time_factor": round(sim_s / wall_s, 3),
    }


def summary_table(report: dict[str, Any]) -> Table:
    """The figures of a demo for people."""
    found, goal, ate = report["relocalization"], report["goal"], report["merged_ate_m"]
    where = (
        f"{report['lost_robot']} was put down in {report['put_down_in']}: " if report["lost_robot"] else ""
    )
    merged = f"{report['components']} component(s), {report['links']} links, {report['false_links']} false"
    rate = f"{report['real_time_factor']:.1f} x real time"
    table = Table(title="Three maps, one map, one lost robot found", show_header=False)
    table.add_column(justify="right", style="bold")
    table.add_column()
    table.add_row("nodes", ", ".join(f"{name} {count}" for name, count in report["nodes"].items()))
    table.add_row("bytes a node", f"{report['bytes_per_node']:.0f} on the wire, edges included")
    table.add_row("merged map", merged)
    table.add_row("merged ATE", "unknown" if ate is None else f"{ate:.3f} m")
    table.add_row("relocalization", where + _outcome(found["found"], found))
    table.add_row(
        "goal", f"node {goal['node']} over {goal['edges']} edges: {_outcome(goal['reached'], goal)}"
    )
    table.add_row("collisions", str(report["collisions"]))
    table.add_row("time", f"{report['sim_s']:.0f} s simulated in {report['wall_s']:.0f} s, {rate}")
    for note in report["notes"]:
        table.add_row("note", note)
    return table


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None else round(value, digits)


def _outcome(good: bool, off: dict[str, Any]) -> str:
    metres, degrees, seconds = off["error_m"], off["error_deg"], off["seconds"]
    if metres is None or degrees is None or seconds is None:
        return "no"
    return f"{'yes' if good else 'no'}, {metres:.3f} m and {degrees:.2f} deg off after {seconds:.0f} s"
