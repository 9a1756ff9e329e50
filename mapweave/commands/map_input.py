"""Maps that commands read: one option text, one progress bar, one way to report what is damaged."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mapweave.merge.pose_graph.merged_map import MergedMap
    from mapweave.merge.settings import MergeSettings
    from mapweave.offline_merge import Progress
    from mapweave.opened_map import OpenedMap

SOURCES = (
    "a map file (.mapweave), a server's store or an agent's journal (.sqlite), or a store's address "
    "(postgresql://)"
)


def map_source(text: str) -> Path | str:
    """The value of an option that names a map: a file, or the address of a database."""
    from mapweave.mapserver.log.opening import is_postgres

    return text if is_postgres(text) else Path(text)


def opened(path: Path | str) -> OpenedMap:
    """Open a map; what of it is damaged is reported on stderr.

    Raises:
        InvalidFile: it is none, or cannot be read.
    """
    from mapweave.opened_map import open_map
    from mapweave.terminal import working

    with working("reading the map"):
        one = open_map(path)
    for complaint in one.complaints.values():
        print(f"mapweave: {complaint}", file=sys.stderr)
    return one


def merged_with_progress(one: OpenedMap, settings: MergeSettings | None = None) -> MergedMap:
    """The merged map of a file, store or journal."""
    with merge_progress() as report:
        return one.merged(settings, report)


@contextmanager
def merge_progress(words: str = "reading nodes", then: str = "comparing and joining") -> Iterator[Progress]:
    """A bar on stderr for people.

    Args:
        words: what is counted.
        then: what is done with all of it.
    """
    from mapweave.terminal import working

    with working(words) as bar:

        def report(done: int, of: int) -> None:
            bar.update(done, then if done == of else "", of)

        yield report
