"""Errors, as users read them."""

from hypothesis import given
from hypothesis import strategies as st

from mapweave.hybridmap.errors import Busy, InvalidFile


@given(st.text())
def test_an_error_is_one_line_whatever_a_library_contributes(words: str):
    assert len(str(InvalidFile(f"a.mapweave: {words}, as SQLite says")).splitlines()) == 1


def test_words_stay_as_they_are():
    assert str(InvalidFile("a  b: no such file")) == "a  b: no such file"
    assert str(Busy(1.0)) == "busy, retry after 1.0 s"
