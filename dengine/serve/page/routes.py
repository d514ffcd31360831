"""The page's addresses: its views, what it is told while it is open, its acts and its assets.

Everything that goes into a template is escaped, and nothing from outside is ever asked for.
"""

from __future__ import annotations

import secrets
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
from .acts import act
from .looking import ChangeFeed, Looking

HERE = Path(__file__).parent
HEADERS = {  # stricter than what `Guard` gives every answer; the rest is its
    "content-security-policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
    "connect-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'",
    "referrer-policy": "same-origin",
}
View = Callable[[Request], Awaitable[Response]]
FRESH = 0.3  # seconds that what happens now may be old, beside the time that it takes to read
CHECK = 5.0  # seconds that the expensive verification takes, where nothing else is said: the paper's height check
THEMES = ("auto", "light", "dark")
YEAR = 365 * 24 * 3600


@cache
def environment() -> Environment:
    """The templates."""
    loader = FileSystemLoader(HERE / "templates")
    made = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    drawing = (charts.bound_chart, charts.bad_chart, charts.course_chart, charts.map_chart, charts.trace_charts)
    saying = (charts.number, charts.percent, views.moment, views.clock, views.duration, views.part_name, views.story)
    made.globals |= {each.__name__: each for each in (*drawing, *saying)} | {"words": views.WORDS}
    return made


def routes(service: CellService, check_seconds: float = CHECK) -> list[BaseRoute]:
    """The page over a service.  check_seconds : what a check takes, for the time that was saved."""
    page = LivePage(service, check_seconds)
    shown = {"/": page.now, "/how": page.how, "/map": page.map, "/part": page.part, "/history": page.history}
    return [
        *(Route(path, _themed(view), name=f"page {path}") for path, view in (shown | {"/acts": page.acts}).items()),
        Route("/acts/{name}", page.act, methods=["POST"], name="page act"),
        Route("/events", page.events, name="page events"),
        Mount("/page/static", StaticFiles(directory=HERE / "static"), name="page static"),
    ]


class LivePage:
    """The page of one service."""

    def __init__(self, service: CellService, check_seconds: float) -> None:
        self._feed = ChangeFeed(service)
        self._service, self._looking = service, Looking(service, self._feed)
        self._check_seconds, self._token = check_seconds, secrets.token_urlsafe(32)

    async def now(self, request: Request) -> Response:
        """What happens now."""
        view = await self._looking.look("now", views.now_view, FRESH)
        return self._page(request, "now", now=view, how=await self._looking.look("how", views.how_view))

    async def how(self, request: Request) -> Response:
        """How it is doing."""
        return self._page(request, "how", "How it is doing", how=await self._looking.look("how", views.how_view))

    async def map(self, request: Request) -> Response:
        """The map, and beside it the part that was chosen."""
        chosen = request.query_params.get("id", "")
        found = await self._looking.look("map", views.map_view)
        part = await self._part(chosen) if chosen else None
        return self._page(request, "map", map=found, chosen=chosen, part=part)

    async def part(self, request: Request) -> Response:
        """One part; 404 for one that is unknown."""
        found = await self._part(request.query_params.get("id", ""))
        if found is None:
            return self._page(request, "failed", "That cannot be shown", 404)
        return self._page(request, "part", part=found)

    async def history(self, request: Request) -> Response:
        """The history."""
        query = views.history_query(dict(request.query_params))
        view = await self._looking.look(("history", query), lambda looking: views.history_view(looking, query))
        return self._page(request, "history", history=view, filters=views.FILTERS)

    async def acts(self, request: Request) -> Response:
        """What people may do."""
        versions = await self._looking.look("versions", lambda looking: looking.store.versions())
        now = self._service.engine.version
        kept = [each for each in versions if each.accepted and each.kept and each.version != now]
        return self._page(request, "acts", versions=kept[::-1], version=now)

    async def act(self, request: Request) -> Response:
        """Do something."""
        answer = await act(self._service, self._token, request)
        if answer.status_code == 200:
            self._looking.look_anew()
        return answer

    async def events(self, request: Request) -> Response:
        """Server-sent events: that something changed, and what lets a page see that it is cut off."""
        return EventSourceResponse(self._feed.events(), headers={"cache-control": "no-store"}, ping=3600)

    async def _part(self, decision_id: str) -> views.PartView | None:
        return await self._looking.look(("part", decision_id), lambda looking: views.part_view(looking, decision_id))

    def _page(self, request: Request, view: str, title: str = "", status: int = 200, **values: object) -> Response:
        self._feed.begin()
        mode, reason = views.mode_of(self._looking)
        theme = request.cookies.get("dengine_theme")
        about = {
            "view": view,
            "title": title or view.capitalize(),
            "theme": theme if theme in THEMES else "auto",
            "root": request.scope.get("root_path", ""),
            "here": urlencode(parse_qsl(request.url.query)),
            "path": request.url.path,
            "token": self._token,
            "boot": self._feed.boot,
            "cell": self._looking.store.cell_id,
            "mode": mode,
            "mode_reason": reason,
            "check_seconds": self._check_seconds,
            "pace_over": views.PACE,
        }
        return HTMLResponse(environment().get_template(f"{view}.html").render(**about, **values), status, HEADERS)


def _themed(view: View) -> View:
    """A view that first takes a chosen appearance into a cookie, and then goes back to itself."""

    @wraps(view)
    async def shown(request: Request) -> Response:
        theme = request.query_params.get("theme")
        if theme not in THEMES:
            return await view(request)
        left = [(key, value) for key, value in parse_qsl(request.url.query) if key != "theme"]
        answer = RedirectResponse(f"{request.url.path}{'?' + urlencode(left) if left else ''}", 303)
        answer.set_cookie("dengine_theme", theme, max_age=YEAR, samesite="strict")
        return answer

    return shown
