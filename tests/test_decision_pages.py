"""Pages of decisions have one form: context, decision, evidence, consequences."""

import re
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[1] / "docs" / "decisions"
LIST = (FOLDER / "README.md").read_text(encoding="utf-8")
PAGES = sorted(path for path in FOLDER.glob("*.md") if path.name != "README.md")
LONGEST = 120
"""Lines."""


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_decision_has_context_evidence_and_consequences_and_is_listed(page: Path):
    text = page.read_text(encoding="utf-8")
    assert re.findall(r"^## (.*)$", text, re.MULTILINE) == [
        "Context", "Decision", "Evidence", "Consequences",
    ]  # fmt: skip
    assert len(text.splitlines()) <= LONGEST
    assert f"]({page.name})" in LIST
