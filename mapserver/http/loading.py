"""While a map server loads: "ask again" to what is asked, except for what the page needs by itself."""

from typing import Any

from mapweave.hybridmap.annotation import Annotations
from mapweave.hybridmap.errors import Busy
from mapweave.hybridmap.floor_plan import PlacedPlans
from mapweave.mapserver.http.answering import Answering
from mapweave.mapserver.http.live import LOADING
from mapweave.wire.log_messages import Scalar

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
        self._waits_for = ""

    def wait(self, words: str) -> None:
        """What the server waits for, in one line; empty once it has come. From any thread."""
        self._waits_for = words

    def take(self, server: Answering) -> None:
        """The server is there; from any thread."""
        self._server = server

    @property
    def read_only(self) -> bool:
        """Whether nothing can be changed, as with a map file."""
        return self._server is not None and self._server.read_only

    def attend(self) -> None:
        """An operator is there: no robot is sent before the server is there, and it waits at its start."""
        if self._server is not None:
            self._server.attend()

    def annotations(self) -> Annotations:
        """What people say about the map."""
        return Annotations() if self._server is None else self._server.annotations()

    def plans(self) -> PlacedPlans:
        """Floor plans."""
        return PlacedPlans() if self._server is None else self._server.plans()

    def status(self) -> dict[str, Scalar]:
        """What the server holds and does; `loading` until it is there, `event` if it waits for something."""
        if self._server is None:
            status: dict[str, Scalar] = {"summary": LOADING, "loading": True, "settled": False}
            if self._waits_for:
                status |= {"summary": self._waits_for, "event": self._waits_for}
            return status
        return self._server.status()

    def __getattr__(self, name: str) -> Any:
        """All other questions.

        Raises:
            Busy: the server is not there yet.
        """
        if self._server is None:
            raise Busy(AGAIN)
        return getattr(self._server, name)
