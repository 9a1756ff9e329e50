"""Changes of many logs that are committed together."""

import tempfile
from collections.abc import Sequence
from pathlib import Path

from hypothesis import given, settings
from hypothesis import strategies as st

from mapweave.hybridmap.errors import InvalidFile, MapweaveError
from mapweave.hybridmap.ids import MapId
from mapweave.mapserver.log.agent_log import AgentLog, PullSettings
from mapweave.mapserver.log.entry import Applied, ReceivedChange
from mapweave.mapserver.log.group_commit import GroupCommit, NextRun
from mapweave.mapserver.log.intake import Intakes
from mapweave.mapserver.log.sqlite_store import SqliteStore
from mapweave.mapserver.log.store import LogChanges
from mapweave.mapserver.quotas import Quotas
from mapweave.wire.memory import MemoryHub
from tests.mapserver.played import LOG_ID, HandAgent, Server, message
from tests.waiting import eventually

MAPS = tuple(MapId(f"r{k}", 1) for k in range(4))


def group(store: SqliteStore) -> GroupCommit:
    return GroupCommit(store, Intakes(store, Quotas(), tuple))


def run(map_id: MapId, sequences: list[int], covered: int | None = None, log_id: int = LOG_ID) -> NextRun:
    entries = [ReceivedChange.read(map_id, sequence, message(sequence, map_id)) for sequence in sequences]
    return NextRun(AgentLog(map_id, log_id, PullSettings()), entries, covered)


def contents(path: Path) -> dict[MapId, object]:
    store = SqliteStore(path)
    try:
        return {m: (store.positions([m]), store.watermark(m), list(store.replay(m))) for m in store.maps()}
    finally:
        store.close()


runs_of_a_turn = st.lists(
    st.tuples(
        st.sampled_from(MAPS),
        st.lists(st.integers(1, 9), max_size=5, unique=True).map(sorted),
        st.none() | st.integers(1, 9),
        st.sampled_from([LOG_ID, LOG_ID, LOG_ID, 5]),
    ),
    max_size=4,
    unique_by=lambda one: one[0],
)


@settings(max_examples=15, deadline=None)
@given(st.lists(runs_of_a_turn, max_size=4))
def test_a_group_gives_what_its_runs_give_one_by_one(turns: list[list[tuple]]):  # type: ignore[type-arg]
    with tempfile.TemporaryDirectory() as folder:
        paths = Path(folder) / "group.sqlite", Path(folder) / "single.sqlite"
        together, single = map(SqliteStore, paths)
        for turn in turns:
            runs = [run(*one) for one in turn]
            results = group(together).commit(runs)
            for one, result in zip(runs, results, strict=True):
                try:
                    alone = single.apply(one.log.map, one.log.log_id, one.entries, one.covered)
                except MapweaveError as error:
                    assert str(error) == str(result)
                else:
                    assert result == alone
        together.close()
        single.close()
        assert contents(paths[0]) == contents(paths[1])


def test_a_run_that_cannot_be_stored_holds_up_no_other(tmp_path, monkeypatch):
    store = SqliteStore(tmp_path / "s.sqlite")
    put = store._put

    def stumble(table: str, values: Sequence[object]) -> None:
        put(table, values)
        if table == "change" and values[0] == MAPS[1].agent:
            raise OverflowError("Python int too large to convert to SQLite INTEGER")

    monkeypatch.setattr(store, "_put", stumble)
    results = group(store).commit([run(map_id, [1, 2]) for map_id in MAPS])
    assert [isinstance(result, Applied) for result in results] == [True, False, True, True]
    assert "OverflowError" in str(results[1]) and "r1" in str(results[1])
    store.close()
    assert [store_map.agent for store_map in contents(tmp_path / "s.sqlite")] == ["r0", "r2", "r3"]


def test_a_disk_that_is_full_in_the_middle_of_a_group_keeps_what_fits(tmp_path, monkeypatch):
    """SQLite itself reports a full disk, by a limit on its pages."""
    path = tmp_path / "s.sqlite"
    store = SqliteStore(path)
    store.apply(MAPS[0], LOG_ID, run(MAPS[0], [1]).entries)
    pages = store._database.connection.execute("PRAGMA page_count").fetchone()[0]
    store._database.connection.execute(f"PRAGMA max_page_count={pages + 2}")
    runs = [run(MAPS[1], [1]), run(MAPS[2], list(range(1, 2000))), run(MAPS[3], [1])]
    results = group(store).commit(runs)
    assert isinstance(results[1], InvalidFile) and "full" in str(results[1])
    assert isinstance(results[0], Applied) and isinstance(results[2], Applied)
    store.close()
    assert {m.agent: kept[1] for m, kept in contents(path).items()} == {"r0": 1, "r1": 1, "r3": 1}  # type: ignore[index]


def test_nothing_of_a_failed_group_is_acknowledged_and_all_of_it_comes_later(hub: MemoryHub, server: Server):
    agents = [HandAgent(hub, map_id) for map_id in MAPS]
    for agent in agents:
        agent.serve(3)
    apply_all, broken = server.store.apply_all, [True]

    def fail(runs: list[LogChanges]) -> list[Applied | MapweaveError]:
        if broken:
            return [InvalidFile("s0.sqlite: map store cannot be used (disk I/O error)") for _ in runs]
        return apply_all(runs)

    server.store.apply_all = fail  # type: ignore[assignment, method-assign]
    for agent in agents:
        agent.publish_each(1, 2, 3)
    eventually(lambda: server.ingest.counters().failures >= len(MAPS))
    assert not any(agent.acks for agent in agents) and not server.seen
    broken.clear()
    eventually(lambda: all(agent.acks and agent.acks[-1].watermark == 3 for agent in agents))
    assert sorted((c.map, c.sequence) for c in server.seen) == [(m, k) for m in MAPS for k in (1, 2, 3)]


def test_changes_that_wait_are_committed_together(hub: MemoryHub, server: Server):
    agents = [HandAgent(hub, map_id) for map_id in MAPS]
    apply_all, groups = server.store.apply_all, list[int]()

    def slow_disk(runs: list[LogChanges]) -> list[Applied | MapweaveError]:
        groups.append(len(runs))
        if len(groups) == 1:
            for agent in agents[1:]:
                agent.publish(1)
            eventually(lambda: server.ingest.waiting == len(agents) - 1)
        return apply_all(runs)

    server.store.apply_all = slow_disk  # type: ignore[assignment, method-assign]
    agents[0].publish(1)
    eventually(lambda: all(agent.acks for agent in agents))
    assert groups == [1, len(agents) - 1]
