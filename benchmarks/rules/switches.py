"""Rules of merge and relocalization, each with what takes its place when it is switched off.

No product code knows of these switches: a function is replaced for as long as something is measured.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from mapweave.mapserver.relocalization import view_registration
from mapweave.mapserver.relocalization.aliased_regions import AliasedRegions
from mapweave.merge import merging
from mapweave.merge.mutual_exclusion.refutation import Refutation
from mapweave.merge.outlier_rejection import agglomerative_joining, pairwise_consistency
from mapweave.merge.outlier_rejection.pairwise_consistency import Sorted
from mapweave.merge.pose_graph.links import Link

Switch = tuple[object, str, object]
"""Where a function stands, its name, and what takes its place."""


def _each_independent(links: Sequence[Link], *_: object) -> NDArray[np.bool_]:
    return np.eye(len(links), dtype=np.bool_)


def _as_it_is(sorted_links: Sorted, *_: object) -> Sorted:
    return sorted_links


def _nothing(*_: object, **__: object) -> list[Any]:
    return []


MERGE_RULES: Mapping[str, tuple[Switch, ...]] = {
    "independent support": ((pairwise_consistency, "neighbours", _each_independent),),
    "chance support": ((Sorted, "beyond_chance", _as_it_is),),
    "dominance": ((pairwise_consistency, "_rival", _nothing),),
    "refused links heard again": (
        (agglomerative_joining, "_with_borne_out", lambda _solver, kept, *_: list(kept)),
    ),
}
"""Rules on links, for fleets without images."""
TRIAL_RULES: Mapping[str, tuple[Switch, ...]] = {
    **MERGE_RULES,
    "mutual exclusion": (
        (Refutation, "impossible", lambda *_: ({}, {})),
        (Refutation, "verdict", lambda *_: ""),
    ),
    "aliased landmarks": ((merging, "weigh", lambda links, *_: list(links)),),
}
"""Rules on links, for robots with images and bodies."""
PLACE_RULES: Mapping[str, tuple[Switch, ...]] = {
    "aliased regions": ((AliasedRegions, "counterpart", lambda *_: None),),
    "lonely recognition": ((view_registration, "is_lonely", lambda *_: False),),
}
"""Rules on answers to lost robots."""


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
