"""What a watcher knows of others is bounded, and what it reports is what holds."""

import threading
from collections.abc import Iterator

import pytest

from mapweave.wire import alive_keys
from mapweave.wire.alive_keys import AliveKeys
from mapweave.wire.dispatch import Dispatcher
from tests.waiting import eventually

ROOT = "mapweave/1/f/agent"


class Watching:
    """A watcher whose handler can be held up."""

    def __init__(self) -> None:
        self.news: list[tuple[str, bool]] = []
        self.go = threading.Event()
        self.go.set()
        self.dispatcher = Dispatcher("test")
        self.keys = AliveKeys(self.dispatcher, self.hear, lambda: True)

    def hear(self, key: str, alive: bool) -> None:
        self.go.wait(30)
        self.news.append((key.removeprefix(f"{ROOT}/"), alive))

    def note(self, key: str, alive: bool) -> None:
        self.keys.note(f"{ROOT}/{key}", alive)

    def hold(self) -> None:
        """From now on news wait, behind one that is known."""
        self.go.clear()
        self.note("holding/alive/1", True)
        eventually(lambda: not len(self.dispatcher._tasks))


@pytest.fixture
def watching() -> Iterator[Watching]:
    watching = Watching()
    yield watching
    watching.go.set()
    watching.dispatcher.close()


def test_a_token_that_comes_and_goes_without_end_is_one_task(watching: Watching):
    watching.hold()
    for _ in range(1000):
        watching.note("r3/alive/1", True)
        watching.note("r3/alive/1", False)
    watching.note("r3/alive/2", True)
    assert len(watching.dispatcher._tasks) == 1
    watching.go.set()
    eventually(lambda: watching.news[-1:] and watching.news[-1] == ("r3/alive/2", True))
    assert ("r3/alive/1", True) not in watching.news


def test_one_that_was_away_meanwhile_is_reported_as_that(watching: Watching):
    """A server that was started again, say: it has forgotten what it was asked."""
    watching.note("r0/alive/1", True)
    eventually(lambda: watching.news == [("r0/alive/1", True)])
    watching.hold()
    watching.note("r0/alive/1", False)
    watching.note("r0/alive/1", True)
    watching.go.set()
    eventually(lambda: watching.news[-2:] == [("r0/alive/1", False), ("r0/alive/1", True)])


def test_a_robot_that_goes_on_with_its_next_map_is_never_away(watching: Watching):
    watching.note("r0/alive/1", True)
    eventually(lambda: len(watching.news) == 1)
    watching.hold()
    watching.note("r0/alive/1", False)
    watching.note("r0/alive/2", True)
    watching.go.set()
    eventually(lambda: watching.news[-2:] == [("r0/alive/2", True), ("r0/alive/1", False)])


def test_names_and_keys_fill_no_memory(watching: Watching, monkeypatch):
    monkeypatch.setattr(alive_keys, "MOST", 100)
    for number in range(500):
        watching.note(f"x{number}/alive/1", True)
    watching.note(f"long/alive/{'1' * 5000}", True)
    eventually(lambda: len(watching.news) == 100)
    assert len(watching.keys._participants) == 100
    watching.keys.end()
    eventually(lambda: len(watching.news) == 200)
    assert not watching.keys._participants
    watching.note("long/alive/1", True)
    eventually(lambda: watching.news[-1:] and watching.news[-1] == ("long/alive/1", True))


def test_tokens_of_one_robot_leave_room_for_others(watching: Watching, monkeypatch, caplog):
    monkeypatch.setattr(alive_keys, "MOST", 2 * alive_keys.MOST_OF_ONE)
    for number in range(1000):
        watching.note(f"r3/alive/{number}", True)
    watching.note("r0/alive/1", True)
    eventually(lambda: len(watching.news) > alive_keys.MOST_OF_ONE)
    assert ("r0/alive/1", True) in watching.news
    assert len(watching.news) == alive_keys.MOST_OF_ONE + 1
    assert "512 liveliness tokens left out so far, the last of " in caplog.text
    assert len(caplog.records) == 10, "a line at each power of two"


def test_tokens_of_ros_2_are_no_robots(watching: Watching):
    for number in range(2 * alive_keys.MOST_OF_ONE):
        watching.keys.note(f"@ros2_lv/0/session/0/{number}/MP/%/%/node/%chatter", True)
    eventually(lambda: len(watching.news) == 2 * alive_keys.MOST_OF_ONE)
