"""`mapweave server --map FILE`: real agents begin anywhere, and their maps join the one that is loaded."""

from contextlib import closing
from pathlib import Path

import pytest

from mapweave.cli import main
from mapweave.hybridmap.agent_status import AgentStatus
from mapweave.opened_map import open_map
from mapweave.scenarios.children import Children, free_port
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.log_messages import decode_record
from mapweave.wire.messages import decode
from mapweave.wire.zenoh_bus import ZenohBus
from tests.mapweave.test_kept_maps import KEYS, PATIENCE, Body
from tests.waiting import eventually


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_an_agent_begins_a_new_map_which_joins_the_loaded_one(tmp_path, capfd):
    def mapped(robot: str, data: Path, *more: str) -> str:
        """A server, and an agent that maps four nodes; what the server says then of its maps."""
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        at = ["--fleet", "kept", "--connect", endpoint]
        with Children(tmp_path / f"logs-{robot}") as children:
            words = ["--fleet", "kept", "--listen", endpoint, "--data", str(data), *more]
            children.start("server", ["server", *words])
            with closing(ZenohBus(BusSettings(mode="client", endpoints=(endpoint,)))) as bus:

                def ask(key: str) -> bytes | None:
                    children.check()
                    replies = [reply for reply in bus.ask(key, b"", 2.0) if not reply.error]
                    return replies[0].payload if replies else None

                eventually(lambda: ask(KEYS.server_status("s0")) is not None, PATIENCE)
                Body(bus, robot)
                children.start(robot, ["agent", robot, "--data", str(data), "--mission", "carried", *at])

                def done() -> bool:
                    payload = ask(KEYS.agent_status(robot))
                    status = None if payload is None else decode(payload, AgentStatus)
                    return status is not None and status.status.nodes >= 4 and status.unsent == 0

                eventually(done, PATIENCE)
                children.end(robot)

                def settled() -> bool:
                    return bool(decode_record(ask(KEYS.server_status("s0")) or b"")["settled"])

                eventually(settled, PATIENCE)
                capfd.readouterr()
                assert main(["map", "explain", *at]) == 0
                said = capfd.readouterr().out
                children.end("server")
                return said

    mapped("r0", tmp_path / "first")
    loaded = tmp_path / "first" / "r0.1.mapweave"
    before = loaded.read_bytes()
    said = mapped("r5", tmp_path / "second", "--map", str(loaded))
    assert said.startswith("r0.1 and r5.1 are one map: "), said
    assert loaded.read_bytes() == before
    assert [str(one) for one in open_map(tmp_path / "second" / "s0.sqlite").maps] == ["r5.1"]
