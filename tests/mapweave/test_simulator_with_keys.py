"""Simulated robots in a fleet with keys: their bodies are beside it, and what cannot be is refused."""

from contextlib import ExitStack
from pathlib import Path

import pytest

from mapweave import Fleet, NotConnected
from mapweave.cli import main
from mapweave.exit_status import USAGE
from mapweave.identities.key_folder import KeyFolder, Profile
from mapweave.scenarios.children import Children
from mapweave.wire.credentials import Role
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
    tmp_path, capfd, command: list[str], profile: Profile
):
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
def test_an_agent_with_a_key_drives_a_body_beside_the_fleet_in_lock_step(tmp_path, profile: Profile):
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
            person = Fleet(keys.catalogue.endpoints[0], "office", keys=keys.key_file("anna"))
            stack.callback(person.close)

            def nodes() -> int:
                children.check()
                try:
                    (robot,) = person.status().robots
                except NotConnected:
                    return 0
                return 0 if robot.status is None else robot.status.status.nodes

            # Without a map server the robots are asked themselves, each alone: all others are denied.
            eventually(lambda: nodes() >= 3, 60)
            (stopped,) = person.stop()
            assert stopped.order.robot == "r0"
