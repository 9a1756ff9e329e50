"""Where people find the page, as the server says it at its start."""

import socket

import pytest

from mapweave.commands.http_access import http_access
from mapweave.identities.key_folder import KeyFolder, Profile


@pytest.mark.parametrize(("at", "words", "url"), [
    (["maps.local"], "0.0.0.0:8080", "https://maps.local:8080/"),
    (["192.168.1.10"], "0.0.0.0:8080", "https://192.168.1.10:8080/"),
    (["fd00::1"], "[::]:8080", "https://[fd00::1]:8080/"),
    (["maps.local", "maps2.local"], "0.0.0.0:8080", "https://localhost:8080/"),
    ([socket.gethostname()], "0.0.0.0:8080", "https://localhost:8080/"),
    ([], "0.0.0.0:8080", "https://localhost:8080/"),
    (["maps.local"], "8080", "https://127.0.0.1:8080/"),
])  # fmt: skip
def test_the_address_of_the_page_is_one_that_its_certificate_has(
    tmp_path, at: list[str], words: str, url: str
):
    """`https://0.0.0.0:8080/` opens on no other machine, and its name is in no certificate."""
    folder = KeyFolder.create(tmp_path / "keys", "demo", Profile.PRODUCTION, at, "s0")
    access = http_access(words, folder, "s0")
    assert access.url(8080) == url
    host = url.removeprefix("https://").rpartition(":")[0].strip("[]")
    assert host in folder.catalogue.hosts
    assert access.address[0] == words.rpartition(":")[0].strip("[]") or words == "8080"
