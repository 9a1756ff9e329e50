"""SQLite files that survive the loss of power, belong to one process, and report errors clearly."""

import os
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from mapweave.hybridmap.errors import InvalidFile
from mapweave.storage.database_reader import reading
from mapweave.storage.file_format import of_format
from mapweave.storage.file_owner import owning
from mapweave.storage.full_disks import CALM, FullDisk, written
from mapweave.storage.os_errors import DISK_FULL, READ_ONLY, no_permission
from mapweave.storage.write_ahead_log import lost_commits

LEAST_FREE = 1 << 16
"""Bytes; a disk with less takes no page of SQLite with its place in the write-ahead log."""
DISK_ERRORS = (sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR, sqlite3.SQLITE_READONLY, sqlite3.SQLITE_CANTOPEN)
BUSY = 1.0
"""How long to wait for a file that another process is about to close, s."""
LOG_BYTES = 1 << 24
"""The write-ahead log is cut to this where it has grown behind a reader, for example a backup."""


class Database:
    """One SQLite file in WAL mode, each commit on the disk before it returns (synchronous=FULL).

    The file belongs to one process while it is open: two that append to one log would use the same sequence
    numbers. Others may read it, for a backup (see mapweave.storage.database_copy). Where the disk has no room
    for the index that SQLite shares with readers, or is none that processes can share memory through, it is
    locked against these, too.
    """

    def __init__(
        self,
        path: Path,
        kind: str,
        application_id: int,
        version: int,
        schema: str,
        repair: Callable[[sqlite3.Connection], None] | None = None,
        advice: str = "",
        read_only: bool = False,
        refuse_loss: bool = False,
    ) -> None:
        """Open the file, or make it.

        Args:
            path: of the file; its folder must be there.
            kind: what it is for people, for example "agent journal".
            application_id: marks files of this kind.
            version: of the schema.
            schema: SQL that makes the tables of a new file.
            repair: called before the check of the file's pages; may take out rows that are damaged.
            advice: what to do about a damaged file, for people; appended to the reason.
            read_only: change nothing, neither the file nor its folder; the file must be there.
            refuse_loss: a file whose write-ahead log is damaged before its last commits is damaged, too; else
                SQLite goes on as if these had never been made.

        Raises:
            InvalidFile: damaged, of another kind or version, in use, or not readable.
        """
        self.path = path
        self._file = path.absolute()
        self.what = kind
        self._repair = repair
        self._advice = f"; {advice}" if advice else ""
        self._closing = ExitStack()
        try:
            with self.guard():
                if read_only:
                    self.connection = self._closing.enter_context(reading(path, kind))
                    self._check_kind(application_id, version)
                else:
                    self._open(application_id, version, schema, refuse_loss)
                self._check_pages()
            self._inode = self._inode_now()
        except BaseException:
            self._closing.close()
            raise

    def _inode_now(self) -> tuple[int, int] | None:
        """The inode by which the file of this name is known; None if there is none."""
        try:
            status = self._file.stat()
        except OSError:
            return None
        return status.st_dev, status.st_ino

    @contextmanager
    def guard(self) -> Iterator[None]:
        """Turn SQLite's errors into InvalidFile with one line."""
        try:
            yield
        except sqlite3.Error as error:
            if "locked" in str(error):
                raise self._in_use() from None
            code = getattr(error, "sqlite_errorcode", 0) & 0xFF
            if code == sqlite3.SQLITE_CORRUPT:
                raise self.damaged(str(error)) from None
            if code in DISK_ERRORS and (reason := _disk_trouble(self._file)):
                words = f"{self.path}: {self.what}: {reason}"
                full = reason == DISK_FULL
                raise FullDisk.of_file(words, self.path) if full else InvalidFile(words) from None
            advice = self._advice if code == sqlite3.SQLITE_NOTADB else ""
            raise InvalidFile(f"{self.path}: {self.what} cannot be used ({error}){advice}") from None
        except UnicodeDecodeError:
            # SQLite quotes a damaged schema in its error, which then is no text.
            raise self.damaged("its schema is no text") from None

    @contextmanager
    def transaction(self) -> Iterator[sqlite3.Connection]:
        """All that is done inside is committed at the end, or nothing of it.

        Raises:
            InvalidFile: the disk does not take it, or the file is gone: what is written would go with it.
        """
        if self._inode_now() != self._inode:
            raise InvalidFile(
                f"{self.path}: {self.what} was deleted or replaced under the running program; "
                "put it back, or start the program again"
            )
        with self.guard():
            self.connection.execute("BEGIN IMMEDIATE")
            try:
                yield self.connection
                self.connection.execute("COMMIT")
            except BaseException:
                # A full disk may have rolled back by itself.
                if self.connection.in_transaction:
                    self.connection.execute("ROLLBACK")
                raise
        written(self.path, CALM)

    def damaged(self, reason: str) -> InvalidFile:
        """The error of a damaged file, with what to do about it."""
        return InvalidFile(f"{self.path}: {self.what} is damaged ({reason}){self._advice}")

    def close(self) -> None:
        """Close the file. Idempotent."""
        self._closing.close()

    def _open(self, application_id: int, version: int, schema: str, refuse_loss: bool) -> None:
        owned = True
        try:
            self._closing.enter_context(owning(self._file, BUSY))
        except BlockingIOError:
            raise self._in_use() from None
        except OSError:
            # The folder takes no file, or is not there: SQLite finds out which.
            owned = False
        # Before SQLite sees the log: it would put what it takes for the whole into the file, and delete it.
        lost = 0
        with suppress(OSError):  # SQLite says why, too
            lost = lost_commits(self._file) if refuse_loss and owned else 0
        if lost:
            raise self.damaged(f"its last {lost} commits cannot be read")
        for locking in ("NORMAL", "EXCLUSIVE") if owned else ("EXCLUSIVE",):
            self._connect()
            try:
                self._prepare(application_id, version, schema, locking)
                return
            except sqlite3.OperationalError as error:
                if locking == "EXCLUSIVE" or error.sqlite_errorcode & 0xFF not in DISK_ERRORS:
                    raise
                self.connection.close()

    def _connect(self) -> None:
        # Threads take turns: a shared Database is used under the caller's lock.
        connection = sqlite3.connect(self.path, timeout=BUSY, isolation_level=None, check_same_thread=False)
        self._closing.callback(connection.close)
        # Text with a flipped bit may be no UTF-8; its meaning is checked by the reader.
        connection.text_factory = lambda data: data.decode("utf-8", "replace")
        self.connection = connection

    def _prepare(self, application_id: int, version: int, schema: str, locking: str) -> None:
        run = self.connection.execute
        run(f"PRAGMA locking_mode={locking}")
        run("PRAGMA synchronous=FULL")
        run(f"PRAGMA journal_size_limit={LOG_BYTES}")
        empty = run("SELECT count(*) FROM sqlite_master").fetchone()[0] == 0
        if not empty:
            self._check_kind(application_id, version)
        run("PRAGMA journal_mode=WAL")
        if empty:
            run("BEGIN IMMEDIATE")
            for statement in filter(str.strip, schema.split(";")):
                run(statement)
            run(f"PRAGMA application_id={application_id}")
            run(f"PRAGMA user_version={version}")
            run("COMMIT")
        if self._repair is not None and not empty:
            self._repair(self.connection)

    def _check_kind(self, application_id: int, version: int) -> None:
        run = self.connection.execute
        if run("PRAGMA application_id").fetchone()[0] != application_id:
            raise InvalidFile(f"{self.path}: is not a Mapweave {self.what}")
        stored_version = run("PRAGMA user_version").fetchone()[0]
        if stored_version != version:
            raise InvalidFile(f"{self.path}: {self.what} {of_format(stored_version, version)}")

    def _check_pages(self) -> None:
        # A message that begins with the file's name may have two lines; the second gives the reason.
        damage = str(self.connection.execute("PRAGMA quick_check(1)").fetchone()[0])
        if damage != "ok":
            raise self.damaged(damage.splitlines()[-1])

    def _in_use(self) -> InvalidFile:
        return InvalidFile(f"{self.path}: {self.what} is in use by another process; stop it first")


def _disk_trouble(file: Path) -> str:
    """Why a file cannot be written, where SQLite only says that it failed; empty if none of this is why."""
    try:
        disk = os.statvfs(file.parent)
    except OSError:
        return ""
    if disk.f_flag & os.ST_RDONLY:
        return READ_ONLY
    if disk.f_bavail * disk.f_frsize < LEAST_FREE:
        return DISK_FULL
    # SQLite keeps its write-ahead log beside the file.
    if not os.access(file.parent, os.W_OK | os.X_OK):
        return f"{file.parent}: {no_permission()}"
    return no_permission() if file.exists() and not os.access(file, os.R_OK | os.W_OK) else ""
