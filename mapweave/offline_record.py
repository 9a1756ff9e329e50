"""What people say about a map, and decide on it, without a server: by the shell (`--map`).

`OfflineRecord` has these methods of mapweave.fleet.Fleet, and writes files. `mapweave.file_map.FileMap`
changes its map in memory by the same functions.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from mapweave.annotation_methods import AnnotationMethods
from mapweave.constraint_methods import ConstraintMethods
from mapweave.hybridmap.annotation import Annotation, Annotations
from mapweave.hybridmap.errors import InvalidFile, InvalidValue
from mapweave.hybridmap.explanation import Explanation
from mapweave.hybridmap.floor_plan import PlacedPlans, PlanImage
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.manual_constraint import ConstraintRequest, ManualConstraint, ManualConstraints
from mapweave.hybridmap.map_event import MapEvent
from mapweave.hybridmap.named_nodes import NodeWord, asked_of
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pin import Pin
from mapweave.hybridmap.query import ExplainRequest, RelocalizeAnswer, ResolveAnswer, ResolveRequest, View
from mapweave.mapserver.annotator import CHECKED
from mapweave.mapserver.constraint_history import with_constraints
from mapweave.mapserver.floor_plans import placed_plans
from mapweave.mapserver.places import PlaceResolver
from mapweave.mapserver.routes import Router
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.settings import MergeSettings
from mapweave.offline_annotations import checked_annotation, with_annotation
from mapweave.opened_map import MapSource, OpenedMap
from mapweave.refusals import refusals
from mapweave.storage.atomic_file import check_place
from mapweave.storage.map_file import MapFile
from mapweave.storage.plan_image import check_plan_png

if TYPE_CHECKING:
    # It needs an extra, and what only looks does not.
    from mapweave.offline_merge import Progress


def _unseen() -> AbstractContextManager[Progress]:
    return nullcontext(lambda done, of: None)


class OfflineRecord(AnnotationMethods, ConstraintMethods):
    """The record of one map. Map files are written; a store is only read, since it is its server's."""

    def __init__(
        self,
        opened: OpenedMap,
        out: Path | None = None,
        by: str = "a person",
        settings: MergeSettings | None = None,
        progress: Callable[[], AbstractContextManager[Progress]] = _unseen,
    ) -> None:
        """Take a map.

        Args:
            opened: a file, store or journal.
            out: where the file with what is new is written; over the old file by default.
            by: says so.
            settings: with which the file was merged.
            progress: within it the map is merged; shows how far that is.
        """
        self._opened, self._by, self._progress = opened, by, progress
        self._settings = settings or MergeSettings()
        of_file = isinstance(opened.path, Path) and opened.source is MapSource.FILE
        self._out = Path(opened.path) if out is None and of_file else out
        self._over = out is None
        self._images = dict(opened.content.images)

    def annotations(self) -> Annotations:
        """What people say about the map."""
        return Annotations(self._opened.content.annotations)

    def resolve(self, request: ResolveRequest | NodeWord | Iterable[NodeWord]) -> ResolveAnswer:
        """Nodes for words.

        Raises:
            InvalidValue: it is no text.
            Refused: a word is none, with the reason.
        """
        asked = asked_of(request)
        with refusals():
            return self._places.answer(asked)

    def plans(self) -> PlacedPlans:
        """Floor plans under the map."""
        return placed_plans(self.annotations(), self.merged)

    def plan_image(self, sha256: str) -> bytes:
        """The PNG file of a plan.

        Raises:
            InvalidFile: it is not in the file.
        """
        if sha256 not in self._images:
            raise InvalidFile(f"the image {sha256[:12]} of a plan is not in the file: add the plan again")
        return self._images[sha256]

    def put_plan_image(self, png: bytes) -> PlanImage:
        """See Fleet.put_plan_image; the file is written with the annotation that names the image."""
        image = check_plan_png(png)
        self._images[image.sha256] = png
        return image

    def constraints(self) -> tuple[ManualConstraint, ...]:
        """What people have linked, unmerged, retired and taken back, in order; the first is number 1."""
        return tuple(self._opened.content.constraints)

    def keep(self, request: ConstraintRequest) -> str:
        """Write a manual constraint, and the map merged with it, unless it is only checked.

        Raises:
            Refused: the map contradicts it, or it has no effect: the evidence, and what to do.
            InvalidFile: there is no place to write it.
        """
        content = self._opened.content
        if not request.check and self._over and content.kind != "merged":
            of_file = self._opened.source is MapSource.FILE
            kind = "a map file of kind agent, not merged," if of_file else self._opened.source.words
            raise InvalidFile(
                f"{self._opened.path}: is {kind} and is not changed: give -o FILE for a merged map with the "
                f"constraint{'' if of_file else ', or ask the running server without --map'}"
            )
        self._check_writable(request.check)
        from mapweave.offline_constraints import checked_constraint, with_constraint

        before = self.merged
        constraint, words = checked_constraint(content, before, request.constraint, self._settings)
        if request.check:
            return CHECKED + words
        assert self._out is not None, "it is writable"
        with self._progress() as report:
            merged, file = with_constraint(self._opened, before, constraint, self._settings, report)
        self._opened = replace(self._opened.written(self._out, file), content=file)
        self._router = Router(merged)
        return f"{words}\n{self._out}: {merged.summary()}"

    def history(self) -> tuple[MapEvent, ...]:
        """What became of the maps until the file was written, and what people decided."""
        decided = ManualConstraints(self._opened.content.constraints)
        return with_constraints(self._opened.content.history, decided, self.annotations())

    def explained(self, request: ExplainRequest) -> Explanation:
        """An explanation of the kind that the request asks for, by what is closed now.

        Raises:
            Refused: what it is about is not there.
        """
        from mapweave.mapserver.explanations import explained

        with refusals():
            return explained(request, self._places.router, self._settings.consistency)

    def locate(self, view: View) -> RelocalizeAnswer:
        """Where a view was taken."""
        from mapweave.offline_relocalization import relocalizer_in

        return self._places.named(relocalizer_in(self.merged).answer(view))

    def node(self, node: NodeId) -> Node:
        """A node that an answer names."""
        return self.merged.maps[node.map].nodes[node]

    def map(self) -> MapFile:
        """The content of a file of the merged map."""
        from mapweave.mapserver.map_files import map_file_of

        return map_file_of(self.merged)

    @property
    def merged(self) -> MergedMap:
        """The merged map."""
        return self._router.merged

    @property
    def _places(self) -> PlaceResolver:
        said = self.annotations()
        return PlaceResolver(self._router.at(said, time.time_ns()), said)

    @cached_property
    def _router(self) -> Router:
        with self._progress() as report:
            return Router(self._opened.merged(self._settings, report))

    def _check_writable(self, check: bool) -> None:
        if check:
            return
        if self._out is None:
            raise InvalidValue(
                f"{self._opened.path} is {self._opened.source.words}, which is not written: give -o"
            )
        check_place(self._out)

    def _say(self, annotation: Annotation, check: bool) -> str:
        words = checked_annotation(self._opened.content, self._router, annotation, self.plan_image)
        if check or self._out is None:
            return CHECKED + words
        content = with_annotation(self._opened.content, annotation, self._images)
        self._opened = replace(self._opened, content=content)
        moved = isinstance(annotation.body, Pin)
        if moved:
            del self._router
        content = self._opened.file(self.merged)
        if moved and content.poses:
            content = replace(content, poses=dict(self.merged.poses))
        self._opened = self._opened.written(self._out, content)
        return words
