"""Floor plans over HTTP: where they lie, as JSON, and their images."""

from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from typing import Any

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response

from mapweave.hybridmap.errors import InvalidFile, InvalidValue
from mapweave.mapserver.http.answering import Answering
from mapweave.mapserver.http.form import form_parts
from mapweave.mapserver.http.json_values import json_values
from mapweave.storage.nav2_map import parse_nav2_map

Answer = Callable[[Request], Awaitable[Mapping[str, Any] | Response]]


def plan_answers(
    server: Answering, body_of: Callable[[Request], Awaitable[bytes]]
) -> list[tuple[str, str, str, Answer]]:
    """Method, path, question and answer of what is asked about plans.

    Args:
        server: answers.
        body_of: reads the body of a request.
    """

    async def plans(_: Request) -> Mapping[str, Any]:
        return await run_in_threadpool(lambda: json_values(server.plans()))

    async def put(request: Request) -> Mapping[str, Any]:
        body = await body_of(request)
        return await run_in_threadpool(keep_image, server, request.headers.get("Content-Type", ""), body)

    async def image(request: Request) -> Response:
        png = await run_in_threadpool(server.plan_image, request.path_params["name"])
        return Response(png, media_type="image/png")

    async def kept(request: Request) -> Response:
        png = await run_in_threadpool(server.kept_image, request.path_params["sha256"])
        return Response(png, media_type="image/png")

    return [
        ("GET", "/plans", "plans", plans),
        ("POST", "/plans", "put_plan_image", put),
        ("GET", "/plan-images/{sha256}.png", "plan_image", kept),
        ("GET", "/plans/{name:path}.png", "plan_image", image),
    ]


def keep_image(server: Answering, content_type: str, body: bytes) -> Mapping[str, Any]:
    """Keep the image of a plan.

    Args:
        server: keeps it.
        content_type: of the body.
        body: the image itself; or a form with the parts `image` and `map`, a map.yaml.

    Returns:
        The image; of a map.yaml also `metres_per_pixel` and `origin`.

    Raises:
        InvalidValue: it is no image, or no map.yaml.
    """
    parts = form_parts(content_type, body)
    if "map" not in parts:
        return json_values(server.put_plan_image(parts["image"]))
    try:
        described = parse_nav2_map(parts["map"], Path("map.yaml"))
    except InvalidFile as error:
        raise InvalidValue(str(error)) from None
    image = json_values(server.put_plan_image(parts["image"], described.negate))
    origin = described.origin.vector.tolist()
    return {**image, "metres_per_pixel": described.resolution, "origin": origin}
