"""Annotations of a map without a server: by the shell (`--map`) and from Python the same."""

from collections.abc import Callable, Mapping
from dataclasses import replace

from mapweave.hybridmap.annotation import Annotation, Annotations
from mapweave.hybridmap.floor_plan import FloorPlan
from mapweave.hybridmap.manual_constraint import ManualConstraints
from mapweave.mapserver.annotation_effects import effects_of
from mapweave.mapserver.annotator import check_annotation, check_edge
from mapweave.mapserver.places import PlaceResolver
from mapweave.mapserver.routes import Router
from mapweave.refusals import refusals
from mapweave.storage.map_file import MapFile


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
