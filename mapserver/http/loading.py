"""While a map server loads: the map as it was last shown, and "ask again" to all else that is asked."""

from __future__ import annotations

import logging
import zlib
from pathlib import Path
from typing import Any

from mapweave.hybridmap.annotation import Annotations
from mapweave.hybridmap.errors import Busy, InvalidFile
from mapweave.hybridmap.floor_plan import PlacedPlans
from mapweave.mapserver.http.answering import Answering
from mapweave.mapserver.http.live import LOADING
from mapweave.storage.atomic_file import read_whole, write_whole
from mapweave.wire.log_messages import Scalar

log = logging.getLogger(__name__)

SUFFIX = ".shown"
"""Of the file with the map that was last shown, behind the store's name."""
MAGIC = b"mapweave shown 1\n"
"""Another number with another message `map` of the WebSocket (docs/http.md)."""
AGAIN = 1.0
"""s after which it is worth asking again."""


class LoadingServer:
    """A map server that is not there yet; once it is, this passes everything on to it.

    Until then it says that it loads, and has what the page asks for by itself. All else is refused: after a
    stop of every robot an answer without robots would mean that all stand.
    """

    def __init__(self) -> None:
        """Begin without a server."""
        self._server: Answering | None = None

    def take(self, server: Answering) -> None:
        """The server is there; from any thread."""
        self._server = server

    @property
    def read_only(self) -> bool:
        """Whether nothing can be changed, as with a map file."""
        return self._server is not None and self._server.read_only

    def annotations(self) -> Annotations:
        """What people say about the map."""
        return Annotations() if self._server is None else self._server.annotations()

    def plans(self) -> PlacedPlans:
        """Floor plans."""
        return PlacedPlans() if self._server is None else self._server.plans()

    def status(self) -> dict[str, Scalar]:
        """What the server holds and does; `loading` until it is there."""
        if self._server is None:
            return {"summary": LOADING, "loading": True, "settled": False}
        return self._server.status()

    def __getattr__(self, name: str) -> Any:
        """All other questions.

        Raises:
            Busy: the server is not there yet.
        """
        if self._server is None:
            raise Busy(AGAIN)
        return getattr(self._server, name)


def read_shown(path: Path) -> str:
    """The message with the map that was last shown; empty if there is none.

    Args:
        path: of the file that `write_shown` has written.
    """
    try:
        data = read_whole(path)
    except FileNotFoundError:
        return ""
    except OSError as error:
        log.warning("%s: cannot be read (%s)", path, error.strerror or error)
        return ""
    if not data.startswith(MAGIC):
        return ""
    try:
        return zlib.decompress(data[len(MAGIC) :]).decode()
    except (zlib.error, UnicodeDecodeError):
        log.warning("%s: is damaged; the map is shown once it is loaded", path)
        return ""


def write_shown(path: Path, message: str) -> None:
    """Keep a map for the next start; that it cannot be kept is only logged.

    Args:
        path: of the file.
        message: with the map; empty keeps none.
    """
    if not message:
        return
    try:
        write_whole(path, MAGIC + zlib.compress(message.encode()))
    except InvalidFile as error:
        log.warning("%s; the next start shows no map before it is loaded", error)
