"""Two nodes or two maps on the command line, and what people hear about words in the place of nodes."""

import sys
from collections.abc import Callable

from mapweave.commands.usage import UsageError, arguments_read
from mapweave.hybridmap.constraint_subject import EXAMPLE, Ends, read_end, read_ends
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.named_nodes import Resolve, is_id, noting
from mapweave.hybridmap.query import ResolveAnswer, ResolveRequest


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


def check_ids(words: list[str], read: Callable[[list[str]], object]) -> None:
    """Let ids be read before anything is asked: what is wrong with them is so without a server, too.

    Raises:
        UsageError: see `read`.
    """
    if all(map(is_id, words)):
        with arguments_read():
            read(words)


def noted(resolve: Resolve) -> Resolve:
    """The same, with what is to be said about the nodes on stderr."""

    def answer(request: ResolveRequest) -> ResolveAnswer:
        notes: list[str] = []
        answered = noting(resolve, notes)(request)
        for note in notes:
            print(f"mapweave: {note}", file=sys.stderr)
        return answered

    return answer


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


def nodes_of(words: list[str]) -> list[NodeId]:
    """Read nodes; see `node_of`."""
    return list(map(node_of, words))


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
