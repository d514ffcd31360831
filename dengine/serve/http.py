"""HTTP: decide, report, put right, and what can be asked of the engine; the application, every interface behind one guard.

curl -d '{"trace": [0.1, 0.3, ...], "request": "order-7"}' -H 'Content-Type: application/json' localhost:8000/decide
app = create_app(CellService(lambda: DataEngine.open_or_create("cell.db"), "cell.db"))
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import AbstractAsyncContextManager, AsyncExitStack, asynccontextmanager
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar
from zipfile import ZipFile

import numpy as np
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import Response, StreamingResponse
from starlette.routing import BaseRoute, Route

from .. import __version__
from ..engine.corrections import Changed
from ..engine.engine import DataEngine
from ..errors import SettingError, UnknownDecisionError, shortened
from ..history.explain import explain
from ..history.map import part_map
from ..history.status import course
from ..records import Action, is_name
from ..store.base import Store
from ..store.records import Key, StoredDecision
from ..store.views import HistoryFilter
from . import api, page, xmlrpc
from .api import Json, Operation, Refusal, answer
from .auth import Access, Guard
from .metrics import Metrics
from .robot_calls import Recorder
from .service import CellService

T = TypeVar("T")
HUNG = 60.0  # seconds without a sign of the engine's thread, after which the server is not well
TICK = 5.0  # seconds of quiet, after which who listens is told that the line still stands
RETRY = 1000  # ms after which a browser that was cut off tries again
BADS, AMONG = 10, 200  # newest bad parts that an explanation is drawn with, of so many newest labels
CONFLICT = "Expected one decision of that part to report on, there are {}; say which by its id: {}."


def routes(service: CellService) -> Sequence[BaseRoute]:
    """What is asked over HTTP."""
    return [*(Route(each.path, each.serve, methods=[each.method]) for each in HttpApi(service).operations()), page.files()]


class HttpApi:
    """What is answered over HTTP; a method's docstring is its summary in the OpenAPI document."""

    def __init__(self, service: CellService) -> None:
        self.service = service
        self._metrics = Metrics(service)

    def operations(self) -> list[Operation]:
        """Every path and method."""
        one: Json = {"trace": [0.1, 1.5, 2.25, None, 0.4], "request": "order-7", "part": "P-1007"}
        traces = one, {"trace": [[0.1, 1.5, 2.25], [0.0, 0.2, 0.1]]}
        reports = {"id": "order-7", "success": True}, {"part": "P-1007", "success": False, "author": "Kim"}
        return [
            Operation("POST", "/decide", self.decide, "Answer", api.TraceRequest, raw=True, examples=traces),
            Operation("POST", "/report", self.report, "Told", api.Report, examples=reports),
            Operation("POST", "/correct", self.correct, "Changed", api.Correct),
            Operation("POST", "/forget", self.forget, "Changed", api.Forget),
            Operation("POST", "/rollback", self.rollback, "Changed", api.Rollback),
            Operation("POST", "/policy", self.policy, "Changed", api.PolicyChange),
            Operation("POST", "/retrain", self.retrain, "Changed", api.Signed),
            Operation("POST", "/export", self.export, "application/zip", api.Signed),
            Operation("GET", "/status", self.status, "Status", api.StatusQuery),
            Operation("GET", "/decisions", self.decisions, "Decisions", api.ListQuery),
            Operation("GET", "/decisions/{id:path}", self.decision, "Traced", api.DecisionQuery),
            Operation("GET", "/explanations/{id:path}", self.explanation, "Explanation", api.DecisionQuery),
            Operation("GET", "/course", self.course, "Course", api.Nothing),
            Operation("GET", "/embedding", self.embedding, "PartMap", api.Nothing),
            Operation("GET", "/versions", self.versions, "Versions", api.Nothing),
            Operation("GET", "/events", self.events, "Events", api.EventQuery),
            Operation("GET", "/changes", self.changes, "text/event-stream"),
            Operation("GET", "/metrics", self.metrics, "text/plain"),
            Operation("GET", "/healthz", self.healthz, "Health"),
            Operation("GET", "/openapi.json", self.openapi, api.JSON),
            Operation("GET", "/docs", self.docs, "text/html"),
        ]

    async def decide(self, request: Request) -> Json:
        """Decide on a trace; asked again under its request id, it answers the same. The query is of a raw body alone."""
        told = await self.service.decide(*await api.read_trace(request))
        return answer("Answer", told.decision, late=told.late, seconds=told.seconds)

    async def report(self, asked: Any) -> Json:
        """Report what became of a part; the label is on the disk when this answers. The same twice is no error."""
        if bool(asked.id) == bool(asked.part):
            raise Refusal(422, "Expected the id of a decision, or the part's number in its place.")
        author = _name(asked.author) if asked.author else ""
        id_ = asked.id or await self.service.look(lambda store: _only_one(store, asked.part))
        return answer("Told", await self.service.report(id_, asked.success, author))

    async def correct(self, asked: Any) -> Json:
        """Put a label right, from the next decision on; what was reported stays on record."""
        return await self._change(asked, lambda engine, by: engine.correct(asked.id, asked.success, by))

    async def forget(self, asked: Any) -> Json:
        """Leave labels out of all that is learned and counted; /correct brings one back."""
        reason = " ".join(asked.reason.split())
        return await self._change(asked, lambda engine, by: engine.forget(*asked.ids, author=by, reason=reason))

    async def rollback(self, asked: Any) -> Json:
        """Let an earlier version answer again, as a new version."""
        return await self._change(asked, lambda engine, by: engine.rollback(asked.version, by))

    async def policy(self, asked: Any) -> Json:
        """Decide by other settings from the next decision on; with shadow, verify every part, or end that."""

        def change(engine: DataEngine, by: str) -> Changed:
            return engine.set_policy(replace(engine.policy, **api.given(asked, type(engine.policy))), by)

        return await self._change(asked, change)

    async def retrain(self, asked: Any) -> Json:
        """Begin a retrain on all labels known by now, where none is under way."""

        def begin(engine: DataEngine, by: str) -> Changed:
            if engine.retraining:
                return Changed("retrain", "A retrain is under way already; nothing changed.", None, engine.version)
            engine.store.put_event("retrain", "asked for by hand", author=by)
            engine.start_retrain()
            return Changed("retrain", "The retrain has begun.", engine.store.events(1)[-1].number, engine.version)

        return await self._change(asked, begin)

    async def export(self, asked: Any) -> Response:
        """The model that answers now, as a TorchScript file with its checksum, in an archive."""

        def packed(engine: DataEngine) -> tuple[bytes, int]:
            from ..export import export_torchscript

            content = BytesIO()
            with TemporaryDirectory(prefix="dengine-export-") as folder, ZipFile(content, "w") as archive:
                export_torchscript(engine, Path(folder) / "model.ts")
                for file in sorted(Path(folder).iterdir()):
                    archive.write(file, file.name)
            engine.store.put_event("export", f"version {engine.version} was downloaded", author=by)
            return content.getvalue(), engine.version

        by = _name(asked.author)
        content, version = await self.service.ask(packed)
        headers = {"Content-Disposition": f'attachment; filename="model_{version}.zip"'}
        return Response(content, media_type="application/zip", headers=headers)

    async def status(self, asked: Any) -> Json:
        """How the cell is doing."""
        found, service = await self.service.status(asked.last, asked.watch), self.service
        line = {name: getattr(service, name) for name in api.IN_LINE}
        return answer("Status", found, alarm=found.alarm, **line)

    async def decision(self, asked: Any) -> Json:
        """One decision with its label; with trace=true its trace too."""
        known = await self.service.find(asked.id)
        if known is None:
            raise _unknown()
        return answer("Traced", known, trace=known.trace if asked.trace else None)

    async def decisions(self, asked: Any) -> Json:
        """Decisions, newest first; with open=true those that wait for a label."""
        where = HistoryFilter(**api.given(asked, HistoryFilter))
        before = _key(asked.before) if asked.before else None
        found = await self.service.look(lambda store: _newest(store, where, asked.limit, before, asked.open))
        older = f"{found[-1].time!r},{found[-1].decision.id}" if len(found) == asked.limit else None
        return {"decisions": [answer("Decision", each) for each in found], "older": older}

    async def explanation(self, asked: Any) -> Json:
        """Why a decision came out as it did, with its trace, the band of good parts, and some bad ones."""
        return await self.service.look(lambda store: _explained(store, asked.id))

    async def course(self, asked: Any) -> Json:
        """How decisions went from the first to the newest, in stretches, and the retrains and safe modes meanwhile."""
        recipe = self.service.engine.recipe
        return answer("Course", await self.service.look(lambda store: course(store, recipe, AMONG)))

    async def embedding(self, asked: Any) -> Json:
        """Where the known and the newest parts lie for the model that answers."""
        engine = self.service.engine
        return answer("PartMap", await self.service.look(lambda store: part_map(store, engine.recipe, engine.version)))

    async def versions(self, asked: Any) -> Json:
        """Every retrain; kept: its model can be rolled back to."""
        return answer("Versions", versions=await self.service.look(lambda store: store.versions()))

    async def events(self, asked: Any) -> Json:
        """What happened beside decisions, and who did it; newest first."""
        return answer("Events", events=(await self.service.look(lambda store: store.events(asked.limit)))[::-1])

    async def changes(self, request: Request) -> Response:
        """Server-sent events: hello, with the server's version; changed, whenever something has; tick, in quiet."""

        async def told() -> AsyncIterator[str]:
            yield f"retry: {RETRY}\nevent: hello\ndata: {__version__}\n\n"
            async for changed in self.service.changes(TICK):
                yield f"event: {'changed' if changed else 'tick'}\ndata: -\n\n"

        return StreamingResponse(told(), media_type="text/event-stream")

    async def metrics(self, request: Request) -> Response:
        """What Prometheus reads."""
        body, kind = self._metrics.text()
        return Response(body, media_type=kind)

    async def healthz(self, request: Request) -> Response:
        """Whether the engine answers: ok; degraded (200): its store cannot be written; down (503). It asks for no token."""
        engine, alive = self.service.engine, self.service.silent < HUNG
        state = "down" if not alive else "degraded" if engine.store_fault else "ok"
        return api.answered(api.Health(state, engine.store_fault, self.service.waiting), 200 if alive else 503)

    async def openapi(self, request: Request) -> Json:
        """The OpenAPI document."""
        return api.document(self.operations(), __version__)

    async def docs(self, request: Request) -> Response:
        """The same, to read."""
        return await page.shown(request)

    async def _change(self, asked: api.Signed, work: Callable[[DataEngine, str], Changed]) -> Json:
        """What a change by somebody did."""
        author = _name(asked.author)
        return answer("Changed", await self.service.ask(lambda engine: work(engine, author)))


