"""Floor plans over HTTP: where they lie, as JSON, and their images."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping
from typing import Any, Protocol

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response

from mapweave.hybridmap.floor_plan import PlacedPlans, PlanImage
from mapweave.mapserver.http.json_values import json_values

Answer = Callable[[Request], Awaitable[Mapping[str, Any] | Response]]


class Planning(Protocol):
    """What a map server offers, see MapServer."""

    def plans(self) -> PlacedPlans:
        """Floor plans under the newest merged map."""

    def plan_image(self, name: str) -> bytes:
        """The PNG file of a plan."""

    def put_plan_image(self, data: bytes) -> PlanImage:
        """Keep the image of a plan."""


def plan_answers(
    server: Planning, body_of: Callable[[Request], Awaitable[bytes]]
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
        return await run_in_threadpool(lambda: json_values(server.put_plan_image(body)))

    async def image(request: Request) -> Response:
        png = await run_in_threadpool(server.plan_image, request.path_params["name"])
        return Response(png, media_type="image/png")

    return [
        ("GET", "/plans", "plans", plans),
        ("POST", "/plans", "put_plan_image", put),
        ("GET", "/plans/{name:path}.png", "plan_image", image),
    ]
