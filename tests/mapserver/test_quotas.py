"""A robot that asks without end: it is refused, others are answered, and people see whose fault it is."""

import logging
from collections.abc import Iterator

import pytest

from mapweave.commands.status import cells
from mapweave.hybridmap.change import Change, NodeRetired
from mapweave.hybridmap.errors import Busy
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.nearby import NearbyRequest
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.query import KnownRequest, ReserveRequest
from mapweave.mapserver.admission_control import AdmissionControl, AdmissionSettings
from mapweave.mapserver.merge_worker import MergeWorker
from mapweave.mapserver.quotas import BURST, Quotas, QuotaSettings, TokenBucket
from mapweave.mapserver.schedule import LockstepSchedule
from mapweave.wire.messages import encode, encode_view
from mapweave.wire.senders import sent_by
from tests.mapserver.house import KEYS, ROBOT, House


@pytest.fixture(scope="module")
def house(mapped_room) -> Iterator[House]:
    house = House(mapped_room())
    yield house
    house.close()


def test_a_robot_asks_at_its_rate_in_the_long_run():
    bucket, allowed = TokenBucket(5.0, 0.0), 0
    for tick in range(10_000):
        now = tick * 0.01
        if bucket.wait(1.0, now) <= 0.0:
            bucket.spend(1.0, now)
            allowed += 1
    assert abs(allowed - 5.0 * (BURST + 100.0)) <= 1.0
    bucket.spend(50.0, 100.0)
    assert bucket.wait(1.0, 100.0) == pytest.approx(10.2, abs=0.21), "a debt is waited for"


def test_a_robot_that_asks_too_much_is_refused_and_shown_and_others_are_answered(house: House, caplog):
    asker, key = house.bus(), KEYS.any_known()
    around = encode(KnownRequest(ROBOT, 0.0, 0.0, 9.0))
    most = round(BURST * QuotaSettings().questions)
    with caplog.at_level(logging.WARNING):
        replies = [asker.ask(sent_by(key, "r7"), around, 20.0)[0] for _ in range(3 * most)]
    refused = [reply for reply in replies if reply.error]
    assert most <= len(replies) - len(refused) < 2 * most
    assert all(0.0 < reply.retry_after <= 1.0 for reply in refused)
    for other in (key, sent_by(key, "r8")):
        assert not asker.ask(other, around, 20.0)[0].error
    (entry,) = [entry for entry in house.person.status().robots if entry.robot == "r7"]
    assert entry.over_quota == cells(entry)[-1] == f"over its quota: {len(refused)} questions"
    assert "r7" in str(house.server.status()["over_quota"])
    lines = [record.message for record in caplog.records if "over its quota" in record.message]
    assert lines[0] == "r7 is over its quota: 1 question held back so far" and len(lines) < 12


def test_a_robot_reserves_and_says_where_it_is_for_itself_alone(house: House):
    asker = house.bus()
    start = NodeId(*ROBOT, 1)
    for_r8 = encode(ReserveRequest("r8", start, Pose2(), ()))
    (reply,) = asker.ask(sent_by(KEYS.any_reserve(), "r9"), for_r8, 20.0)
    assert reply.error == "r9 reserves nothing for r8"
    assert not asker.ask(sent_by(KEYS.any_reserve(), "r8"), for_r8, 20.0)[0].error
    about_r8 = encode(NearbyRequest("r8", ((start, Pose2()),), 0.1, 0.1, 0.2, 0.3, 0.3))
    (reply,) = asker.ask(sent_by(KEYS.any_nearby(), "r9"), about_r8, 20.0)
    assert reply.error == "r9 does not say where r8 is"
    assert not asker.ask(sent_by(KEYS.any_nearby(), "r8"), about_r8, 20.0)[0].error


def test_a_robot_is_localized_in_its_own_name(house: House):
    view = encode_view(house.mapped.view(min(house.mapped.truth)))
    (reply,) = house.bus().ask(sent_by(KEYS.any_relocalize(), "r8"), view, 20.0)
    assert not reply.error


def test_one_question_of_a_robot_is_open_at_a_time():
    admission = AdmissionControl(AdmissionSettings(1), executor=LockstepSchedule().executor(1))

    def ask_again() -> float:
        with pytest.raises(Busy) as busy:
            admission.submit(lambda: None, 2, asker="r7")
        assert admission.submit(lambda: "yes", 3, asker="r8").result() == "yes"
        return busy.value.retry_after

    assert admission.submit(ask_again, 1, asker="r7").result() > 0.0
    assert admission.submit(lambda: "again", 1, asker="r7").result() == "again"


def test_changes_of_a_robot_wait_behind_its_own_to_be_merged(monkeypatch):
    schedule, order = LockstepSchedule(), []
    worker = MergeWorker(schedule)
    monkeypatch.setattr(worker._merger, "on_change", lambda change: order.append(change.map.agent))
    for agent, count in (("r7", 50), ("r8", 2)):
        for number in range(1, count + 1):
            map_id = MapId(agent, 1)
            worker.take(Change(map_id, number, number, NodeRetired(NodeId(*map_id, number))))
    assert (worker.unmerged("r7"), worker.unmerged("r8")) == (50, 2)
    schedule.catch_up()
    assert order[:4] == ["r7", "r8", "r7", "r8"] and len(order) == 52


def test_names_without_end_are_forgotten(monkeypatch):
    monkeypatch.setattr("mapweave.mapserver.quotas.MOST_ROBOTS", 10)
    quotas = Quotas(clock=lambda: 0.0)
    for number in range(100):
        quotas.ask(f"x{number}")
        quotas.hold_back(f"x{number}", "beacons")
    assert len(quotas.over()) == 10
