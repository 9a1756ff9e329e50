"""Values of arguments, read where they are declared: what is none is a wrong command line, in one line.

argparse itself would print the usage above it, and call a word that is no number an "invalid float value".
`mapweave.cli.CommandParser` puts before the words here which argument it is.
"""

import math
from pathlib import Path

from mapweave.commands.usage import UsageError
from mapweave.hybridmap.errors import InvalidValue


def name(text: str) -> str:
    """The name of a robot, server or fleet."""
    from mapweave.hybridmap.ids import check_name

    try:
        return check_name(text)
    except InvalidValue as error:
        raise UsageError(str(error).rpartition(": ")[2]) from None


def given(text: str) -> str:
    """What may not be empty, as a variable is that a script has not set: that would pass for left out."""
    if not text.strip():
        raise UsageError("give a value, or leave it out")
    return text


def endpoint(text: str) -> str:
    """A Zenoh endpoint."""
    from mapweave.wire.bus_settings import DEFAULT_ENDPOINT, ENDPOINT

    if not ENDPOINT.fullmatch(text):
        raise UsageError(f"endpoints look like {DEFAULT_ENDPOINT}")
    port = text.partition("#")[0].partition("?")[0].rpartition(":")[2]
    if len(port) > 5 or int(port) > 65535:
        raise UsageError("a port is at most 65535")
    return text


def goal(text: str) -> str:
    """Where a robot shall go; the map says whether it is there."""
    if not text.strip():
        raise UsageError("give a node (r0.1.17), a named place, a position (3.1,-2.0) or home")
    from mapweave.hybridmap.mission_order import MAX_TEXT

    if len(text) > MAX_TEXT:
        raise UsageError(f"it is longer than {MAX_TEXT} characters")
    return node(text)


def node(text: str) -> str:
    """A node, the name of a place or a position; the map says whether it is there."""
    from mapweave.hybridmap.constraint_subject import read_end
    from mapweave.hybridmap.ids import NodeId

    try:
        end = read_end(text.strip())
    except InvalidValue:
        return text
    if not isinstance(end, NodeId) and end.agent.isdigit():
        raise UsageError("this is a map; a position has a comma and no blank, as 3.1,-2.0")
    if not isinstance(end, NodeId):
        raise UsageError(f"this is a map: give one of its nodes, {end}.1 for example")
    return text


def title(text: str) -> str:
    """What people call a floor, a plan, a portal or a closure."""
    from mapweave.hybridmap.annotation import MAX_NAME

    return _line(text, 1, MAX_NAME)


def remark(text: str) -> str:
    """Who and why. The usual default is nothing, which needs no library to be checked."""
    if not text:
        return text
    from mapweave.hybridmap.manual_constraint import MOST_WORDS

    return _line(text, 0, MOST_WORDS)


def note(text: str) -> str:
    """A note for who takes a robot through a portal; likewise."""
    if not text:
        return text
    from mapweave.hybridmap.portal import MOST_NOTE

    return _line(text, 0, MOST_NOTE)


def seed(text: str) -> int:
    """A seed that random generators take."""
    return _whole(text, 0, math.inf, "use 0 or more")


def port(text: str) -> int:
    """A TCP port; 0 takes a free one."""
    return _whole(text, 0, 65535, "a port is 0 to 65535; 0 takes a free one")


def count(text: str) -> int:
    """How many."""
    return _whole(text, 1, math.inf, "use 1 or more")


def seconds(text: str) -> float:
    """A time, s."""
    return _positive(text, "give seconds, more than 0")


def metres(text: str) -> float:
    """A distance, m."""
    return _positive(text, "give metres, more than 0")


def png(text: str) -> Path:
    """Where a picture goes."""
    path = Path(text)
    if path.suffix.lower() != ".png":
        raise UsageError("the picture will be a PNG; end its name with .png")
    return path


def _line(text: str, least: int, most: int) -> str:
    if not least <= len(text) <= most or not text.isprintable():
        raise UsageError(f"give one printable line of {least} to {most} characters")
    return text


def _whole(text: str, least: float, most: float, words: str) -> int:
    try:
        number = int(text)
    except ValueError:
        number = -1
    if not least <= number <= most:
        raise UsageError(words)
    return number


def _positive(text: str, words: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not 0.0 < number < math.inf:
        raise UsageError(words)
    return number
