"""The live page: static files, whose script asks what everybody may ask of `HttpApi`, and nothing from outside."""

from collections.abc import Sequence
from pathlib import Path

from starlette.requests import Request
from starlette.responses import FileResponse, Response
from starlette.routing import BaseRoute, Mount, Route
from starlette.staticfiles import StaticFiles

STATIC = Path(__file__).parent / "static"
VIEWS = ("/", "/overview", "/map", "/part", "/history", "/actions")  # one file: its script shows the one that is asked for
HEADERS = {  # stricter than what `Guard` gives every answer; the rest is its
    "content-security-policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
    "connect-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'",
    "referrer-policy": "same-origin",
}


async def shown(request: Request) -> Response:
    """The page, whichever view of it; at /docs the document of the API, to read."""
    name = "docs.html" if request.url.path.endswith("/docs") else "index.html"
    return FileResponse(STATIC / name, headers=HEADERS)


def files() -> BaseRoute:
    """What the page and the document of the API are made of."""
    return Mount("/page/static", StaticFiles(directory=STATIC))


def routes() -> Sequence[BaseRoute]:
    """The page's addresses."""
    return [Route(path, shown) for path in VIEWS]
