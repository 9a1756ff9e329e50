"""Manual constraints of a map without a server: by the shell (`--map`) and from Python the same."""

from collections.abc import Callable
from dataclasses import replace

from mapweave.hybridmap.annotation import Annotations
from mapweave.hybridmap.manual_constraint import ManualConstraint, ManualConstraints
from mapweave.mapserver.annotation_effects import without_effect
from mapweave.mapserver.map_files import map_file_of
from mapweave.mapserver.map_history import between
from mapweave.merge.constraint_checks import check_manual_constraint
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.settings import MergeSettings
from mapweave.opened_map import OpenedMap
from mapweave.refusals import refusals
from mapweave.storage.map_file import MapFile


def checked_constraint(
    content: MapFile, merged: MergedMap, constraint: ManualConstraint, settings: MergeSettings
) -> tuple[ManualConstraint, str]:
    """The constraint as it is kept, with what the images say of a link; and in words what it does.

    Args:
        content: of the map.
        merged: likewise, without the constraint.
        constraint: new.
        settings: of the merge.

    Raises:
        Refused: the map contradicts it, or it has no effect: the evidence, and what to do.
    """
    said = Annotations(content.annotations)
    earlier = ManualConstraints(content.constraints, floors=said.floors)
    with refusals():
        checked = check_manual_constraint(merged, earlier, constraint, settings=settings)
    words = "; ".join(filter(None, (checked.words, without_effect(checked.constraint, merged, said))))
    return checked.constraint, words


def with_constraint(
    one: OpenedMap,
    before: MergedMap,
    constraint: ManualConstraint,
    settings: MergeSettings,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> tuple[MergedMap, MapFile]:
    """The map merged again with a constraint, and the content of its file; its history has what changes.

    Args:
        one: the map. It is not changed.
        before: the same, merged.
        constraint: as `checked_constraint` gives it.
        settings: of the merge.
        progress: as of `OpenedMap.merged`.
    """
    content = one.content
    changed = replace(one, content=replace(content, constraints=(*content.constraints, constraint)))
    merged = changed.merged_again(settings, progress)
    history = (*content.history, *between(before, merged, constraint.stamp_ns))
    return merged, map_file_of(merged, history, Annotations(content.annotations), content.images)
