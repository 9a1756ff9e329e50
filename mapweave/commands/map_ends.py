"""Two nodes or two maps on the command line, and asking a running server about them."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING

from mapweave.commands.map_input import router_of
from mapweave.commands.network import key_holder, network_of, reach, settings_of
from mapweave.commands.usage import UsageError, arguments_read
from mapweave.hybridmap.annotation import Annotations
from mapweave.hybridmap.constraint_subject import EXAMPLE, Ends, read_end, read_ends
from mapweave.hybridmap.errors import InvalidValue, NotConnected, Refused
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.named_nodes import Record, Resolve, ids_of
from mapweave.hybridmap.query import ExplainRequest, ResolveAnswer, ResolveRequest
from mapweave.refusals import refusals
from mapweave.wire.bus import Bus, Reply
from mapweave.wire.keys import Keys
from mapweave.wire.messages import decode, decode_explanation, encode
from mapweave.wire.patience import ask_patiently

if TYPE_CHECKING:
    from mapweave.hybridmap.explanation import Explanation
    from mapweave.mapserver.routes import Router
    from mapweave.settings import NetworkSettings


def different_ends_of(words: list[str]) -> Ends:
    """Read two different nodes or two different maps.

    Raises:
        UsageError: they are neither.
    """
    if len(words) != 2:
        raise UsageError(f"give two nodes or two maps, not {len(words)}: {EXAMPLE}")
    with arguments_read():
        ends = read_ends(words[0], words[1])
    if ends[0] == ends[1]:
        raise UsageError(f"{ends[0]} twice: give two different nodes or two different maps")
    return ends


def resolved(
    arguments: argparse.Namespace, words: list[str], router: Router | None = None, near: str = ""
) -> list[str]:
    """Words with active nodes in the place of named places and positions; nodes and maps as they are.

    Args:
        arguments: of the command line; with `map`, of this file, else of a running server.
        words: as people write them.
        router: of the map of `map`, if it is there already.
        near: a node or place in the part of the map where positions are; empty: the largest part.

    Raises:
        MapweaveError: a word is none of these, or no server answers.
    """
    return ids_of(words, names_of(arguments, router)[1], near)


def names_of(arguments: argparse.Namespace, router: Router | None = None) -> tuple[Record, Resolve]:
    """The annotations, and nodes for words with notes on stderr, as functions; see `resolved`."""
    if arguments.map is None:
        return (
            lambda: decode(ask(arguments, Keys.any_annotations, b"")[0].payload, Annotations),
            lambda request: _noted(
                request,
                decode(ask(arguments, Keys.any_resolve, encode(request))[0].payload, ResolveAnswer),
            ),
        )
    from mapweave.mapserver.places import PlaceResolver

    known = cache(lambda: router or router_of(arguments))

    def answered(request: ResolveRequest) -> ResolveAnswer:
        with refusals():
            return PlaceResolver(known(), known().annotations).answer(request)

    return (
        lambda: known().annotations,
        lambda request: _noted(request, answered(request)),
    )


def _noted(request: ResolveRequest, answer: ResolveAnswer) -> ResolveAnswer:
    for word, one in zip(request.words, answer.found, strict=True):
        if one.note:
            print(f"mapweave: {word}: {one.note}", file=sys.stderr)
    return answer


def explanation_of(
    arguments: argparse.Namespace, request: ExplainRequest, router: Router | None = None
) -> Explanation:
    """The explanation that is asked for.

    Args:
        arguments: of the command line; with `map`, of this file, else of what a running server has.
        request: what is asked.
        router: of the map of `map`, if it is there already.

    Raises:
        MapweaveError: what it is about is not there, or no server answers.
    """
    if arguments.map is None:
        return decode_explanation(ask(arguments, Keys.any_explain, encode(request))[0].payload, request)
    from mapweave.mapserver.explanations import explained

    with refusals():
        return explained(request, router or router_of(arguments), settings_of(arguments).merge.consistency)


def map_of(word: str) -> MapId:
    """Read a map.

    Raises:
        UsageError: it is none.
    """
    try:
        end = read_end(word)
    except InvalidValue:
        raise UsageError(f"{word!r} is no map: write it as r0.1, the robot and the map's number") from None
    if isinstance(end, NodeId):
        raise UsageError(f"{word} is a node: give its map, {end.map}")
    return end


def node_of(word: str) -> NodeId:
    """Read a node.

    Raises:
        UsageError: it is none.
    """
    with arguments_read():
        end = read_end(word)
    if isinstance(end, MapId):
        raise UsageError(f"{word} is a map: give one of its nodes, {word}.1 for example")
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
        NotConnected: no server answers, or all are busy.
        Refused: all refuse.
    """
    network = network_of(arguments, settings_of(arguments))
    bus, keys = reach(network, "give --connect, or --map FILE")
    try:
        return answers(bus, network, key_of(keys), payload, arguments.timeout)
    finally:
        bus.close()


def answers(bus: Bus, network: NetworkSettings, key: str, payload: bytes, timeout: float) -> list[Reply]:
    """The same by a connection that is there."""
    from mapweave.connection import no_server

    replies = ask_patiently(bus, key, payload, timeout)
    if not replies:
        raise no_server(bus, Keys(network.fleet), key_holder(network))
    good = [reply for reply in replies if not reply.error]
    if not good:
        if any(reply.retry_after for reply in replies):
            raise NotConnected(f"the map server is {replies[0].error}")
        raise Refused(f"the map server refused: {replies[0].error}")
    for reply in replies:
        if reply.error:
            print(f"mapweave: another map server refused: {reply.error}", file=sys.stderr)
    return good
