"""One publisher for each key, and not more than fit."""

from __future__ import annotations

import json
from collections.abc import Iterator

import pytest
import zenoh

from mapweave.wire.publishers import Publishers
from tests.waiting import eventually


@pytest.fixture
def session() -> Iterator[zenoh.Session]:
    config = zenoh.Config()
    config.insert_json5("scouting/multicast/enabled", json.dumps(False))
    config.insert_json5("listen/endpoints", json.dumps([]))
    session = zenoh.open(config)
    yield session
    session.close()  # type: ignore[no-untyped-call]


def test_a_key_has_one_publisher_until_others_need_its_place(session: zenoh.Session) -> None:
    publishers, got = Publishers(most=2), list[tuple[str, bytes]]()
    keys = ["a/1", "a/2", "a/1", "a/3", "a/1", "a/2", "a/2"]
    subscriber = session.declare_subscriber(
        "a/*", lambda s: got.append((str(s.key_expr), s.payload.to_bytes()))
    )
    used = []
    for number, key in enumerate(keys):
        used.append(publishers.of(session, key))
        used[-1].put(str(number).encode())
        assert len(publishers) <= 2
    eventually(lambda: len(got) == len(keys))
    assert sorted(got, key=lambda one: int(one[1])) == [(k, str(n).encode()) for n, k in enumerate(keys)]
    assert used[0] is used[2] is used[4], "it was used again before its place was needed"
    assert used[1] is not used[5] and used[5] is used[6]
    with pytest.raises(zenoh.ZError):
        used[1].put(b"it is taken back")
    subscriber.undeclare()  # type: ignore[no-untyped-call]
