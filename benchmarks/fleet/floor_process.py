"""The least that an acknowledged change costs here: a Zenoh question, answered after a commit of SQLite.

python -m benchmarks.fleet.floor_process ENDPOINT FOLDER
"""

import sqlite3
import sys
from pathlib import Path

from mapweave.wire.bus import Request
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.zenoh_bus import ZenohBus

KEY = "mapweave/fleet/floor"


def main() -> None:
    """Answer until the end of stdin."""
    endpoint, folder = sys.argv[1:]
    disk = sqlite3.connect(Path(folder) / "floor.sqlite", isolation_level=None, check_same_thread=False)
    disk.execute("PRAGMA journal_mode = WAL")
    disk.execute("PRAGMA synchronous = FULL")
    disk.execute("CREATE TABLE change (number INTEGER PRIMARY KEY, body BLOB)")

    def answer(request: Request) -> None:
        disk.execute("INSERT INTO change (body) VALUES (?)", (request.payload,))
        request.reply(b"")

    bus = ZenohBus(BusSettings(endpoints=(endpoint,)))
    bus.serve(KEY, answer)
    if not bus.wait_connected(20.0):
        raise SystemExit(f"no router at {endpoint}")
    print("ready", flush=True)
    sys.stdin.read()
    bus.close()


if __name__ == "__main__":
    main()
