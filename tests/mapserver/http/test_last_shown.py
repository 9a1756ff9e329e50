"""What the page showed last: another content than a server writes keeps none from starting."""

import zlib

import pytest

from mapweave.mapserver.http.last_shown import MAGIC, NOTHING, read_shown

BAD = [
    b'{"map": "{}", "robots": [5], "history": []}',
    b'{"map": 5, "robots": [], "history": []}',
    b"[" * 100_000,
]


@pytest.mark.parametrize("content", BAD, ids=["robots", "map", "deep"])
def test_what_no_server_writes_is_not_shown(content: bytes, tmp_path):
    path = tmp_path / "s0.shown"
    path.write_bytes(MAGIC + zlib.compress(content))
    assert read_shown(path) is NOTHING
