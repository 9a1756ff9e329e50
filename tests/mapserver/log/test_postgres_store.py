"""What only a PostgreSQL store does: it comes back, keeps its secrets, and agrees with the SQLite one."""

import tempfile
import threading
from dataclasses import astuple
from pathlib import Path

import psycopg
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule, run_state_machine_as_test

from mapweave.cli import main
from mapweave.hybridmap.change import ChangeBody, NodeRetired
from mapweave.hybridmap.errors import InvalidFile, InvalidValue, MapweaveError
from mapweave.hybridmap.ids import EdgeId, MapId, NodeId
from mapweave.mapserver.log.entry import Applied, ReceivedChange
from mapweave.mapserver.log.opening import open_store
from mapweave.mapserver.log.postgres_store import PostgresStore
from mapweave.mapserver.log.store import LogChanges, Store
from mapweave.wire.codec import encode_body
from synthetic.postgres_server import ROLE, PostgresServer, binaries
from tests.mapserver.log.test_store import MAP, OTHER, broken, edge_put, entry, node_put
from tests.postgres import absent_standby
from tests.waiting import eventually

BODIES: list[ChangeBody] = [
    node_put(1, 3), node_put(1, 7), node_put(2, 5), NodeRetired(NodeId(*MAP, 1)),
    edge_put(11, 1, 2, [(2, 4)]), edge_put(12, 1, 2, [(6, 0)]),
]  # fmt: skip
FOREIGN: list[ChangeBody] = [node_put(1, 2, OTHER), NodeRetired(NodeId(*OTHER, 1))]


def entries(map_id: MapId, first: int, picks: list[int]) -> list[ReceivedChange]:
    """Changes from a place in a log on; some are broken."""
    bodies = BODIES if map_id == MAP else FOREIGN
    made = []
    for sequence, pick in enumerate(picks, first):
        if pick >= len(bodies):
            made.append(ReceivedChange.read(map_id, sequence, b"\xc1\0\xff"))
        else:
            made.append(entry(sequence, bodies[pick], map_id))
    return made


RUNS = st.builds(
    lambda map_id, log_id, first, picks, gap: LogChanges(
        map_id, log_id, entries(map_id, first, picks), None if gap is None else first + len(picks) + gap
    ),
    st.sampled_from([MAP, OTHER]), st.sampled_from([5, 5, 5, 2**64 - 1]), st.integers(1, 12),
    st.lists(st.integers(0, 6), max_size=5), st.sampled_from([None, None, 0, 2]),
)  # fmt: skip


def seen(result: Applied | MapweaveError) -> object:
    """What is to be compared of a result."""
    if isinstance(result, MapweaveError):
        return type(result), str(result)
    changes = [(change.sequence, encode_body(change.body)) for change in result.changes]
    return changes, result.refusals, result.watermark, result.before


def content(store: Store) -> list[object]:
    """All that can be seen of a store."""
    return [
        store.maps(), store.positions(), store.refused(), store.damaged(),
        store.constraints(), store.annotations(), store.result("poses"), store.kept("r0"), store.traffic(),
        *((store.watermark(m), store.positions([m]), store.refusals(m, 3)) for m in (MAP, OTHER)),
        *(store.unverified(m) for m in (MAP, OTHER)),
        *(store.traffic(m) for m in (MAP, OTHER)),
        *([(c.sequence, c.stamp_ns, encode_body(c.body)) for c in store.replay(m, 2)] for m in (MAP, OTHER)),
        *(store.landmarks(NodeId(*m, k)) for m in (MAP, OTHER) for k in (1, 2)),
    ]  # fmt: skip


