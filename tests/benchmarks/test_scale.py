"""The plan for many robots: its constants measured again, and its sums by another way."""

from dataclasses import replace

import pytest

from benchmarks.figures import scale
from benchmarks.figures.measurements import MEASUREMENTS
from benchmarks.figures.results import StoredResult, load
from benchmarks.figures.scale import costs_of, scale_page, site
from benchmarks.fleet.drives import drive
from mapweave import MapId, NodeId, Pose2
from mapweave.hybridmap.agent_status import AgentStatus, Status
from mapweave.hybridmap.change import Change, EdgePut
from mapweave.hybridmap.drive_statistics import DriveStatistics
from mapweave.hybridmap.mission_order import MissionKind, MissionOrder, MissionReport, MissionState
from mapweave.mapserver.log.entry import ReceivedChange
from mapweave.mapserver.log.sqlite_store import SqliteStore
from mapweave.wire.codec import encode_change
from mapweave.wire.messages import encode, encode_view


@pytest.fixture(scope="module")
def results() -> dict[str, StoredResult]:
    return {name: load(name) for name in MEASUREMENTS}


def test_bytes_are_those_of_today(tmp_path):
    node = NodeId("r0", 3, 17)
    doing = Status(
        "driving to the goal", "3 nodes to go", 17, 40, Pose2(1.25, -2.0, 0.5), False, "goto", node,
        Pose2(0.1, 0.0, 0.25), 5, progress=0.25, drive=DriveStatistics(4, 1, 1, 0),
        covariance=(0.25, 0.0, 0.25, 0.0625),
    )  # fmt: skip
    order = MissionOrder("7f3a9c", "r0", MissionKind.GO, 1_700_000_000_123_456_789, "anna", node, "kitchen")
    status = AgentStatus(doing, 1_700_000_000_123_456_789, "r0", 3, 2, 123_456, True, 15, battery=0.75)
    size = len(encode(status))
    assert (
        size
        <= scale.STATUS_BYTES
        <= len(encode(replace(status, mission=MissionReport(order, MissionState.RUNNING, 0.25))))
    )
    store, nodes, edges = SqliteStore(tmp_path / "s.sqlite"), 0, []
    for robot in range(4):
        tour, map_id, entries = drive(robot, 20, 731), MapId(f"r{robot}", 1), []
        for body in (body for stop in tour.changes for body in stop):
            message = encode_change(Change(map_id, len(entries) + 1, 10**18, body))
            entries.append(ReceivedChange.read(map_id, len(entries) + 1, message))
            edges += [len(message)] * isinstance(body, EdgePut)
        nodes += len(tour.changes)
        store.apply(map_id, 7, entries)
    store.close()
    assert (tmp_path / "s.sqlite").stat().st_size / nodes == pytest.approx(scale.DISK_BYTES, rel=0.2)
    assert sum(edges) / len(edges) == pytest.approx(scale.EDGE_BYTES, rel=0.1)
    assert len(encode_view(tour.view)) == pytest.approx(scale.QUESTION_BYTES, rel=0.1)


def test_the_sums_are_those_of_simulated_minutes(results: dict[str, StoredResult]):
    """One robot after the other, minute by minute, instead of by rates."""
    costs = costs_of(results)
    plan = site(costs)
    robots, minutes = scale.ROBOTS // scale.SITES, 60 * 24
    sent, nodes, answers = 0.0, 0, 0
    for robot in range(robots):
        maps = robot < robots * scale.MAPPING
        per_minute = 60 / scale.NODE_EVERY if maps else 0
        sent += per_minute * (costs["node_bytes"] + scale.EDGE_BYTES + 2 * scale.FRAME_BYTES)
        sent += 120 * (scale.STATUS_BYTES + scale.FRAME_BYTES) + scale.QUESTION_BYTES + scale.FRAME_BYTES
        nodes += int(per_minute) * minutes
        answers += minutes
    assert plan["robot_bps"] == pytest.approx(sent / robots / 60)
    assert plan["disk_day"] == pytest.approx(nodes * scale.DISK_BYTES)
    assert plan["answer_cores"] == pytest.approx(answers * costs["answer_s"] / 86_400)
    assert plan["compare_cores"] == pytest.approx(nodes * costs["compare_s"] / 86_400)
    assert plan["memory"] > plan["nodes"] * costs["kept_bytes"] > 0


def test_a_server_carries_the_largest_fleet_that_is_in_time(results: dict[str, StoredResult]):
    row = {"server_cpu": 0.5, "router_cpu": 0.1, "ack_p99_ms": 90.0}
    figures = {
        "agents": {"50": row, "1000": {**row, "ack_p99_ms": 400.0}, "2000": {**row, "ack_p99_ms": 9e3}}
    }
    costs = costs_of({**results, "fleet": replace(results["life"], figures=figures)})
    assert (costs["agents"], costs["carried"]) == (2000, 1000)
    assert costs["link_s"] == pytest.approx(0.6 / 2000)
    page = scale_page({**results, "fleet": replace(results["life"], figures=figures)})
    assert "| front servers | robots over that | 10 |" in page
    # A twentieth of 10 000 robots maps, a node every 10 s; of ten servers one compares all 50 a second.
    assert f"| new nodes × comparing | {50 * costs['compare_s']:.1f} |" in page
    assert f"| new nodes × comparing | {20 * 50 * costs['compare_s']:.0f} |" in page
    assert "| cores for merging, of the one that leads | share of a core | 0.4 |" in page
    late = {"agents": {"50": {**row, "ack_p99_ms": 501.0}}}
    page = scale_page({**results, "fleet": replace(results["life"], figures=late)})
    assert "| none of 50 was in time on that machine |" in page
    assert "| front servers | robots over that | not known |" in page
