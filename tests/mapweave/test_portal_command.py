"""The command that takes a robot through a portal: real processes, and a clock that the test moves."""

from dataclasses import replace

import pytest

from mapweave.agent.settings import PortalSettings
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.portal import PortalMeans, PortalStop, PortalWait
from mapweave.processes.portal_command import PortalCommand
from tests.waiting import eventually

LIFT = PortalStop("east lift", PortalMeans.LIFT, NodeId("r0", 1, 3), NodeId("r1", 1, 5), "2")


class Trial:
    """A robot that asks, and what comes of it."""

    def __init__(self, *command: str) -> None:
        self.done: list[str] = []
        self.lines: list[str] = []
        self.now = 0.0
        settings = PortalSettings(command, patience=60.0)
        self.command = PortalCommand("r0", settings, self.done.append, self.lines.append, lambda: self.now)

    def seen(self, wait: PortalWait | None) -> bool:
        self.command.see(wait)
        return bool(self.done or self.lines)


def test_it_is_run_once_a_request_and_knows_where_the_robot_is_to_go(tmp_path):
    report = (
        'echo "$MAPWEAVE_ROBOT, $MAPWEAVE_KIND $MAPWEAVE_PORTAL, $MAPWEAVE_FLOOR, $MAPWEAVE_ASKED" >> report'
    )
    trial = Trial("sh", "-c", f"cd '{tmp_path}' && {report}")
    trial.command.see(None)
    eventually(lambda: trial.seen(PortalWait(LIFT)))
    assert trial.done == ["the portal command"] and trial.lines == []
    trial.command.see(PortalWait(LIFT, done=True))
    trial.done.clear()
    eventually(lambda: trial.seen(PortalWait(LIFT, asked=2)))
    assert (tmp_path / "report").read_text() == "r0, lift east lift, 2, 1\nr0, lift east lift, 2, 2\n"


@pytest.mark.parametrize(("command", "line"), [
    (("sh", "-c", "exit 3"), "the portal command ended with exit status 3: waits for a person"),
    (("/nowhere/lift",), "the portal command cannot be run: [Errno 2]"),
])  # fmt: skip
def test_one_that_fails_leaves_the_robot_to_people(command: tuple[str, ...], line: str):
    trial = Trial(*command)
    eventually(lambda: trial.seen(PortalWait(LIFT)))
    assert len(trial.lines) == 1 and trial.lines[0].startswith(line) and trial.done == []
    trial.command.see(PortalWait(LIFT))
    assert len(trial.lines) == 1, "it is not tried again"


def test_one_that_hangs_is_ended_with_its_children_and_so_is_one_that_is_needed_no_more(tmp_path):
    hang = f"echo $$ > '{tmp_path}/pid'; sleep 600 & wait"
    for leave in (False, True):
        trial = Trial("sh", "-c", hang)
        trial.command.see(PortalWait(LIFT))
        running = trial.command._running
        assert running is not None
        eventually((tmp_path / "pid").exists)
        trial.now = 59.0 if leave else 61.0
        trial.command.see(None if leave else PortalWait(LIFT))
        assert running.poll() is not None and trial.done == []
        assert trial.lines == ([] if leave else ["the portal command took longer than 60 s and was ended"])


def test_a_person_may_be_faster():
    def late(by: str) -> None:
        raise InvalidValue("r0 does not wait at a portal")

    lines: list[str] = []
    command = PortalCommand("r0", PortalSettings(("true",)), late, lines.append)
    waiting = PortalWait(replace(LIFT, floor=""))
    command.see(waiting)
    eventually(lambda: (command.see(waiting), command._running is None)[1])
    assert lines == []
