"""Maps that commands read: one option text, one progress bar, one way to report what is damaged."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mapweave.mapserver.routes import Router
    from mapweave.merge.pose_graph.merged_map import MergedMap
    from mapweave.merge.settings import MergeSettings
    from mapweave.offline_merge import Progress
    from mapweave.opened_map import OpenedMap

SOURCES = "a map file (.mapweave), a server's store or an agent's journal (.sqlite)"


def opened(path: Path) -> OpenedMap:
    """Open a map; what of it is damaged is reported on stderr.

    Raises:
        InvalidFile: it is none, or cannot be read.
    """
    from mapweave.opened_map import open_map

    one = open_map(path)
    for complaint in one.complaints.values():
        print(f"mapweave: {complaint}", file=sys.stderr)
    return one


def merged_with_progress(one: OpenedMap, settings: MergeSettings | None = None) -> MergedMap:
    """The merged map of a file, store or journal."""
    with merge_progress() as report:
        return one.merged(settings, report)


def router_of(arguments: argparse.Namespace) -> Router:
    """Routes over the map of `--map`, by what is closed now.

    Raises:
        InvalidFile: it is none, or cannot be read.
    """
    from mapweave.commands.network import settings_of
    from mapweave.hybridmap.annotation import Annotations
    from mapweave.mapserver.routes import Router

    one = opened(arguments.map)
    merged = merged_with_progress(one, settings_of(arguments).merge)
    return Router(merged).at(Annotations(one.content.annotations), time.time_ns())


@contextmanager
def merge_progress() -> Iterator[Progress]:
    """A bar on stderr for people."""
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = None

        def report(done: int, of: int) -> None:
            nonlocal task
            if task is None:
                task = bar.add_task("reading nodes")
            words = "reading nodes" if done < of else "comparing and joining"
            bar.update(task, description=words, completed=done, total=of if done < of else None)

        yield report
