"""The server's record of what has become of the maps: what joined, what came apart and why, with dates."""

import logging
import math
import threading
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import replace

from mapweave.hybridmap.counted import counted
from mapweave.hybridmap.errors import InvalidFile, InvalidMessage, InvalidValue
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.limits import MAX_WORDS
from mapweave.hybridmap.map_event import MapEvent, MapEventKind
from mapweave.mapserver.log.store import HISTORY, Store
from mapweave.merge.explanation.component_changes import joined_maps, joinings, partings
from mapweave.merge.explanation.twin_maps import TWINS, are_twins, is_twin_reason
from mapweave.merge.mutual_exclusion.collision import is_exclusion
from mapweave.merge.pose_graph.links import Link, RefusedLink
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.pose_graph.pinned_frames import FrameChange, frame_changes
from mapweave.storage.full_disks import logged
from mapweave.wire.messages import KeptHistory, decode, encode

log = logging.getLogger(__name__)

MOST = 500
"""Events that are kept: the newest."""
MOST_APART = 2000
"""Pairs of maps that are remembered as kept apart, so that it is reported once."""
MOST_AT_ONCE = 50
"""Events of one sort that one merge adds one by one: a thousand maps may join at once."""
Pair = tuple[MapId, MapId]


class MapHistory:
    """Compares each merge with the one before, also across restarts. Written by the merging thread alone."""

    def __init__(
        self, store: Store | None = None, most: int = MOST, clock: Callable[[], int] = time.time_ns
    ) -> None:
        """Read the record; a damaged one is replaced by an empty one, with a warning.

        Args:
            store: where it is kept; None: it ends with the process.
            most: events that are kept.
            clock: wall time, ns.
        """
        self._store, self._most, self._clock = store, most, clock
        self._lock = threading.Lock()
        self._kept = KeptHistory()
        self._links: Collection[Link] | None = None
        self._stored: tuple[bytes | None, ...] = ()
        """What may be stored: a commit that is not confirmed may be one all the same."""
        self.reload()

    def reload(self) -> None:
        """Read the record, which the server that leads may have written."""
        record = None if self._store is None else self._store.result(HISTORY)
        self._stored = (record,)
        if record is not None:
            try:
                kept = decode(record, KeptHistory)
            except InvalidMessage as error:
                self.failed(f"the record of what happened before was damaged ({error}); a new one begins")
                return
            with self._lock:
                self._kept = kept

    @property
    def events(self) -> tuple[MapEvent, ...]:
        """All events in order; for any thread."""
        with self._lock:
            return self._kept.events

    @property
    def newest(self) -> str:
        """Words of what last became of the maps; empty if nothing has."""
        return next(
            (event.words for event in reversed(self.events) if event.kind is not MapEventKind.FAILED), ""
        )

    @property
    def set_apart(self) -> frozenset[MapId]:
        """Maps that were set apart by the last merge that was followed, also of another process."""
        return self._kept.set_apart

    @property
    def disbelieved(self) -> tuple[tuple[MapId, str], ...]:
        """Maps of which something said was not believed at that merge, and why."""
        return self._kept.disbelieved

    def follow(self, merged: MergedMap) -> None:
        """Take note of what has changed with a merge, and keep it."""
        if not merged.maps and not merged.set_apart:
            return  # Nothing is read yet: what was one is no less so.
        if self._store is not None and not self._store.leads:
            self._links = merged.links
            return  # The server that leads writes the record.
        before, now = self._kept.parts, tuple(joined_maps(merged))
        same = now == before
        joined = () if same else joinings(before, merged)
        parted = () if same else partings(before, self._links, merged)
        apart = _kept_apart(merged, now)
        was_in, is_in = _part_of(before), _part_of(now)
        # Until two maps are joined nothing new is reported of them, and beyond the limit nothing at all.
        still = {(a, b) for a, b in self._kept.apart if is_in.get(a, -1) != is_in.get(b, -2)}
        new = [pair for pair in apart if pair not in still][: MOST_APART - len(still)]
        # The reason of a split is reported with it already.
        held = [apart[a, b] for a, b in new if was_in.get(a, -1) != was_in.get(b, -2)]
        bad, before_bad = merged.set_apart, self._kept.set_apart
        left_out = [f"map {map_id} is set apart: {bad[map_id]}" for map_id in sorted(bad.keys() - before_bad)]
        taken_in = [f"map {map_id} is no longer set apart" for map_id in sorted(before_bad - bad.keys())]
        odd = merged.implausible
        implausible = [
            f"map {which} is implausible: {odd[which]}"
            for which in sorted(odd.keys() - self._kept.implausible)
        ]
        # A link that is taken back, or no longer contradicted, may be reported once more.
        against_hand = merged.contradicted
        said = self._kept.contradicted & against_hand.keys()
        contradicted = [
            f"the link by hand of {a} and {b}: {against_hand[a, b]}"
            for a, b in sorted(against_hand.keys() - said)
        ]
        for words in (*joined, *taken_in):
            log.info("%s", words)
        for words in (*parted, *held, *left_out, *implausible, *contradicted):
            log.warning("%s", words)
        frames = {
            (change.pinned, change.holding or change.pinned): change for change in frame_changes(merged)
        }
        before_frames = self._kept.frames
        moved = [_frame_words(change) for key, change in frames.items() if key not in before_frames]
        not_holding, pinned = {node for node, _ in frames}, {pin.node for pin in merged.pins}
        moved += [
            f"the pin of {node} holds its component's frame again"
            for node in sorted({node for node, _ in before_frames} & pinned - not_holding)
        ]
        for words in moved:
            log.warning("%s", words)
        # Of what happens at once, that something came apart is what people must see last.
        fresh = [
            *_briefly(MapEventKind.JOINED, joined),
            *_briefly(MapEventKind.FRAME, moved),
            *_briefly(MapEventKind.KEPT_APART, held),
            *_briefly(MapEventKind.PARTED, parted),
            *_briefly(MapEventKind.SET_APART, taken_in),
            *_briefly(MapEventKind.IMPLAUSIBLE, implausible),
            *_briefly(MapEventKind.SET_APART, left_out),
            *_briefly(MapEventKind.CONTRADICTED, contradicted),
        ]
        apart_pairs = frozenset(still | set(new))
        self._links = merged.links
        after = KeptHistory(
            (), now, apart_pairs, frozenset(bad), frozenset(against_hand), frozenset(frames), frozenset(odd),
            tuple(sorted(merged.disbelieved.items())),
        )  # fmt: skip
        if fresh or replace(after, events=self._kept.events) != self._kept:
            self._keep(fresh, after)

    def failed(self, words: str) -> None:
        """Record that something could not be done; the same twice is reported once."""
        if not self._kept.events or self._kept.events[-1].words != words:
            self._keep([(MapEventKind.FAILED, words)], self._kept)

    def _keep(self, fresh: list[tuple[MapEventKind, str]], state: KeptHistory) -> None:
        """Add to the record; it is on the disk when this returns, unless the disk does not take it.

        Args:
            fresh: new events.
            state: what is remembered besides events.
        """
        now = self._clock()
        more = [MapEvent(now, kind, _one_line(words)) for kind, words in fresh]
        kept = replace(state, events=(*self._kept.events, *more)[-self._most :])
        with self._lock:
            self._kept = kept
        if self._store is None or not self._store.leads:
            return
        try:
            record = encode(kept)
            known, self._stored = self._stored, (self._stored[0], record)
            if self._store.replace_result(HISTORY, record, known):
                self._stored = (record,)
            else:
                # Another server leads since this one stood still.
                self.reload()
        except (InvalidFile, InvalidValue) as error:
            if not logged(error):
                log.warning("what has happened to the maps is not kept: %s", error)


