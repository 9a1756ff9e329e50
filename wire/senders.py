"""Who asks, as the last chunk of a key.

An access rule lets a person ask under keys that end with that person's name alone, so what is recorded is the
name in the key, whatever the message says. On a fleet without keys people ask under the plain key, and the
message's word holds.
"""

from collections.abc import Callable

from mapweave.hybridmap.errors import InvalidMessage, InvalidValue
from mapweave.hybridmap.ids import check_name
from mapweave.wire.bus import Bus, Closing, Request


def sent_by(key: str, who: str) -> str:
    """The key under which someone asks; the key itself without a name.

    Raises:
        InvalidValue: the name is none.
    """
    return f"{key}/{check_name(who)}" if who else key


def sent_by_any(key: str) -> str:
    """Pattern: the key with any name behind it."""
    return f"{key}/*"


def serve_senders(bus: Bus, key: str, handler: Callable[[Request, str], None]) -> list[Closing]:
    """Serve a key, plain and with a name behind it.

    Args:
        bus: the connection.
        key: without the name.
        handler: takes a question and the name in its key, empty without one.
    """

    def with_name(request: Request) -> None:
        who = request.key.rpartition("/")[2]
        try:
            check_name(who)
        except InvalidValue as error:
            raise InvalidMessage(f"key {request.key!r}: {error}") from None
        handler(request, who)

    return [bus.serve(key, lambda request: handler(request, "")), bus.serve(sent_by_any(key), with_name)]
