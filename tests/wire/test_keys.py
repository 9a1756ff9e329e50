"""Patterns match what they should, and what comes from outside is checked; each key is in test_vectors.py."""

import re
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapweave.hybridmap.errors import InvalidMessage, InvalidValue
from mapweave.hybridmap.ids import MapId
from mapweave.wire.keyexpr import check_key, check_pattern, intersects
from mapweave.wire.keys import Keys

KEYS = Keys("warehouse")
names = st.from_regex(r"[a-z0-9][a-z0-9_-]{0,31}", fullmatch=True)
maps = st.builds(MapId, names, st.integers(0, 2**53))


@given(maps, names)
def test_patterns_match_their_keys_and_no_others(one: MapId, server: str):
    keys = {
        KEYS.changes(): KEYS.change(one),
        KEYS.heads(): KEYS.head(one),
        KEYS.agents_alive(): KEYS.agent_alive(one),
        KEYS.agent_statuses(): KEYS.agent_status(one.agent),
        KEYS.views(): KEYS.view(one.agent),
        KEYS.acks(one.agent): KEYS.ack(server, one.agent),
        KEYS.all_poses(server): KEYS.poses(server, one.agent),
        KEYS.any_relocalize(): KEYS.relocalize(server),
        KEYS.any_route(): KEYS.route(server),
        KEYS.any_known(): KEYS.known(server),
        KEYS.any_server_map(): KEYS.server_map(server),
        KEYS.server_statuses(): KEYS.server_status(server),
        KEYS.robot_drivers(): KEYS.robot_driver(server, one.epoch),
    }
    others = [KEYS.log(one), KEYS.mission(one.agent), KEYS.robot_describe(server), f"{KEYS.root}/sim/alive"]
    for pattern in keys:
        check_pattern(pattern)
        for own_pattern, key in keys.items():
            assert intersects(pattern, check_key(key)) == (pattern == own_pattern)
        assert not any(intersects(pattern, check_key(key)) for key in others)


@given(maps, names)
def test_a_key_is_parsed(one: MapId, server: str):
    assert KEYS.parse_change(KEYS.change(one)) == one
    assert KEYS.parse_head(KEYS.head(one)) == one
    assert KEYS.parse_log(KEYS.log(one)) == one
    assert KEYS.parse_agent_alive(KEYS.agent_alive(one)) == one
    assert KEYS.parse_agent_status(KEYS.agent_status(one.agent)) == one.agent
    assert KEYS.parse_view(KEYS.view(one.agent)) == one.agent
    assert KEYS.parse_ack(KEYS.ack(server, one.agent)) == (server, one.agent)
    assert KEYS.parse_robot_driver(KEYS.robot_driver(server, one.epoch)) == (server, one.epoch)


@pytest.mark.parametrize(
    "key",
    [
        "",
        "mapweave/1/warehouse/agent/r0/change",
        "mapweave/1/warehouse/agent/r0/change/3/4",
        "mapweave/2/warehouse/agent/r0/change/3",
        "mapweave/1/other/agent/r0/change/3",
        "mapweave/1/warehouse/agent/R0/change/3",
        "mapweave/1/warehouse/agent/*/change/3",
        "mapweave/1/warehouse/agent//change/3",
        "mapweave/1/warehouse/agent/r0/head/3",
        "mapweave/1/warehouse/agent/r0/change/-3",
        "mapweave/1/warehouse/agent/r0/change/03",
        "mapweave/1/warehouse/agent/r0/change/٣",
        "mapweave/1/warehouse/agent/r0/change/three",
        "mapweave/1/warehouse/agent/r0/change/9007199254740993",
        "mapweave/1/warehouse/agent/r0/change/" + "9" * 5000,
        "/" * 1000,
    ],
)
def test_foreign_keys_are_refused(key: str):
    with pytest.raises(InvalidMessage):
        KEYS.parse_change(key)


@given(st.text(max_size=60))
def test_any_text_is_parsed_or_refused(text: str):
    for key in (text, f"{KEYS.root}/agent/{text}/change/3", f"{KEYS.root}/agent/r0/change/{text}"):
        try:
            assert KEYS.change(KEYS.parse_change(key)) == key
        except InvalidMessage as error:
            assert "\n" not in str(error)


@pytest.mark.parametrize(
    "make",
    [
        lambda: Keys("A"),
        lambda: Keys("a/b"),
        lambda: Keys(""),
        lambda: KEYS.change(MapId("*", 1)),
        lambda: KEYS.change(MapId("r0", -1)),
        lambda: KEYS.ack("s0", "r0/../x"),
        lambda: KEYS.mission("@x"),
        lambda: KEYS.relocalize("x" * 33),
    ],
)
def test_names_that_cannot_be_in_a_key_are_refused(make: Callable[[], object]):
    with pytest.raises(InvalidValue):
        make()


chunks = st.lists(st.sampled_from(["a", "b"]), min_size=1, max_size=4)
pattern_chunks = st.lists(st.sampled_from(["a", "b", "*", "**"]), min_size=1, max_size=4)


def as_regex(pattern: list[str]) -> re.Pattern[str]:
    """Over keys with a `/` behind each chunk."""
    part = {"*": "[ab]/", "**": "([ab]/)*"}
    return re.compile("".join(part.get(chunk, f"{chunk}/") for chunk in pattern))


@given(chunks, pattern_chunks)
def test_matching_agrees_with_regular_expressions(key: list[str], pattern: list[str]):
    expected = as_regex(pattern).fullmatch("".join(f"{chunk}/" for chunk in key)) is not None
    assert intersects("/".join(pattern), "/".join(key)) == expected
    assert intersects("/".join(key), "/".join(pattern)) == expected


@given(pattern_chunks, pattern_chunks)
def test_two_patterns_meet_where_some_key_matches_both(one: list[str], other: list[str]):
    keys = [""]
    count = False
    for _ in range(7):
        keys = [key + chunk for key in keys for chunk in ("a/", "b/")]
        count = count or any(as_regex(one).fullmatch(k) and as_regex(other).fullmatch(k) for k in keys)
    # Two patterns of only `**` also meet in the empty key, which is none.
    assert intersects("/".join(one), "/".join(other)) == count
