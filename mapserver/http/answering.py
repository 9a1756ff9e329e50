"""What the HTTP server asks the map server."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from typing import Protocol

from mapweave.hybridmap.explanation import Explanation
from mapweave.hybridmap.manual_constraint import ConstraintList, ConstraintRequest
from mapweave.hybridmap.mission_order import MissionKind, MissionReport, Missions
from mapweave.hybridmap.query import ExplainRequest, RelocalizeAnswer, View
from mapweave.mapserver.http.annotations import Annotating
from mapweave.mapserver.http.live import Shown
from mapweave.mapserver.http.nodes import Showing
from mapweave.mapserver.http.plans import Planning


class Answering(Annotating, Planning, Showing, Shown, Protocol):
    """The questions, as of a MapServer or a map file: from any thread; a MapweaveError refuses one."""

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
