"""Ids for what people write: ids of nodes and maps stay, names of places and positions are looked up."""

from collections.abc import Callable, Iterable
from numbers import Real
from typing import TypeGuard, cast

import numpy as np

from mapweave.hybridmap.annotation import Annotations, Place
from mapweave.hybridmap.constraint_subject import (
    RetiredArea,
    RetiredMap,
    RetiredNodes,
    read_end,
    read_retired,
)
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.query import ResolveAnswer, ResolveRequest

Position = tuple[float, float]
"""x and y in the frame of a component, or of a floor plan, m."""
NodeWord = NodeId | str | Position
"""A node, also as people write it: `r0.1.17`, the name of a place, a position `3.1,-2.0` or `(3.1, -2.0)`."""
Resolve = Callable[[ResolveRequest], ResolveAnswer]
"""Returns nodes for words, of a map; raises InvalidValue for a word that is none."""
Record = Callable[[], Annotations]
"""Returns the annotations of the same map."""


def word_of(node: NodeWord | MapId) -> str:
    """A node, or a map, as people write it; a position to a millimetre.

    Raises:
        InvalidValue: it is neither of these, nor text, nor two numbers.
    """
    if isinstance(node, str | NodeId | MapId):
        return str(node)
    if is_position(node):
        return ",".join(str(round(float(number), 3)) for number in node)
    raise InvalidValue(f"{node!r:.40}: give a node (r0.1.17), the name of a place, or a position (3.1, -2.0)")


def is_position(value: object) -> TypeGuard[Position]:
    """Whether a value is two numbers, in a tuple, a list or an array."""
    return (
        isinstance(value, tuple | list | np.ndarray)
        and len(value) == 2
        and all(isinstance(number, Real) for number in value)
    )


def asked_of(words: ResolveRequest | NodeWord | Iterable[NodeWord]) -> ResolveRequest:
    """A question for nodes: one word, several, or the question itself.

    Raises:
        InvalidValue: it is none of these.
    """
    if isinstance(words, ResolveRequest):
        return words
    if isinstance(words, list | tuple) and not isinstance(words, NodeId) and not is_position(words):
        return ResolveRequest(tuple(map(word_of, words)))
    return ResolveRequest((word_of(cast(NodeWord, words)),))


def ids_of(words: Iterable[str], resolve: Resolve, near: str = "") -> list[str]:
    """An id for each word: nodes (`r0.1.17`) and maps (`r0.1`) as they are, active nodes for all else.

    Ids are not looked up: a retired node has no place in the map, and can be taken back all the same.

    Args:
        words: as people write them.
        resolve: returns nodes for words.
        near: a node or place in the component in whose frame positions are; empty: the largest one.

    Raises:
        InvalidValue: a word is neither an id, nor the name of a place, nor a position.
    """
    written = [word.strip() for word in words]
    asked = tuple(dict.fromkeys(word for word in written if not is_id(word)))
    found = resolve(ResolveRequest(asked, near)).found if asked else ()
    ids = {word: str(one.node) for word, one in zip(asked, found, strict=True)}
    return [ids.get(word, word) for word in written]


def noting(resolve: Resolve, notes: list[str]) -> Resolve:
    """The same, which adds what people need to hear about the nodes to `notes`, a line for each word."""

    def answer(request: ResolveRequest) -> ResolveAnswer:
        answered = resolve(request)
        found = zip(request.words, answered.found, strict=True)
        notes.extend(f"{word}: {one.note}" for word, one in found if one.note)
        return answered

    return answer


def own_ids_of(words: Iterable[str], annotations: Record, resolve: Resolve) -> list[str]:
    """Likewise, for corrections: a place that is a node means that node, active or not.

    So the same name takes back what it has set, whatever has become of the node in between.

    Raises:
        InvalidValue: see `ids_of`.
    """
    own = [str(place.node) if place and place.node else word for word, place in _places(words, annotations)]
    return ids_of(own, resolve)


def retired_of(
    words: Iterable[str], annotations: Record, resolve: Resolve
) -> RetiredMap | RetiredNodes | RetiredArea:
    """One map, some nodes, or a named area, as people write them; see `own_ids_of`.

    Raises:
        InvalidValue: they are none of these, or an area and something else.
    """
    places = _places(words, annotations)
    for word, place in places:
        if place is not None and place.area is not None:
            if len(places) > 1:
                raise InvalidValue(f"place {word} is an area: give it alone")
            return RetiredArea(place.area)
    return read_retired(own_ids_of((word for word, _ in places), annotations, resolve))


def _places(words: Iterable[str], annotations: Record) -> list[tuple[str, Place | None]]:
    """Each word, and the place of which it is the name."""
    written = [word.strip() for word in words]
    known = Annotations() if all(map(is_id, written)) else annotations()
    entries = [known.last("place", word) for word in written]
    bodies = [entry.body if entry is not None else None for entry in entries]
    return [
        (word, body if isinstance(body, Place) else None) for word, body in zip(written, bodies, strict=True)
    ]


def is_id(word: str) -> bool:
    """Whether it is the id of a node or of a map, and so is not looked up."""
    try:
        read_end(word)
    except InvalidValue:
        return False
    return True
