"""Two nodes or two maps on the command line, and asking a running server about them."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from mapweave.commands.network import connect, network_of, settings_of
from mapweave.hybridmap.constraint_subject import EXAMPLE, Ends, read_end, read_ends
from mapweave.hybridmap.errors import InvalidValue, NotConnected
from mapweave.hybridmap.node import MapId, NodeId
from mapweave.hybridmap.query import ResolveAnswer, ResolveRequest
from mapweave.wire.bus import Bus, Reply
from mapweave.wire.keys import Keys
from mapweave.wire.messages import decode, encode

if TYPE_CHECKING:
    from mapweave.mapserver.routes import Router


def ends_of(words: list[str]) -> Ends:
    """Read two nodes or two maps.

    Raises:
        InvalidValue: they are neither.
    """
    if len(words) != 2:
        raise InvalidValue(f"give two nodes or two maps, not {len(words)}: {EXAMPLE}")
    return read_ends(words[0], words[1])


def _patiently(bus: Bus, key: str, payload: bytes, timeout: float) -> list[Reply]:
    """Ask, and ask busy servers again at their time, until the patience is over."""
    end = time.monotonic() + timeout
    while True:
        replies = bus.ask(key, payload, max(end - time.monotonic(), 0.1))
        pause = max((reply.retry_after for reply in replies), default=0.0)
        if pause <= 0.0 or time.monotonic() + pause > end:
            return replies
        time.sleep(pause)


def resolved(arguments: argparse.Namespace, words: list[str], router: Router | None = None) -> list[str]:
    """Words with nodes in the place of named places and positions; nodes and maps as they are.

    Args:
        arguments: of the command line; with `map`, of this file, else of a running server.
        words: as people write them.
        router: of the map of `map`, if it is there already.

    Raises:
        MapweaveError: a word is none of these, or no server answers.
    """
    asked = [word for word in words if not _is_end(word)]
    if not asked:
        return words
    request = ResolveRequest(tuple(asked))
    if arguments.map is None:
        answer = decode(ask(arguments, Keys.any_resolve, encode(request))[0].payload, ResolveAnswer)
    else:
        from mapweave.commands.map_input import router_of
        from mapweave.mapserver.places import Places

        router = router or router_of(arguments)
        answer = Places(router, router.annotations).answer(request)
    for word, one in zip(asked, answer.found, strict=True):
        if one.note:
            print(f"mapweave: {word}: {one.note}", file=sys.stderr)
    nodes = {word: str(one.node) for word, one in zip(asked, answer.found, strict=True)}
    return [nodes.get(word, word) for word in words]


def _is_end(word: str) -> bool:
    try:
        read_end(word)
    except InvalidValue:
        return False
    return True


def map_of(word: str) -> MapId:
    """Read a map.

    Raises:
        InvalidValue: it is none.
    """
    end = read_end(word)
    if isinstance(end, NodeId):
        raise InvalidValue(f"{word} is a node: give its map, {end.map}")
    return end


def node_of(word: str) -> NodeId:
    """Read a node.

    Raises:
        InvalidValue: it is none.
    """
    end = read_end(word)
    if isinstance(end, MapId):
        raise InvalidValue(f"{word} is a map: give one of its nodes, {word}.1 for example")
    return end


def ask(arguments: argparse.Namespace, key_of: Callable[[Keys], str], payload: bytes) -> list[Reply]:
    """Ask every map server of the fleet.

    Args:
        arguments: of the command line, with those of `add_network` and `timeout`.
        key_of: which question, a pattern for every server: `Keys.any_explain`, for example.
        payload: the question.

    Returns:
        Answers, at least one; none of them an error.

    Raises:
        NotConnected: no server answers, or all refuse.
    """
    network = network_of(arguments, settings_of(arguments))
    bus, keys = connect(network)
    try:
        where = ", ".join(network.endpoints)
        if not bus.wait_connected(arguments.timeout):
            raise NotConnected(
                f"no router at {where}: start `mapweave server`, give --connect, or --map FILE"
            )
        replies = _patiently(bus, key_of(keys), payload, arguments.timeout)
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
