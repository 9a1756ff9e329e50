"""The benchmark of shards: its figures by hand, and a small run with a real cluster and a killed shard."""

import json
import tempfile
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from benchmarks.shards import benchmark
from benchmarks.shards.askers import IN_A_ROW, AnswerLog
from benchmarks.shards.benchmark import (
    KILLS,
    SHARED_KILLS,
    all_compared,
    good,
    in_json,
    main,
    not_killed,
    summary,
    unacknowledged,
)
from benchmarks.shards.fleet import BuildingFleet
from benchmarks.shards.shared_store import SharedStore, can_be_shared
from mapweave.mapserver.log.opening import open_store
from tests.programs import python

WITHOUT = "needs the extra `postgres` and Debian's package postgresql"


def test_recovery_by_hand():
    times = [1.0, 2.0, 2.1, 4.5, *(4.6 + 0.1 * k for k in range(IN_A_ROW))]
    tally = AnswerLog([(at, at not in (2.0, 2.1)) for at in times])
    assert tally.recovery(1.5) == pytest.approx(3.0)
    assert tally.whole(4.55) and not tally.whole(5.0)


@pytest.mark.parametrize("kind", ["primary", "front"])
def test_a_file_has_no_second_server_and_no_primary(kind: str, capsys):
    with pytest.raises(SystemExit):
        main(["--store", "sqlite", "--kills", "shard", kind])
    assert "with --store postgresql alone" in capsys.readouterr().err


def test_what_is_not_killed_is_said_with_the_reason():
    assert not_killed([*KILLS, *SHARED_KILLS], "postgresql") == {}
    assert not_killed(["worker", "primary"], "postgresql") == dict.fromkeys(
        ("shard", "gateway", "server", "head", "front"), "not in --kills"
    )
    for_want = not_killed(KILLS, "sqlite")
    assert {*for_want} == {"front", "primary"}
    assert all("a store in a file has one server and no primary" in why for why in for_want.values())


def test_maps_of_two_servers_are_as_good_as_the_worse(monkeypatch):
    rows = iter([
        {"links": 30, "same_links": True, "max_pose_difference_m": 0.0},
        {"links": 29, "same_links": False, "max_pose_difference_m": 0.25},
    ])  # fmt: skip
    monkeypatch.setattr(benchmark, "compared", lambda content, reference: next(rows))
    assert all_compared([None, None], None) == {  # type: ignore[arg-type, list-item]
        "links": 30, "same_links": False, "max_pose_difference_m": 0.25,
    }  # fmt: skip


@pytest.mark.parametrize(("change", "is_good"), [
    ({}, True),
    ({"lost": 1}, False),
    ({"wrong": 1}, False),
    ({"same_links": False}, False),
    ({"max_pose_difference_m": float("inf")}, False),
])  # fmt: skip
def test_it_is_good_if_nothing_is_lost_wrong_or_linked_otherwise(change: dict[str, object], is_good: bool):
    row = {"lost": 0, "wrong": 0, "same_links": True, "max_pose_difference_m": 0.0}
    rows = {"without": {"lost": 0, "wrong": 0}, "2 shards": row, "killed": {**row, **change}}
    report = summary(rows)
    assert good(report) is is_good
    number = None if "max_pose_difference_m" in change else 0.0
    assert (
        json.loads(in_json({**report, "sizes": rows}))["sizes"]["killed"]["max_pose_difference_m"] == number
    )


def test_robots_that_stay_unacknowledged_are_named():
    robots: Any = [
        SimpleNamespace(agent=name, acknowledged=lambda s, n=name: n == "r0") for name in ("r0", "r1")
    ]
    assert unacknowledged(robots) == {"r1"}


@pytest.mark.slow
def test_a_lost_primary_has_a_standby_with_all_that_was_stored(tmp_path):
    """The address names both machines: the standby is found by it."""
    if not can_be_shared():
        pytest.skip(WITHOUT)
    fleet = BuildingFleet(2, 4, 8963)
    # A socket's path is short.
    with tempfile.TemporaryDirectory() as place, SharedStore(Path(place)) as shared:
        address = shared.database()
        fleet.write(address, range(2))
        shared.lose_primary()
        store = open_store(address)
        assert {map_id for map_id, _ in (log[0] for log in fleet.logs)} == set(store.positions())
        for log in fleet.logs:
            assert len([*store.replay(log[0][0])]) == len(log)
        store.close()


@pytest.mark.slow
@pytest.mark.skipif(find_spec("ray") is None, reason="needs the extra cluster: Ray")
@pytest.mark.parametrize(("store", "kind"), [("sqlite", "shard"), ("postgresql", "primary")])
def test_a_small_run(store: str, kind: str):
    if store == "postgresql" and not can_be_shared():
        pytest.skip(WITHOUT)
    sizes = "--shards 2 --robots 4 --nodes 12 --seconds 1 --ray-nodes 2"
    arguments = f"{sizes} --store {store} --kills {kind} --seed 1 --json"
    run = python("-m", "benchmarks.shards", *arguments.split(), timeout=220)
    assert run.returncode == 0, run.stderr[-3000:]
    figures = json.loads(run.stdout)
    assert figures["store"] == store and {*figures["not_killed"]} == {*KILLS, *SHARED_KILLS} - {kind}
    assert figures["same_links"] and figures["max_pose_difference_m"] <= 0.001
    assert (figures["lost"], figures["wrong"]) == (0, 0)
    assert figures["sizes"]["2 shards"]["links"] > 20 and figures["sizes"]["2 shards"]["found"] > 10
    assert figures["sizes"]["killed"]["recovery_s"][kind] < 60.0
    assert 0.0 < figures["sizes"]["killed"]["acknowledged_s"][kind] < 60.0
