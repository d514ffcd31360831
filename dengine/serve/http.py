"""HTTP and JSON: decide, report, and what can be asked of the engine.

    curl -d '{"trace": [0.1, 0.3, ...], "request": "order-7"}' -H 'Content-Type: application/json' localhost:8000/decide

What each answers is in `openapi`, which the tests hold to these routes.

The web application in front of one engine: the interfaces' routes behind one guard.

    app = create_app(CellService(lambda: DataEngine.open_or_create("cell.db"), "cell.db"))

Each interface is a module of this package that gives its routes; `INTERFACES` names them.
"""

from __future__ import annotations

import json
import math
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from contextlib import AbstractAsyncContextManager, AsyncExitStack, asynccontextmanager
from typing import Any

from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import HTMLResponse, Response
from starlette.routing import BaseRoute, Route

from .. import __version__
from ..errors import ReportError, SettingError, TraceError, shortened
from ..records import Action, Decision, as_success, plain
from ..store.base import Store
from ..store.records import StoredDecision
from ..store.views import HistoryFilter, PastDecision
from . import http, page, xmlrpc
from .api import HANDLERS, MOST_OPEN, OPEN, Refusal, as_page, document, report_request, trace_request
from .auth import Access, Guard
from .metrics import Metrics
from .robot_calls import Recorder
from .service import Answer, CellService

HUNG = 60.0  # seconds without a sign of the engine's thread, after which the server is not well
Endpoint = Callable[[Request], Awaitable[Response]]


def routes(service: CellService) -> Sequence[BaseRoute]:
    """What is asked over HTTP."""
    api = HttpApi(service, Metrics(service))
    return [
        Route("/decide", api.decide, methods=["POST"]),
        Route("/report", api.report, methods=["POST"]),
        Route("/status", api.status, methods=["GET"]),
        Route("/decisions", api.decisions, methods=["GET"]),
        Route("/decisions/{id:path}", api.decision, methods=["GET"]),
        Route("/metrics", api.metrics, methods=["GET"]),
        Route("/healthz", api.healthz, methods=["GET"]),
        Route("/openapi.json", api.openapi, methods=["GET"]),
        Route("/docs", api.docs, methods=["GET"]),
    ]


class HttpApi:
    """What is answered over HTTP."""

    def __init__(self, service: CellService, metrics: Metrics) -> None:
        self.service = service
        self._metrics = metrics

    async def decide(self, request: Request) -> Response:
        """Decide on a trace; 409 where its id is another trace's."""
        asked = await trace_request(request)
        try:
            return answered(answer_record(await self.service.decide(asked.trace, asked.request, asked.part)))
        except TraceError as error:
            known = None if asked.request is None else await self.service.find(asked.request)
            raise Refusal(422 if known is None else 409, str(error)) from error

    async def report(self, request: Request) -> Response:
        """Report what became of a decision; 404 for an unknown one, 409 for a label against the first."""
        said = await report_request(request)
        success = as_success(said.success)
        try:
            told = await self.service.report(said.id, success)
        except ReportError as error:
            raise Refusal(await self._status_of(said.id), str(error)) from error
        return answered(plain(told))

    async def _status_of(self, decision_id: str) -> int:
        """Why a report was refused: its id is none, its decision is unknown, or contradicts it."""
        try:
            known = await self.service.find(decision_id)
        except ReportError:  # it is no id
            return 422
        if known is None:
            return 404
        return 409 if known.source is not None or known.action is Action.REJECT else 422

    async def status(self, request: Request) -> Response:
        """How the engine stands, and what its store counts."""
        counts = await self.service.look(lambda store: store.status())
        return answered(plain(facts(self.service) | {"store": counts}))

    async def decision(self, request: Request) -> Response:
        """One decision with its label; its trace too, where `trace=true`."""
        try:
            known = await self.service.find(request.path_params["id"])
        except ReportError as error:
            raise Refusal(404, str(error)) from error
        if known is None:
            raise Refusal(404, "Expected the id of a decision of this cell, got one that is unknown.")
        return answered(stored_record(known, _flag(request, "trace")))

    async def decisions(self, request: Request) -> Response:
        """The newest decisions, newest first; with `open=true` the verified ones that wait for a label."""
        limit, waiting = _limit(request), _flag(request, "open")
        found = await self.service.look(lambda store: _newest(store, limit, waiting))
        return answered({"decisions": [past_record(each) for each in found]})

    async def metrics(self, request: Request) -> Response:
        """Counters and histograms as Prometheus reads them."""
        body, kind = self._metrics.text()
        return Response(body, media_type=kind)

    async def healthz(self, request: Request) -> Response:
        """Whether the engine answers: ok, degraded (its store cannot be written, and labels wait in a journal) or down."""
        engine, alive = self.service.engine, self.service.silent < HUNG
        state = "down" if not alive else "degraded" if engine.store_fault else "ok"
        said = {"status": state, "store_fault": engine.store_fault, "waiting": self.service.waiting}
        return answered(plain(said), 200 if alive else 503)

    async def openapi(self, request: Request) -> Response:
        """What this server answers, as OpenAPI has it."""
        return answered(document(__version__))

    async def docs(self, request: Request) -> Response:
        """The same, to read."""
        return HTMLResponse(as_page(document(__version__)))


