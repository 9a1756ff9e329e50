"""Asking a fleet's servers and robots."""

from mapweave.connection import ANSWERED, no_server, router_gone, server_statuses
from mapweave.hybridmap.errors import InvalidValue, NotConnected, Refused
from mapweave.wire.bus import Bus, Reply
from mapweave.wire.credentials import Credentials, Role
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import Scalar
from mapweave.wire.patience import ask_patiently


class FleetQuestions:
    """The part of `mapweave.fleet.Fleet` by which all others ask."""

    _bus: Bus
    _keys: Keys
    _by: str
    _key_holder: Credentials | None

    def servers(self) -> list[dict[str, Scalar]]:
        """What the map servers say of themselves, those that answer."""
        return server_statuses(self._bus, self._keys, ANSWERED)

    def _question(self, key: str, payload: bytes, timeout: float) -> bytes:
        """The answer of a map server; see `_answers`."""
        return self._answers(key, payload, timeout)[0][0]

    def _answers(self, key: str, payload: bytes, timeout: float) -> tuple[list[bytes], list[str]]:
        """The answers of map servers, at least one, and why others refuse; busy ones are asked again.

        Raises:
            NotConnected: no map server answers, or all stay busy.
            Refused: all refuse the question.
        """
        replies = ask_patiently(self._bus, key, payload, timeout)
        if not replies:
            raise self._no_answer()
        reasons = [reply.error.removeprefix("refused: ") for reply in replies if reply.error]
        if len(reasons) < len(replies):
            return [reply.payload for reply in replies if not reply.error], reasons
        busy = next((reply.error for reply in replies if reply.retry_after), "")
        raise NotConnected(f"the map server is {busy}") if busy else Refused(reasons[0])

    def _no_answer(self) -> NotConnected:
        """The error that nothing answers."""
        if not self._bus.connected():
            return router_gone()
        return no_server(self._bus, self._keys, self._key_holder)

    @property
    def _sender(self) -> str:
        """The name under which commands are sent; empty without a key."""
        return "" if self._key_holder is None else self._key_holder.name

    def _check_role(self) -> None:
        """Raise InvalidValue if one may only look; see `check_role`."""
        check_role(self._key_holder)

    def _ask(self, key: str, payload: bytes, timeout: float) -> list[Reply]:
        """Answers of all who answer and do not refuse."""
        return [reply for reply in self._bus.ask(key, payload, timeout) if not reply.error]


def check_role(holder: Credentials | None) -> None:
    """The router drops what a role may not send, without a word, so that is said here.

    Args:
        holder: of the key with which one is connected, if there is one.

    Raises:
        InvalidValue: missions and corrections are not of this role.
    """
    role = None if holder is None else holder.role
    if role in (Role.VIEWER, Role.ROBOT):
        raise InvalidValue(f"this is the key of a {role}: missions and corrections need an operator's")
