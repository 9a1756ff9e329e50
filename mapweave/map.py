"""A map to look at and to ask, in one form: from a file (`mapweave.open`) or of a fleet (`mapweave.connect`).

import mapweave

office = mapweave.open("office.mapweave")
print(office, office.nodes.x.mean())
office.plot()
"""

from __future__ import annotations

import os
import time
import warnings
from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, overload

import numpy as np
from numpy.typing import NDArray

from mapweave.annotation_methods import AnnotationMethods
from mapweave.constraint_methods import ConstraintMethods
from mapweave.extras import need
from mapweave.hybridmap.annotation import Annotation, Annotations
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.constraint_subject import Subject, read_end, read_ends
from mapweave.hybridmap.errors import InvalidValue, Refused
from mapweave.hybridmap.explanation import (
    Explanation,
    FleetExplanation,
    MapsExplanation,
    PairExplanation,
    RouteExplanation,
    route_over,
)
from mapweave.hybridmap.floor_plan import PlacedPlans, PlanImage
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.manual_constraint import ManualConstraint
from mapweave.hybridmap.named_nodes import NodeWord, asked_of, ids_of, word_of
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pin import Pin
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.query import ExplainRequest, RelocalizeAnswer, ResolveAnswer, ResolveRequest, View
from mapweave.login import login
from mapweave.map_reading import MapReading
from mapweave.merge.settings import MergeSettings
from mapweave.node_table import NodeTable
from mapweave.refusals import check_component, listed, refusals
from mapweave.storage.map_file import MapFile, write_map_file

if TYPE_CHECKING:
    import networkx as nx
    from matplotlib.axes import Axes

    from mapweave.mapserver.plan_answers import AnswerOnPlan
    from mapweave.mapserver.routes import Router

Image = NDArray[np.uint8] | str | os.PathLike[str]
"""(H, W) grey, or its file."""
CameraName = Camera | str | os.PathLike[str]
"""A camera, or its `camera.toml`."""
MapName = MapId | str
"""A robot's own map, also as people write it: `r0.1`."""


