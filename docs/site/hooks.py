"""Hooks of the pages' build: pictures are drawn, and files beside the pages are named instead of linked."""

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
LINK = re.compile(r"\[([^\]]*)\]\(([^)#:]+)(#[^)]*)?\)")
PAGES = {".md", ".png", ".gif", ".svg"}
PICTURES = {
    "docs/site/pictures.py": (
        "site/one-robot.png", "site/two-robots.png", "site/link.png", "site/page.png", "site/edit.png",
    ),
    "docs/site/film.py": ("site/one-robot.gif", "site/two-robots.gif"),
    "docs/site/diagrams.py": ("site/robot.png", "site/fleet-server.png", "site/cluster.png"),
    "docs/site/calibration_picture.py": ("calibrate-camera.png",),
    "docs/floor_plan.py": ("floor-plan.png",),
    "docs/independent_support.py": ("independent-support.svg",),
}  # fmt: skip
"""What is drawn, by program. `page.png` and `edit.png` need a browser, and stay as they are without one."""
BY_HAND = {"docs/site/demo_picture.py": ("demo.png",)}
"""What takes minutes: drawn when a person runs the program."""


def on_pre_build(config: Any) -> None:
    """Draw the pictures of the pages."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "agg"}
    for program in PICTURES:
        subprocess.run(
            [sys.executable, program], check=True, cwd=ROOT, env=environment, stdout=subprocess.DEVNULL
        )


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
