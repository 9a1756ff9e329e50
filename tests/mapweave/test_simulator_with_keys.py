"""Simulated robots in a fleet with keys: their bodies are beside it, and what cannot be is refused."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

import pytest

from mapweave.cli import main
from mapweave.exit_status import USAGE
from mapweave.hybridmap.agent_status import AgentStatus
from mapweave.identities.key_file import read_key_file
from mapweave.identities.key_folder import KeyFolder, Profile
from mapweave.scenarios.children import Children
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.credentials import Role
from mapweave.wire.keys import Keys
from mapweave.wire.messages import decode
from mapweave.wire.zenoh_bus import ZenohBus
from tests.mapweave.test_drive import WORLD
from tests.simulator import needs_simulator
from tests.waiting import eventually, free_port

PROFILES = [Profile.LAB, Profile.PRODUCTION]


def keys_of(folder: Path, profile: Profile) -> KeyFolder:
    keys = KeyFolder.create(folder, "office", profile, [], "s0", free_port())
    keys.add("r0", Role.ROBOT)
    keys.add("anna", Role.OPERATOR)
    return keys


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("command", [["sim", "serve", "office"], ["agent", "r0", "--lockstep"]])
def test_what_a_router_with_keys_denies_is_refused_at_once(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], command: list[str], profile: Profile
) -> None:
    """Before, the agent waited 90 s for the other robots, and said that its base was gone."""
    keys = keys_of(tmp_path / "keys", profile)
    assert main([*command, "--keys", str(keys.key_file("r0"))]) == USAGE
    out, err = capfd.readouterr()
    assert out == "" and len(err.splitlines()) == 1
    assert "admits no simulator" in err and "--fleet office --listen tcp/127.0.0.1:7448" in err
    assert "--body tcp/127.0.0.1:7448" in err


@pytest.mark.slow
@needs_simulator
@pytest.mark.parametrize("profile", PROFILES)
def test_an_agent_with_a_key_drives_a_body_beside_the_fleet_in_lock_step(
    tmp_path: Path, profile: Profile
) -> None:
    keys = keys_of(tmp_path / "keys", profile)
    scenario, body = tmp_path / "alone.toml", f"tcp/127.0.0.1:{free_port()}"
    scenario.write_text(WORLD)
    with ExitStack() as stack:
        router = ZenohBus(keys.router("s0", [keys.catalogue.endpoints[0]]))
        stack.callback(router.close)
        with Children(tmp_path / "logs") as children:
            children.start("sim", ["sim", "serve", str(scenario), "--fleet", "office", "--listen", body])
            children.start(
                "r0",
                ["agent", "r0", "--lockstep", "--without-rangers", "--mission", "explore", "--data",
                 str(tmp_path), "--keys", str(keys.key_file("r0")), "--body", body],
            )  # fmt: skip
            own = read_key_file(keys.key_file("anna")).credentials
            person = ZenohBus(BusSettings(endpoints=keys.catalogue.endpoints[:1], credentials=own))
            stack.callback(person.close)

            def nodes() -> int:
                children.check()
                replies = person.ask(Keys("office").agent_status("r0"), b"", 2.0)
                return sum(decode(reply.payload, AgentStatus).status.nodes for reply in replies)

            eventually(lambda: nodes() >= 3, 60)
