"""Files of arrays: with a right digest and wrong heads they are refused in one line."""

import gc
import hashlib

import numpy as np
import pytest

from mapweave.hybridmap.errors import InvalidFile
from mapweave.mapserver.checksummed_file import DIGEST, checksummed, json_part, read_checksummed

MAGIC = b"a kind\n"


@pytest.mark.parametrize(
    ("word", "instead"),
    [
        (b"'shape': (3,), }", b"'shape': (3,    "),
        (b"'shape': (3,), }", b"'shape': (1<<60)"),
        (b"(3,), }       ", b"(10**17,), }  "),
        (b"(3,), }             ", b"(99999999999999,), }"),
        (b"'<f8'", b"'|O' "),
        (b"'<f8'", b"',  '"),
    ],
)
def test_heads_of_arrays_that_are_none_are_refused(word: bytes, instead: bytes, tmp_path):
    data = checksummed(MAGIC, [json_part("header"), np.arange(3.0)])
    assert len(word) == len(instead) and word in data
    whole = data[:-DIGEST].replace(word, instead)
    path = tmp_path / "x"
    path.write_bytes(whole + hashlib.sha256(whole).digest())
    with pytest.raises(InvalidFile, match="x: is none of these"):
        read_checksummed(path, MAGIC, "header", list, "is none of these")


def test_what_is_checksummed_may_be_part_of_a_cycle():
    """Python 3.13 says so of a view of a stream, and pytest makes an error of that."""
    cycle: list[object] = [checksummed(MAGIC, [np.arange(3.0)])]
    cycle.append(cycle)
    del cycle
    gc.collect()
