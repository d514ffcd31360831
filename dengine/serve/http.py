"""HTTP: decide, report, and what can be asked of the engine; and the application, every interface behind one guard.

curl -d '{"trace": [0.1, 0.3, ...], "request": "order-7"}' -H 'Content-Type: application/json' localhost:8000/decide
app = create_app(CellService(lambda: DataEngine.open_or_create("cell.db"), "cell.db"))
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import AbstractAsyncContextManager, AsyncExitStack, asynccontextmanager
from typing import Any

import msgspec
from msgspec import UNSET
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import HTMLResponse, Response
from starlette.routing import BaseRoute, Route

from .. import __version__
from ..errors import SettingError, UnknownDecisionError, shortened
from ..records import Action, plain
from ..store.base import Store
from ..store.records import StoredDecision
from ..store.views import HistoryFilter
from . import http, page, xmlrpc
from .api import (
    HANDLERS,
    JSON,
    DetailQuery,
    Health,
    ListQuery,
    Operation,
    RawQuery,
    Report,
    TraceRequest,
    answer,
    answered,
    document,
    read_query,
    read_struct,
    read_trace,
)
from .auth import Access, Guard
from .metrics import Metrics
from .robot_calls import Recorder
from .service import CellService

HUNG = 60.0  # seconds without a sign of the engine's thread, after which the server is not well


def routes(service: CellService) -> Sequence[BaseRoute]:
    """What is asked over HTTP."""
    return [Route(each.path, each.run, methods=[each.method]) for each in HttpApi(service).operations()]


class HttpApi:
    """What is answered over HTTP; a method's docstring is its summary in the OpenAPI document."""

    def __init__(self, service: CellService) -> None:
        self.service = service
        self._metrics = Metrics(service)

    def operations(self) -> list[Operation]:
        """Every path and method."""
        one: dict[str, Any] = {"trace": [0.1, 1.5, 2.25, None, 0.4], "request": "order-7", "part": "P-1007"}
        traces = one, {"trace": [[0.1, 1.5, 2.25], [0.0, 0.2, 0.1]]}
        reports = ({"id": "order-7", "success": True},)
        return [
            Operation("POST", "/decide", self.decide, "Answer", (409, 503), TraceRequest, RawQuery, traces, raw=True),
            Operation("POST", "/report", self.report, "Told", (404, 409, 503), Report, examples=reports),
            Operation("GET", "/status", self.status, "Status", (503,)),
            Operation("GET", "/decisions", self.decisions, "Decisions", (422, 503), query=ListQuery),
            Operation("GET", "/decisions/{id:path}", self.decision, "Decision", (404, 422, 503), query=DetailQuery),
            Operation("GET", "/metrics", self.metrics, "text/plain"),
            Operation("GET", "/healthz", self.healthz, "Health"),
            Operation("GET", "/openapi.json", self.openapi, JSON),
            Operation("GET", "/docs", self.docs, "text/html"),
        ]

    async def decide(self, request: Request) -> Response:
        """Decide on a trace; asked again under its request id, it answers the same. The query is of a raw body alone."""
        given = await self.service.decide(*await read_trace(request))
        return answered(answer("Answer", given.decision, given))

    async def report(self, request: Request) -> Response:
        """Report what became of a part; the label is on the disk when this answers. The same twice is no error."""
        said = await read_struct(request, Report)
        return answered(await self.service.report(said.id, said.success))

    async def status(self, request: Request) -> Response:
        """How the cell is doing."""
        await self.service.ask(lambda engine: engine.flush())
        found = answer("Status", self.service, await self.service.status())
        return answered(plain(msgspec.structs.asdict(found)))

    async def decision(self, request: Request) -> Response:
        """One decision with its label; with trace=true its trace too."""
        shown = read_query(request, DetailQuery)
        known = await self.service.find(request.path_params["id"])
        if known is None:
            raise UnknownDecisionError("Expected the id of a decision of this cell, got one that is unknown.")
        return answered(answer("Decision", known.decision, known, trace=known.trace if shown.trace else UNSET))

    async def decisions(self, request: Request) -> Response:
        """The newest decisions, newest first; with open=true those that wait for a label."""
        asked = read_query(request, ListQuery)
        found = await self.service.look(lambda store: _newest(store, asked.limit, asked.open))
        return answered({"decisions": [answer("Decision", each.decision, each, trace=UNSET) for each in found]})

    async def metrics(self, request: Request) -> Response:
        """What Prometheus reads."""
        body, kind = self._metrics.text()
        return Response(body, media_type=kind)

    async def healthz(self, request: Request) -> Response:
        """Whether the engine answers: ok; degraded (200): its store cannot be written; down (503). It asks for no token."""
        engine, alive = self.service.engine, self.service.silent < HUNG
        state = "down" if not alive else "degraded" if engine.store_fault else "ok"
        return answered(Health(state, engine.store_fault, self.service.waiting), 200 if alive else 503)

    async def openapi(self, request: Request) -> Response:
        """The OpenAPI document."""
        return answered(document(self.operations(), __version__))

    async def docs(self, request: Request) -> Response:
        """The same, to read."""
        return HTMLResponse(page.environment().get_template("docs.html").render(document(self.operations(), __version__)))


def _newest(store: Store, limit: int, waiting: bool) -> list[StoredDecision]:
    """Newest first. A forgotten label is none that is waited for."""
    where = HistoryFilter(action=Action.VERIFY, label="none") if waiting else HistoryFilter()
    found: list[StoredDecision] = []
    page = store.decisions(where, limit)
    while page and len(found) < limit:
        found += [past for past in reversed(page) if not waiting or past.source is None]
        page = store.decisions(where, limit, page[0].key)
    return found[:limit]


INTERFACES: Mapping[str, Callable[[CellService, Recorder | None], Sequence[BaseRoute]]] = {
    "http": lambda service, recorder: http.routes(service),
    "xmlrpc": xmlrpc.routes,
    "page": lambda service, recorder: page.routes(service),
}
Beside = Callable[[CellService], AbstractAsyncContextManager[object]]


def create_app(
    service: CellService,
    access: Access | None = None,
    interfaces: Sequence[str] = tuple(INTERFACES),
    beside: Sequence[Beside] = (),
    recorder: Recorder | None = None,
) -> Starlette:
    """The application; whoever made the service closes it, once the application has ended.

    access : who may ask, and how much; None: whoever is on this machine.
    interfaces : those that answer, of `INTERFACES`; their routes are tried in this order.
    beside : what runs in the same loop as long as the application does, an OPC UA server for one.
    recorder : of what a robot's program asks to decide on by `decide_recorded`; whoever made it closes it.
    SettingError for an interface that there is not.
    """
    if unknown := [name for name in interfaces if name not in INTERFACES]:
        raise SettingError(f"Expected interfaces among {', '.join(INTERFACES)}, got {shortened(unknown[0])}.")
    routes = [route for name in interfaces for route in INTERFACES[name](service, recorder)]

    @asynccontextmanager
    async def lifespan(app: Starlette) -> AsyncIterator[None]:
        async with AsyncExitStack() as stack:
            try:
                for begin in beside:
                    await stack.enter_async_context(begin(service))
            except Exception as error:
                app.state.failure = error  # uvicorn says only that it did not start
                raise
            yield

    guard = Middleware(Guard, access=access or Access())
    app = Starlette(routes=routes, middleware=[guard], exception_handlers=HANDLERS, lifespan=lifespan)
    app.router.redirect_slashes = False  # a robot does not follow; and where to, a request's Host would say
    return app