def between(before: MergedMap, after: MergedMap, stamp_ns: int) -> tuple[MapEvent, ...]:
    """What has become of the maps from one merge to another, with the time at which that was asked for."""
    parts = joined_maps(before)
    joined, parted = joinings(parts, after), partings(parts, before.links, after)
    fresh = [*_briefly(MapEventKind.JOINED, joined), *_briefly(MapEventKind.PARTED, parted)]
    return tuple(MapEvent(stamp_ns, kind, _one_line(words)) for kind, words in fresh)


def _part_of(parts: Iterable[frozenset[MapId]]) -> dict[MapId, int]:
    return {map_id: number for number, part in enumerate(parts) for map_id in part}


def _kept_apart(merged: MergedMap, parts: Sequence[frozenset[MapId]]) -> dict[Pair, str]:
    """Maps that are kept apart: by mutual exclusion, as twins, or since one has wrong geometry."""
    part_of = _part_of(parts)
    refused: dict[Pair, list[RefusedLink]] = {}
    telling: dict[str, bool] = {}
    for r in merged.refused:
        if r.link is None or r.edge is not None:
            continue
        if r.reason not in telling:
            telling[r.reason] = is_twin_reason(r.reason)
        first, second = sorted((r.a.map, r.b.map))
        if telling[r.reason] and part_of.get(first) != part_of.get(second):
            refused.setdefault((first, second), []).append(r)
    # One line for a map with wrong geometry, under its pair with the first of those that it contradicts.
    out: dict[Pair, str] = {}
    for wrong in merged.wrong.values():
        first, second = sorted((wrong.which, wrong.agreeing[0]))
        out[first, second] = wrong.reason
    for (first, second), links in sorted(refused.items()):
        counts, twins = Counter(link.reason for link in links), are_twins(links)
        excluded = any(is_exclusion(reason) for reason in counts)
        if not (excluded or twins):
            continue
        why = f"{counted(len(links), 'link')} refused ({counts.most_common(1)[0][0]})"
        more = f". They show the same places: {TWINS}" if twins else ""
        out[first, second] = f"{first} and {second} are kept apart: {why}{more}"
    return out


def _frame_words(change: FrameChange) -> str:
    if change.holding is None:
        return f"the pin of {change.pinned} holds no frame: the node is not in the merged map"
    x, y, heading = change.now_from_pinned.vector
    return (
        f"the pin of {change.pinned} yields to the older one of {change.holding} in its component: "
        f"coordinates are turned by {math.degrees(heading):.2f} deg about the origin, then shifted by "
        f"{x:.3f}, {y:.3f} m"
    )


def _briefly(kind: MapEventKind, events: Sequence[str]) -> list[tuple[MapEventKind, str]]:
    """What happened in few words; of very much at once the number."""
    more = [f"and {len(events) - MOST_AT_ONCE} more at once"] if len(events) > MOST_AT_ONCE else []
    return [(kind, words) for words in (*events[:MOST_AT_ONCE], *more)]


def _one_line(words: str) -> str:
    return "".join(c if c.isprintable() else " " for c in words)[:MAX_WORDS]