def _name(author: str) -> str:
    """An author's name for the event log; Refusal for none."""
    name = " ".join(author.split())
    if not is_name(name):
        raise Refusal(422, "Expected author, the name of who asks for it, for the event log.")
    return name


def _unknown() -> UnknownDecisionError:
    return UnknownDecisionError("Expected the id of a decision of this cell, got one that is unknown.")


def _only_one(store: Store, part: str) -> str:
    """The id of the one decision of a part that a label can be of; of a part that is unknown, it may be the id itself."""
    found = [each for each in store.decisions(HistoryFilter(part=part), 20) if each.decision.action is not Action.REJECT]
    found = found or [each for each in [store.get_decision(part, trace=False)] if each is not None]
    if not found:
        got = f"{shortened(part)}, which is unknown"
        raise UnknownDecisionError(f"Expected the number of a part that was decided on and not rejected, got {got}.")
    if len(found) > 1:
        raise Refusal(409, CONFLICT.format(len(found), ", ".join(each.decision.id for each in reversed(found))))
    return found[0].decision.id


def _key(text: str) -> Key:
    time, _, id_ = text.partition(",")
    try:
        return float(time), id_
    except ValueError as error:
        raise Refusal(422, "Expected before as an answer said it, as `older`.") from error


def _newest(store: Store, where: HistoryFilter, limit: int, before: Key | None, waiting: bool) -> list[StoredDecision]:
    """Newest first. A forgotten label is none that is waited for."""
    where = replace(where, action=Action.VERIFY, label="none") if waiting else where
    found: list[StoredDecision] = []
    while len(found) < limit and (page := store.decisions(where, limit, before)):
        found += [past for past in reversed(page) if not waiting or past.source is None]
        before = page[0].key
    return found[:limit]


