"""The page docs/cheat-sheet.md: `python -m mapweave.cheat_sheet > docs/cheat-sheet.md`; a test compares."""

import argparse

from mapweave.cli import parser
from mapweave.commands.examples import EXAMPLES, parsers_of
from mapweave.exit_status import MEANINGS

GROUPS = {
    "Try it": ("demo", "sim list", "sim run", "sim batch", "sim serve"),
    "Set a robot up": (
        "robots", "find-port", "find-cameras", "calibrate target", "calibrate camera", "calibrate drive",
        "doctor", "settings",
    ),
    "Run": ("server", "router", "agent", "record"),
    "Command": ("status", "go", "explore", "stop", "missions", "drive"),
    "Places and closures": (
        "place add", "place list", "place remove", "close", "reopen", "prefer", "avoid", "closures",
    ),
    "Floors": ("floor", "map portal add", "map portal list", "map portal remove", "portal done"),
    "Floor plans": ("plan add", "plan show", "plan export", "plan remove", "map pin"),
    "Maps": (
        "map show", "map diff", "open", "map explain", "map route", "map history", "map link", "map unmerge",
        "map retire", "map undo", "map merge",
        "map fetch", "map backup", "map export", "map extract", "map import", "map from-photos", "relocalize",
    ),
    "Keys": ("keys init", "keys add", "keys token", "keys list", "keys revoke", "keys bundle"),
    "Recordings": ("info", "replay", "eval replay", "eval relocalize", "eval merge"),
}  # fmt: skip
"""Commands by what a person wants; the rest comes last."""

HEAD = """# Cheat sheet

Every command has `--help` with examples. This page is made of the commands themselves
(`python -m mapweave.cheat_sheet > docs/cheat-sheet.md`).

"""
FINDING = """## Where the fleet is

`--connect tcp/HOST:7447` names the router, or several, `--fleet NAME` the fleet, `--settings FILE` a file
with both and all other [settings](settings.md). Without a server or router a command says so within 2 s, in
one line with what to do.

## Scripts

`--json` prints one JSON object on stdout: {json}.
Where stdout or stderr is no terminal, lines are not wrapped, and progress on stderr is a plain line every
10 s.
Agents, servers and routers print an event as one line with the time.

"""
COMPLETION = """## Completion

    mapweave completion bash >> ~/.bashrc
    mapweave completion zsh >> ~/.zshrc      # after compinit
    mkdir -p ~/.config/fish/completions && mapweave completion fish > ~/.config/fish/completions/mapweave.fish
"""


def as_markdown() -> str:
    """The whole page."""
    parsers = {words: one for words, one in parsers_of(parser()).items() if not _has_commands(one)}
    grouped = {words for group in GROUPS.values() for words in group}
    rest = tuple(words for words in parsers if words not in grouped)
    summaries = _summaries(parser())
    lines = [HEAD]
    for title, group in {**GROUPS, "Shell": rest}.items():
        lines.append(f"## {title}\n\n| | |\n|---|---|\n")
        for words in group:
            examples = "<br>".join(f"`{example}`" for example in EXAMPLES[words])
            lines.append(f"| {examples} | {summaries[words]} |\n")
        lines.append("\n")
    with_json = [f"`{words}`" for words, one in parsers.items() if "--json" in one.format_help()]
    lines.append(FINDING.format(json=", ".join(with_json)))
    lines.append("## Exit statuses\n\n| | |\n|---|---|\n")
    lines += [f"| {status} | {meaning} |\n" for status, meaning in MEANINGS.items()]
    lines.append("\n" + COMPLETION)
    return "".join(lines)


def _has_commands(one: argparse.ArgumentParser) -> bool:
    return any(isinstance(action, argparse._SubParsersAction) for action in one._actions)


def _summaries(top: argparse.ArgumentParser, words: str = "") -> dict[str, str]:
    """The one-line help of every command."""
    found: dict[str, str] = {}
    for action in top._actions:
        if isinstance(action, argparse._SubParsersAction):
            for choice in action._choices_actions:
                name = f"{words} {choice.dest}".strip()
                found[name] = (choice.help or "").replace("|", "\\|")
                found |= _summaries(action.choices[choice.dest], name)
    return found


if __name__ == "__main__":
    print(as_markdown(), end="")