def answered(body: Mapping[str, Any], status: int = 200) -> Response:
    """A JSON answer."""
    return Response(json.dumps(body, allow_nan=False, separators=(",", ":")), status, media_type="application/json")


def answer_record(answer: Answer) -> dict[str, Any]:
    """An answer as JSON has it."""
    return decision_record(answer.decision) | {"late": answer.late, "seconds": answer.seconds}


def decision_record(decision: Decision | StoredDecision) -> dict[str, Any]:
    """A decision as JSON has it. By hand, for a robot waits for it: `plain` looks for passwords in every word."""
    return {
        "id": decision.id,
        "action": decision.action.value,
        "predicted": decision.predicted.value,
        "reason": decision.reason.value,
        "lower": _finite(decision.lower),
        "upper": _finite(decision.upper),
        "n_success": decision.n_success,
        "n_failure": decision.n_failure,
        "audit": decision.audit,
        "propensity": _finite(decision.propensity),
        "model_version": decision.model_version,
        "embedding": None if decision.embedding is None else [[_finite(v) for v in z] for z in decision.embedding],
        "part": decision.part,
    }


def stored_record(known: StoredDecision, with_trace: bool) -> dict[str, Any]:
    """A decision and its label as JSON has it."""
    source = None if known.source is None else known.source.value
    record = decision_record(known) | {"quarantined": known.quarantined, "success": known.success, "source": source}
    return record | ({"trace": [[_finite(float(v)) for v in row] for row in known.trace]} if with_trace else {})


def past_record(past: PastDecision) -> dict[str, Any]:
    """A decision in a list as JSON has it; without its hash, for JavaScript has no integers of 64 bits."""
    record: dict[str, Any] = plain(past)
    del record["content_hash"]
    return record


def facts(service: CellService) -> dict[str, Any]:
    """How the engine and the line in front of it stand."""
    engine = service.engine
    return {
        "cell": engine.store.cell_id,
        "version": engine.version,
        "policy": engine.policy,
        "reducer": engine.recipe.name,
        "trace": engine.trace,
        "shadow": engine.shadow,
        "safe_mode": engine.safe_mode,
        "retraining": engine.retraining,
        "new_labels": engine.new_labels,
        "retrain_every": engine.recipe.retrain_every,
        "store_fault": engine.store_fault,
        "waiting": service.waiting,
        "late": service.late,
        "busy": service.busy,
        "deadline": service.deadline,
    }


def _newest(store: Store, limit: int, waiting: bool) -> list[PastDecision]:
    """Newest first. A forgotten label is none that is waited for."""
    where = HistoryFilter(action=Action.VERIFY, label="none") if waiting else HistoryFilter()
    found: list[PastDecision] = []
    page = store.decisions(where, limit)
    while page and len(found) < limit:
        found += [past for past in reversed(page) if not waiting or past.source is None]
        page = store.decisions(where, limit, page[0].key)
    return found[:limit]


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _flag(request: Request, name: str) -> bool:
    value = request.query_params.get(name, "false")
    if value not in ("true", "false"):
        raise Refusal(422, f"Expected {name}=true or false.")
    return value == "true"


def _limit(request: Request) -> int:
    text = request.query_params.get("limit", str(OPEN))
    if not (text.isascii() and text.isdecimal() and len(text) < 5 and 1 <= int(text) <= MOST_OPEN):
        raise Refusal(422, f"Expected limit to be a whole number from 1 to {MOST_OPEN}.")
    return int(text)


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
