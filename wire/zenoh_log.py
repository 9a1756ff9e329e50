"""What Zenoh itself logs. Its binding writes plain lines to standard output, and knows no other way."""

from __future__ import annotations

import os
import sys

import zenoh

REFUSALS = "off,zenoh_link_tls=warn,zenoh_transport=warn"
"""Why handshakes are refused: a foreign authority, no certificate, no TLS."""


def show_refusals(log_format: str) -> None:
    """Let a router with keys say why it refuses handshakes; RUST_LOG in the environment chooses otherwise.

    Args:
        log_format: of the process's log; nothing is shown unless it is `text`.
    """
    # Zenoh asks for it once; in a file or a pipe colours are noise.
    before = os.environ.get("NO_COLOR")
    if not sys.stdout.isatty():
        os.environ["NO_COLOR"] = "1"
    try:
        zenoh.init_log_from_env_or(REFUSALS if log_format == "text" else "off")
    finally:
        if before is None:
            os.environ.pop("NO_COLOR", None)
        else:
            os.environ["NO_COLOR"] = before
