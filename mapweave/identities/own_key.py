"""A running client takes note when its own key file is replaced, as before its certificate expires."""

import threading
from collections.abc import Callable
from pathlib import Path

from mapweave.hybridmap.errors import MapweaveError, SettingsError
from mapweave.identities.key_file import read_key_file
from mapweave.identities.validity import out_of_date
from mapweave.wire.credentials import Credentials
from mapweave.wire.zenoh_bus import ZenohBus

EVERY = 5.0
"""s between two looks at the file."""


class OwnKey:
    """Reads a key file again and again; the client connects again with the key that is there then.

    A file that cannot be read, or is another's, is said once, and the key of before is kept.
    """

    def __init__(
        self, bus: ZenohBus, path: Path, holder: Credentials, say: Callable[[str], None], every: float = EVERY
    ) -> None:
        """Begin to look.

        Args:
            bus: the client.
            path: of its key file.
            holder: the key with which it was opened.
            say: takes a line for people.
            every: s between two looks.
        """
        self._bus, self._path, self._holder, self._say = bus, path, holder, say
        self._complaint = ""
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(every,), name="own-key", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Look no more."""
        self._closed.set()
        self._thread.join()

    def check(self) -> None:
        """Look once."""
        try:
            new = read_key_file(self._path).credentials
            if (new.name, new.role) != (self._holder.name, self._holder.role):
                raise SettingsError(f"{self._path}: is the key of {new.role} {new.name}")
            if new != self._holder and (old := out_of_date(new)):
                raise SettingsError(old)
        except MapweaveError as error:
            if str(error) != self._complaint:
                self._say(f"goes on with the key that it had: {error}")
            self._complaint = str(error)
            return
        self._complaint = ""
        if new != self._holder:
            self._holder = new
            self._bus.renew(new)
            self._say("has a new key: it connects again")

    def _run(self, every: float) -> None:
        while not self._closed.wait(every):
            self.check()
