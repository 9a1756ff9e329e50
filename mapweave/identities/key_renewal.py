"""A running router takes note when keys come and go."""

from __future__ import annotations

from collections.abc import Callable

from mapweave.hybridmap.errors import MapweaveError
from mapweave.identities.key_folder import KeyFolder
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.credentials import Credentials
from mapweave.wire.zenoh_bus import ZenohBus


class KeyRenewal:
    """Opens the router again with new rules; its clients connect again by themselves.

    What fails is tried again at each check, and said once: a router that could not open its port again must
    not stay closed.
    """

    def __init__(
        self,
        bus: ZenohBus,
        folder: KeyFolder,
        server: str,
        settings: BusSettings,
        say: Callable[[str], None],
        renewed: Callable[[Credentials], None] = lambda credentials: None,
    ) -> None:
        """Begin with the keys that the router has.

        Args:
            bus: the router, or a server that is a client of one: its own key it reads at its start.
            folder: of the keys, as they were when the router was opened.
            server: name of the map server whose key the router has.
            settings: of the bus.
            say: takes a line for people.
            renewed: takes the server's own key, which may be another one now.
        """
        self._bus, self._folder, self._server, self._say = bus, folder, server, say
        self._routes, self._renewed = settings.mode == "router", renewed
        self._listen, self._routers = settings.listen if self._routes else (), settings.routers
        self._behind = False
        self._complaint = ""

    def check(self) -> None:
        """Read the catalogue of keys, and open the router again if it has changed."""
        try:
            if not self._folder.changed() and not self._behind:
                self._complaint = ""
                return
            self._behind = True
            settings = self._folder.router(self._server, self._listen, self._routers)
            if self._routes:
                self._bus.reopen(settings)
            if settings.credentials is not None:
                self._renewed(settings.credentials)
        except MapweaveError as error:
            if str(error) != self._complaint:
                self._say(f"the keys cannot be used, which is tried again: {error}")
            self._complaint = str(error)
            return
        self._behind, self._complaint = False, ""
        self._say("the keys have changed" + (": all connect again" if self._routes else ""))
