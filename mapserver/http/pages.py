"""The page and its files, from memory: it has thirty, each on a connection of its own."""

from collections.abc import Awaitable, Callable
from http import HTTPStatus
from pathlib import Path

from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response

STATIC = Path(__file__).with_name("static")
TYPES = {".html": "text/html", ".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}
WORKERS = ("map_bitmap.js",)
"""No modules."""

Endpoint = Callable[[Request], Awaitable[Response]]


def page(name: str, asked: Callable[[], object]) -> Endpoint:
    """A page. The browser asks for all its modules at once, and not for each when another has named it.

    Args:
        name: of the file.
        asked: called when the page is asked for.
    """
    modules = (path.name for path in sorted(STATIC.glob("*.js")) if path.name not in WORKERS)
    links = "".join(f'<link rel="modulepreload" href="static/{module}">\n' for module in modules)
    content = (STATIC / name).read_text(encoding="utf-8").replace("<header>", f"{links}<header>", 1)

    async def endpoint(_: Request) -> Response:
        asked()
        return Response(content, media_type=TYPES[".html"])

    return endpoint


def static() -> Endpoint:
    """The files of pages."""
    files = {path.name: (path.read_bytes(), TYPES[path.suffix]) for path in STATIC.iterdir()}

    async def endpoint(request: Request) -> Response:
        content, kind = files.get(request.path_params["name"], (b"", ""))
        if not kind:
            raise HTTPException(HTTPStatus.NOT_FOUND)
        return Response(content, media_type=kind)

    return endpoint
