"""A robot at a portal: it asks to be taken through, and looks where it is then.

It is a kidnapping that is announced: the robot knows on which floor it must be, and its own view confirms
that. Only then does it believe that it was taken through.
"""

from dataclasses import replace

from mapweave.agent.settings import PortalSettings
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.portal import PortalMeans, PortalStop, PortalWait


class PortalCrossing:
    """Where a robot stands with the portals on its way.

    Attributes:
        wait: the portal at which it waits, or which it was taken through; None while it drives.
        trouble: why it asks again, in words; empty when it asks for the first time.
    """

    def __init__(
        self,
        map_id: MapId | None = None,
        patience: float = PortalSettings().patience,
        wait: PortalWait | None = None,
    ) -> None:
        """Take up where the robot was switched off.

        Args:
            map_id: of the robot's own map.
            patience: how long it waits at one portal altogether, s.
            wait: the portal at which it was then.
        """
        self.wait = wait
        self.trouble = ""
        self._map_id = map_id or MapId("r0", 1)
        self._patience = patience
        self._since: float | None = None
        self._before: PortalWait | None = wait

    @property
    def request(self) -> str:
        """What the robot asks people for."""
        assert self.wait is not None, "it is at a portal"
        portal = self.wait.portal
        note = f" ({portal.note})" if portal.note else ""
        again = f"{self.trouble}; " if self.trouble else ""
        return (
            f"{again}at {portal.title}{note}: take me to {portal.beyond}, then say "
            f"`mapweave portal done {self._map_id.agent}`"
        )

    def begin(self, portal: PortalStop) -> None:
        """The robot has parked at a portal."""
        before, self._before = self._before, None
        if before is not None and before.portal == portal:
            self.wait = PortalWait(portal, before.asked + 1)
        else:
            self.wait, self._since, self.trouble = PortalWait(portal), None, ""

    def late(self, now: float) -> str:
        """Why it no longer waits, if it has waited too long; else empty.

        Args:
            now: s.
        """
        assert self.wait is not None, "it is at a portal"
        self._since = now if self._since is None else self._since
        if now - self._since <= self._patience:
            return ""
        portal, why = self.wait.portal, f": {self.trouble}" if self.trouble else ""
        return f"not taken through {portal.title} within {self._patience:g} s{why}"

    def taken_through(self) -> None:
        """A person says that the robot was taken through."""
        if self.wait is not None:
            self.wait = replace(self.wait, done=True)

    def looked(self, found: bool) -> None:
        """It has looked where it is after that; if it has found nothing it asks again.

        If it has found itself, the way from there says whether it was taken through; see `check`.
        """
        assert self.wait is not None, "it is at a portal"
        if found:
            self.wait, self._before = None, self.wait
        else:
            self.trouble = f"I cannot find myself on {self.wait.portal.beyond}"
            self.wait = replace(self.wait, asked=self.wait.asked + 1, done=False)

    def check(self, next_portal: PortalStop | None) -> None:
        """Take note of where the way leads after a crossing: through the same portal, it was none."""
        if self._before is None:
            return
        if next_portal == self._before.portal:
            self.trouble = f"I am still on this side of {next_portal.title}"
        else:
            self._before, self.trouble = None, ""

    @property
    def elsewhere(self) -> bool:
        """Whether the robot's own map is on another floor than where the portal leads."""
        assert self.wait is not None, "it is at a portal"
        portal = self.wait.portal
        return portal.means is not PortalMeans.DOOR and portal.exit.map != self._map_id
