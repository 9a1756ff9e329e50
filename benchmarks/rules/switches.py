"""Rules of mapping, merge and relocalization, each with what takes its place when it is switched off.

No product code knows of these switches: a function is replaced for as long as something is measured.
"""

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.mapping import image_acceptance
from mapweave.agent.mapping.kidnap_detection import FrameOverlap, KidnapDetector
from mapweave.agent.mapping.odometry_consistency import OdometryConsistency
from mapweave.hybridmap.pose import Array
from mapweave.mapserver.relocalization import verdict
from mapweave.mapserver.relocalization.aliased_regions import AliasedRegions
from mapweave.mapserver.relocalization.place_hypotheses import PlaceHypothesis
from mapweave.mapserver.relocalization.verdict import HypothesisSelector
from mapweave.merge import merging
from mapweave.merge.mutual_exclusion.refutation import Refutation
from mapweave.merge.outlier_rejection import (
    agglomerative_joining,
    closing_links,
    loop_closures,
    pairwise_consistency,
    segmentation,
)
from mapweave.merge.outlier_rejection.pairwise_consistency import Sorted
from mapweave.merge.pose_graph import verification
from mapweave.merge.pose_graph.links import Link
from mapweave.registration import recognition
from mapweave.registration.recognition import RecognitionSettings

Switch = tuple[object, str, object]
"""Where a function stands, its name, and what takes its place."""


def _each_independent(links: Sequence[Link], *_: object) -> NDArray[np.bool_]:
    return np.eye(len(links), dtype=np.bool_)


def _as_it_is(sorted_links: Sorted, *_: object) -> Sorted:
    return sorted_links


def _nothing(*_: object, **__: object) -> list[Any]:
    return []


def _all_kept(links: Sequence[Link], *_: object) -> Sorted:
    weight = float(sum(link.weight for link in links))
    return Sorted(tuple(links), (), weight=weight, sets=(tuple(links), ()))


def _no_misfits(links: Sequence[Link], *_: object) -> Array:
    return np.zeros(len(links))


def _first(_: object, places: Sequence[PlaceHypothesis]) -> Sequence[PlaceHypothesis]:
    return places[:1]


_compare = KidnapDetector.compare


def _unnoticed(overlap: FrameOverlap) -> Switch:
    """Images with this in common with the one before are used like any other."""

    def compare(self: KidnapDetector, *images: Any) -> FrameOverlap:
        found = _compare(self, *images)
        return FrameOverlap.SAME if found is overlap else found

    return KidnapDetector, "compare", compare


_objection = recognition._objection


def _good(**figures: float) -> tuple[Switch, ...]:
    """Recognitions are judged as if these numbers of their evidence were good."""

    def objection(evidence: dict[str, float], s: RecognitionSettings) -> str:
        return _objection({**evidence, **figures}, s)

    return ((recognition, "_objection", objection),)


MERGE_RULES: Mapping[str, tuple[Switch, ...]] = {
    "independent support": ((pairwise_consistency, "neighbours", _each_independent),),
    "chance support": ((Sorted, "beyond_chance", _as_it_is),),
    "dominance": ((pairwise_consistency, "_rival", _nothing),),
    "refused links heard again": (
        (agglomerative_joining, "_with_borne_out", lambda _solver, kept, *_: list(kept)),
    ),
}
"""Rules on links, for fleets without images."""
SINGLE_RULES: Mapping[str, tuple[Switch, ...]] = {
    "one strong link": ((pairwise_consistency, "OVERWHELMING_INLIERS", math.inf),),
}
"""Exceptions from the rule that one link joins nothing."""
TRIAL_RULES: Mapping[str, tuple[Switch, ...]] = {
    **MERGE_RULES,
    "mutual exclusion": (
        (Refutation, "impossible", lambda *_: ({}, {})),
        (Refutation, "verdict", lambda *_: ""),
    ),
    "aliased landmarks": ((merging, "weigh", lambda links, *_: list(links)),),
}
"""Rules on links, for robots with images and bodies."""
LOOP_RULES: Mapping[str, tuple[Switch, ...]] = {
    "own way": ((pairwise_consistency, "_against_odometry", lambda links, *_: (list(links), [])),),
    "own loops that agree": ((segmentation, "sort_links", _all_kept),),
    "closing links": ((closing_links, "misfits", _no_misfits),),
    "drives against loops": ((loop_closures, "distance2_of", lambda *_: 0.0),),
}
"""Rules on a robot's own loop closures, for maps without images."""
RECOGNITION_RULES: Mapping[str, tuple[Switch, ...]] = {
    "share of matches": _good(share=1.0),
    "image cells": _good(cells=math.inf),
    "landmarks in view": _good(seen=1.0),
    "depths": _good(depths=1.0),
    "mirrored pose": _good(rival=0.0),
    "certain links": (
        (verification, "MOST_SIGMA_XY", math.inf),
        (verification, "MOST_SIGMA_HEADING", math.inf),
    ),
}
"""Rules on the registration of nodes, and of views, with nodes."""
PLACE_RULES: Mapping[str, tuple[Switch, ...]] = {
    "aliased regions": ((AliasedRegions, "counterpart", lambda *_: None),),
    "one weak node": ((verdict, "ALONE", 0),),
    "rivals": ((HypothesisSelector, "_rivals", _first),),
}
"""Rules on answers to lost robots."""
FRAME_RULES: Mapping[str, tuple[Switch, ...]] = {
    "repeated images": ((image_acceptance, "same_image", lambda *_: False),),
    "strange images": (_unnoticed(FrameOverlap.STRANGE),),
    "images that show nothing": (_unnoticed(FrameOverlap.BLANK),),
    "images in another light": ((image_acceptance, "relit", lambda image, _: image),),
    "odometry against images": ((OdometryConsistency, "compare", lambda *_: None),),
}
"""Rules on images, and on what they show, while a robot maps."""


@contextlib.contextmanager
def switched_off(switches: Sequence[Switch]) -> Iterator[None]:
    """Do without a rule for a while."""
    with contextlib.ExitStack() as stack:
        for where, name, instead in switches:
            stack.enter_context(patch.object(where, name, instead))
        yield


def by_rule(
    rules: Mapping[str, tuple[Switch, ...]], measured: Callable[[], dict[str, Any]]
) -> dict[str, dict[str, Any]]:
    """What is measured with all rules, and without each."""
    out = {ALL: measured()}
    for name, switches in rules.items():
        with switched_off(switches):
            out[name] = measured()
    return out


ALL = "all rules"
"""Name of what is measured with none switched off."""
