"""Annotations of a map file, without a server; the same methods as of mapweave.fleet.Fleet."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

from mapweave.hybridmap.annotation import Annotations
from mapweave.hybridmap.errors import InvalidFile
from mapweave.hybridmap.floor_plan import FloorPlan, PlacedPlans, PlanImage
from mapweave.hybridmap.pin import Pin
from mapweave.hybridmap.query import ResolveAnswer, ResolveRequest
from mapweave.mapserver.annotation_words import annotation_of_words
from mapweave.mapserver.annotator import check_annotation
from mapweave.mapserver.floor_plans import placed_plans
from mapweave.mapserver.map_files import merged_of
from mapweave.mapserver.places import Places
from mapweave.mapserver.routes import Router
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.settings import MergeSettings
from mapweave.storage.atomic_file import check_place
from mapweave.storage.map_file import read_map_file, write_map_file
from mapweave.storage.plan_image import check_plan_png


class OfflineAnnotations:
    """The annotations of one map file."""

    def __init__(
        self, path: Path, out: Path | None = None, by: str = "a person", settings: MergeSettings | None = None
    ) -> None:
        """Read a map file.

        Args:
            path: of the file.
            out: where the file with new annotations is written; over the old one by default.
            by: says so.
            settings: with which the file was merged.

        Raises:
            InvalidFile: it cannot be read.
        """
        self._out, self._by, self._settings = out or path, by, settings
        self._content = read_map_file(path)
        self._images = dict(self._content.images)

    def annotate(self, kind: str, name: str, because: str = "", **fields: Any) -> str:
        """See Fleet.annotate; the file is written.

        Raises:
            MapweaveError: it says nothing new, is about something that is not there, or cannot be written.
        """
        return self._annotate(name, {"kind": kind, **fields}, False, because)

    def withdraw(self, kind: str, name: str, because: str = "") -> str:
        """See Fleet.withdraw; the file is written."""
        return self._annotate(name, {"kind": kind}, True, because)

    def annotations(self) -> Annotations:
        """What people say about the map."""
        return Annotations(self._content.annotations)

    def resolve(self, request: ResolveRequest) -> ResolveAnswer:
        """Nodes for words.

        Raises:
            InvalidValue: a word is none, with the reason.
        """
        return Places(self._router, self.annotations()).answer(request)

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
        return Router(merged_of(self._content, self._settings))

    def _annotate(self, name: str, fields: Mapping[str, Any], removed: bool, because: str) -> str:
        check_place(self._out)
        annotation = annotation_of_words(
            name, fields, removed, self.annotations, self.resolve, self._by, because, time.time_ns()
        )
        check_annotation(self._router.merged, self.annotations(), annotation)
        body = annotation.body
        if isinstance(body, FloorPlan) and not annotation.removed:
            self.plan_image(body.image.sha256)
        content = replace(self._content, annotations=(*self._content.annotations, annotation))
        if isinstance(annotation.body, Pin):
            content = replace(content, poses=dict(merged_of(content, self._settings).poses))
            self.__dict__.pop("_router", None)
        used = {plan.image.sha256 for _, plan in Annotations(content.annotations).in_force(FloorPlan)}
        self._content = replace(
            content, images={name: png for name, png in self._images.items() if name in used}
        )
        write_map_file(self._out, self._content)
        return annotation.words
