"""The command that takes a robot through a portal: run once for each request, beside the robot's loop."""

import os
import signal
import subprocess
import time
from collections.abc import Callable
from contextlib import suppress

from mapweave.agent.settings import PortalSettings
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.portal import PortalWait


class PortalCommand:
    """Runs the command of the settings, if there is one. It is never waited for."""

    def __init__(
        self,
        robot: str,
        settings: PortalSettings,
        done: Callable[[str], object],
        print_line: Callable[[str], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Run nothing yet.

        Args:
            robot: its name.
            settings: the command, and its time limit.
            done: called with who says so when the robot is through; InvalidValue if it no longer waits.
            print_line: takes lines for people.
            clock: s, only grows.
        """
        self._robot, self._settings, self._done = robot, settings, done
        self._print, self._clock = print_line, clock
        self._request: PortalWait | None = None
        self._running: subprocess.Popen[bytes] | None = None
        self._until = 0.0

    def see(self, wait: PortalWait | None) -> None:
        """Take note of what the robot asks for; called each tick.

        Args:
            wait: the portal at which it waits; None while it drives.
        """
        request = None if wait is None or wait.done else wait
        if request != self._request:
            self.close()
            self._request = request
            if request is not None and self._settings.command:
                self._start(request)
        if self._running is None:
            return
        status = self._running.poll()
        if status is None and self._clock() > self._until:
            self.close()
            self._print(f"the portal command took longer than {self._settings.patience:g} s and was ended")
        elif status is not None:
            self._running = None
            if status == 0:
                with suppress(InvalidValue):  # a person may have said so meanwhile
                    self._done("the portal command")
            else:
                self._print(f"the portal command ended with exit status {status}: waits for a person")

    def close(self) -> None:
        """End the command, if it runs, with all that it has started."""
        running, self._running = self._running, None
        if running is not None and running.poll() is None:
            os.killpg(running.pid, signal.SIGKILL)
            running.wait()

    def _start(self, request: PortalWait) -> None:
        portal = request.portal
        said = {
            "ROBOT": self._robot, "PORTAL": portal.name, "KIND": str(portal.means), "FLOOR": portal.floor,
            "ENTRY": str(portal.entry), "EXIT": str(portal.exit), "ASKED": str(request.asked),
        }  # fmt: skip
        environment = {**os.environ, **{f"MAPWEAVE_{name}": value for name, value in said.items()}}
        try:
            self._running = subprocess.Popen(
                self._settings.command, stdin=subprocess.DEVNULL, env=environment, start_new_session=True
            )
        except OSError as error:
            self._print(f"the portal command cannot be run: {error}")
        self._until = self._clock() + self._settings.patience
