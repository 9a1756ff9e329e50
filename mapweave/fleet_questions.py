"""Asking a fleet's servers and robots."""

from __future__ import annotations

from mapweave.connection import no_server
from mapweave.hybridmap.errors import InvalidValue, NotConnected
from mapweave.wire.bus import Bus, Reply
from mapweave.wire.keys import Keys
from mapweave.wire.patience import ask_patiently


class FleetQuestions:
    """The part of `mapweave.fleet.Fleet` by which all others ask."""

    _bus: Bus
    _keys: Keys
    _by: str

    def _question(self, key: str, payload: bytes, timeout: float) -> bytes:
        """The answer of a map server; one that is busy is asked again at its time.

        Raises:
            NotConnected: no map server answers, or all stay busy.
            InvalidValue: it refuses the question.
        """
        replies = ask_patiently(self._bus, key, payload, timeout)
        for reply in replies:
            if not reply.error:
                return reply.payload
        if not replies:
            raise no_server(self._keys.fleet)
        reason = replies[0].error.removeprefix("refused: ")
        raise NotConnected(f"the map server is {reason}") if replies[0].retry_after else InvalidValue(reason)

    def _ask(self, key: str, payload: bytes, timeout: float) -> list[Reply]:
        """Answers of all who answer and do not refuse."""
        return [reply for reply in self._bus.ask(key, payload, timeout) if not reply.error]