class Map(ABC):
    """A map. What it has does not change while it is looked at; a fleet's is fetched again by `refresh`."""

    @property
    @abstractmethod
    def _reading(self) -> MapReading:
        """The map as it was read last."""

    @abstractmethod
    def _answer(self, view: View) -> RelocalizeAnswer:
        """Where a view was taken."""

    @abstractmethod
    def _explained(self, request: ExplainRequest) -> Explanation:
        """An explanation of the kind that the request asks for."""

    @abstractmethod
    def annotations(self) -> Annotations:
        """What people say about the map: named places, closures, preferences."""

    @abstractmethod
    def resolve(self, request: ResolveRequest | NodeWord | Iterable[NodeWord]) -> ResolveAnswer:
        """Nodes for words: names of places, and positions in the merged map.

        Raises:
            InvalidValue: it is no text.
            Refused: a word is none, with the reason.
        """

    @abstractmethod
    def plans(self) -> PlacedPlans:
        """Floor plans, and where they lie under the merged map."""

    def __repr__(self) -> str:
        """A short description, for example `<FileMap: 17 nodes, 3 maps, ...>`."""
        return f"<{type(self).__name__}: {self.content.title}>"

    @property
    def content(self) -> MapFile:
        """All that a map file holds."""
        return self._reading.content

    @property
    def hash(self) -> str:
        """Content hash in hexadecimal digits, as `mapweave map show` prints it: the same map has the same."""
        return self._reading.hash

    @property
    def nodes(self) -> NodeTable:
        """The nodes in columns, which are NumPy arrays."""
        return self._reading.nodes

    def nodes_on(self, plan: str) -> NodeTable:
        """The nodes of the components under which a floor plan lies, with their poses in its frame.

        Raises:
            MissingExtra: that needs the extra "server".
            Refused: there is no such plan.
        """
        return self._reading.nodes_on(plan)

    def node(self, node: NodeWord) -> Node:
        """A node with its camera and landmarks.

        Raises:
            Refused: it is not there.
        """
        with refusals():
            return self._reading.node(self._named(node)[0])

    def pose(self, node: NodeWord) -> PoseGaussian:
        """Pose of a node in the frame of its component.

        Raises:
            Refused: it is not there.
        """
        found = self._reading.placed.get(self._named(node)[0])
        if found is None:
            raise Refused(f"the map has no pose of node {node}")
        return found[1]

    def graph(self) -> nx.MultiGraph[str]:
        """Nodes and edges as a networkx graph; see `mapweave.formats.graph` for their attributes.

        Among others, nodes have `x`, `y`, `heading` and `component`, edges `kind`, `length` and, for links
        between maps, `probability`.
        """
        from mapweave.formats.graph import graph_of
        from mapweave.mapserver.own_maps import PROBABILITY

        reading = self._reading
        placed = {node: (component, pose.mean) for node, (component, pose) in reading.placed.items()}
        wanted = ("inliers", PROBABILITY)
        return graph_of(
            reading.graph.nodes, placed, reading.graph.edges.values(),
            lambda edge: {name: float(edge.evidence[name]) for name in wanted if name in edge.evidence},
        )  # fmt: skip

    def plot(
        self,
        axes: Axes | None = None,
        component: int | None = None,
        landmarks: bool = True,
        plan: str | None = None,
    ) -> Axes:
        """Draw a component: nodes, edges and links, with the landmarks that the nodes see.

        Args:
            axes: where; by default in a new figure.
            component: which; each has a frame of its own. By default 0, the largest; with a plan that with
                most of its pairs.
            landmarks: whether they are drawn.
            plan: a floor plan, in whose frame the axes are then; with the extra "server".

        Returns:
            The axes; `axes.figure.savefig("map.png")` writes the picture.

        Raises:
            MissingExtra: matplotlib is not installed.
            Refused: there is no such component, or no such plan under it.
        """
        need("viz")
        from mapweave.drawing.map_picture import MapPicture, draw_on

        reading = self._reading
        component, frame_from_merged = self._frame(component, plan)
        poses = {
            n: frame_from_merged @ pose.mean
            for n, (number, pose) in reading.placed.items()
            if number == component
        }
        check_component(component, len({number for number, _ in reading.placed.values()}))
        if axes is None:
            from matplotlib import pyplot

            axes = pyplot.figure(layout="constrained").add_subplot()
        seen = [
            poses[n].apply(reading.node(n).points_in_robot[reading.node(n).landmarks.has_depth, :2])
            for n in (poses if landmarks else ())
        ]
        points = np.concatenate([np.zeros((0, 2)), *seen])
        edges = list(reading.graph.edges.values())
        draw_on(axes, MapPicture(self.content.title, poses, edges, landmarks=points))
        axes.legend(loc="best", fontsize="small")
        return axes

    @overload
    def relocalize(self, image: Image, camera: CameraName, plan: None = None) -> RelocalizeAnswer: ...
    @overload
    def relocalize(self, image: Image, camera: CameraName, plan: str) -> AnswerOnPlan: ...

    def relocalize(self, image: Image, camera: CameraName, plan: str | None = None) -> RelocalizeAnswer:
        """Where an image was taken.

        Args:
            image: (H, W) grey, or its file (PNG, JPEG, PGM or BMP).
            camera: that took it, ideal, or its `camera.toml`, which also gives the lens.
            plan: a floor plan, in whose frame each candidate then has `plan_from_robot`.

        Returns:
            Certainty, candidates with poses, best first, and the reason in words.

        Raises:
            InvalidValue: the image is of another form or size.
            DeviceError: a file cannot be read.
            Refused: there is no such plan.
        """
        from mapweave.agent.recordings.camera_file import read_camera
        from mapweave.offline_relocalization import view_of
        from mapweave.storage.image_file import read_grey
        from mapweave.vision.lens import NO_DISTORTION, Distortion

        source, distortion = "the camera", NO_DISTORTION
        lens: Distortion = distortion
        if not isinstance(camera, Camera):
            source = str(camera)
            camera, lens = read_camera(Path(camera))
        if not isinstance(image, np.ndarray):
            image = read_grey(Path(image), camera, source)
        if image.dtype != np.uint8 or image.shape != (camera.height, camera.width):
            wanted = f"({camera.height}, {camera.width}) of uint8, grey, by {source}"
            raise InvalidValue(f"an image of shape {image.shape} of {image.dtype}: give {wanted}")
        placed = None if plan is None else self.plans().plan(plan)
        answer = self._answer(view_of(image, camera, lens))
        if placed is None:
            return answer
        from mapweave.mapserver.plan_answers import answer_on_plan

        return answer_on_plan(answer, placed)

    def route(
        self,
        start: NodeWord,
        goal: NodeWord,
        blocked: Iterable[tuple[NodeWord, NodeWord]] = (),
        via: Iterable[NodeWord] = (),
        plan: str | None = None,
        near: NodeWord = "",
    ) -> RouteExplanation:
        """The way that a robot would drive, step by step, or why there is none.

        Args:
            start: a node.
            goal: another one.
            blocked: as if a robot could not get through between these.
            via: what to pass before, in order.
            plan: a floor plan, in whose frame positions are then.
            near: in the part of the map where this node or place is; without, in the largest one, with a
                plan in that with most of its pairs.

        Raises:
            InvalidValue: one place is given for a list of places, or for a pair.
            Refused: a node is not there.
        """
        stops = [start, *listed("via", via), goal]
        pairs_of_names = [listed("blocked", pair) for pair in blocked]
        if any(len(pair) != 2 for pair in pairs_of_names):
            raise InvalidValue("`blocked` is a list of pairs of nodes")
        words = [*stops, *(end for pair in pairs_of_names for end in pair)]
        if plan is not None:
            from mapweave.mapserver.plan_answers import off_plan

            words = [*off_plan(map(word_of, words), self.plans().plan(plan), word_of(near), self.resolve)]
        nodes = self._named(*words, near=word_of(near))
        stopping, closed = nodes[: len(stops)], nodes[len(stops) :]
        pairs = tuple(zip(closed[::2], closed[1::2], strict=True))
        legs = []
        for ends in pairwise(stopping):
            explanation = self._explained(ExplainRequest(ends, True, pairs))
            assert isinstance(explanation, RouteExplanation), "a route was asked for"
            legs.append(explanation)
        return route_over(legs)

    def explain(self, a: NodeWord, b: NodeWord) -> PairExplanation:
        """Why two nodes are linked, or are not, with every number behind it.

        Raises:
            InvalidValue: the two are one node, or maps.
            Refused: a node is not there.
        """
        for name in map(word_of, (a, b)):
            if _is_map(name):
                raise InvalidValue(f"{name} is a map: `explain_maps` is for two maps")
        first, second = self._named(a, b)
        explanation = self._explained(ExplainRequest((first, second)))
        assert isinstance(explanation, PairExplanation), "two nodes were asked for"
        return explanation

    def explain_maps(self, *ends: MapName) -> tuple[MapsExplanation, ...]:
        """Why two robots' maps are one, or are not; of each two of them if none are given.

        Raises:
            InvalidValue: there is one alone, or one is a node.
            Refused: a map is not there.
        """
        if len(ends) not in (0, 2):
            raise InvalidValue(f"give two maps, or none for each two of them; not {len(ends)}")
        pair = read_ends(str(ends[0]), str(ends[1])) if ends else None
        if pair is not None and isinstance(pair[0], NodeId):
            raise InvalidValue(f"{ends[0]} is a node: `explain` is for two nodes")
        explanation = self._explained(ExplainRequest(pair))
        assert isinstance(explanation, FleetExplanation), "maps were asked for"
        return explanation.maps

    def _named(self, *names: NodeWord, near: str = "") -> list[NodeId]:
        """The nodes for names; positions are in the component of `near`, see `ids_of`.

        Raises:
            Refused: one is none.
        """
        return [NodeId.parse(word) for word in ids_of(map(word_of, names), self.resolve, near)]

    def _frame(self, component: int | None, plan: str | None) -> tuple[int, Pose2]:
        """A component, and what takes its coordinates to those of a plan.

        Raises:
            Refused: there is no such plan, or it does not lie there.
        """
        if plan is None:
            return component or 0, Pose2()
        part = self._reading.plans.plan(plan).part(component)
        return part.component, part.plan_from_merged

    def export(
        self,
        path: str | os.PathLike[str],
        to: str = "",
        component: int | None = None,
        plan: str | None = None,
    ) -> list[Path]:
        """Write a component for others' tools, as `mapweave map export` does.

        Args:
            path: the file, or the folder for several trajectories.
            to: `g2o`, `tum`, `graphml` or `geojson`; by default as the file is called.
            component: which; by default 0, the largest, with a plan that with most of its pairs.
            plan: a floor plan, in whose coordinates it is written.

        Returns:
            What was written.

        Raises:
            MissingExtra: that needs the extra "server".
            InvalidValue: there is no such format.
            Refused: there is no such component, or no such plan under it.
        """
        merged, out = self._reading.merged, Path(path)
        from mapweave.formats.export import FORMATS
        from mapweave.formats.map_part import MapPart

        write = FORMATS.get(to or out.suffix[1:])
        if write is None:
            raise InvalidValue(f"{out}: give its format with `to`: {', '.join(FORMATS)}")
        return write(MapPart(merged, *self._frame(component, plan)), out)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the map into a map file, all or nothing.

        Raises:
            InvalidFile: the disk does not take it.
        """
        write_map_file(Path(path), self.content)


class FileMap(Map, ConstraintMethods, AnnotationMethods):
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

    def _answer(self, view: View) -> RelocalizeAnswer:
        router = self._router()
        from mapweave.mapserver.places import PlaceResolver

        return PlaceResolver(router, router.annotations).named(self._read.relocalizer.answer(view))

    def _explained(self, request: ExplainRequest) -> Explanation:
        router = self._router()
        from mapweave.mapserver.explanations import explained

        with refusals():
            return explained(request, router, self._read.settings.consistency)

    def constraints(self) -> tuple[ManualConstraint, ...]:
        """What people have linked, unmerged, retired and taken back, in order; the first is number 1."""
        return tuple(self.content.constraints)

    def constrain(self, about: Subject, holds: bool, because: str = "", *, check: bool = False) -> str:
        """Set a manual constraint of any kind, or take it back; see `link`. The map is merged again.

        Raises:
            Refused: the map contradicts it, or it has no effect: the evidence, and what to do.
            MissingExtra: that needs the extra "server".
        """
        before, settings = self._read.merged, self._read.settings
        from mapweave.offline_constraints import CHECKED, checked_constraint, with_constraint
        from mapweave.opened_map import MapSource, OpenedMap

        asked = ManualConstraint(about, holds, self._by, time.time_ns(), because)
        constraint, words = checked_constraint(self.content, before, asked, settings)
        if check:
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
        moved = MapReading(content, self._read.settings)
        if content.poses:
            moved = moved.with_content(replace(content, poses=dict(moved.merged.poses)))
        self._read = moved
        return words

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


def _is_map(name: str) -> bool:
    """Whether it is written as a map's name, `r0.1`."""
    try:
        return isinstance(read_end(name), MapId)
    except InvalidValue:
        return False
