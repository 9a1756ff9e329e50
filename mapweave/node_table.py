"""The nodes of a map as NumPy arrays."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pose import Array, PoseGaussian


@dataclass(frozen=True, eq=False)
class NodeTable:
    """Nodes in columns, in the order of their ids.

    Poses are in the frame of the node's component; each component has a frame of its own.

    Attributes:
        ids: (N,) text, `r0.1.17` for example.
        x: (N,) m.
        y: (N,) m.
        heading: (N,) rad.
        sigma: (N, 3) m, m, rad, standard deviations ahead, to the left and of the heading.
        component: (N,) number of the component, 0 is the largest.
        stamp_ns: (N,) when the node's image was taken.
        landmarks: (N,) how many it has.
        superseded: (N,) whether a newer node of the same place replaces it.
    """

    ids: NDArray[np.str_]
    x: Array
    y: Array
    heading: Array
    sigma: Array
    component: NDArray[np.int64]
    stamp_ns: NDArray[np.int64]
    landmarks: NDArray[np.int64]
    superseded: NDArray[np.bool_]

    @staticmethod
    def of(
        nodes: Mapping[NodeId, Node],
        placed: Mapping[NodeId, tuple[int, PoseGaussian]],
        superseded: Collection[NodeId],
    ) -> NodeTable:
        """Put nodes into columns.

        Args:
            nodes: by id.
            placed: component and pose in its frame; nodes without are left out.
            superseded: those that newer ones replace.
        """
        ids = sorted(nodes.keys() & placed.keys())
        poses = [placed[node][1] for node in ids]
        x, y, heading = np.array([pose.mean.vector for pose in poses]).reshape(-1, 3).T
        variances = np.array([np.diag(pose.covariance) for pose in poses]).reshape(-1, 3)
        return NodeTable(
            np.array([str(node) for node in ids], np.str_),
            x,
            y,
            heading,
            np.sqrt(np.maximum(variances, 0.0)),
            np.array([placed[node][0] for node in ids], np.int64),
            np.array([nodes[node].stamp_ns for node in ids], np.int64),
            np.array([len(nodes[node].landmarks) for node in ids], np.int64),
            np.array([node in superseded for node in ids], np.bool_),
        )

    def __len__(self) -> int:
        """How many nodes."""
        return len(self.ids)

    def columns(self) -> dict[str, NDArray[Any]]:
        """(N,) columns by name, as `pandas.DataFrame` takes them; `sigma` in three."""
        sigmas = zip(("sigma_x", "sigma_y", "sigma_heading"), self.sigma.T, strict=True)
        return {
            "id": self.ids, "x": self.x, "y": self.y, "heading": self.heading, **dict(sigmas),
            "component": self.component, "stamp_ns": self.stamp_ns, "landmarks": self.landmarks,
            "superseded": self.superseded,
        }  # fmt: skip
