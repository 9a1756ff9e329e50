"""How many landmarks of a node are compared."""

from dataclasses import replace

import numpy as np

from mapweave.hybridmap.node import Node

MOST_LANDMARKS = 400
"""Of a node with more the first ones are compared, see `bounded`: a robot's nodes have up to 150."""


def bounded(node: Node) -> Node:
    """A node with at most `MOST_LANDMARKS`, the very same one if it has no more.

    Two nodes take as much time to compare as the product of their landmarks.
    """
    if len(node.landmarks) <= MOST_LANDMARKS:
        return node
    return replace(node, landmarks=node.landmarks.take(np.arange(MOST_LANDMARKS)))
