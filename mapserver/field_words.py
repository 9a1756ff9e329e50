"""What is wrong with a value that people send, in a line that names the field and what to give instead.

`msgspec` says it in terms of its types: "Expected `str`, got `int` - at `$.name`".
"""

import re
from collections.abc import Mapping
from types import MappingProxyType

from mapweave.hybridmap.counted import counted

TYPES = {
    "int": "a whole number",
    "float": "a number",
    "str": "text",
    "bool": "true or false",
    "array": "a list",
    "object": "an object",
}
NOT = {**TYPES, "float": "a number with decimals", "null": "null"}
EXPECTED = re.compile(
    r"Expected `(?P<types>[^`]*)`(?P<limit>[^,]*)(?:, got (?:`(?P<got>\w+)`|(?P<count>\d+)))?"
)
MISSING = re.compile(r"Object missing required field `(.*)`")
UNKNOWN = re.compile(r"Object contains unknown field `(.*)`")
CHOICE = re.compile(r"Invalid enum value (.*)")
PLACE = re.compile(r" - at `\$(.*?)`")
"""Of an error. A value within another has two: its place in that one, then the place of that one."""


def field_words(error: str, examples: Mapping[str, str] = MappingProxyType({}), within: str = "") -> str:
    """An error of msgspec in plain words.

    Args:
        error: its words; also those of a value that refuses itself.
        examples: JSON by the name of a field.
        within: the field that was read; empty for a whole body.

    Returns:
        For example "`name`: give text, not a whole number".
    """
    said = PLACE.sub("", error)
    path = (within + "".join(reversed(PLACE.findall(error)))).removeprefix(".")
    if found := MISSING.fullmatch(said):
        path, words = f"{path}.{found[1]}".removeprefix("."), "this field is missing"
    elif found := UNKNOWN.fullmatch(said):
        path, words = f"{path}.{found[1]}".removeprefix("."), "there is no such field"
    elif found := CHOICE.fullmatch(said):
        words = f"{found[1]} is none of the words that it may be"
    elif found := EXPECTED.fullmatch(said):
        words = _expected(found)
    else:
        words = said
    example = examples.get(re.split(r"[.\[]", path)[0])
    if example is not None:
        words += f"; for example {example}"
    return f"`{path}`: {words}" if path else words


def _expected(found: re.Match[str]) -> str:
    wanted = ", or ".join(TYPES[name] for name in found["types"].split(" | ") if name in TYPES)
    limit = found["limit"].replace(">=", "at least").replace("<=", "at most").strip()
    if limit.startswith("of length"):
        of = "element" if found["types"].startswith("array") else "character"
        words, _, count = limit.removeprefix("of length").strip().rpartition(" ")
        wanted += " of " + f"{words} {counted(int(count), of)}".strip()
    elif limit:
        wanted += f", {limit}"
    given = found["count"] or NOT.get(found["got"] or "")
    return f"give {wanted or 'another value'}" + (f", not {given}" if given else "")
