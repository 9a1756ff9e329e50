"""What people say about a map, and decide on it, without a server: by the shell (`--map`).

`OfflineRecord` answers as mapweave.fleet.Fleet does, and writes what is new into a map file.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from mapweave.file_map import FileMap
from mapweave.hybridmap.annotation import Annotation
from mapweave.hybridmap.errors import InvalidFile, InvalidValue
from mapweave.hybridmap.manual_constraint import ConstraintRequest, ManualConstraints
from mapweave.hybridmap.map_event import MapEvent
from mapweave.map_reading import MapReading
from mapweave.mapserver.annotator import CHECKED
from mapweave.mapserver.constraint_history import with_constraints
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.settings import MergeSettings
from mapweave.opened_map import MapSource, OpenedMap
from mapweave.storage.atomic_file import check_map_place
from mapweave.storage.map_file import MapFile

if TYPE_CHECKING:
    # It needs an extra, and what only looks does not.
    from mapweave.offline_merge import Progress


def _unseen() -> AbstractContextManager[Progress]:
    return nullcontext(lambda done, of: None)


class OfflineRecord(FileMap):
    """The record of one map. Map files are written; a store is only read, since it is its server's."""

    def __init__(
        self,
        opened: OpenedMap,
        out: Path | None = None,
        by: str = "",
        settings: MergeSettings | None = None,
        progress: Callable[[], AbstractContextManager[Progress]] = _unseen,
    ) -> None:
        """Take a map.

        Args:
            opened: a file, store or journal.
            out: where the file with what is new is written; over the old file by default.
            by: says so; the login name by default.
            settings: with which the file was merged.
            progress: within it the map is merged; shows how far that is.
        """
        super().__init__(opened.content, settings, by)
        self._opened, self._progress = opened, progress
        self._read = MapReading(opened.content, settings, self._solved)
        of_file = isinstance(opened.path, Path) and opened.source is MapSource.FILE
        self._out = Path(opened.path) if out is None and of_file else out
        self._over = out is None

    def plan_image(self, sha256: str) -> bytes:
        """The PNG file of a plan.

        Raises:
            InvalidFile: it is not in the file.
        """
        if sha256 not in self._images:
            raise InvalidFile(f"the image {sha256[:12]} of a plan is not in the file: add the plan again")
        return super().plan_image(sha256)

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

        before, settings = self.merged, self._read.settings
        constraint, words = checked_constraint(content, before, request.constraint, settings)
        if request.check:
            return CHECKED + words
        assert self._out is not None, "it is writable"
        with self._progress() as report:
            merged, file = with_constraint(self._opened, before, constraint, settings, report)
        self._opened = replace(self._opened.written(self._out, file), content=file)
        self._read = MapReading(file, settings, lambda: merged)
        return f"{words}\n{self._out}: {merged.summary()}"

    def history(self) -> tuple[MapEvent, ...]:
        """What became of the maps until the file was written, and what people decided."""
        decided = ManualConstraints(self.content.constraints)
        return with_constraints(self.content.history, decided, self.annotations())

    def map(self) -> MapFile:
        """The content of a file of the merged map."""
        from mapweave.mapserver.map_files import map_file_of

        return map_file_of(self.merged)

    @property
    def merged(self) -> MergedMap:
        """The merged map."""
        return self._read.merged

    def _solved(self) -> MergedMap:
        with self._progress() as report:
            return self._opened.merged(self._read.settings, report)

    def _read_again(self, content: MapFile) -> MapReading:
        self._opened = replace(self._opened, content=content)
        return MapReading(content, self._read.settings, self._solved)

    def _check_writable(self, check: bool) -> None:
        if check:
            return
        if self._out is None:
            raise InvalidValue(
                f"{self._opened.path} is {self._opened.source.words}, which is not written: give -o"
            )
        check_map_place(self._out)

    def _say(self, annotation: Annotation, check: bool) -> str:
        words = super()._say(annotation, check)
        if not check:
            assert self._out is not None, "it is writable"
            self._opened = replace(self._opened, content=self.content)
            self._opened = self._opened.written(self._out, self._opened.file(self.merged))
        return words
