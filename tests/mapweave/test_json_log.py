"""The log as JSON: each line of real processes is an object, with what a message names as fields."""

import io
import json
import logging
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from datetime import UTC, datetime, timedelta

import pytest

from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.identities.key_folder import KeyFolder, Profile
from mapweave.json_log import JsonFormatter
from mapweave.terminal import TextFormatter, stamped
from mapweave.wire.log_messages import Mark
from mapweave.wire.memory import MemoryHub
from tests.mapserver.played import KEYS, MAP, HandAgent, Server
from tests.waiting import eventually, free_port


@pytest.fixture
def lines() -> Iterator[io.StringIO]:
    """Of a logger tree with this format."""
    handler = logging.StreamHandler(stream := io.StringIO())
    handler.setFormatter(JsonFormatter(robot="r9"))
    logger = logging.getLogger("mapweave.mapserver")
    logger.addHandler(handler)
    yield stream
    logger.removeHandler(handler)


def objects(text: str) -> list[dict[str, str]]:
    return [json.loads(line) for line in text.splitlines()]


def test_a_refused_change_names_its_map_and_robot(lines: io.StringIO, tmp_path):
    hub = MemoryHub()
    server, agent = Server(hub, tmp_path / "s0.sqlite"), HandAgent(hub)
    agent.serve(1, lambda asked: agent.answer(asked))
    agent.log[1] = b"\xc1"
    agent.bus.publish(KEYS.change(MAP), b"\xc1", Mark(1, agent.log_id).encode())
    eventually(lambda: "refused" in lines.getvalue())
    server.end()
    (line,) = [line for line in objects(lines.getvalue()) if "refused" in line["message"]]
    assert (line["level"], line["logger"]) == ("warning", "mapweave.mapserver.log.ingest")
    assert (line["map"], line["robot"]) == ("r0.3", "r0")
    assert abs(datetime.fromisoformat(line["time"]) - datetime.now(UTC)) < timedelta(minutes=10)


HOSTILE = "agent/r0/alive/\x1b[31mRED\x07\x9b2J\u202eabc\n2026-11-30 01:00:00 all is well"
"""A key that a robot chose: escape sequences, a mark that turns the direction, and a line of its own."""


@pytest.mark.parametrize("log_format", [TextFormatter(), JsonFormatter()])
def test_what_others_have_written_controls_no_terminal_and_makes_no_line(log_format: logging.Formatter):
    handler = logging.StreamHandler(stream := io.StringIO())
    handler.setFormatter(log_format)
    logger = logging.getLogger("mapweave.mapserver.test")
    logger.addHandler(handler)
    try:
        logger.warning("%s: no epoch", HOSTILE, extra={"reason": HOSTILE})
        try:
            raise ValueError(HOSTILE)
        except ValueError:
            logger.exception("it failed")
    finally:
        logger.removeHandler(handler)
    first, *rest = stream.getvalue().splitlines()
    assert "all is well: no epoch" in first
    assert all(line.isprintable() for line in (first, *rest))
    assert "RED" in rest[-1] or "RED" in rest[-2], "the exception is there"
    assert stamped(HOSTILE).isprintable()


def test_fields_are_those_of_the_message_and_those_that_are_given(lines: io.StringIO):
    log = logging.getLogger("mapweave.mapserver.test")
    log.warning("two\nlines of %s and %s", NodeId("r0", 1, 7), MapId("r1", 2), extra={"reason": "ünknown"})
    log.warning("100 % of nothing")
    try:
        raise ValueError("cause")
    except ValueError:
        log.exception("failed")
    first, second, third = objects(lines.getvalue())
    assert first["message"] == "two lines of r0.1.7 and r1.2"
    assert (first["node"], first["map"], first["robot"], first["reason"]) == (
        "r0.1.7", "r0.1", "r0", "ünknown",
    )  # fmt: skip
    assert second["robot"] == "r9" and "map" not in second
    assert "ValueError: cause" in third["exception"] and third["level"] == "error"


def test_every_line_of_a_process_is_an_object_also_its_last(tmp_path):
    port = free_port()
    words = [sys.executable, "-m", "mapweave", "router", "--listen", f"tcp/127.0.0.1:{port}"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True, "cwd": tmp_path}
    with subprocess.Popen([*words, "--log-format", "json"], **pipes) as router:
        assert router.stdout is not None
        try:
            first = router.stdout.readline()
            again = subprocess.run([*words, "--log-format", "json"], **pipes, check=False)
        finally:
            router.send_signal(signal.SIGTERM)
            rest = router.communicate(timeout=30)[0]
    (listens, *_), (fails,) = objects(first + rest), objects(again.stdout)
    assert (listens["level"], listens["message"]) == ("info", f"router listens at tcp/127.0.0.1:{port}")
    assert again.returncode == 1 and fails["level"] == "error" and str(port) in fails["message"]


@pytest.mark.parametrize("log_format", ["text", "json"])
def test_a_refused_handshake_is_a_line_as_all_others(log_format: str, tmp_path):
    """Zenoh, which refuses it, would write lines of its own."""
    port = free_port()
    KeyFolder.create(tmp_path / "keys", "demo", Profile.PRODUCTION, [], "s0", port)
    words = [sys.executable, "-m", "mapweave", "router", "--keys", "keys", "--log-format", log_format]
    words += ["--listen", f"tls/127.0.0.1:{port}"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True, "cwd": tmp_path}
    with subprocess.Popen(words, **pipes) as router:
        assert router.stdout is not None
        try:
            lines = router.stdout.readline()
            with socket.create_connection(("127.0.0.1", port)) as stranger:
                stranger.settimeout(30)
                stranger.sendall(b"GET / HTTP/1.1\r\n\r\n")
                with suppress(ConnectionResetError):
                    while stranger.recv(100):
                        pass
            lines += router.stdout.readline()
        finally:
            router.send_signal(signal.SIGTERM)
            lines += router.communicate(timeout=30)[0]
    assert router.returncode == 0
    if log_format == "json":
        listens, refused = objects(lines)
        assert str(port) in listens["message"]
        assert (refused["level"], refused["logger"]) == ("warning", "mapweave.wire.zenoh_log")
        assert refused["message"] == "refused a client: it speaks plain TCP, not TLS"
    else:
        _, line = lines.splitlines()
        assert line[20:] == "refused a client: it speaks plain TCP, not TLS"
