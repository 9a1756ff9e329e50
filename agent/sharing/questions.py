"""Questions to the map server and their answers as messages."""

from __future__ import annotations

from agent.mission import Question, WhatIsKnown, WhereAmI
from hybridmap.query import KnownAnswer, RelocalizeAnswer, RouteAnswer
from wire.keys import Keys
from wire.messages import (
    KnownRequest,
    RouteRequest,
    decode_known_answer,
    decode_relocalize_answer,
    decode_route_answer,
    encode_known_request,
    encode_route_request,
    encode_view,
)


def encode_question(keys: Keys, question: Question) -> tuple[str, bytes]:
    """Whom to ask, and how.

    Args:
        keys: of the fleet.
        question: any.

    Raises:
        InvalidValue: no message can hold it.
    """
    if isinstance(question, WhereAmI):
        return keys.any_relocalize(), encode_view(question.view)
    if isinstance(question, WhatIsKnown):
        around = KnownRequest(question.map, question.x, question.y, question.reach)
        return keys.any_known(), encode_known_request(around)
    request = RouteRequest(question.start, question.goal, question.blocked, question.start_from_robot)
    return keys.any_route(), encode_route_request(request)


def decode_answer(question: Question, payload: bytes) -> RelocalizeAnswer | RouteAnswer | KnownAnswer:
    """What a server says to a question.

    Raises:
        InvalidMessage: it is no answer to it.
    """
    if isinstance(question, WhereAmI):
        return decode_relocalize_answer(payload)
    if isinstance(question, WhatIsKnown):
        return decode_known_answer(payload)
    return decode_route_answer(payload)