@pytest.mark.parametrize("examples", [4, pytest.param(30, marks=pytest.mark.slow)])
def test_both_stores_give_the_same_for_the_same(address: str, tmp_path, examples: int):

    class Both(RuleBasedStateMachine):
        def __init__(self) -> None:
            super().__init__()
            with psycopg.connect(address, autocommit=True) as connection:
                connection.execute("DROP SCHEMA IF EXISTS mapweave CASCADE")
            self.folder = Path(tempfile.mkdtemp(dir=tmp_path))
            self.open()

        def open(self) -> None:
            self.stores = [open_store(self.folder / "s"), open_store(address)]

        @rule(runs=st.lists(RUNS, max_size=3))
        def apply(self, runs: list[LogChanges]) -> None:
            one, other = ([*map(seen, store.apply_all(runs))] for store in self.stores)
            assert one == other

        @rule(body=st.binary(max_size=9))
        def decide(self, body: bytes) -> None:
            for store in self.stores:
                store.add_constraint(body)
                store.add_annotation(body[::-1])
                store.put_result("poses", body)

        @rule(
            nodes=st.sets(st.sampled_from([NodeId(*m, k) for m in (MAP, OTHER) for k in (1, 2)])),
            edges=st.sets(st.sampled_from([EdgeId(*MAP, 11), EdgeId(*MAP, 12)])),
            last=st.none() | st.dictionaries(st.sampled_from([MAP, OTHER]), st.integers(0, 8)),
            known=st.none() | st.sampled_from([b"pruned", b""]),
        )
        def prune(
            self, nodes: set[NodeId], edges: set[EdgeId], last: dict[MapId, int] | None, known: bytes | None
        ) -> None:
            one, other = (
                store.prune(nodes, edges, {"poses": b"pruned"}, last, {"poses": known})
                for store in self.stores
            )
            assert one == other

        @rule(map_id=st.sampled_from([MAP, OTHER]), first=st.integers(1, 5), more=st.integers(0, 3))
        def lose(self, map_id: MapId, first: int, more: int) -> None:
            for store in self.stores:
                assert list(store.restore(map_id, first, first + more, [])) == []

        @rule(
            map_id=st.sampled_from([MAP, OTHER]), first=st.integers(1, 5), more=st.integers(0, 3),
            kept=st.sets(st.integers(1, 7)),
        )  # fmt: skip
        def verify(self, map_id: MapId, first: int, more: int, kept: set[int]) -> None:
            one, other = (store.verify(map_id, first, first + more, kept) for store in self.stores)
            assert one == other

        @rule()
        def reopen(self) -> None:
            ids = [store.id for store in self.stores]
            self.teardown()
            self.open()
            assert [store.id for store in self.stores] == ids

        @invariant()
        def same(self) -> None:
            one, other = (content(store) for store in self.stores)
            assert one == other
            for store in self.stores:
                of_maps = [astuple(store.traffic(m)) for m in (MAP, OTHER)]
                assert astuple(store.traffic()) == tuple(map(sum, zip(*of_maps, strict=True)))

        def teardown(self) -> None:
            for store in self.stores:
                store.close()

    run_state_machine_as_test(
        Both, settings=settings(max_examples=examples, stateful_step_count=8, deadline=None)
    )


