"""The way to the cluster: answers, failures, and a process that dies, with a process that is not Ray's."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from mapweave.hybridmap.errors import MapweaveError
from mapweave.mapserver.cluster import gateway as gateway_module
from mapweave.mapserver.cluster.gateway import WORK, ClusterGone, Gateway
from tests.waiting import eventually


@contextmanager
def gateway(monkeypatch: pytest.MonkeyPatch, address: str = "here") -> Iterator[Gateway]:
    monkeypatch.setattr(gateway_module, "PROCESS", "tests.mapserver.cluster.echo_process")
    monkeypatch.setattr(gateway_module, "FIRST_PAUSE", 0.05)
    opened = Gateway(address, 3)
    opened.start()
    try:
        yield opened
    finally:
        opened.close()


def test_requests_are_answered_and_failures_have_their_reason(monkeypatch):
    with gateway(monkeypatch) as opened:
        eventually(lambda: opened.workers == 3)
        answers = [opened.ask(k, b"%d" % k) for k in range(3)]
        assert [answer.result(10.0) for answer in answers] == [b"0 0", b"1 1", b"2 2"]
        assert opened.ask(WORK, b"work").result(10.0) == b"-1 work"
        with pytest.raises(MapweaveError, match="it failed"):
            opened.ask(0, b"fail").result(10.0)


def test_what_a_dead_process_was_asked_fails_at_once_and_another_is_started(monkeypatch):
    with gateway(monkeypatch) as opened:
        eventually(lambda: opened.workers)
        waiting = [opened.ask(0, b"silence"), opened.ask(0, b"die")]
        for answer in waiting:
            with pytest.raises(ClusterGone):
                answer.result(10.0)
        eventually(lambda: opened.workers)
        assert opened.ask(1, b"again").result(10.0) == b"1 again"


def test_a_cluster_that_does_not_answer_is_given_up(monkeypatch):
    monkeypatch.setattr(gateway_module, "SILENCE", 0.5)
    with gateway(monkeypatch) as opened:
        eventually(lambda: opened.workers)
        with pytest.raises(ClusterGone):
            opened.ask(0, b"silence").result(10.0)


def test_without_a_cluster_every_request_fails_at_once_and_the_log_says_why(monkeypatch, caplog):
    with gateway(monkeypatch, "nowhere") as opened:
        eventually(lambda: "nothing listens at nowhere" in caplog.text)
        assert opened.workers == 0
        with pytest.raises(ClusterGone):
            opened.ask(0, b"hello").result(0.0)


def test_a_server_says_that_it_waits_for_its_cluster(monkeypatch, caplog):
    monkeypatch.setattr(gateway_module, "SAID_EVERY", 0.2)
    with caplog.at_level("INFO"), gateway(monkeypatch, "slow") as opened:
        eventually(lambda: opened.workers == 3)
    waiting, reached = (
        "the cluster at slow is not reached yet, after ",
        "in the cluster at slow, with 3 workers",
    )
    assert waiting in caplog.text and caplog.text.index(waiting) < caplog.text.index(reached)


@pytest.mark.parametrize("request_of_it", [b"garbage", b"too long"])
def test_a_process_that_sends_no_frame_is_started_again(request_of_it: bytes, monkeypatch, caplog):
    with gateway(monkeypatch) as opened:
        eventually(lambda: opened.workers)
        with pytest.raises(ClusterGone):
            opened.ask(0, request_of_it).result(10.0)
        eventually(lambda: "the cluster at here is not there: " in caplog.text and opened.workers)
        assert opened.ask(1, b"again").result(10.0) == b"1 again"
