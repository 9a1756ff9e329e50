"""A map that is opened, served to people as a map server serves its own, without robots. It never changes."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cached_property
from importlib.metadata import version
from typing import NoReturn

from mapweave.hybridmap.agent_status import FleetStatus
from mapweave.hybridmap.annotation import Annotations
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.explanation import Explanation
from mapweave.hybridmap.floor_plan import PlacedPlans
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.manual_constraint import ConstraintList, ManualConstraints
from mapweave.hybridmap.map_event import MapEvent
from mapweave.hybridmap.mission_order import Missions
from mapweave.hybridmap.query import ExplainRequest, RelocalizeAnswer, ResolveAnswer, ResolveRequest, View
from mapweave.mapserver.admission_control import AdmissionControl
from mapweave.mapserver.constraint_history import with_constraints
from mapweave.mapserver.explanations import explained
from mapweave.mapserver.floor_plans import placed_plans
from mapweave.mapserver.node_views import NoView
from mapweave.mapserver.places import PlaceResolver
from mapweave.mapserver.routes import Router
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.settings import MergeSettings
from mapweave.offline_relocalization import relocalizer_in
from mapweave.opened_map import OpenedMap
from mapweave.storage.map_file import pack_map_file
from mapweave.wire.log_messages import Scalar

NO_VIEWS = "a map file has no views"


def _refused(why: str) -> Callable[..., NoReturn]:
    """A method that refuses to change anything, as InvalidValue."""

    def refuse(self: ReadOnlyServer, *_: object) -> NoReturn:
        raise InvalidValue(
            f"{self._opened.name} is only shown, and nothing of it changes: {why}; "
            "`mapweave server --map FILE` serves it to robots"
        )

    return refuse


class ReadOnlyServer:
    """Answers what `mapserver.http.web.Web` asks. A context manager; any thread may ask."""

    annotate = _refused("`mapweave place add --map FILE -o OUT` and the like write an annotated copy")
    put_plan_image = _refused("`mapweave plan add --map FILE -o OUT` writes a copy with a plan")
    constrain = _refused("`mapweave map link | unmerge | retire --map FILE -o OUT` write a corrected copy")
    give = _refused("there are no robots to send")
    portal_done = _refused("there are no robots")
    metrics = _refused("a map file has no metrics")

    def __init__(self, opened: OpenedMap, merged: MergedMap, settings: MergeSettings | None = None) -> None:
        """Begin to prepare answers, in the background.

        Args:
            opened: the map.
            merged: `opened.merged(settings)`.
            settings: how it is explained.
        """
        self._opened = opened
        self._merged = merged
        self._consistency = (settings or MergeSettings()).consistency
        self._admission = AdmissionControl()
        self._background = ThreadPoolExecutor(1, thread_name_prefix="opened map")
        self._relocalizer = self._background.submit(relocalizer_in, merged)
        self._annotations = Annotations(opened.content.annotations)
        self._router = self._background.submit(Router, merged)

    def __enter__(self) -> ReadOnlyServer:
        """Nothing is left to do."""
        return self

    def __exit__(self, *_: object) -> None:
        """Stop answering."""
        self._admission.close()
        self._background.shutdown(cancel_futures=True)

    def locate(self, look: Callable[[], View], ticket: int) -> Future[RelocalizeAnswer]:
        """Where a view was taken; see `MapServer.locate`.

        Raises:
            Busy: too many ask.
        """
        return self._admission.submit(
            lambda: self._places().named(self._relocalizer.result().answer(look())), ticket
        )

    def explain(self, request: ExplainRequest) -> Future[Explanation]:
        """Explain a merge or a route.

        Raises:
            Busy: too many ask.
        """
        return self._admission.submit(
            lambda: explained(request, self._places().router, self._consistency), usual=False
        )

    def status(self) -> dict[str, Scalar]:
        """What the map holds."""
        return {
            **self._merged.counts(),
            "damaged": len(self._opened.complaints),
            "event": "",
            "settled": True,
            "summary": self._merged.summary(),
            "version": version("mapweave"),
            "file": self._opened.name,
            "source": str(self._opened.source),
        }

    @property
    def read_only(self) -> bool:
        """Nothing can be changed."""
        return True

    def attend(self) -> None:
        """Nothing: there is no robot."""

    def merged(self) -> MergedMap:
        """The map."""
        return self._merged

    def history(self) -> tuple[MapEvent, ...]:
        """What became of the maps until the file was written, and what people decided."""
        content = self._opened.content
        return with_constraints(content.history, ManualConstraints(content.constraints), self._annotations)

    def annotations(self) -> Annotations:
        """What people say about the map."""
        return self._annotations

    def plans(self) -> PlacedPlans:
        """Floor plans under the map."""
        return placed_plans(self._annotations, self._merged)

    def plan_image(self, name: str) -> bytes:
        """The PNG file of a floor plan.

        Raises:
            InvalidValue: there is none of this name, or its image is not in the file.
        """
        image = self.plans().plan(name).plan.image
        if image.sha256 not in self._opened.content.images:
            raise InvalidValue(f"the image of plan {name} is not in {self._opened.name}")
        return self._opened.content.images[image.sha256]

    def kept_image(self, sha256: str) -> bytes:
        """The PNG file of an image of the map file.

        Raises:
            InvalidValue: it is not in the file.
        """
        if sha256 not in self._opened.content.images:
            raise InvalidValue(f"the image {sha256[:12]} is not in {self._opened.name}")
        return self._opened.content.images[sha256]

    def resolve(self, request: ResolveRequest) -> ResolveAnswer:
        """Nodes for words.

        Raises:
            InvalidValue: a word is none, with the reason.
        """
        return self._places().answer(request)

    def robots(self) -> FleetStatus:
        """There are none."""
        return FleetStatus()

    def missions(self) -> Missions:
        """There are none."""
        return Missions()

    def why_no_view(self, node: NodeId) -> str:
        """Maps have no images."""
        return NO_VIEWS

    def view(self, node: NodeId) -> bytes:
        """Refuse.

        Raises:
            NoView: always.
        """
        raise NoView(NO_VIEWS)

    def constraints(self) -> ConstraintList:
        """What people decided, in order."""
        return ConstraintList(tuple(self._opened.content.constraints))

    def map_file(self) -> Future[bytes]:
        """The map as a map file."""
        return self._background.submit(lambda: self._packed)

    def _places(self) -> PlaceResolver:
        router = self._router.result().at(self._annotations, time.time_ns())
        return PlaceResolver(router, self._annotations)

    @cached_property
    def _packed(self) -> bytes:
        return pack_map_file(self._opened.file(self._merged))
