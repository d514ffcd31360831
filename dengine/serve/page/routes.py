"""The page's addresses: its views, what it is told while it is open, its acts and its assets.

Templates into pages: everything that goes in is escaped, and nothing from outside is ever asked for.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from functools import cache, wraps
from pathlib import Path
from urllib.parse import parse_qsl, urlencode

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from sse_starlette.sse import EventSourceResponse
from starlette.requests import Request
from starlette.responses import HTMLResponse, RedirectResponse, Response
from starlette.routing import BaseRoute, Mount, Route
from starlette.staticfiles import StaticFiles

from ..service import CellService
from . import charts as bound_chart
from . import charts as course_chart
from . import charts as map_chart
from . import charts as trace_chart
from .actions import Acts
from .looking import Looking, Pulse
from .views import (
    FILTERS,
    PACE,
    HowView,
    PartView,
    history_query,
    history_view,
    how_view,
    map_view,
    mode_of,
    now_view,
    part_name,
    part_view,
    story,
    why,
)
from .words import CATALOGUES, Words, language

HERE = Path(__file__).parent
STATIC = HERE / "static"
HEADERS = {  # stricter than what `Guard` gives every answer; the rest is its
    "content-security-policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
    "connect-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'",
    "referrer-policy": "same-origin",
}


@cache
def environment() -> Environment:
    """The templates."""
    loader = FileSystemLoader(HERE / "templates")
    return Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)


def page(template: str, status: int = 200, **values: object) -> HTMLResponse:
    """A page out of a template."""
    return HTMLResponse(environment().get_template(template).render(**values), status, HEADERS)


View = Callable[[Request], Awaitable[Response]]
FRESH = 0.3  # seconds that what happens now may be old, beside the time that it takes to read
CHECK = 5.0  # seconds that the expensive verification takes, where nothing else is said: the paper's height check
CHOICES = {"lang": tuple(CATALOGUES), "theme": ("auto", "light", "dark")}
YEAR = 365 * 24 * 3600
DRAWING = {
    "trace_charts": trace_chart.trace_charts,
    "bound_chart": bound_chart.bound_chart,
    "bad_chart": bound_chart.bad_chart,
    "map_chart": map_chart.map_chart,
    "course_chart": course_chart.course_chart,
    "part_name": part_name,
    "story": story,
    "why": why,
}


def routes(service: CellService, check_seconds: float = CHECK) -> list[BaseRoute]:
    """The page over a service.  check_seconds : what a check takes, for the time that was saved."""
    return LivePage(service, check_seconds).routes()


class LivePage:
    """The page of one service."""

    def __init__(self, service: CellService, check_seconds: float) -> None:
        self._pulse = Pulse(service)
        self._looking = Looking(service, self._pulse)
        self._acts = Acts(self._looking)
        self._check_seconds = check_seconds

    def routes(self) -> list[BaseRoute]:
        """Its addresses."""
        views = {
            "/": self.now,
            "/how": self.how,
            "/map": self.map,
            "/part": self.part,
            "/history": self.history,
            "/acts": self.acts,
        }
        return [
            *(Route(path, _chosen(view), name=f"page {path}") for path, view in views.items()),
            Route("/acts/{name}", self.act, methods=["POST"], name="page act"),
            Route("/events", self.events, name="page events"),
            Mount("/page/static", StaticFiles(directory=STATIC), name="page static"),
        ]

    async def now(self, request: Request) -> Response:
        """What happens now."""
        view = await self._looking.look("now", now_view, FRESH)
        return self._page(request, "now", now=view, how=await self._how())

    async def how(self, request: Request) -> Response:
        """How it is doing."""
        return self._page(request, "how", how=await self._how())

    async def map(self, request: Request) -> Response:
        """The map, and beside it the part that was chosen."""
        chosen = request.query_params.get("id", "")
        found = await self._looking.look("map", map_view)
        part = await self._part(chosen) if chosen else None
        return self._page(request, "map", map=found, chosen=chosen, part=part)

    async def part(self, request: Request) -> Response:
        """One part; 404 for one that is unknown."""
        found = await self._part(request.query_params.get("id", ""))
        if found is None:
            return self._page(request, "failed", 404)
        return self._page(request, "part", part=found)

    async def history(self, request: Request) -> Response:
        """The history."""
        query = history_query(dict(request.query_params))
        view = await self._looking.look(("history", query), lambda looking: history_view(looking, query))
        return self._page(request, "history", history=view, filters=FILTERS)

    async def acts(self, request: Request) -> Response:
        """What people may do."""
        versions = await self._looking.look("versions", lambda looking: looking.store.versions())
        now = self._looking.service.engine.version
        kept = [each for each in versions if each.accepted and each.kept and each.version != now]
        return self._page(request, "acts", versions=kept[::-1], version=now)

    async def act(self, request: Request) -> Response:
        """Do something."""
        return await self._acts.answer(request.path_params["name"], request, _words(request))

    async def events(self, request: Request) -> Response:
        """Server-sent events: that something changed, and what lets a page see that it is cut off."""
        return EventSourceResponse(self._pulse.events(), headers={"cache-control": "no-store"}, ping=3600)

    async def _how(self) -> HowView:
        return await self._looking.look("how", how_view)

    async def _part(self, decision_id: str) -> PartView | None:
        return await self._looking.look(("part", decision_id), lambda looking: part_view(looking, decision_id))

    def _page(self, request: Request, view: str, status: int = 200, **values: object) -> Response:
        self._pulse.begin()
        mode, reason = mode_of(self._looking)
        about = {
            "w": _words(request),
            "view": view,
            "theme": _choice(request, "theme") or "auto",
            "languages": CATALOGUES,
            "root": request.scope.get("root_path", ""),
            "here": urlencode(parse_qsl(request.url.query)),
            "path": request.url.path,
            "token": self._acts.token,
            "boot": self._pulse.boot,
            "cell": self._looking.store.cell_id,
            "mode": mode,
            "mode_reason": reason,
            "check_seconds": self._check_seconds,
            "pace_over": PACE,
        }
        return page(f"{view}.html", status, **about, **DRAWING, **values)


def _chosen(view: View) -> View:
    """A view that first takes a chosen language or appearance."""

    @wraps(view)
    async def shown(request: Request) -> Response:
        for name, values in CHOICES.items():
            if request.query_params.get(name) in values:
                return _remembered(request, name)
        return await view(request)

    return shown


def _remembered(request: Request, name: str) -> Response:
    """Back to the same view, with the choice in a cookie."""
    left = [(key, value) for key, value in parse_qsl(request.url.query) if key != name]
    answer = RedirectResponse(f"{request.url.path}{'?' + urlencode(left) if left else ''}", 303)
    answer.set_cookie(f"dengine_{name}", request.query_params[name], max_age=YEAR, samesite="strict")
    return answer


def _choice(request: Request, name: str) -> str | None:
    value = request.cookies.get(f"dengine_{name}")
    return value if value in CHOICES[name] else None


def _words(request: Request) -> Words:
    return Words(language(_choice(request, "lang"), request.headers.get("accept-language", "")))
