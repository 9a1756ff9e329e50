"""What the HTTP server asks the map server."""

from collections.abc import Callable
from concurrent.futures import Future
from typing import Protocol

from mapweave.hybridmap.agent_status import FleetStatus
from mapweave.hybridmap.annotation import Annotation, Annotations
from mapweave.hybridmap.explanation import Explanation
from mapweave.hybridmap.floor_plan import PlacedPlans, PlanImage
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.manual_constraint import ConstraintList, ConstraintRequest
from mapweave.hybridmap.map_event import MapEvent
from mapweave.hybridmap.mission_order import MissionKind, MissionReport, Missions
from mapweave.hybridmap.query import ExplainRequest, RelocalizeAnswer, ResolveAnswer, ResolveRequest, View
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.wire.log_messages import Scalar


class Answering(Protocol):
    """The questions, as of a MapServer or a map file: from any thread; a MapweaveError refuses one."""

    def annotations(self) -> Annotations:
        """What people say about the map."""

    def annotate(self, annotation: Annotation, check: bool = False) -> str:
        """Add an annotation, or only check it."""

    def merged(self) -> MergedMap:
        """The newest merged map; the same object as long as nothing has changed."""

    def resolve(self, request: ResolveRequest) -> ResolveAnswer:
        """Nodes for words."""

    def why_no_view(self, node: NodeId) -> str:
        """Why asking for the image of a node is of no use; empty if it is worth it."""

    def view(self, node: NodeId) -> bytes:
        """The image of a node, a JPEG file; NoView says why there is none."""

    def plans(self) -> PlacedPlans:
        """Floor plans under the newest merged map."""

    def plan_image(self, name: str) -> bytes:
        """The PNG file of a plan."""

    def kept_image(self, sha256: str) -> bytes:
        """The PNG file of an image, by its content."""

    def put_plan_image(self, data: bytes, negate: bool = False) -> PlanImage:
        """Keep the image of a plan."""

    @property
    def read_only(self) -> bool:
        """Whether nothing can be changed, and no robot be moved, as with a map file."""

    def attend(self) -> None:
        """An operator is there; must not wait."""

    def robots(self) -> FleetStatus:
        """The robots, and where they are."""

    def history(self) -> tuple[MapEvent, ...]:
        """The history of the maps."""

    def status(self) -> dict[str, Scalar]:
        """What the server holds and does."""

    def locate(self, look: Callable[[], View], ticket: int) -> Future[RelocalizeAnswer]:
        """Where a view was taken."""

    def explain(self, request: ExplainRequest) -> Future[Explanation]:
        """Explain a merge or a route."""

    def missions(self) -> Missions:
        """The missions that are known."""

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
        """Give a robot a mission; waits for its answer."""

    def map_file(self) -> Future[bytes]:
        """The merged map as a map file."""

    def metrics(self) -> bytes:
        """What Prometheus scrapes."""

    def portal_done(self, robot: str, by: str) -> str:
        """Tell a robot that it was taken through a portal."""

    def constraints(self) -> ConstraintList:
        """The record of manual constraints."""

    def constrain(self, request: ConstraintRequest) -> str:
        """Keep a manual constraint, or only check it; says what it does."""
