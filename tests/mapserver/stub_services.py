"""A server with scripted answers, and a picture to ask about."""

from collections.abc import Callable
from concurrent.futures import Future
from functools import cache

import cv2
import numpy as np

from mapweave.hybridmap.agent_status import FleetStatus
from mapweave.hybridmap.annotation import Annotations
from mapweave.hybridmap.errors import Busy, InvalidValue
from mapweave.hybridmap.explanation import Explanation, FleetExplanation
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.map_event import MapEvent
from mapweave.hybridmap.mission_order import MissionKind, MissionReport, Missions
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.query import (
    Certainty,
    ExplainRequest,
    RelocalizeAnswer,
    ResolveAnswer,
    ResolveRequest,
    View,
    Whereabouts,
)
from mapweave.mapserver.node_views import NoView
from mapweave.mapserver.places import PlaceResolver
from mapweave.mapserver.route_explaining import explain_route
from mapweave.mapserver.routes import Router
from mapweave.merge.explanation.map_explanation import explain_fleet, explain_maps
from mapweave.merge.explanation.node_explanation import explain_nodes
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.wire.log_messages import Scalar
from synthetic.maps import looked_around, merger_of

HERE = PoseGaussian.from_sigmas(Pose2(0.5, -0.25, 0.1), 0.02, 0.01)
ANSWER = RelocalizeAnswer(
    Certainty.FOUND,
    (Whereabouts(NodeId("r0", 1, 7), HERE, None, -1, 31, 0.99),),
    "31 landmarks of r0.1.7 agree",
)

PLACE = RelocalizeAnswer(
    Certainty.PLACE,
    (Whereabouts(NodeId("r0", 1, 7), HERE, None, -1, 31, 0.9, distance_known=False),),
    "31 landmarks of r0.1.7 agree",
)


class StubServices:
    """Answers everything alike and remembers what was asked, or does what the test says."""

    def __init__(self) -> None:
        self.views: list[View] = []
        self.refusal: Exception | None = None
        self.answer = ANSWER
        self.holds: dict[str, Scalar] = {"nodes": 12, "summary": "12 nodes"}
        self.events: tuple[MapEvent, ...] = ()
        self.map: MergedMap | None = None
        self.fleet = FleetStatus()
        self.said = Annotations()
        self.ways: list[tuple[str, tuple[str, ...]]] = []
        self.reasons: list[str] = []
        self.read_only = False
        self.images: dict[NodeId, bytes] = {}

    def merged(self) -> MergedMap:
        return self.map or two_maps()

    def attend(self) -> None:
        pass

    def robots(self) -> FleetStatus:
        return self.fleet

    def status(self) -> dict[str, Scalar]:
        return self.holds

    def history(self) -> tuple[MapEvent, ...]:
        return self.events

    def annotations(self) -> Annotations:
        return self.said

    def missions(self) -> Missions:
        return Missions(())

    def give(
        self,
        robot: str,
        kind: MissionKind,
        goal: str,
        by: str,
        mission_id: str,
        via: tuple[str, ...],
        because: str = "",
    ) -> MissionReport:
        self.ways.append((goal, via))
        self.reasons.append(because)
        raise InvalidValue(f"{robot} stays where it is")

    def resolve(self, request: ResolveRequest) -> ResolveAnswer:
        return PlaceResolver(Router(self.merged()), self.annotations()).answer(request)

    def why_no_view(self, node: NodeId) -> str:
        return "" if node in self.images else f"{node.agent} is away, or keeps no views"

    def view(self, node: NodeId) -> bytes:
        if node not in self.images:
            raise NoView(self.why_no_view(node))
        return self.images[node]

    def metrics(self) -> bytes:
        return b"mapweave_nodes 12.0\n"

    def locate(self, look: Callable[[], View], ticket: int) -> Future[RelocalizeAnswer]:
        done: Future[RelocalizeAnswer] = Future()
        if isinstance(self.refusal, Busy):
            raise self.refusal
        try:
            self.views.append(look())
            if self.refusal is not None:
                raise self.refusal
            done.set_result(self.answer)
        except Exception as error:  # noqa: BLE001 - as a worker would
            done.set_exception(error)
        return done

    def explain(self, request: ExplainRequest) -> Future[Explanation]:
        done: Future[Explanation] = Future()
        if isinstance(self.refusal, Busy):
            raise self.refusal
        try:
            done.set_result(_explained(request))
        except Exception as error:  # noqa: BLE001 - as a worker would
            done.set_exception(error)
        return done


@cache
def _explained(request: ExplainRequest) -> Explanation:
    merged = two_maps()
    if request.ends is None:
        return FleetExplanation(explain_fleet(merged, 10))
    first, second = request.ends
    if isinstance(first, NodeId) and isinstance(second, NodeId):
        if request.route:
            return explain_route(Router(merged), first, second)
        return explain_nodes(merged, first, second)
    return FleetExplanation((explain_maps(merged, MapId(*first[:2]), MapId(*second[:2])),))


@cache
def two_maps() -> MergedMap:
    """Two robots have looked around in one room."""
    return merger_of(looked_around((MapId("r0", 1), MapId("r1", 1)), seed=6)).merged()


def picture(width: int = 160, height: int = 120, kind: str = ".png") -> bytes:
    """Something with features in it."""
    noise = np.random.default_rng(1).integers(0, 255, (height // 8, width // 8)).astype(np.uint8)
    image = cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC)
    return bytes(cv2.imencode(kind, image)[1].tobytes())