def _explained(store: Store, id_: str) -> Json:
    if store.get_decision(id_, trace=False) is None:
        raise _unknown()
    found, labelled = explain(store, id_), store.labelled(AMONG)
    trace, band = found.trace, found.envelope
    bads = labelled.traces[labelled.labels == 0][-BADS:]
    bads = bads if bads.shape[1:] == trace.shape else np.zeros((0, *trace.shape))
    digits = 4 - int(np.log10(np.ptp(np.nan_to_num(trace, posinf=0.0, neginf=0.0)) or 1.0))  # what lies around is a picture
    around = {name: getattr(band, name, None) for name in ("low", "median", "high")} | {"bads": bads}
    drawn = {name: None if each is None else np.round(each.astype(np.float64), digits) for name, each in around.items()}
    corrections = [each for each in store.corrections() if each.decision_id == id_]
    return answer("Explanation", found, trace=trace, corrections=corrections, **drawn)


INTERFACES: Mapping[str, Callable[[CellService, Recorder | None], Sequence[BaseRoute]]] = {
    "http": lambda service, recorder: routes(service),
    "xmlrpc": xmlrpc.routes,
    "page": lambda service, recorder: page.routes(),
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
    every = [route for name in interfaces for route in INTERFACES[name](service, recorder)]

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
    app = Starlette(routes=every, middleware=[guard], exception_handlers=api.HANDLERS, lifespan=lifespan)
    app.router.redirect_slashes = False  # a robot does not follow; and where to, a request's Host would say
    return app
