"""The body of a request: of a kind that is expected, of a length that is stated, within a time."""

from http import HTTPStatus

from starlette.exceptions import HTTPException
from starlette.requests import Request

from mapweave.hybridmap.errors import InvalidValue
from mapweave.mapserver.http.places import PLACE, Place
from mapweave.mapserver.http.reply import WHOLE

MOST_BYTES = 16 * 2**20
"""Longest body, 16 MiB."""
JSON = ("application/json",)
IMAGE = ("image/jpeg", "image/png", "application/octet-stream")
FORM = "multipart/form-data"


async def read_body(
    request: Request, kinds: tuple[str, ...], patience: float, most: int = MOST_BYTES
) -> bytes:
    """All of it; refused before it is sent if it is too long, or of another kind.

    Args:
        request: with the body. Its place is free for others meanwhile.
        kinds: media types that are taken. None of them but a form is one that a page of another site may send
            without asking first.
        patience: within which it has to be there, s.
        most: bytes.

    Raises:
        HTTPException: 411 without a length, 413 too long, 415 of another kind.
        InvalidValue: it is empty, or cut off.
        TimeoutError: it takes too long.
        Busy: all places are taken once it is there.
    """
    length = _length(request, kinds, most)
    kind = request.headers.get("Content-Type", "").partition(";")[0].strip().lower()
    if kind not in kinds:
        words = f"{kind[:60]!r} is not taken here" if kind else "there is no Content-Type"
        raise HTTPException(
            HTTPStatus.UNSUPPORTED_MEDIA_TYPE, f"{words}: send Content-Type: {' or '.join(kinds)}"
        )
    body, place = bytearray(), request.scope[PLACE]
    assert isinstance(place, Place)
    async with place.left(patience):
        async for piece in request.stream():
            body += piece
    request.scope[WHOLE] = True
    if len(body) < length:
        raise InvalidValue(f"only {len(body)} of {length} bytes came")
    return bytes(body)


def _length(request: Request, kinds: tuple[str, ...], most: int) -> int:
    text = request.headers.get("Content-Length", "")
    if "Transfer-Encoding" in request.headers or not (text.isascii() and text.isdigit()):
        raise HTTPException(HTTPStatus.LENGTH_REQUIRED, "give the length of the body with Content-Length")
    if len(text) > 12 or int(text) > most:
        words = f"{most >> 20} MiB" if most >> 20 else f"{most >> 10} KiB"
        raise HTTPException(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"at most {words} are taken")
    if int(text) == 0:
        raise InvalidValue(f"send {'JSON' if kinds == JSON else 'a JPEG or PNG image'} as the body")
    return int(text)
