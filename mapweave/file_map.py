"""A map from a file: `mapweave.open`."""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING

from mapweave.editable_map import EditableMap
from mapweave.extras import need
from mapweave.hybridmap.annotation import Annotation, Annotations
from mapweave.hybridmap.errors import Refused
from mapweave.hybridmap.explanation import Explanation
from mapweave.hybridmap.floor_plan import PlacedPlans, PlanImage
from mapweave.hybridmap.manual_constraint import ConstraintRequest, ManualConstraint
from mapweave.hybridmap.named_nodes import NodeWord, asked_of
from mapweave.hybridmap.pin import Pin
from mapweave.hybridmap.query import ExplainRequest, RelocalizeAnswer, ResolveAnswer, ResolveRequest, View
from mapweave.login import login
from mapweave.map_reading import MapReading
from mapweave.merge.settings import MergeSettings
from mapweave.refusals import refusals
from mapweave.storage.map_file import MapFile

if TYPE_CHECKING:
    from mapweave.mapserver.routes import Router


class FileMap(EditableMap):
    """A map from a file; it asks no server.

    Corrections (`link`, `unlink`, `retire`, `undo`) merge the map again, in memory: its nodes, components and
    ways are then those with the correction. What is said about it (`place`, `close_way`, `prefer`, `floor`,
    `portal`, `plan`, `pin`, `withdraw`) is kept in memory, too. A file has both once the map is saved.
    """

    def __init__(self, content: MapFile, settings: MergeSettings | None = None, by: str = "") -> None:
        """Take the content of a map file.

        Args:
            content: as `read_map_file` and `merge_map_files` give it.
            settings: with which it was merged.
            by: who corrects the map, for its record; the login name by default.
        """
        self._read = MapReading(content, settings)
        self._by = by or login()
        self._images = dict(content.images)

    @property
    def _reading(self) -> MapReading:
        return self._read

    def locate(self, view: View) -> RelocalizeAnswer:
        """Where a view was taken."""
        router = self._router()
        from mapweave.mapserver.places import PlaceResolver

        return PlaceResolver(router, router.annotations).named(self._read.relocalizer.answer(view))

    def explained(self, request: ExplainRequest) -> Explanation:
        """An explanation of the kind that the request asks for, by what is closed now."""
        router = self._router()
        from mapweave.mapserver.explanations import explained

        with refusals():
            return explained(request, router, self._read.settings.consistency)

    def constraints(self) -> tuple[ManualConstraint, ...]:
        """What people have linked, unmerged, retired and taken back, in order; the first is number 1."""
        return tuple(self.content.constraints)

    def keep(self, request: ConstraintRequest) -> str:
        """Keep a manual constraint, unless it is only to be checked; see `link`. The map is merged again.

        Raises:
            Refused: the map contradicts it, or it has no effect: the evidence, and what to do.
            MissingExtra: that needs the extra "server".
        """
        before, settings = self._read.merged, self._read.settings
        from mapweave.mapserver.annotator import CHECKED
        from mapweave.offline_constraints import checked_constraint, with_constraint
        from mapweave.opened_map import MapSource, OpenedMap

        constraint, words = checked_constraint(self.content, before, request.constraint, settings)
        if request.check:
            return CHECKED + words
        one = OpenedMap("the map", MapSource.FILE, self.content, tuple(before.maps), {})
        _, content = with_constraint(one, before, constraint, settings)
        self._read = MapReading(content, settings)
        return words

    def annotations(self) -> Annotations:
        """What people say about the map: what the file has, and what was said since it was opened."""
        return Annotations(self.content.annotations)

    def plan_image(self, sha256: str) -> bytes:
        """The PNG file of a plan, by the name of its image.

        Raises:
            Refused: the map does not have it.
        """
        if sha256 not in self._images:
            raise Refused(f"the map does not have the image {sha256[:12]} of a plan: put it first")
        return self._images[sha256]

    def put_plan_image(self, png: bytes) -> PlanImage:
        """Keep the image of a plan, a PNG file, for the annotation that names it.

        Raises:
            InvalidValue: it is no PNG file, or too large.
        """
        from mapweave.storage.plan_image import check_plan_png

        image = check_plan_png(png)
        self._images[image.sha256] = png
        return image

    def plans(self) -> PlacedPlans:
        """Floor plans under the map."""
        return self._read.plans

    def resolve(self, request: ResolveRequest | NodeWord | Iterable[NodeWord]) -> ResolveAnswer:
        """Nodes for words; see Map."""
        asked = asked_of(request)
        router = self._router()
        from mapweave.mapserver.places import PlaceResolver

        with refusals():
            return PlaceResolver(router, router.annotations).answer(asked)

    def _check_writable(self, check: bool) -> None:
        need("server")

    def _say(self, annotation: Annotation, check: bool) -> str:
        from mapweave.mapserver.annotator import CHECKED
        from mapweave.offline_annotations import checked_annotation, with_annotation

        words = checked_annotation(self.content, self._read.router, annotation, self.plan_image)
        if check:
            return CHECKED + words
        content = with_annotation(self.content, annotation, self._images)
        if not isinstance(annotation.body, Pin):
            self._read = self._read.with_content(content)
            return words
        moved = self._read_again(content)
        if content.poses:
            moved = moved.with_content(replace(content, poses=dict(moved.merged.poses)))
        self._read = moved
        return words

    def _read_again(self, content: MapFile) -> MapReading:
        """A content of which another merged map follows."""
        return MapReading(content, self._read.settings)

    def _router(self) -> Router:
        """The router over the ways that are open now."""
        return self._read.router.at(self.annotations(), time.time_ns())


def open(path: str | os.PathLike[str], by: str = "") -> FileMap:
    """Open a map file, a server's store, also one in PostgreSQL, or an agent's journal. It is never changed.

    Several maps of a store or journal are merged first, and so is a single one that people have corrected. Of
    a damaged one what can be read is opened, with a warning that says what is lost.

    Args:
        path: of the file, or the address of the database.
        by: who corrects the map, for its record; the login name by default.

    Raises:
        InvalidFile: it cannot be read, is damaged, in use, or none of these.
        MissingExtra: maps are merged with the extra "server".
    """
    # A fleet's map comes over the network: who connects need not wait for what reads stores and journals.
    from mapweave.opened_map import open_map

    opened = open_map(os.fspath(path))
    for complaint in opened.complaints.values():
        warnings.warn(complaint, stacklevel=2)
    if opened.decided:
        return FileMap(opened.content, by=by)
    need("server")
    return FileMap(opened.file(opened.merged()), by=by)
