"""Code and pages use the words of docs/glossary.md, and none that only their authors would know."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
FOLDERS = (
    "agent", "benchmarks", "docs", "examples", "hybridmap", "mapserver", "mapweave", "merge", "registration",
    "sim", "storage", "synthetic", "tests", "vision", "wire",
)  # fmt: skip
SUFFIXES = {".py", ".md", ".js", ".html", ".toml"}

PLAIN = {
    "anew": "again",
    "afresh": "again",
    "anybody": "any robot, any client, a person",
    "chronicle": "map history",
    "conductor": "scenario runner",
    "credence": "link probability",
    "everybody": "all robots, all receivers",
    "happening": "event",
    "happenings": "events",
    "hearsay": "fleet coverage",
    "heed": "apply",
    "heeds": "applies",
    "herald": "pose broadcast",
    "lately": "recently",
    "lifeline": "parent watchdog",
    "living": "active",
    "lookalike": "alias",
    "lookalikes": "aliases",
    "nobody": "no robot, no server, unknown",
    "ruled": "constrained",
    "ruling": "manual constraint",
    "rulings": "manual constraints",
    "sealed": "checksummed",
    "somebody": "a person",
    "stories": "consistent sets",
    "story": "consistent set",
    "told": "sent, reported, given",
    "trail": "trajectory",
    "trails": "trajectories",
    "upkeep": "merge worker",
    "wake": "trajectory segment",
    "wakes": "trajectory segments",
    "whoever": "the caller, any client",
    "whom": "which robot",
    "witness": "place, independent link",
    "witnesses": "places, independent links",
}
"""Words of a private language, and what the field says instead."""
PHRASES = {
    r"stands? for": "replaces, supersedes",
    r"in vain": "without success",
    r"the one whose": "the robot, node, link ... whose",
    r"of whom": "of which",
}

APART = re.compile(r"told apart")
"""To distinguish: plain English."""
EXCEPTIONS: dict[str, tuple[str, ...]] = {
    # A living room.
    "living": ("docs/worlds.md", "sim/worlds/examples/", "tests/sim/test_world_file.py")
}
"""Words by the files that may use them, with the reason."""


def pages() -> list[Path]:
    """Every text file of the project that people read."""
    inside = [p for folder in FOLDERS for p in (ROOT / folder).rglob("*") if p.suffix in SUFFIXES]
    return [*ROOT.glob("*.md"), *(p for p in inside if "__pycache__" not in p.parts)]


WORD = re.compile(r"[A-Za-z]+")
CAMEL = re.compile(r"(?<=[a-z])(?=[A-Z])")
PHRASE = re.compile(r"\b(?:" + "|".join(PHRASES) + r")\b")


def hits(text: str) -> set[str]:
    """Words and phrases that other ones stand in place of; names in camel case count word by word."""
    names = set(WORD.findall(APART.sub("", text)))
    words = {word.lower() for name in names for word in CAMEL.split(name)}
    return (PLAIN.keys() & words) | {m.group() for m in PHRASE.finditer(text.lower())}


def test_code_and_pages_use_the_words_of_the_field():
    collected = []
    for path in pages():
        name = path.relative_to(ROOT).as_posix()
        text = path.read_text(encoding="utf-8")
        if path == Path(__file__) or not hits(text):
            continue
        collected += [
            f"{name}:{number}: {hit}"
            for number, line in enumerate(text.splitlines(), 1)
            for hit in sorted(hits(line))
            if not name.startswith(EXCEPTIONS.get(hit, ("\0",)))
        ]
    assert not collected, "see PLAIN for other words:\n" + "\n".join(collected)
