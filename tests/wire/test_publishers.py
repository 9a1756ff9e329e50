"""One publisher for each key, and not more than fit."""

import json
import threading
import weakref
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import cast

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


def test_a_key_has_one_publisher_until_others_need_its_place(session: zenoh.Session):
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
    # Another thread may have it from before its place was needed: undeclared, it would lose what is sent,
    # and Zenoh raises "Already borrowed" while a message is on its way.
    used[1].put(b"7")
    keys.append("a/2")
    eventually(lambda: len(got) == len(keys))
    assert sorted(got, key=lambda one: int(one[1])) == [(k, str(n).encode()) for n, k in enumerate(keys)]
    assert used[0] is used[2] is used[4], "it was used again before its place was needed"
    assert used[1] is not used[5] and used[5] is used[6]
    subscriber.undeclare()  # type: ignore[no-untyped-call]


class SlowSession:
    """Declares when it is allowed to."""

    def __init__(self) -> None:
        self.allowed = {key: threading.Event() for key in ("slow", "quick")}
        self.asked, self.declared = list[str](), weakref.WeakSet[SlowPublisher]()

    def declare_publisher(self, key: str) -> object:
        self.asked.append(key)
        assert self.allowed[key].wait(30)
        publisher = SlowPublisher()
        self.declared.add(publisher)
        return publisher


class SlowPublisher:
    """Taken back when nothing refers to it, as Zenoh's."""


def test_a_key_whose_publisher_is_being_declared_holds_up_no_other():
    session, publishers = SlowSession(), Publishers()
    of = partial(publishers.of, cast(zenoh.Session, session))
    with ThreadPoolExecutor(2) as pool:
        both = [pool.submit(of, "slow") for _ in range(2)]
        eventually(lambda: session.asked == ["slow", "slow"])
        session.allowed["quick"].set()
        quick = of("quick")
        session.allowed["slow"].set()
        first, second = (future.result() for future in both)
    assert first is second is of("slow") and first is not quick
    eventually(lambda: len(session.declared) == 2)
