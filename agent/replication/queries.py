"""Questions to the map server and their answers as messages."""

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

from mapweave.agent.mission import AnswerContent, MayIDrive, Question, WhatIsKnown, WhereAmI, WhoIsNear
from mapweave.hybridmap.errors import InvalidMessage
from mapweave.hybridmap.nearby import NearbyAnswer, NearbyRequest
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.query import (
    Certainty,
    KnownAnswer,
    KnownRequest,
    RelocalizeAnswer,
    ReserveAnswer,
    ReserveRequest,
    RouteAnswer,
    RouteRequest,
)
from mapweave.wire.keys import Keys
from mapweave.wire.messages import decode, encode, encode_view
from mapweave.wire.senders import sent_by

FARTHEST = 100.0
"""m; no robot sees a node, or drives from one node to the next, from further away. Nodes of recordings from
cars lie up to ten metres apart."""


def encode_query(keys: Keys, question: Question, robot: str) -> tuple[str, bytes]:
    """Which server to ask, and how.

    Raises:
        InvalidValue: no message can hold it.
    """
    if isinstance(question, WhereAmI):
        view = replace(question.view, near=question.near)
        return sent_by(keys.any_relocalize(), robot), encode_view(view)
    if isinstance(question, WhatIsKnown):
        around = KnownRequest(question.map, question.x, question.y, question.reach)
        return sent_by(keys.any_known(), robot), encode(around)
    if isinstance(question, MayIDrive):
        reserve = ReserveRequest(robot, question.start, question.start_from_robot, question.route)
        return sent_by(keys.any_reserve(), robot), encode(reserve)
    if isinstance(question, WhoIsNear):
        q = question
        who = NearbyRequest(robot, q.starts, q.sigma, q.heading_sigma, q.radius, q.height, q.speed)
        return sent_by(keys.any_nearby(), robot), encode(who)
    way = question
    request = RouteRequest(way.start, way.goal, way.blocked, way.start_from_robot, way.obstacles)
    return sent_by(keys.any_route(), robot), encode(request)


def decode_answer(question: Question, payload: bytes) -> AnswerContent:
    """A server's answer to a question.

    Raises:
        InvalidMessage: it is no answer to it, or one that no robot can act on.
    """
    if isinstance(question, WhereAmI):
        answer = decode(payload, RelocalizeAnswer)
        for best in answer.candidates[:1]:
            _check_near(best.node_from_robot.mean, f"whereabouts: the robot, seen from node {best.node},")
        return answer
    if isinstance(question, WhatIsKnown):
        return decode(payload, KnownAnswer)
    if isinstance(question, MayIDrive):
        return decode(payload, ReserveAnswer)
    if isinstance(question, WhoIsNear):
        return decode(payload, NearbyAnswer)
    route = decode(payload, RouteAnswer)
    for leg in route.legs:
        _check_near(leg.previous_from_node.mean, f"route: the leg to node {leg.node.id}")
    end = question.goal if route.portal is None else route.portal.entry
    if route.legs and route.legs[-1].node.id != end:
        raise InvalidMessage(f"route: it ends at node {route.legs[-1].node.id}, not at {end}")
    nodes = [leg.node.id for leg in route.legs]
    if twice := next((node for k, node in enumerate(nodes) if node in nodes[:k]), None):
        raise InvalidMessage(f"route: it leads in a circle, to node {twice} twice")
    blocked = {frozenset(pair) for pair in question.blocked}
    for a, b in pairwise(nodes):
        if frozenset((a, b)) in blocked:
            raise InvalidMessage(f"route: it leads from {a} to {b}, where the robot did not get through")
    return route


def settles(answer: AnswerContent) -> bool:
    """Whether no other server's answer is waited for.

    One that is new, or gets its store again, does not know yet what others do. And a robot drives only where
    every server lets it.
    """
    match answer:
        case RelocalizeAnswer():
            return answer.certainty in (Certainty.FOUND, Certainty.PLACE)
        case RouteAnswer():
            return bool(answer.legs)
    return False


def best(answers: Sequence[AnswerContent]) -> AnswerContent:
    """The one of several servers' answers that a robot acts on; of equals the first."""

    def rank(answer: AnswerContent) -> tuple[bool, float]:
        match answer:
            case ReserveAnswer():
                return not answer.closed, answer.granted
            case KnownAnswer():
                return False, -len(answer.views)
            case NearbyAnswer():
                return False, -len(answer.robots)
        return not settles(answer), 0.0

    return min(answers, key=rank)


def _check_near(pose: Pose2, name: str) -> None:
    distance = math.hypot(pose.x, pose.y)
    if distance > FARTHEST:
        raise InvalidMessage(f"{name} is {distance:.0f} m away, more than {FARTHEST:g} m")
