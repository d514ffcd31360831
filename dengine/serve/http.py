"""HTTP and JSON."""

from __future__ import annotations

from collections.abc import Sequence

from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import BaseRoute, Route

from .service import CellService


def routes(service: CellService) -> Sequence[BaseRoute]:
    """What is asked over HTTP."""

    async def healthz(request: Request) -> Response:
        return JSONResponse({"version": service.engine.version})

    return [Route("/healthz", healthz, methods=["GET"])]
