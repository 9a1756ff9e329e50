"""A store that does not answer holds up no one who asks how the server is."""

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from mapweave.mapserver import prompt_reading
from tests.mapserver.test_set_apart import Fleet, serving


@pytest.fixture
def fleet(tmp_path: Path) -> Iterator[Fleet]:
    with serving(tmp_path / "s0.sqlite") as fleet:
        yield fleet


def test_the_status_of_a_server_whose_store_does_not_answer_is_given_and_names_that(
    fleet: Fleet, monkeypatch
):
    before = fleet.server.status()
    assert before["event"] == ""
    answers = threading.Event()
    store = fleet.server._store
    count = store.traffic
    monkeypatch.setattr(store, "traffic", lambda: answers.wait(20.0) and count())
    monkeypatch.setattr(prompt_reading, "LONG", 1.0)
    began = time.monotonic()
    try:
        assert fleet.server.status()["node_puts"] == before["node_puts"]
        assert fleet.server.status()["event"] == ""
        assert time.monotonic() < began + 1.0
        while fleet.server.status()["event"] == "" and time.monotonic() < began + 10.0:
            time.sleep(0.05)
        assert fleet.server.status()["event"] == "the store does not answer"
        assert time.monotonic() > began + 1.0
    finally:
        answers.set()
    while fleet.server.status()["event"] and time.monotonic() < began + 20.0:
        time.sleep(0.05)
    assert fleet.server.status()["event"] == ""
