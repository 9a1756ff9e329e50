"""Missions and statuses as bytes."""

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapweave.hybridmap.agent_status import AgentStatus, Status
from mapweave.hybridmap.drive_statistics import DriveStatistics
from mapweave.hybridmap.errors import InvalidMessage
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.mission_order import MissionKind, MissionOrder, MissionReport, MissionState
from mapweave.hybridmap.pose import Pose2
from mapweave.wire.messages import decode, encode

names = st.from_regex(r"[a-z0-9][a-z0-9_-]{0,31}", fullmatch=True)
node_ids = st.builds(NodeId, names, st.integers(0, 2**53), st.integers(0, 2**40))
stamps = st.integers(0, 2**63 - 1)
orders = st.one_of(
    st.builds(
        MissionOrder, names, names, st.sampled_from(sorted({*MissionKind} - {MissionKind.GO})), stamps, names
    ),
    st.builds(MissionOrder, names, names, st.just(MissionKind.GO), stamps, names, node_ids),
)
reports = st.builds(MissionReport, orders, st.sampled_from(sorted(MissionState)), st.floats(0.0, 1.0))
finite = st.floats(-1e6, 1e6)
words = st.text(st.characters(categories=["L", "N", "P", "Zs"]).filter(str.isprintable), max_size=200)
counts = st.integers(0, 10**4)
statuses = st.builds(
    Status,
    doing=words, detail=words, nodes=st.integers(0, 10**6), tracked=st.integers(0, 500),
    map_from_robot=st.builds(Pose2, finite, finite, finite), finished=st.booleans(), mission=words,
    fix_node=st.none() | node_ids, node_from_robot=st.builds(Pose2, finite, finite, finite),
    legs=st.integers(0, 1000), drive=st.builds(DriveStatistics, counts, counts, counts, counts),
)  # fmt: skip


@given(orders, reports)
def test_missions_come_back_as_they_were(order: MissionOrder, report: MissionReport):
    assert decode(encode(order), MissionOrder) == order
    assert decode(encode(report), MissionReport) == report


@given(statuses, stamps, st.none() | reports)
def test_statuses_come_back_as_they_were(status: Status, stamp_ns: int, mission: MissionReport | None):
    sent = AgentStatus(status, stamp_ns, "r0", mission=mission)
    assert decode(encode(sent), AgentStatus) == sent


@pytest.mark.parametrize("name", ["doing", "detail", "nodes", "tracked", "map_from_robot", "finished"])
def test_a_status_without_a_field_is_refused(name: str):
    fields = msgpack.unpackb(encode(AgentStatus(Status("turning", "", 0, 0, Pose2(), False), 5)))
    del fields["status"][name]
    with pytest.raises(InvalidMessage, match=name):
        decode(msgpack.packb(fields), AgentStatus)
