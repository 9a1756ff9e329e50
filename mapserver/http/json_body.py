"""JSON that people post."""

from collections.abc import Mapping
from typing import TypeVar

import msgspec

from mapweave.hybridmap.errors import InvalidValue
from mapweave.mapserver.field_words import field_words
from mapweave.wire.conversion import json_value

Body = TypeVar("Body")


def read_json(data: bytes, kind: type[Body], examples: Mapping[str, str]) -> Body:
    """Read the body of a request.

    Args:
        data: the body.
        kind: its type.
        examples: JSON by the name of a field, for who sends something else.

    Raises:
        InvalidValue: it is no JSON, or a field is missing, unknown or of another type; the words name it.
    """
    try:
        return json_value(data, kind)
    except msgspec.ValidationError as error:
        raise InvalidValue(field_words(str(error), examples)) from None
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InvalidValue(f"the body is no JSON: {error}") from None
