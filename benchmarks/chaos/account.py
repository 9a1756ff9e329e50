"""What was sent, and what of it servers have: by logs, journals and stores, when all processes have ended."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from benchmarks.chaos.agent_process import STAMP, digest
from benchmarks.chaos.scripted_robot import ScriptedRobot
from mapweave.agent.replication.journal import Journal
from mapweave.hybridmap.change import Change, EdgePut, EdgeRetired, NodeRetired
from mapweave.hybridmap.ids import NodeId
from mapweave.mapserver.content_hash import content_hash
from mapweave.mapserver.log.kept_bytes import LEAST_GROWN
from mapweave.mapserver.log.sql_sizes import ROW_BYTES
from mapweave.mapserver.log.store import Store
from mapweave.storage.map_file import MapFile
from mapweave.wire.codec import element_of, encode_body, encode_change


@dataclass(frozen=True, slots=True)
class Account:
    """What was sent and stored, of one robot or summed over robots.

    Attributes:
        sent: changes that the robot's journal had committed, by the robot's own log.
        stored: of these, those in the store; of several stores the least.
        undone: of these, those that a store lacks since a later change puts the same node or edge again or
            retires it, or it was a retirement: the robot's journal no longer has them, either, or the store
            has deleted them itself, as it does in large maps.
        lost: the others.
        duplicated: changes that a store has more than once.
        out_of_order: changes that are not where they were in the robot's log, or were never sent.
        maps_equal: whether log, journal and stores make the same map.
    """

    sent: int = 0
    stored: int = 0
    undone: int = 0
    lost: int = 0
    duplicated: int = 0
    out_of_order: int = 0
    maps_equal: bool = True

    def __add__(self, other: Account) -> Account:
        """Both robots together."""
        return Account(
            self.sent + other.sent, self.stored + other.stored, self.undone + other.undone,
            self.lost + other.lost, self.duplicated + other.duplicated,
            self.out_of_order + other.out_of_order, self.maps_equal and other.maps_equal,
        )  # fmt: skip


class BrokenLog(Exception):
    """A robot's own log contradicts itself: it is no measure of anything."""


def sent_changes(folder: Path, robot: int, seed: int) -> list[Change]:
    """The changes that a robot has committed, in order, by its own log and its deterministic script.

    Raises:
        BrokenLog: half a step was committed, or a digest or length is not that of its script.
    """
    script = ScriptedRobot(robot, seed)
    committed = 0
    handed: dict[int, tuple[int, str]] = {}
    heads: dict[int, int] = {}
    for line in (folder / f"{script.map.agent}.truth").read_text().splitlines():
        match line.split():
            case ["T", number, count, summary]:
                handed[int(number)] = int(count), summary
            case ["C", number, head, _]:
                if int(number) < committed:
                    raise BrokenLog(f"{script.map.agent}: {line}: step {committed} was committed before")
                committed = int(number)
                heads[committed] = int(head)
            case ["TORN", *_]:
                raise BrokenLog(f"{script.map.agent}: half a step is in its journal")
    changes: list[Change] = []
    for step in range(1, committed + 1):
        bodies = script.step()
        if handed[step] != (len(bodies), digest(bodies)):
            raise BrokenLog(f"{script.map.agent}: step {step} is not that of its script")
        first = len(changes) + 1
        changes += [Change(script.map, first + k, step * STAMP, body) for k, body in enumerate(bodies)]
        if heads.get(step, len(changes)) != len(changes):
            raise BrokenLog(f"{script.map.agent}: the journal was {heads[step]} long at step {step}")
    return changes


def account(sent: Sequence[Change], journal: Journal, stores: Sequence[Store]) -> Account:
    """Compare what a robot has sent with what its journal and the stores have."""
    map_id = sent[0].map
    position = {encode_change(change): change.sequence for change in sent}
    superfluous, deleted = _superfluous(sent), _deleted_by_store(sent)
    kept = {encode_change(c) for c in journal.changes(map_id, 1, len(sent))}
    maps = {_hash([change.body for change in sent]), _hash(list(journal.replay(map_id)))}
    result = Account(sent=len(sent), stored=len(sent))
    for store in stores:
        rows = list(store.replay(map_id))
        have = [encode_change(row) for row in rows]
        missing = {data: k for data, k in position.items() if data not in set(have)}
        undone = sum(k in deleted or (data not in kept and k in superfluous) for data, k in missing.items())
        in_order = [position.get(data) == row.sequence for data, row in zip(have, rows, strict=True)]
        rising = all(a.sequence < b.sequence for a, b in pairwise(rows))
        maps.add(_hash([row.body for row in rows]))
        result = Account(
            len(sent), min(result.stored, len(sent) - len(missing)), max(result.undone, undone),
            max(result.lost, len(missing) - undone),
            result.duplicated + len(rows) - len({encode_body(row.body) for row in rows}),
            result.out_of_order + in_order.count(False) + (not rising),
        )  # fmt: skip
    # A journal that has lost what was committed has lost it, whatever the servers have.
    gone = sum(data not in kept and k not in superfluous for data, k in position.items())
    return Account(
        result.sent, result.stored, result.undone, max(result.lost, gone), result.duplicated,
        result.out_of_order, len(maps) == 1,
    )  # fmt: skip


def _superfluous(sent: Sequence[Change]) -> set[int]:
    """Changes that later ones undo, and retirements: whether the map is the same without them is compared."""
    newest: dict[NodeId, int] = {element_of(change.body): change.sequence for change in sent}
    retired = {change.body.id: change.sequence for change in sent if isinstance(change.body, NodeRetired)}
    out = {change.sequence for change in sent if newest[element_of(change.body)] > change.sequence}
    for change in sent[:-1]:
        match change.body:
            case EdgePut(edge) if change.sequence < max(retired.get(edge.a, 0), retired.get(edge.b, 0)):
                out.add(change.sequence)
            case NodeRetired() | EdgeRetired():
                out.add(change.sequence)
    return out


def _deleted_by_store(sent: Sequence[Change]) -> set[int]:
    """Changes that a store may delete by itself: superseded ones, in a map that is large enough.

    It keeps the last retirement of a node or edge, and all that comes after.
    """
    if sum(ROW_BYTES + len(encode_change(change)) for change in sent) < LEAST_GROWN:
        return set()
    newest: dict[NodeId, int] = {element_of(change.body): change.sequence for change in sent}
    retires = {k.sequence for k in sent if isinstance(k.body, NodeRetired | EdgeRetired)}
    retired = {element_of(k.body): k.sequence for k in sent if k.sequence in retires}
    return {
        change.sequence
        for change in sent
        if change.sequence < retired.get(element_of(change.body), 0)
        or (change.sequence < newest[element_of(change.body)] and change.sequence not in retires)
    }


def _hash(bodies: Sequence[object]) -> str:
    return content_hash(MapFile("agent", "", tuple(bodies)))  # type: ignore[arg-type]
