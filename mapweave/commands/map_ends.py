"""Two nodes or two maps on the command line, and asking a running server about them."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable

from hybridmap.errors import InvalidValue, NotConnected
from hybridmap.node import NUMBER, MapId, NodeId, check_name
from hybridmap.ruling import Ends
from mapweave.commands.network import connect, network_of, settings_of
from wire.bus import Reply
from wire.keys import Keys

EXAMPLE = "two nodes look like r0.1.17 r1.1.5, two maps like r0.1 r1.1"


def ends_of(words: list[str]) -> Ends:
    """Read two nodes or two maps.

    Raises:
        InvalidValue: they are neither.
    """
    if len(words) != 2:
        raise InvalidValue(f"give two nodes or two maps, not {len(words)}: {EXAMPLE}")
    first, second = (_read(word) for word in words)
    if isinstance(first, NodeId) and isinstance(second, NodeId):
        return first, second
    if isinstance(first, NodeId) or isinstance(second, NodeId):
        raise InvalidValue(f"{words[0]} and {words[1]} are a node and a map: {EXAMPLE}")
    return first, second


def map_of(word: str) -> MapId:
    """Read a map.

    Raises:
        InvalidValue: it is none.
    """
    found = _read(word)
    if isinstance(found, NodeId):
        raise InvalidValue(f"{word} is a node: give its map, {found.map}")
    return found


def ask(arguments: argparse.Namespace, key_of: Callable[[Keys], str], payload: bytes) -> list[Reply]:
    """Ask every map server of the fleet.

    Args:
        arguments: of the command line, with those of `add_network` and `timeout`.
        key_of: which question, a pattern for every server: `Keys.any_explain`, for example.
        payload: the question.

    Returns:
        Answers, at least one; none of them an error.

    Raises:
        NotConnected: nobody is there, or the servers refuse.
    """
    network = network_of(arguments, settings_of(arguments))
    bus, keys = connect(network)
    try:
        where = ", ".join(network.endpoints)
        if not bus.wait_connected(arguments.timeout):
            raise NotConnected(
                f"no router at {where}: start `mapweave server`, give --connect, or --map FILE"
            )
        replies = bus.ask(key_of(keys), payload, arguments.timeout)
    finally:
        bus.close()
    if not replies:
        raise NotConnected(f"a router is up at {where}, but no map server of fleet {network.fleet} answered")
    good = [reply for reply in replies if not reply.error]
    if not good:
        raise NotConnected(f"the map server refused: {replies[0].error}")
    for reply in replies:
        if reply.error:
            print(f"mapweave: another map server refused: {reply.error}", file=sys.stderr)
    return good


def _read(word: str) -> NodeId | MapId:
    parts = word.split(".")
    if len(parts) == 3:
        return NodeId.parse(word)
    if len(parts) != 2 or not NUMBER.fullmatch(parts[1]):
        raise InvalidValue(f"{word!r} is neither a node nor a map: {EXAMPLE}")
    return MapId(check_name(parts[0]), int(parts[1]))
