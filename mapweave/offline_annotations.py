"""Annotations of a map without a server: by the shell (`--map`) and from Python the same.

`OfflineAnnotations` has the methods of mapweave.fleet.Fleet, and writes files. `mapweave.file_map.FileMap`
changes its map in memory by the same two functions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from mapweave.annotation_methods import AnnotationMethods
from mapweave.hybridmap.annotation import Annotation, Annotations
from mapweave.hybridmap.errors import InvalidFile, InvalidValue
from mapweave.hybridmap.floor_plan import FloorPlan, PlacedPlans, PlanImage
from mapweave.hybridmap.manual_constraint import ManualConstraints
from mapweave.hybridmap.named_nodes import NodeWord, asked_of
from mapweave.hybridmap.pin import Pin
from mapweave.hybridmap.query import ResolveAnswer, ResolveRequest
from mapweave.mapserver.annotation_effects import effects_of
from mapweave.mapserver.annotator import CHECKED, check_annotation, check_edge
from mapweave.mapserver.floor_plans import placed_plans
from mapweave.mapserver.places import PlaceResolver
from mapweave.mapserver.routes import Router
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.settings import MergeSettings
from mapweave.opened_map import MapSource, open_map
from mapweave.refusals import refusals
from mapweave.storage.atomic_file import check_place
from mapweave.storage.map_file import MapFile
from mapweave.storage.plan_image import check_plan_png

if TYPE_CHECKING:
    # It needs an extra, and what only looks does not.
    from mapweave.offline_merge import Progress


def checked_annotation(
    content: MapFile, router: Router, annotation: Annotation, plan_image: Callable[[str], bytes]
) -> str:
    """What an annotation says and does, in words.

    Args:
        content: of the map.
        router: of the map, without the annotation.
        annotation: new.
        plan_image: returns the PNG file of a floor plan by its name; raises if there is none.

    Raises:
        Refused: it says nothing new, or is about something that is not there.
    """
    said = Annotations(content.annotations)
    with refusals():
        check_annotation(router.merged, said, annotation, ManualConstraints(content.constraints))
        check_edge(router, said, annotation)
    if isinstance(annotation.body, FloorPlan) and not annotation.removed:
        plan_image(annotation.body.image.sha256)
    return "; ".join((annotation.words, *effects_of(annotation, PlaceResolver(router, said))))


def with_annotation(content: MapFile, annotation: Annotation, images: Mapping[str, bytes]) -> MapFile:
    """The content with an annotation, and with those images that a plan names; its poses as they were.

    Args:
        content: of the map. It is not changed.
        annotation: as `checked_annotation` has passed it.
        images: PNG files of floor plans, by their names, also those that no plan names yet.
    """
    said = Annotations((*content.annotations, annotation))
    used = {plan.image.sha256 for _, plan in said.in_force(FloorPlan)}
    kept = {name: png for name, png in images.items() if name in used}
    return replace(content, annotations=said.made, images=kept)


def _unseen() -> AbstractContextManager[Progress]:
    return nullcontext(lambda done, of: None)


class OfflineAnnotations(AnnotationMethods):
    """The annotations of one map. Map files are written; a store is only read, since it is its server's."""

    def __init__(
        self,
        path: Path | str,
        out: Path | None = None,
        by: str = "a person",
        settings: MergeSettings | None = None,
        progress: Callable[[], AbstractContextManager[Progress]] = _unseen,
    ) -> None:
        """Read a map.

        Args:
            path: of the file, store or journal; or the address of a PostgreSQL database.
            out: where the file with new annotations is written; over the old file by default.
            by: says so.
            settings: with which the file was merged.
            progress: within it the map is merged; shows how far that is.

        Raises:
            InvalidFile: it cannot be read.
        """
        self._by, self._settings, self._progress = by, settings, progress
        self._opened = open_map(path)
        self._out = Path(path) if out is None and self._opened.source is MapSource.FILE else out
        self._images = dict(self._opened.content.images)

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
            return PlaceResolver(self._router, self.annotations()).answer(asked)

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

    @property
    def merged(self) -> MergedMap:
        """The merged map of the file."""
        return self._router.merged

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
