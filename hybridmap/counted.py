"""Counts in messages for people."""


def counted(count: int, noun: str) -> str:
    """A number with its noun, for example `1 node`, `2 nodes`; the noun is given in the singular."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"
