"""Keeps the answers up to date: takes changes in and merges in the background, piece by piece."""

import logging
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from itertools import islice

from mapweave.hybridmap.change import Change
from mapweave.hybridmap.counted import counted
from mapweave.hybridmap.errors import InvalidFile
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.manual_constraint import ManualConstraints
from mapweave.hybridmap.pin import Pin
from mapweave.mapserver.answers import Answers
from mapweave.mapserver.map_history import MapHistory
from mapweave.mapserver.merging.merge_adoption import MergeAdoption
from mapweave.mapserver.merging.merge_handover import MOST_WORDS, MergeHandover
from mapweave.mapserver.merging.merge_intake import MergeIntake
from mapweave.mapserver.merging.merge_retry import SHORT, MergeRetry
from mapweave.mapserver.merging.merger import Merger
from mapweave.mapserver.merging.merger_counters import MergerCounters
from mapweave.mapserver.merging.node_comparisons import Compare, compare
from mapweave.mapserver.merging.pruning_record import PruningRecord
from mapweave.mapserver.merging.stored_merges import StoredMerges
from mapweave.mapserver.merging.unmerged import Unmerged
from mapweave.mapserver.merging.verification_cache_keeper import VerificationCacheKeeper
from mapweave.mapserver.retrieval.place_database import PlaceDatabase
from mapweave.mapserver.schedule import Job, Schedule
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.settings import MergeSettings
from mapweave.storage.full_disks import logged

log = logging.getLogger(__name__)

READ_AT_ONCE = 1024
"""Changes of a store that are taken in at once: while these are, the next are decoded."""
SEARCHES_AT_ONCE = 20
"""Nodes whose similar nodes are searched at once, before new changes are taken in."""
PREPARED_AT_ONCE = 4
"""Nodes whose aliasing is evaluated at once, likewise."""
RETRY = 5.0
"""s between two looks whether merging is to be tried again for which there was too little memory."""
LOOK = 1.0
"""s between two looks for a merge that can be adopted, while there is none."""
FAILED = "merging failed: see the server's log"


