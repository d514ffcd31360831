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
from . import charts, views
from .actions import Acts
from .looking import ChangeFeed, Looking
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
    part_view,
)

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
    made = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    drawing = (charts.bound_chart, charts.bad_chart, charts.course_chart, charts.map_chart, charts.trace_charts)
    saying = (charts.number, charts.percent, views.moment, views.clock, views.duration, views.part_name, views.story)
    made.globals |= {each.__name__: each for each in (*drawing, *saying)} | {"words": views.WORDS}
    return made


def page(template: str, status: int = 200, **values: object) -> HTMLResponse:
    """A page out of a template."""
    return HTMLResponse(environment().get_template(template).render(**values), status, HEADERS)


View = Callable[[Request], Awaitable[Response]]
FRESH = 0.3  # seconds that what happens now may be old, beside the time that it takes to read
CHECK = 5.0  # seconds that the expensive verification takes, where nothing else is said: the paper's height check
THEMES = ("auto", "light", "dark")
TITLES = {"how": "How it is doing", "failed": "That cannot be shown"}
YEAR = 365 * 24 * 3600


def routes(service: CellService, check_seconds: float = CHECK) -> list[BaseRoute]:
    """The page over a service.  check_seconds : what a check takes, for the time that was saved."""
    return LivePage(service, check_seconds).routes()


class LivePage:
    """The page of one service."""

    def __init__(self, service: CellService, check_seconds: float) -> None:
        self._feed = ChangeFeed(service)
        self._looking = Looking(service, self._feed)
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
        return await self._acts.answer(request.path_params["name"], request)

    async def events(self, request: Request) -> Response:
        """Server-sent events: that something changed, and what lets a page see that it is cut off."""
        return EventSourceResponse(self._feed.events(), headers={"cache-control": "no-store"}, ping=3600)

    async def _how(self) -> HowView:
        return await self._looking.look("how", how_view)

    async def _part(self, decision_id: str) -> PartView | None:
        return await self._looking.look(("part", decision_id), lambda looking: part_view(looking, decision_id))

    def _page(self, request: Request, view: str, status: int = 200, **values: object) -> Response:
        self._feed.begin()
        mode, reason = mode_of(self._looking)
        about = {
            "view": view,
            "title": TITLES.get(view, view.capitalize()),
            "theme": _theme(request.cookies.get("dengine_theme")) or "auto",
            "root": request.scope.get("root_path", ""),
            "here": urlencode(parse_qsl(request.url.query)),
            "path": request.url.path,
            "token": self._acts.token,
            "boot": self._feed.boot,
            "cell": self._looking.store.cell_id,
            "mode": mode,
            "mode_reason": reason,
            "check_seconds": self._check_seconds,
            "pace_over": PACE,
        }
        return page(f"{view}.html", status, **about, **values)


def _chosen(view: View) -> View:
    """A view that first takes a chosen appearance into a cookie, and then goes back to itself."""

    @wraps(view)
    async def shown(request: Request) -> Response:
        theme = _theme(request.query_params.get("theme"))
        if theme is None:
            return await view(request)
        left = [(key, value) for key, value in parse_qsl(request.url.query) if key != "theme"]
        answer = RedirectResponse(f"{request.url.path}{'?' + urlencode(left) if left else ''}", 303)
        answer.set_cookie("dengine_theme", theme, max_age=YEAR, samesite="strict")
        return answer

    return shown


def _theme(name: str | None) -> str | None:
    return name if name in THEMES else None
