"""Tests that the pages name are there."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = sorted(
    path for folder in (ROOT, ROOT / "docs", ROOT / "docs/decisions") for path in folder.glob("*.md")
)
NAMED = re.compile(r"`((?:tests/|::|test_\w+\.py)[^`\s]*)")
"""From the folder on; a name alone would be looked for in the wrong file."""


def missing(name: str) -> bool:
    path, _, function = name.partition("::")
    if not path.startswith("tests/") or not (ROOT / path).exists():
        return True
    return bool(function) and f"def {function}(" not in (ROOT / path).read_text()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_test_that_a_page_names_is_there(page: Path):
    assert [name for name in NAMED.findall(page.read_text()) if missing(name)] == []


def test_security_names_tests():
    assert len(NAMED.findall((ROOT / "SECURITY.md").read_text())) > 40
