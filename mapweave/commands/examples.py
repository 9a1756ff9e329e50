"""An example or more of every command, for its --help and the cheat sheet. A test parses each."""

import argparse

EXAMPLES: dict[str, tuple[str, ...]] = {
    "demo": ("mapweave demo --seed 3",),
    "server": (
        "mapweave server --http 8080",
        "mapweave server --keys keys --http 0.0.0.0:8080",
        "mapweave server --keys keys --store postgresql://mapweave@db1,db2/maps",
    ),
    "router": (
        "mapweave router --keys keys",
        "mapweave router --keys keys --print-config",
    ),
    "sim": ("mapweave sim run passing --one-process",),
    "sim list": ("mapweave sim list",),
    "sim run": ("mapweave sim run office --set world.rooms=5 --seed 7",),
    "sim batch": ("mapweave sim batch kidnapped --seeds 20",),
    "sim serve": ("mapweave sim serve office --set robots=2",),
    "agent": (
        "mapweave agent r0 --settings robot.toml --connect tcp/192.168.1.10:7447",
        "mapweave agent r0 --settings robot.toml --metrics 9101",
    ),
    "drive": ("mapweave drive r0", "mapweave drive r0 --gamepad"),
    "status": ("mapweave status --watch", "mapweave status --json"),
    "go": ("mapweave go r0 r1.1.17", "mapweave go r0 3.1,-2.0 --wait", "mapweave go r0 home"),
    "explore": ("mapweave explore r0",),
    "stop": ("mapweave stop r0", "mapweave stop --all"),
    "missions": ("mapweave missions", "mapweave missions r0 --json"),
    "place": ("mapweave place add kitchen r0.1.17",),
    "place add": ("mapweave place add kitchen r0.1.17", "mapweave place add hall 2.0,1.5 --radius 3"),
    "place list": ("mapweave place list",),
    "place remove": ("mapweave place remove kitchen",),
    "plan": ("mapweave plan show office",),
    "plan add": (
        "mapweave plan add office.yaml --pair r0.1.1=102,340 --pair r0.1.17=412,230 --pair kitchen=77,52",
    ),
    "plan show": ("mapweave plan show office -o office-plan.png",),
    "plan export": ("mapweave plan export office --format rmf",),
    "plan remove": ("mapweave plan remove office",),
    "close": ("mapweave close r0.1.17 r0.1.19 --until 14:00", "mapweave close kitchen --because paint"),
    "reopen": ("mapweave reopen kitchen",),
    "prefer": ("mapweave prefer r0.1.17 r0.1.19",),
    "avoid": ("mapweave avoid r0.1.17 r0.1.19",),
    "closures": ("mapweave closures",),
    "floor": ("mapweave floor ground r0.1.17",),
    "portal": ("mapweave portal done r0",),
    "portal done": ("mapweave portal done r0",),
    "keys": ("mapweave keys list",),
    "keys init": ("mapweave keys init --fleet office --at 192.168.1.10",),
    "keys add": ("mapweave keys add r0 --role robot",),
    "keys token": ("mapweave keys token anna --days 30",),
    "keys list": ("mapweave keys list --json",),
    "keys revoke": ("mapweave keys revoke r0 --because stolen", "mapweave keys revoke anna --tokens"),
    "keys bundle": ("mapweave keys bundle r0 -o r0.key",),
    "robots": ("mapweave robots",),
    "doctor": (
        "mapweave doctor --robot robot.toml",
        "mapweave doctor --robot robot.toml --offline --json",
    ),
    "find-port": ("mapweave find-port",),
    "find-cameras": ("mapweave find-cameras",),
    "calibrate": ("mapweave calibrate camera --settings robot.toml --height 0.2",),
    "calibrate target": ("mapweave calibrate target --paper a4 -o target.pdf",),
    "calibrate camera": ("mapweave calibrate camera --settings robot.toml --height 0.2 --http",),
    "calibrate drive": ("mapweave calibrate drive drive/",),
    "map": ("mapweave map show office.mapweave",),
    "map show": (
        "mapweave map show office.mapweave",
        "mapweave map show office.mapweave --json --no-picture",
    ),
    "map diff": ("mapweave map diff monday.mapweave tuesday.mapweave",),
    "map explain": ("mapweave map explain r0.1 r1.1", "mapweave map explain r0.1.5 r1.1.9"),
    "map route": ("mapweave map route r0.1.1 r1.1.17",),
    "map history": ("mapweave map history --most 10",),
    "map unmerge": ("mapweave map unmerge r0.1.5 r1.1.9 --because 'two like doors'",),
    "map link": ("mapweave map link r0.1.17 r1.1.5 --check",),
    "map undo": ("mapweave map undo", "mapweave map undo 3"),
    "map pin": ("mapweave map pin r0.1.17", "mapweave map pin r0.1.17 12.5,-3,90"),
    "map portal": ("mapweave map portal add 'east lift' r0.1.17 r1.1.5 --kind lift",),
    "map portal add": ("mapweave map portal add 'east lift' r0.1.17 r1.1.5 --kind lift --note 'key: desk'",),
    "map portal list": ("mapweave map portal list",),
    "map portal remove": ("mapweave map portal remove 'east lift'",),
    "map retire": ("mapweave map retire r0.1 --because 'before the move'",),
    "open": ("mapweave open office.mapweave",),
    "map merge": ("mapweave map merge r0.1.mapweave r1.1.mapweave -o office.mapweave",),
    "map fetch": ("mapweave map fetch office.mapweave",),
    "map backup": ("mapweave map backup out/server/s0.sqlite -o monday.sqlite",),
    "map export": ("mapweave map export office.mapweave --format geojson -o office.geojson",),
    "map extract": ("mapweave map extract out/agents/r0.sqlite -o maps/",),
    "map import": ("mapweave map import graph.g2o -o optimum.g2o",),
    "map from-photos": ("mapweave map from-photos photos/ --spacing 0.5 -o hall.mapweave",),
    "record": ("mapweave record r0 --settings robot.toml -o drive/",),
    "replay": ("mapweave replay drive/ --offline", "mapweave replay walk.mp4 --camera camera.toml"),
    "info": ("mapweave info drive/", "mapweave info drive/ --json"),
    "relocalize": ("mapweave relocalize photo.png --camera camera.toml",),
    "eval": ("mapweave eval replay drive/",),
    "eval relocalize": ("mapweave eval relocalize drive/ --json",),
    "eval merge": ("mapweave eval merge drive/ --robots 3",),
    "eval replay": ("mapweave eval replay drive/ --truth truth.csv",),
    "settings": ("mapweave settings > robot.toml",),
    "completion": ("mapweave completion bash >> ~/.bashrc",),
}
"""By the command's words."""


class ExampleHelp(argparse.HelpFormatter):
    """Wraps text as usual, but leaves lines that are indented as they are."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        lines = text.splitlines()
        return "\n".join(
            line if line.startswith("  ") else super(ExampleHelp, self)._fill_text(line, width, indent)
            for line in lines
        )


def parsers_of(parser: argparse.ArgumentParser, words: str = "") -> dict[str, argparse.ArgumentParser]:
    """The parsers of a parser's commands, of theirs, and so on, by their words: `map`, `map show` ..."""
    found = {words: parser} if words else {}
    for action in parser._actions:  # argparse has no other way to list them
        if isinstance(action, argparse._SubParsersAction):
            for name, choice in action.choices.items():
                found |= parsers_of(choice, f"{words} {name}".strip())
    return found


def add_examples(parser: argparse.ArgumentParser) -> None:
    """Put the examples below the help of every command."""
    for words, command in parsers_of(parser).items():
        lines = [f"  {example}" for example in EXAMPLES.get(words, ())]
        title = "examples:" if len(lines) > 1 else "example:"
        command.epilog = "\n".join(
            [*([command.epilog, ""] if command.epilog else []), *([title, *lines] if lines else [])]
        )
        command.formatter_class = ExampleHelp
