"""Hooks of the pages' build: pictures are drawn, and files beside the pages are named instead of linked."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
LINK = re.compile(r"\[([^\]]*)\]\(([^)#:]+)(#[^)]*)?\)")
PAGES = {".md", ".png", ".gif", ".svg"}


def on_pre_build(config: Any) -> None:
    """Draw the pictures of the tutorials."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "agg"}
    for program in ("pictures", "film", "diagrams"):
        script = ROOT / "docs" / "site" / f"{program}.py"
        subprocess.run([sys.executable, str(script)], check=True, cwd=ROOT, env=environment)


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Links to files and folders that are no pages lead nowhere on the site: name them instead.

    Raises:
        FileNotFoundError: there is no such file.
    """
    folder = Path(page.file.abs_src_path).parent

    def named(match: re.Match[str]) -> str:
        target = (folder / match[2]).resolve()
        if target.is_relative_to(ROOT / "docs") and target.suffix in PAGES:
            return match[0]
        if not target.exists():
            raise FileNotFoundError(f"{page.file.src_path}: {match[2]}")
        return f"{match[1]} (`{target.relative_to(ROOT)}`)"

    return LINK.sub(named, markdown)
