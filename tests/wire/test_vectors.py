"""docs/wire_vectors.json: as the program writes it, and as a decoder reads it that knows the page alone."""

import json
import math
import re
import runpy
from pathlib import Path
from typing import Any

import pytest

from mapweave.hybridmap.ids import MapId
from mapweave.wire.keys import Keys
from mapweave.wire.messages import LIMITS, KeptHistory, KeptPruned, KeptPruning
from tests.wire import plain_decoder
from tests.wire.plain_decoder import Plain, schema

ROOT = Path(__file__).parents[2]
VECTORS = json.loads((ROOT / "docs" / "wire_vectors.json").read_text(encoding="utf-8"))
PAGE = (ROOT / "docs" / "wire.md").read_text(encoding="utf-8")


def agrees(found: Any, stated: Any, where: str) -> None:
    """Both are the same, numbers to float32; NaN is null, and a map with ids as keys a list of pairs."""
    if isinstance(stated, dict) and isinstance(found, list):
        found = dict(found)
    if isinstance(stated, float | int) and not isinstance(stated, bool):
        assert found == pytest.approx(stated, rel=1e-6, abs=1e-12), where
    elif stated is None:
        assert found is None or math.isnan(found), where
    elif isinstance(stated, dict):
        assert set(found) == set(stated), where
        for name, value in stated.items():
            agrees(found[name], value, f"{where}.{name}")
    elif isinstance(stated, list):
        assert len(found) == len(stated), where
        for k, value in enumerate(stated):
            agrees(found[k], value, f"{where}[{k}]")
    else:
        assert found == stated, where


def test_a_decoder_written_from_the_page_reads_every_vector():
    plain = Plain()
    for number, vector in enumerate(VECTORS):
        found = plain.decode(vector["what"], bytes.fromhex(vector["hex"]))
        agrees(found, vector["value"], f"{number}: {vector['what']}")
    assert plain.read == set(plain.classes), "every class of the page, and no other, occurs in a vector"
    assert not re.search(
        r"^\s*(from|import) .*(mapweave|tests)", Path(plain_decoder.__file__).read_text(), re.M
    )


def test_the_page_describes_every_value():
    on_disk_alone = {KeptHistory, KeptPruned, KeptPruning}
    assert set(schema()) >= {kind.__name__ for kind in LIMITS if kind not in on_disk_alone}


def test_every_key_is_on_the_page_and_has_a_vector():
    """A key that a program uses, with its names as the page writes them."""
    keys = Keys("demo")
    given = {"map_id": MapId("r0", 3), "agent": "r0", "server": "s0", "robot": "b0", "number": 7}
    travelled = {vector["key"] for vector in VECTORS}
    for name in dir(keys):
        method = getattr(Keys, name)
        if name.startswith(("_", "parse_")) or not callable(method):
            continue
        code = method.__code__
        names = [x for x in code.co_varnames[: code.co_argcount] if x not in ("self", "keys")]
        if "question" in names:  # of a robot in its own name: the key of the question, and the name
            continue
        if names == ["name"]:  # the form of the key says which
            role = method(keys, "x").removeprefix("mapweave/1/demo/").split("/")[0]
            given["name"] = {"agent": "r0", "server": "s0", "robot": "b0"}[role]
        key = method(keys, *(given[argument] for argument in names))
        if "*" in key:
            continue
        end = key.removeprefix("mapweave/1/demo/")
        for word, letter in (("/r0", "/A"), ("/s0", "/S"), ("/b0", "/R"), ("/3", "/E"), ("/7", "/N")):
            end = end.replace(word, letter)
        assert f"`{end}`" in PAGE, key
        if not end.endswith(("alive", "alive/E", "driver/N", "plan_image")) and end != "server/S/status":
            assert key in travelled, f"{key} has no vector"


def test_the_file_is_what_the_program_writes():
    """Bytes that have been written are read for ever: a change here is a change of the format."""
    written = runpy.run_path(str(ROOT / "docs" / "wire_vectors.py"))["as_json"]()
    for made, kept in zip(json.loads(written), VECTORS, strict=True):
        assert made == kept, f"{kept['what']} {kept['note']}: run `python -m docs.wire_vectors`"
