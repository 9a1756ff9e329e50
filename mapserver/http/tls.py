"""HTTPS by the server's certificate of the fleet's authority."""

import ssl
from pathlib import Path
from tempfile import TemporaryDirectory

from mapweave.identities.key_file import write_private
from mapweave.wire.credentials import Credentials


def server_context(credentials: Credentials | None) -> ssl.SSLContext | None:
    """What HTTPS is served with; None without a certificate."""
    if credentials is None or not credentials.certified:
        return None
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    load(context, credentials)
    return context


def load(context: ssl.SSLContext, credentials: Credentials) -> None:
    """Use this certificate from the next connection on."""
    # The library reads files alone.
    with TemporaryDirectory() as folder:
        path = Path(folder) / "server.pem"
        write_private(path, f"{credentials.certificate.strip()}\n{credentials.private_key.strip()}\n")
        context.load_cert_chain(path)