def test_two_servers_share_a_store(address: str):
    one, other = PostgresStore(address, "s0"), PostgresStore(address, "s1")
    assert one.id == other.id
    assert one.apply(MAP, 5, [entry(1), entry(2)]).before == 0
    late = other.apply(MAP, 5, [entry(1), entry(2), entry(3)])
    assert ([c.sequence for c in late.changes], late.before, late.watermark) == ([3], 2, 3)
    done: list[object] = []

    def write(store: PostgresStore, maps: list[MapId]) -> None:
        for first in range(1, 16):
            done.append(
                store.apply_all([LogChanges(m, 5, entries(m, first, [0, 1]), first + 1) for m in maps])
            )
            store.add_constraint(b"%d" % first)

    # In opposite orders: neither may wait for the other for ever.
    threads = [
        threading.Thread(target=write, args=args) for args in ((one, [MAP, OTHER]), (other, [OTHER, MAP]))
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert len(done) == 30 and not any(isinstance(r, MapweaveError) for results in done for r in results)
    for store in (one, other):
        assert [c.sequence for c in store.replay(OTHER)] == list(range(1, 17))
        assert len(store.constraints()) == 30, "none overwrites another"
        store.close()


@pytest.mark.slow
def test_it_goes_on_when_postgresql_is_back(own_postgres: PostgresServer):
    store = PostgresStore(own_postgres.database())
    store.apply(MAP, 5, [entry(1)])
    own_postgres.kill()
    with pytest.raises(InvalidFile) as away:
        store.apply(MAP, 5, [entry(2)])
    assert "\n" not in str(away.value) and "the map store cannot be used" in str(away.value)
    with pytest.raises(InvalidFile, match="the map store cannot be used"):
        store.watermark(MAP)
    assert [str(one) for one in store.apply_all([LogChanges(MAP, 5, [entry(2)])] * 2)], "each has its error"
    own_postgres.start()

    def taken() -> bool:
        (result,) = store.apply_all([LogChanges(MAP, 5, [entry(1), entry(2)])])
        return isinstance(result, Applied)

    eventually(taken)
    assert [change.sequence for change in store.replay(MAP)] == [1, 2]
    store.close()
    with pytest.raises(InvalidFile, match="is closed"):
        store.watermark(MAP)


def test_a_commit_that_no_standby_confirms_is_none(postgres: PostgresServer):
    """The wait for a standby may be cancelled; PostgreSQL then commits, with a warning."""
    store = PostgresStore(postgres.database(), "waits")
    store.apply(MAP, 5, [entry(1)])
    results: list[Applied | MapweaveError] = []

    def write() -> None:
        # The setting is in force a little later.
        while all(isinstance(result, Applied) for result in results):
            results.extend(store.apply_all([LogChanges(MAP, 5, [entry(2 + len(results))])]))

    with absent_standby(postgres) as people:
        writer = threading.Thread(target=write)
        writer.start()
        waiting = "SELECT pid FROM pg_stat_activity WHERE wait_event = 'SyncRep'"
        eventually(lambda: people.execute(waiting).fetchall())
        assert store.traffic().nodes == 0, "questions are answered meanwhile"
        people.execute("SELECT pg_cancel_backend(pid) FROM pg_stat_activity WHERE wait_event = 'SyncRep'")
        writer.join(30)
        assert "is not confirmed" in str(results[-1]) and isinstance(results[-1], InvalidFile)
    again = LogChanges(MAP, 5, [entry(1 + len(results))])
    eventually(lambda: isinstance(store.apply_all([again])[0], Applied))
    store.close()


@pytest.mark.parametrize(
    "address",
    [
        "postgresql://anna:s3cret@host/maps",
        "postgresql://anna@host/maps?password=s3cret",
        "postgresql://anna:s3cret@host:p0rt/maps?nonsense=s3cret",
        "postgresql://anna:s3/cret@host/maps",
    ],
)
def test_a_password_in_the_address_is_refused_and_not_repeated(address: str, capsys):
    with pytest.raises(InvalidValue, match="the store's address"):
        PostgresStore(address)
    assert main(["map", "show", address]) == 1
    out, err = capsys.readouterr()
    assert len(err.splitlines()) == 1
    assert not any(part in out + err for part in ("s3cret", "anna", "s3", "cret"))


def test_a_store_of_another_format_is_refused(address: str):
    with pytest.raises(InvalidFile, match=r"has no map store: a map server makes one at its first start"):
        PostgresStore(address, read_only=True)
    PostgresStore(address).close()
    with psycopg.connect(address, autocommit=True) as connection:
        connection.execute("UPDATE mapweave.schema_version SET version = 99")
    with pytest.raises(InvalidFile, match=r"format 99, this program uses format 1"):
        PostgresStore(address)


def test_a_server_whose_role_may_only_read_is_refused_at_its_start(address: str):
    """It would serve, and acknowledge nothing; a command that only reads needs no more."""
    reader = address.replace(f"{ROLE}@", "reader@")
    store = PostgresStore(address, "s0")
    with psycopg.connect(address, autocommit=True) as owner:
        owner.execute("CREATE ROLE reader LOGIN")
        owner.execute("GRANT USAGE ON SCHEMA mapweave TO reader")
        owner.execute("GRANT SELECT ON ALL TABLES IN SCHEMA mapweave TO reader")
        try:
            PostgresStore(reader, read_only=True).close()
            with pytest.raises(InvalidFile, match=r"may not change annotation, change, .*: ") as refused:
                PostgresStore(reader, "s1")
            assert "\n" not in str(refused.value)
            owner.execute("GRANT INSERT, UPDATE, DELETE ON ALL TABLES IN SCHEMA mapweave TO reader")
            owner.execute("REVOKE UPDATE ON mapweave.log FROM reader")
            with pytest.raises(InvalidFile, match=r"user may not change log: "):
                PostgresStore(reader, "s1")
            owner.execute("GRANT UPDATE ON mapweave.log TO reader")
            PostgresStore(reader, "s1").close()
        finally:
            store.close()
            owner.execute("DROP OWNED BY reader")
            owner.execute("DROP ROLE reader")


@pytest.mark.parametrize("part", ["tables", "rows", "cut-off", "no-version"])
def test_a_store_that_was_restored_in_part_is_refused(postgres: PostgresServer, part: str):
    """Neither a server nor a reader takes it for a store, and it stays as it is."""
    folder = binaries()
    if folder is None or not all((folder / name).exists() for name in ("pg_dump", "pg_restore")):
        pytest.skip("this PostgreSQL comes without pg_dump and pg_restore")
    address, other = postgres.database(), postgres.database()
    store = PostgresStore(address)
    store.apply(MAP, 5, [entry(1), entry(2)])
    store.close()
    names = [str(psycopg.conninfo.conninfo_to_dict(one)["dbname"]) for one in (address, other)]
    dump = postgres.folder / f"{names[0]}.dump"
    postgres.run("pg_dump", "--format=custom", "--file", str(dump), names[0])
    restore = ["pg_restore", "--exit-on-error", "--dbname", names[1], str(dump)]
    if part == "cut-off":
        dump.write_bytes(dump.read_bytes()[:-1])
        with pytest.raises(AssertionError, match=r"unexpected end|end of file"):
            postgres.run(*restore)
    else:
        sections = ["pre-data"] if part == "tables" else ["pre-data", "data"]
        postgres.run(*restore, *(f"--section={section}" for section in sections))
    if part == "no-version":
        with psycopg.connect(other) as connection:
            connection.execute("DROP TABLE mapweave.schema_version")
    before = postgres.run("pg_dump", names[1])
    for read_only in (True, False):
        with pytest.raises(
            InvalidFile, match=r"has only a part of a map store.*drop this database"
        ) as refused:
            PostgresStore(other, read_only=read_only)
        assert "\n" not in str(refused.value)
    assert main(["map", "show", other, "--no-picture"]) == 1
    # Each dump has another word against injected commands.
    after = postgres.run("pg_dump", names[1])
    assert [line for line in after.splitlines() if "restrict" not in line] == [
        line for line in before.splitlines() if "restrict" not in line
    ]


def test_texts_that_postgresql_does_not_take(postgres: PostgresServer):
    store = PostgresStore(postgres.database())
    refused = ReceivedChange(1, b"", "a reason with \0 and \udcff")
    assert store.apply(MAP, 5, [refused, broken(2)]).watermark == 2
    assert store.refusals(MAP)[0].reason == "a reason with \ufffd and ?"
    store.close()


def test_a_database_without_an_encoding_keeps_texts_as_they_are(postgres: PostgresServer):
    """As `initdb` makes one where no locale is set: psycopg then gave bytes for texts."""
    with psycopg.connect(postgres.address(), autocommit=True) as people:
        people.execute("DROP DATABASE IF EXISTS ascii")
        people.execute("CREATE DATABASE ascii ENCODING 'SQL_ASCII' TEMPLATE template0")
    store = PostgresStore(postgres.address("ascii"))
    (taken,) = store.apply_all([LogChanges(MAP, 5, [entry(1), broken(2)])])
    assert isinstance(taken, Applied) and taken.watermark == 2
    store.put_result("Büro", b"\xff")
    store.close()
    store = PostgresStore(postgres.address("ascii"), read_only=True)
    assert [change.sequence for change in store.replay(MAP)] == [1]
    (refusal,) = store.refusals(MAP)
    assert refusal.sequence == 2 and isinstance(refusal.reason, str)
    assert store.result("Büro") == b"\xff"
    store.close()
    with psycopg.connect(postgres.address(), autocommit=True) as people:
        people.execute("DROP DATABASE ascii WITH (FORCE)")
