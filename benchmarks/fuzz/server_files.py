"""What servers and agents keep beside their stores. Digests are made right: what is behind them is read."""

from __future__ import annotations

import hashlib
import tempfile
import zlib
from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mapweave.agent.calibration.learned import LEARNABLE, LearnedGeometry, LearnedParameter
from mapweave.agent.drive_geometry import DriveGeometry
from mapweave.agent.recordings.learned_file import read_learned, write_learned
from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.map_event import MapEvent, MapEventKind
from mapweave.mapserver.checksummed_file import DIGEST
from mapweave.mapserver.http import last_shown
from mapweave.mapserver.http.serving import json_bytes
from mapweave.mapserver.merging import merge_encoding, restart_record_file, verification_cache_file
from mapweave.mapserver.merging.restart_record import RestartRecord
from mapweave.mapserver.merging.verification_cache import PRINT_BYTES, RecentComparisons, VerificationCache
from mapweave.merge.map_maintenance.superseding_log import Changes, SupersedingLog
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.storage.view_file import checked_view, view_file

if TYPE_CHECKING:
    from benchmarks.fuzz.samples import Samples

MADE_BY = "fuzz"
VIEWED = Camera(64, 48, 60.0, 60.0, 32.0, 24.0, 0.25, 0.0)
"""Of the node of which there is an image."""
CHECKSUMMED: dict[bytes, Callable[[bytes], object]] = {
    restart_record_file.MAGIC: lambda data: restart_record_file.load(data, MADE_BY),
    verification_cache_file.MAGIC: lambda data: verification_cache_file.load(data, MADE_BY),
    merge_encoding.MAGIC: lambda data: merge_encoding.EncodedMerge.read(data, MADE_BY),
}
"""Files with a digest at their end, by their first line."""


def run_checksummed(data: bytes, _: Path) -> None:
    """The first byte chooses the kind; the digest is put behind what follows."""
    if data:
        magic = [*CHECKSUMMED][data[0] % len(CHECKSUMMED)]
        whole = magic + data[1:]
        CHECKSUMMED[magic](whole + hashlib.sha256(whole).digest())


def checksummed_samples(samples: Samples) -> list[bytes]:
    """A good file of each kind, without its first line and digest."""
    merged = samples.merged
    record = _record(merged)
    verdicts = {link.pair: link for link in merged.links} | {one.pair: one for one in merged.refused}
    verdicts = {pair: one for pair, one in verdicts.items() if all(n in record.recent.prints for n in pair)}
    cache = VerificationCache(record.recent.prints, dict.fromkeys(verdicts, 0.5), verdicts)
    head = merge_encoding.MergeHead.of(
        "s0", {map_id: (7, bytes(32)) for map_id in merged.maps}, None, [bytes(32)], merged
    )
    files = (
        restart_record_file.packed(record, MADE_BY),
        verification_cache_file.packed(cache, MADE_BY),
        merge_encoding.packed(head, record, merged, verdicts.get, MADE_BY),
    )
    return [
        bytes([k]) + bytes(file)[len(magic) : -DIGEST]
        for k, (magic, file) in enumerate(zip(CHECKSUMMED, files, strict=True))
    ]


def _record(merged: MergedMap) -> RestartRecord:
    """A restart record with a log."""
    prints = {node: bytes(PRINT_BYTES) for node in merged.poses}
    first, second, *_ = sorted(prints)
    step = Changes({first: None}, frozenset({first}), frozenset({(first, second)}))
    joined = (dict.fromkeys(merged.maps, 0),)
    return RestartRecord(
        RecentComparisons(prints, frozenset(prints), {(first, second): 0.5}),
        frozenset(prints), linked=frozenset({(first, second)}), unsure=frozenset({first.map}),
        log=SupersedingLog((step,), joined),
    )  # fmt: skip


def run_shown(data: bytes, folder: Path) -> None:
    """What the page showed last, behind its compression."""
    path = folder / "s0.shown"
    path.write_bytes(last_shown.MAGIC + zlib.compress(data, 1))
    _ = last_shown.read_shown(path).unheard


def shown_samples(_: Samples) -> list[bytes]:
    """A page with a robot and an event."""
    robot = {"robot": "r0", "alive": True, "merged_from_robot": [1.0, 2.0, 0.5], "component": 0}
    event = MapEvent(10**18, MapEventKind.JOINED, "r0.1 and r1.1 are one map now")
    shown = '{"components": [{"maps": ["r0.1", "r1.1"]}], "nodes": {}, "maps": ["r0.1", "r1.1"]}'
    events = [(event.stamp_ns, event.kind.value, event.words)]
    return [json_bytes({"map": shown, "robots": [robot], "history": events})]


def run_learned(path: Path) -> None:
    """What a robot has learned of its geometry."""
    read_learned(path)


def learned_samples(_: Samples) -> list[bytes]:
    """A file as an agent writes it."""
    learned = LearnedGeometry(
        DriveGeometry(), (60.0, 60.0, 32.0, 24.0), {LEARNABLE[0]: LearnedParameter(0.01, 0.002)}
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "r0.learned.toml"
        write_learned(path, learned, date(2026, 11, 29))
        return [path.read_bytes()]


def run_view(data: bytes, _: Path) -> None:
    """The image of a node, as its robot gives it to a server."""
    checked_view(data, VIEWED)


def view_samples(_: Samples) -> list[bytes]:
    """Such images: plain ones, and of noise."""
    plain = np.arange(VIEWED.height * VIEWED.width, dtype=np.uint8).reshape(VIEWED.height, VIEWED.width)
    noise = np.random.default_rng(1).integers(0, 255, plain.shape, dtype=np.uint8)
    return [view_file(pixels, VIEWED) for pixels in (plain, noise)]