class MergeWorker:
    """Merges in the background. Only its jobs touch the merger; new answers replace the old."""

    def __init__(
        self,
        schedule: Schedule,
        share: float = 0.4,
        places: PlaceDatabase | None = None,
        merge: MergeSettings | None = None,
        keeper: VerificationCacheKeeper | None = None,
        history: MapHistory | None = None,
        compare: Compare = compare,
        observe: Callable[[float], None] = lambda seconds: None,
        pruning: PruningRecord | None = None,
        stored: StoredMerges | None = None,
        retry: MergeRetry | None = None,
        choice_key: bytes = b"",
    ) -> None:
        """Start with no map.

        Args:
            schedule: runs the work, all of it one after the other.
            share: largest share of the time that is spent merging.
            places: is filled with the nodes that come; may have them already.
            merge: how maps are merged.
            keeper: of the verification cache.
            history: records what joins and parts.
            compare: compares nodes.
            observe: called with the time that a merge has taken, s.
            pruning: prunes what has been superseded for long; None: nothing is.
            stored: hands merges over to other servers, or from them; None: this one merges for itself.
            retry: says when merging is tried again for which there was too little memory.
            choice_key: see `Merger`.
        """
        self._schedule = schedule
        self._stored = stored
        self._handover = MergeHandover(stored, schedule.monotonic) if stored else None
        # Until it is known which server leads this one follows.
        self._adoption = MergeAdoption(stored, pruning, schedule.monotonic) if stored else None
        self._following, self._alone = stored is not None, ""
        self._own_merges = 0
        self._waiting_for: list[threading.Event] = []
        self._keeper, self._pruning = keeper, pruning
        self._history = history or MapHistory()
        self._observe = observe
        self._share_of_time = share
        self._merger = Merger(places, merge, compare, schedule.pause, choice_key)
        self._intake = MergeIntake(self._merger, pruning)
        self._answers = self._answers_from(MergedMap.empty())
        self._dirty = self._reading = self._unprepared = False
        self._read_all = self._begun = self._waits_for_memory = False
        self._problem = self._trouble = ""
        self._unmerged = Unmerged(schedule.monotonic)
        self._merger.suspect(self._history.set_apart)
        for map_id, reason in self._history.disbelieved:
            self._merger.note_disbelief(map_id, reason)
        self._counting = threading.Lock()
        self._came = self._applied = self._done = 0
        self._retry = retry or MergeRetry(clock=schedule.monotonic)
        schedule.idle(self._idle)
        schedule.every(RETRY, self._remind)

    @property
    def answers(self) -> Answers:
        """Answers from the newest merged map."""
        return self._answers

    @property
    def event(self) -> str:
        """What holds up merging; else the newest event of the history, with its reason."""
        return (self._problem or self._history.newest)[:MOST_WORDS]

    @property
    def delay(self) -> str:
        """What holds up merging, here or on the server that leads; empty if nothing does."""
        return self._problem[:MOST_WORDS]

    @property
    def begun(self) -> bool:
        """Whether it has merged what it has read, or tried to; until then maps lie apart."""
        return self._begun

    @property
    def settled(self) -> bool:
        """Whether everything that has come is merged, or could not be."""
        return self._done == self._came

    @property
    def behind(self) -> int:
        """Changes that wait for the merge of the server that leads."""
        return self._adoption.behind if self._adoption else 0

    @property
    def unmerged_seconds(self) -> float:
        """For how long the oldest of what has come and is not in the merged map has waited; 0: all is."""
        return self._unmerged.seconds

    @property
    def alone(self) -> str:
        """Why this server merges though another one leads; empty if it does not."""
        return self._alone

    def current(self) -> Answers:
        """Answers that contain all changes before a question (see Schedule.catch_up)."""
        self._schedule.catch_up()
        return self._answers

    def start(self) -> None:
        """Begin to merge."""
        self._schedule.post(self._restore)
        self._schedule.start()

    def take(self, change: Change) -> None:
        """Take note of a change, in the order of its log. Returns at once.

        A new place can be found from now on, however long a merge takes: the merging thread takes
        the change in when its turn comes, and its result for the place database is final.
        """
        self._schedule.observe(change.stamp_ns)
        self._intake.put(change)
        self._post(self._take_next)

    def counters(self) -> MergerCounters:
        """Counters since the start, from any thread."""
        return replace(self._merger.counters)

    def queues(self) -> Mapping[str, int]:
        """Changes that wait to be taken in, or for another server's merge, and nodes to be compared."""
        compare = 0 if self._following else self._merger.uncompared
        return {"merge": len(self._intake), "leader": self.behind, "comparisons": compare}

    def unmerged(self, robot: str) -> int:
        """Changes of a robot that wait to be taken in: robots take turns."""
        return self._intake.waiting(robot)

    def read(self, changes: Iterable[Change]) -> None:
        """Take in all that is in a store, map by map in the order of its log, once this has started.

        Returns when every place can be found, and lies in the frame of its own map. Maps are compared
        with each other afterwards.

        Raises:
            InvalidFile: the store is damaged.
        """
        rest, taken = iter(changes), threading.Event()
        self._reading = True
        try:
            while some := list(islice(rest, READ_AT_ONCE)):
                self._post(partial(self._intake.read, some))
        finally:
            self._schedule.post(lambda: self._end_reading(taken))
        self._schedule.catch_up()
        taken.wait()

    def note_refusal(self, map_id: MapId, reason: str) -> None:
        """Note that a change of a map was refused. Returns at once."""
        self._post(lambda: self._merger.note_refusal(map_id, reason))

    def note_disbelief(self, map_id: MapId, reason: str) -> None:
        """Note that something said of a map is not believed. Returns at once."""
        self._post(lambda: self._merger.note_disbelief(map_id, reason))

    def constrain(self, constraints: ManualConstraints) -> None:
        """Apply exactly these manual constraints from now on. Returns at once."""
        self._post(lambda: self._merger.constrain(constraints))

    def pin(self, pins: Sequence[Pin]) -> None:
        """Hold the frames of components by exactly these pins from now on, oldest first. Returns at once."""
        self._post(lambda: self._merger.pin(pins))

    def follow_pruning(self) -> None:
        """Let go what another server has pruned, if any has. Returns at once; for any thread.

        Raises:
            InvalidFile: the store cannot be read.
        """
        if self._pruning and self._pruning.outdated:
            self._post(self._adopt_pruning)

    def follow_merges(self) -> None:
        """Look which server leads, and whether it has merged. Returns at once; for any thread."""
        self._schedule.post(self._look)

    def settle(self, timeout: float) -> bool:
        """Wait until everything that came before this call is merged; False if the time is over first."""
        merged = threading.Event()
        self._schedule.post(lambda: self._settle(merged))
        self._schedule.catch_up()
        return merged.wait(timeout)

    def close(self) -> None:
        """Stop, and keep what was found. Changes that wait are in the store, for the next start."""
        if self._schedule.close():
            self._save(last=True)
        self._retry.end()

    def _post(self, job: Job) -> None:
        """Post a job after which the merged map is out of date."""
        with self._counting:
            self._came += 1
            self._unmerged.came(self._came)

        def change() -> None:
            try:
                job()
            finally:
                self._applied += 1
                self._dirty = True

        self._schedule.post(change)

    def _restore(self) -> None:
        if self._pruning:
            try:
                self._pruning.restore(self._merger)
            except InvalidFile as error:  # a store that servers share says later that it has it
                log.error("what was pruned cannot be read: %s", error)
        if self._keeper:
            try:
                self._keeper.restore(self._merger)
            except Exception:  # it can all be found out again
                log.exception("what was found before cannot be read: nodes are compared again")

    def _adopt_pruning(self) -> None:
        if self._pruning:
            try:
                self._pruning.adopt(self._merger)
            except InvalidFile as error:  # it is looked again with the next news
                log.warning("%s", error)

    def _save(self, last: bool = False) -> None:
        if self._keeper and not self._following:
            try:
                self._keeper.save(self._merger, last)
            except Exception:  # the next start takes longer
                log.exception("what was found is not kept")

    def _remind(self) -> None:
        """Have the work that can wait begun again, if it waited for memory."""
        if self._waits_for_memory and not self._retry.pause:
            self._schedule.post(lambda: None)

    def _idle(self) -> float | None:
        """A piece of the work that can wait: compare nodes, merge, prepare answers."""
        # What comes in pieces is merged when it is whole.
        if self._reading:
            return None
        if self._following:
            return self._follow()
        if not (self._dirty or self._unprepared):
            return self._share()
        self._waits_for_memory = self._dirty and self._retry.pause > 0.0
        if self._waits_for_memory:
            self._problem = f"{self._retry.words}; {self._lacking}"
            return None
        if self._merger.uncompared:
            self._search_pairs()
            return 0.0
        began = self._schedule.monotonic()
        if self._dirty:
            self._merge()
            self._share()
        else:
            self._prepare(PREPARED_AT_ONCE)
        spent = self._schedule.monotonic() - began
        self._save()
        return spent * (1.0 / self._share_of_time - 1.0)

    def _settle(self, merged: threading.Event) -> None:
        if self._following:
            self._waiting_for.append(merged)
            return
        if self._dirty:
            self._merge()
            self._share()
        merged.set()
        self._save()

    def _end_reading(self, taken: threading.Event) -> None:
        self._reading, self._read_all, self._begun = False, True, not self._dirty
        if self._dirty and not self._following:
            self._retry.begin()
        if self._merger.uncompared:
            self._publish_parts()
        taken.set()

    def _take_next(self) -> None:
        change = self._intake.pop()
        if self._following and self._adoption:
            self._adoption.hold(self._applied + 1, change)
        else:
            self._intake.take(change)

    def _look(self) -> None:
        """Lead or follow, as the store says."""
        if self._adoption is None or self._handover is None or self._stored is None:
            return
        if self._stored.store.leads:
            self._handover.lead()
            if self._following:
                self._adopt()
                self._go_on()
            self._alone = ""
        elif not self._following and (not self._alone or self._adoption.promising(self._merger)):
            self._following, self._alone = True, ""
            self._adoption.begin()

    def _follow(self) -> float | None:
        """A piece of idle work: adopt what the server that leads has merged, or merge after all."""
        self._adopt()
        if self._adoption is None or self._adoption.overdue:
            self._alone = self._adoption.reason[:MOST_WORDS] if self._adoption else ""
            log.warning("this server merges itself, though it does not lead: %s", self._alone)
            self._go_on()
            return 0.0
        if self._adoption.in_step(self._merger):
            self._done = self._applied
            self._unmerged.merged(self._done)
            self._release()
        problem = self._adoption.reason
        if not problem and (trouble := self._adoption.leaders_trouble(self._unmerged.seconds)):
            problem = f"{trouble}; {self._lacking}"
        if problem != self._problem and not self._adoption.reason and problem:
            log.warning("%s", problem)
        self._problem = problem
        if self._unprepared:
            began = self._schedule.monotonic()
            self._prepare(PREPARED_AT_ONCE)
            return (self._schedule.monotonic() - began) * (1.0 / self._share_of_time - 1.0)
        return LOOK if self._adoption.reason or self._unmerged.seconds else None

    @property
    def _lacking(self) -> str:
        """How old the map is, in words that stay the same while nothing is merged."""
        began = self._schedule.time_ns() * 1e-9 - self._unmerged.seconds
        since = datetime.fromtimestamp(began, UTC)
        return f"the map lacks what came since {since:%Y-%m-%d %H:%M} UTC"

    def _adopt(self) -> None:
        if self._adoption is None:
            return
        try:
            merged = self._adoption.adopt(
                self._merger, self._intake.take_held, self._has_merged, self._intake.last
            )
            if merged is None:
                return
            self._own_merges = self._merger.counters.merges
            self._answers = self._answers_from(merged)
        except Exception as error:  # the map of before must not pass for the newest
            log.exception("a merge could not be adopted")
            self._adoption.give_up(f"a merge could not be adopted ({type(error).__name__}: {error})")
            return
        self._unprepared, self._begun, self._problem = True, True, ""
        if (first := self._adoption.first_held) is not None:
            self._unmerged.merged(first - 1)
        self._follow_history(merged)

    @property
    def _has_merged(self) -> bool:
        """Whether this server has merged since it began, or since it adopted a merge."""
        return self._merger.counters.merges != self._own_merges

    def _go_on(self) -> None:
        """Merge from now on, from where the server that led left off."""
        if self._adoption:
            try:
                self._adoption.hand_over(self._merger, self._has_merged)
            except Exception:  # it can all be found out again
                log.exception("what the server that led has found cannot be used: nodes are compared again")
            self._intake.take_held(self._adoption.release())
        self._following, self._dirty = False, True
        waiting, self._waiting_for = self._waiting_for, []
        for merged in waiting:
            self._schedule.post(partial(self._settle, merged))

    def _release(self) -> None:
        waiting, self._waiting_for = self._waiting_for, []
        for merged in waiting:
            merged.set()

    def _share(self) -> float | None:
        """Hand the newest merge over to the servers that follow; see `MergeHandover.write`."""
        if self._handover is None:
            return None
        mark = self._pruning.mark if self._pruning else None
        return self._handover.write(self._merger, self._intake.last, mark, self._dirty, self._trouble)

    def _answers_from(self, merged: MergedMap) -> Answers:
        return Answers.of(self._merger, merged, self._intake.node)

    def _search_pairs(self) -> None:
        """A part of the work before the first merge, which must not hold up new changes."""
        self._problem = f"still to be compared with others: {counted(self._merger.uncompared, 'node')}"
        try:
            with self._retry.attempt():
                self._merger.search_pairs(SEARCHES_AT_ONCE)
        except MemoryError:
            self._retry.short()
        except Exception:  # the merge tries again, and reports if it cannot
            log.exception("nodes could not be compared")
            self._merge()

    def _publish_parts(self) -> None:
        """Answer from each map by itself, as its robot made it, until all are compared with each other."""
        try:
            self._answers = self._answers_from(self._merger.apart())
        except Exception:  # as below
            log.exception("the maps could not be published one by one")

    def _prepare(self, most: int) -> None:
        """Evaluate the aliasing of nodes in advance, so that relocalization need not wait for it."""
        self._unprepared = False
        try:
            self._unprepared = self._answers.relocalizer.prepare(most) > 0
        except Exception:  # it is evaluated with the next question
            log.exception("the aliasing of nodes could not be evaluated in advance")

    def _follow_history(self, merged: MergedMap) -> None:
        try:
            self._history.follow(merged)
        except Exception:  # a defect here must not end all merging
            log.exception("the history of the maps could not be written")

    def _merge(self) -> None:
        self._dirty = False
        began = self._schedule.monotonic()
        made: list[Answers] = []
        try:
            with self._retry.attempt():
                merged = self._merger.merged(lambda merged: made.append(self._answers_from(merged)))
            self._answers = made[-1] if made else self._answers_from(merged)
        except MemoryError:
            self._dirty = True
            self._retry.short()
            self._problem, self._trouble = f"{self._retry.words}; {self._lacking}", SHORT
            self._history.failed(SHORT)
            return
        except Exception:  # questions are answered from the map before; the next change is the next chance
            log.exception("merging failed")
            self._retry.end()
            self._problem, self._trouble = f"{FAILED}; {self._lacking}", FAILED
            self._history.failed(FAILED)
            return
        finally:
            self._done, self._begun = self._applied, self._read_all
            self._observe(self._schedule.monotonic() - began)
        self._retry.succeeded(self._read_all)
        self._unprepared, self._problem, self._trouble = True, "", ""
        self._unmerged.merged(self._applied)
        self._follow_history(merged)
        try:
            now_ns = self._schedule.time_ns()
            if self._pruning and self._pruning.prune(self._merger, now_ns, self._intake.last):
                self._dirty = True
        except InvalidFile as error:  # it is tried again the next day
            if not logged(error):
                log.warning("what has been superseded for long is not pruned: %s", error)
        except Exception:
            log.exception("what has been superseded for long could not be pruned")
