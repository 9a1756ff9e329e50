"""A running router takes note when keys come and go."""

from collections.abc import Callable

from mapweave.hybridmap.errors import MapweaveError
from mapweave.identities.key_file import read_key_file
from mapweave.identities.key_folder import KeyFolder
from mapweave.identities.validity import out_of_date
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.credentials import Credentials
from mapweave.wire.zenoh_bus import ZenohBus


class KeyRenewal:
    """Opens the router again with new rules; its clients connect again by themselves.

    What fails is tried again at each check, and said once: a router that could not open its port again must
    not stay closed. Without a key of its own in the folder the server keeps the one that it had, and
    revocations of others hold all the same.
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
        self._own = settings.credentials
        self._behind = False
        self._complaint = self._lack = ""
        self._out_of_date = False

    def check(self) -> None:
        """Read the catalogue of keys, and open the router again if it has changed.

        That the own certificate does not hold is said once: who connects sees it, and the router does not.
        """
        try:
            self._behind |= self._folder.changed()
            own, lack = self._own_key() if self._behind or self._lack else (self._own, "")
            if self._behind or own != self._own:
                self._behind = True
                settings = self._folder.router(self._server, self._listen, self._routers, own)
                if self._routes:
                    self._bus.reopen(settings)
                if settings.credentials is not None:
                    self._renewed(settings.credentials)
                self._say("the keys have changed" + (": all connect again" if self._routes else ""))
        except MapweaveError as error:
            if str(error) != self._complaint:
                self._say(f"the keys cannot be used, which is tried again: {error}")
            self._complaint = str(error)
            return
        if lack and lack != self._lack:
            self._say(f"the server has no good key of its own, and goes on with the one that it had: {lack}")
        self._own, self._behind, self._complaint, self._lack = own, False, "", lack
        old = out_of_date(own)
        if old and not self._out_of_date:
            self._say(f"robots and people do not trust this server, and connect no more: {old}")
        self._out_of_date = bool(old)

    def _own_key(self) -> tuple[Credentials | None, str]:
        """The server's key, and why it is not that of the folder."""
        try:
            return read_key_file(self._folder.key_file(self._server)).credentials, ""
        except MapweaveError as error:
            return self._own, str(error)
