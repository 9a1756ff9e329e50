"""Nodes over HTTP: what is known of one, as JSON, and its image, if its robot has kept one."""

from collections.abc import Awaitable, Callable, Mapping
from http import HTTPStatus
from typing import Any

from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.named_nodes import ids_of
from mapweave.mapserver.http.answering import Answering
from mapweave.mapserver.http.json_values import json_values
from mapweave.mapserver.http.node_details import node_details
from mapweave.mapserver.node_views import NoView

Answer = Callable[[Request], Awaitable[Mapping[str, Any] | Response]]


def node_answers(server: Answering) -> list[tuple[str, str, str, Answer]]:
    """Method, path, question and answer of what is asked about a node."""

    def named(request: Request) -> NodeId:
        return NodeId.parse(*ids_of([request.path_params["node"]], server.resolve))

    async def node(request: Request) -> Mapping[str, Any]:
        def details() -> Mapping[str, Any]:
            asked = named(request)
            known = node_details(server.merged(), asked, server.annotations().floors)
            missing = server.why_no_view(asked)
            return {**json_values(known), "view": not missing, "no_view": missing}

        return await run_in_threadpool(details)

    async def view(request: Request) -> Response:
        try:
            jpeg = await run_in_threadpool(lambda: server.view(named(request)))
        except NoView as error:
            raise HTTPException(HTTPStatus.NOT_FOUND, str(error)) from None
        return Response(jpeg, media_type="image/jpeg")

    # Who may read the map may see the images of which it was made.
    return [("GET", "/nodes/{node}", "map", node), ("GET", "/nodes/{node}/view", "map", view)]
