"""Pairs of nodes that many servers and commands of tests compare are compared once in a process."""

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest

from mapweave.hybridmap.node import Node
from mapweave.merge.pose_graph import verification
from mapweave.registration.recognition import (
    Recognition,
    RecognitionFailure,
    RecognitionSettings,
    examine_nodes,
)

_found: dict[bytes, Recognition | RecognitionFailure] = {}


def _examined(
    a: Node, b: Node, settings: RecognitionSettings | None, rng: np.random.Generator
) -> Recognition | RecognitionFailure:
    """What comes of two nodes, which depends on their ids and on what they see alone: see `verify`."""
    key = hashlib.blake2b(repr(settings).encode(), digest_size=16)
    for node in (a, b):
        marks = node.landmarks
        key.update(f"{node.id} {node.camera} {len(marks)}".encode())
        for column in (marks.pixels, marks.codes, marks.depths, marks.depth_sigmas):
            key.update(column.tobytes())
    if (found := _found.get(key.digest())) is None:
        found = _found[key.digest()] = examine_nodes(a, b, settings, rng)
    return replace(found, pairs=found.pairs.copy(), evidence=dict(found.evidence))


@contextmanager
def examined_once() -> Iterator[None]:
    """For tests of what is made of the verdicts; those of the verdicts themselves do without it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(verification, "examine_nodes", _examined)
        yield
