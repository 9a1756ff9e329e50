"""Logging in on the page in a real browser: a viewer looks, an operator commands, and the record says who."""

import base64
import hashlib
import os
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat

from mapweave.identities.key_file import read_key_file
from mapweave.identities.key_folder import KeyFolder, Profile
from mapweave.identities.logins import Logins
from mapweave.mapserver.http.tls import server_context
from mapweave.mapserver.http.web import Web
from mapweave.wire.credentials import Role
from tests.browser import PROGRAMS, Browser, there_is_none
from tests.mapserver.house import House
from tests.mapserver.stub_services import StubServices
from tests.waiting import eventually

pytestmark = pytest.mark.skipif(there_is_none(), reason=f"needs {' and '.join(PROGRAMS)} on the PATH")
PICTURES = os.environ.get("PAGE_PICTURES")
"""Folder for pictures of what is seen, for people."""
FORM = "return !document.getElementById('login').hidden"
TITLE = "return document.querySelector('h1').getBoundingClientRect().width"
WHO = "return document.getElementById('who').textContent"
SELECTED = "return document.getElementById('selected').textContent"
ROBOT = "const robot = document.querySelector('#robots button'); robot?.click(); return Boolean(robot)"
SUMMARY = "return document.getElementById('summary').textContent"
NAMED = """
document.getElementById('tab-edit')?.click();
return document.getElementById('edit-name').checkVisibility()
"""
RETIRE = """
const body = JSON.stringify({ retire: ["r0.1.5"], because: "a mirror", by: "mallory" });
fetch("constraints", { method: "POST", headers: { "Content-Type": "application/json" }, body });
"""


@pytest.mark.slow
def test_a_viewer_looks_and_an_operator_commands(house: House, tmp_path):
    _, control = house.robot()
    folder = KeyFolder.create(tmp_path / "keys", "fleet", Profile.LAB, [], "s0")
    tokens = {}
    for name, role in (("vera", Role.VIEWER), ("otto", Role.OPERATOR)):
        folder.add(name, role)
        tokens[name] = folder.token(name, 1.0)
    logins = Logins(folder.path)
    with Browser(tmp_path / "profile") as page, Web(("127.0.0.1", 0), house.server, logins=logins) as web:

        def look(name: str) -> None:
            if PICTURES:
                page.screenshot(Path(PICTURES) / f"{name}.png")

        def log_in(name: str) -> None:
            eventually(lambda: page.run(FORM))
            page.run("document.getElementById('token').value = ''")
            page.type("#token", tokens[name])
            page.run("document.getElementById('login').requestSubmit()")
            eventually(lambda: "7 nodes" in page.run(SUMMARY))
            eventually(lambda: page.run(ROBOT))

        # Before the login a phone shows the name, too: its bar was empty.
        page.look(390, 844, mobile=True)
        page.open(f"http://127.0.0.1:{web.port}/")
        eventually(lambda: page.run(FORM))
        assert page.run(TITLE) > 50.0
        page.look(1100, 700)
        page.open(f"http://127.0.0.1:{web.port}/why?a=r0.1.3&b=r0.1.4")
        eventually(lambda: page.run(FORM))
        assert page.run(SUMMARY) == "" and page.run("return document.cookie") == ""
        page.type("#token", "mapweave_guess")
        page.run("document.getElementById('login').requestSubmit()")
        eventually(lambda: "unknown" in page.run("return document.getElementById('login-words').textContent"))
        look("login")

        log_in("vera")
        assert page.run(WHO) == "vera, viewer" and page.run("return document.cookie") == ""
        assert "You are vera, a viewer: missions and corrections need an operator." in page.run(SELECTED)
        assert page.run("return document.getElementById('goal')") is None
        look("viewer")
        page.run("document.getElementById('logout').click()")

        log_in("otto")
        eventually(lambda: page.run("return Boolean(document.getElementById('goal'))"))
        page.run(
            "[...document.querySelectorAll('#selected button')].find(b => b.textContent == 'Explore').click()"
        )
        eventually(lambda: control.report is not None)
        assert control.report is not None and control.report.order.by == "otto"
        assert not page.run(NAMED), "the record has the name of the login"
        look("operator")
        page.run(RETIRE)
        eventually(lambda: any("by otto on" in event.words for event in house.server.history()))
        assert "r0.1.5 is retired by otto on" in house.server.history()[-1].words
        assert house.server.history()[-1].words.endswith('"a mirror"')
        assert "mallory" not in house.server.history()[-1].words

        folder.revoke("otto", "left")
        eventually(lambda: page.run(FORM))
        assert page.run(SUMMARY) == "", "nothing of the fleet is left on the page"


@pytest.mark.slow
def test_the_page_over_https(tmp_path):
    """Login, session and the live map, with the certificate of the fleet's authority."""
    folder = KeyFolder.create(tmp_path / "keys", "fleet", Profile.PRODUCTION, [], "s0")
    folder.add("vera", Role.VIEWER)
    token, own = folder.token("vera", 1.0), read_key_file(folder.key_file("s0")).credentials
    key = x509.load_pem_x509_certificate(own.certificate.encode()).public_key()
    spki = hashlib.sha256(key.public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo)).digest()
    trusted = f"--ignore-certificate-errors-spki-list={base64.b64encode(spki).decode()}"
    services = StubServices()
    with (
        Web(("127.0.0.1", 0), services, logins=Logins(folder.path), tls=server_context(own)) as web,
        Browser(tmp_path / "profile", trusted) as page,
    ):
        page.open(f"https://127.0.0.1:{web.port}/")
        eventually(lambda: page.run(FORM))
        page.type("#token", token)
        page.run("document.getElementById('login').requestSubmit()")
        eventually(lambda: page.run(WHO) == "vera, viewer")
        eventually(lambda: "12 nodes" in page.run(SUMMARY))
        assert page.run("return location.protocol + document.cookie") == "https:", "scripts see no cookie"
    with (
        Web(("127.0.0.1", 0), services, logins=Logins(folder.path), tls=server_context(own)) as web,
        Browser(tmp_path / "stranger") as page,
    ):
        page.open(f"https://127.0.0.1:{web.port}/")
        assert page.run("return document.getElementById('login')") is None, "who does not trust it is warned"
        assert "ERR_CERT_AUTHORITY_INVALID" in page.run("return document.documentElement.textContent")
