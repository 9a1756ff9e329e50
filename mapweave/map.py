"""A map to look at and to ask, in one form: from a file (`file_map.py`) or of a fleet (`fleet_map.py`).

import mapweave

office = mapweave.open("office.mapweave")
print(office, office.nodes.x.mean())
office.plot()
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, overload

import numpy as np
from numpy.typing import NDArray

from mapweave.extras import need
from mapweave.hybridmap.annotation import Annotations
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.constraint_subject import read_end, read_ends
from mapweave.hybridmap.errors import InvalidValue, Refused
from mapweave.hybridmap.explanation import (
    Explanation,
    FleetExplanation,
    MapsExplanation,
    PairExplanation,
    RouteExplanation,
    route_over,
)
from mapweave.hybridmap.floor_plan import PlacedPlans
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.named_nodes import NodeWord, ids_of, word_of
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.hybridmap.query import ExplainRequest, RelocalizeAnswer, ResolveAnswer, ResolveRequest, View
from mapweave.map_reading import MapReading
from mapweave.node_table import NodeTable
from mapweave.refusals import check_component, listed, refusals
from mapweave.storage.map_file import MapFile, write_map_file

if TYPE_CHECKING:
    import networkx as nx
    from matplotlib.axes import Axes

    from mapweave.mapserver.plan_answers import AnswerOnPlan

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
    def locate(self, view: View) -> RelocalizeAnswer:
        """Where a view was taken."""

    @abstractmethod
    def explained(self, request: ExplainRequest) -> Explanation:
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
        from mapweave.storage.image_file import read_grey
        from mapweave.view_features import view_of
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
        answer = self.locate(view_of(image, camera, lens))
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
            explanation = self.explained(ExplainRequest(ends, True, pairs))
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
        explanation = self.explained(ExplainRequest((first, second)))
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
        explanation = self.explained(ExplainRequest(pair))
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
        """Write the map into a map file, all or nothing. It replaces a map file, and no other file.

        Raises:
            InvalidFile: the disk does not take it, or a file that is no map is there.
        """
        write_map_file(Path(path), self.content)


def _is_map(name: str) -> bool:
    """Whether it is written as a map's name, `r0.1`."""
    try:
        return isinstance(read_end(name), MapId)
    except InvalidValue:
        return False
