"""HTTP: decide, report, put right, what can be asked of the engine, and the page; the application behind one guard.

curl -d '{"trace": [0.1, 0.3, ...], "request": "order-7"}' -H 'Content-Type: application/json' localhost:8000/decide
app = create_app(CellService(lambda: DataEngine.open_or_create("cell.db"), "cell.db"))
"""

from __future__ import annotations

import asyncio
import copy
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import AbstractAsyncContextManager, AsyncExitStack, asynccontextmanager
from dataclasses import replace
from functools import cached_property
from itertools import islice
from pathlib import Path
from shutil import make_archive
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from msgspec import Meta
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import FileResponse, Response, StreamingResponse
from starlette.routing import BaseRoute, Mount, Route
from starlette.staticfiles import StaticFiles

from .. import __version__
from ..decision.policy import Policy
from ..engine.corrections import Changed
from ..engine.engine import DataEngine, core_of
from ..errors import expect
from ..history.explain import explain, find_decision_id
from ..history.map import part_map
from ..history.status import NEWEST, iterate_decisions, read_course
from ..model.base import Exportable
from ..records import Action, is_name
from ..store.records import StoredDecision, unknown_decision
from ..store.views import HistoryFilter
from . import api
from .api import Json, Operation, Refusal, answer, fields_of
from .auth import CURRENT_TOKEN, Access, Guard
from .metrics import Metrics
from .robot_calls import Recorder
from .service import CellService
from .xmlrpc import routes as xmlrpc_routes

if TYPE_CHECKING:
    from ..store.sql import SqlStore

HUNG = 60.0  # seconds without a sign of the engine's thread, after which the server is not well
TICK = 5.0  # seconds of quiet, after which who listens is told that the line still stands
RETRY = 1000  # ms after which a browser that was cut off tries again
BADS, AMONG = 10, 200  # newest bad parts that an explanation is drawn with, of so many newest labels
STATIC = Path(__file__).parent / "page" / "static"
VIEWS = ("/", "/overview", "/map", "/part", "/history", "/actions")  # one file: its script shows the one that is asked for
Limit = Annotated[int, Meta(ge=1, le=200)]
SHORTEST = 0.0003  # hours of a stretch
Hours = Annotated[float, Meta(ge=0.0, le=1e7)]
Beside = Callable[[CellService], AbstractAsyncContextManager[object]]


class HttpApi:
    """What is answered over HTTP; a method's docstring and parameters are what the OpenAPI document says of it."""

    def __init__(self, service: CellService) -> None:
        self.service = service
        self._metrics = Metrics(service)

    @cached_property
    def operations(self) -> list[Operation]:
        """Every path and method."""
        one: Json = {"trace": [0.1, 1.5, 2.25, None, 0.4], "request": "order-7", "part": "P-1007"}
        traces = one, {"trace": [[0.1, 1.5, 2.25], [0.0, 0.2, 0.1]]}
        reports = {"id": "order-7", "success": True}, {"part": "P-1007", "success": False, "author": "Kim"}
        # A guarantee may be a class by name, and nothing that is asked over the network may have one imported.
        policy = fields_of(Policy, "guarantee") | {"windows": list[str]}
        return [
            Operation("POST", "/decide", self.decide, "Answer", raw="trace", examples=traces),
            Operation("POST", "/report", self.report, "Told", examples=reports),
            Operation("POST", "/correct", self.correct, "Changed"),
            Operation("POST", "/forget", self.forget, "Changed"),
            Operation("POST", "/rollback", self.rollback, "Changed"),
            Operation("POST", "/policy", self.policy, "Changed", policy),
            Operation("POST", "/retrain", self.retrain, "Changed"),
            Operation("POST", "/export", self.export, "application/zip"),
            Operation("GET", "/status", self.status, "Status"),
            Operation("GET", "/decisions", self.decisions, "Decisions", fields_of(HistoryFilter, "label")),
            Operation("GET", "/decisions/{id:path}", self.decision, "Decision"),
            Operation("GET", "/explanations/{id:path}", self.explanation, "Explanation"),
            Operation("GET", "/course", self.course, "Course"),
            Operation("GET", "/embedding", self.embedding, "PartMap"),
            Operation("GET", "/versions", self.versions, "Versions"),
            Operation("GET", "/events", self.events, "Events"),
            Operation("GET", "/me", self.me, "Me"),
            Operation("GET", "/changes", self.changes, "text/event-stream"),
            Operation("GET", "/metrics", self.metrics, "text/plain"),
            Operation("GET", "/healthz", self.healthz, "Health"),
            Operation("GET", "/openapi.json", self.openapi, api.JSON),
            Operation("GET", "/docs", self.docs, "text/html"),
        ]

    async def decide(
        self,
        trace: bytes | api.Samples,
        request: str | None = None,
        part: str | int | None = None,
        channels: Annotated[int, Meta(ge=1, le=99_999)] = 1,
    ) -> Json:
        """Decide on a trace; asked again under its request id, it answers the same. The query is of a raw body alone.

        trace : (samples,) or (channels, samples), null for a missing sample; or bytes, raw float32, little-endian.
        request : the caller's id of this trace, once for every trace.  part : the part's number, where one is known.
        channels : of bytes, one after another.
        """
        told = await self.service.decide(api.as_samples(trace, channels), request, part)
        return answer("Answer", told.decision, late=told.late, seconds=told.seconds)

    async def report(self, success: bool | float, id_: str = "", part: str = "", author: str = "") -> Json:
        """Report what became of a part; the label is on the disk when this answers. The same twice is no error.

        id : of the decision.  part : its number in the place of that, where there is one decision of it; or the id.
        success : true, or 1: good; false, or 0: bad, of an accepted part that came back a system stop. Of a rejected part
            that was looked at afterwards it is an inspection.
        author : who says so, for the event log, where the token has no name; a robot leaves it out.
        """
        by = _name(author) if author or CURRENT_TOKEN.get().name else ""
        return answer("Told", await self.service.report(await self._of(id_, part), success, by))

    async def _of(self, id_: str, part: str) -> str:
        if bool(id_) == bool(part):
            raise Refusal(422, "Expected the id of a decision, or the part's number in its place.")
        return id_ or await self.service.look(lambda store: find_decision_id(store, part))

    async def correct(self, success: bool, id_: str = "", part: str = "", author: str = "") -> Json:
        """Put a label right, from the next decision on; what was reported stays on record.

        success : what it counts as from now on.  id, part : of the decision, as in /report.
        author : who asks, for the event log.
        """
        found = await self._of(id_, part)
        return await self._change(author, lambda engine, by: engine.correct(found, success, by))

    async def forget(self, ids: list[str], author: str = "", reason: str = "") -> Json:
        """Leave labels out of all that is learned and counted; /correct brings one back.

        ids : of the decisions.  author, reason : for the event log.
        """
        why = " ".join(reason.split())
        return await self._change(author, lambda engine, by: engine.forget(*ids, author=by, reason=why))

    async def rollback(self, version: int, author: str = "") -> Json:
        """Let an earlier version answer again, as a new version.

        version : its number, as /versions lists it.  author : who asks, for the event log.
        """
        return await self._change(author, lambda engine, by: engine.rollback(version, by))

    async def policy(self, author: str = "", **changes: Any) -> Json:
        """Decide by other settings from the next decision on; with shadow, verify every part, or end that."""
        return await self._change(author, lambda engine, by: engine.set_policy(replace(engine.policy, **changes), by))

    async def retrain(self, author: str = "") -> Json:
        """Begin a retrain on all labels known by now, where none is under way."""

        def begin(engine: DataEngine, by: str) -> Changed:
            if core_of(engine).is_retraining:
                return Changed("retrain", "A retrain is under way already; nothing changed.", None, engine.version)
            engine.store.put_event("retrain", "asked for by hand", author=by)
            core_of(engine).start_retrain()
            return Changed("retrain", "The retrain has begun.", engine.store.events(1)[-1].number, engine.version)

        return await self._change(author, begin)

    async def export(self, author: str = "") -> Response:
        """The model that answers now, as a TorchScript file with its checksum, in an archive.

        An accepted part that waits for its confirmation is not in it: that stays with the engine.
        """

        def copied(engine: DataEngine) -> Exportable:
            found = core_of(engine).exported()
            return replace(found, model=copy.deepcopy(found.model))  # the engine goes on learning meanwhile

        by, source = _name(author), await self.service.ask(copied)
        content = await asyncio.to_thread(_packed, source)
        told = f"version {source.model_version} was downloaded"
        await self.service.ask(lambda engine: engine.store.put_event("export", told, author=by))
        headers = {"Content-Disposition": f'attachment; filename="model_{source.model_version}.zip"'}
        return Response(content, media_type="application/zip", headers=headers)

    async def status(self, last: Annotated[int, Meta(ge=1, le=100_000)] = NEWEST, watch: bool = False) -> Json:
        """How the cell is doing.

        last : the newest so many decisions are looked at apart.  watch : how far the safe mode's detectors are, too.
        """
        found, service = await self.service.status(last, watch), self.service
        line = {name: getattr(service, name) for name in api.IN_LINE}
        return answer("Status", found, alarm=found.alarm, **line)

    async def decision(self, id_: str, trace: bool = False) -> Json:
        """One decision with its label.  trace : with its samples too."""
        known = await self._known(id_)
        return answer("Decision", known, trace=known.trace if trace else None)

    async def decisions(
        self,
        label: Literal["good", "bad", "none"] | None = None,
        open_: bool = False,
        limit: Limit = 20,
        before: str = "",
        **where: Any,
    ) -> Json:
        """Decisions, newest first; with open=true verified ones that wait for a label.

        limit : how many at most.  before : older ones than this one, by its id, as the answer before said it, `older`.
        since, until : times in seconds, the first included, the last not.
        predicted : what the model alone would have done.  part : its number.
        """
        asked, beyond = HistoryFilter(label=label, **where), (await self._known(before)).decision.id if before else None
        found = await self.service.look(lambda store: _newest(store, asked, limit, beyond, open_))
        older = found[-1].decision.id if len(found) == limit else None
        return {"decisions": [answer("Decision", each, trace=None) for each in found], "older": older}

    async def explanation(self, id_: str) -> Json:
        """Why a decision came out as it did, with its trace, the band of good parts, and some bad ones.

        id : of the decision, or its part's number.
        """
        return await self.service.look(lambda store: _explained(store, id_))

    async def course(self, hours: Hours = 0.0, start: Hours = 0.0, batch: Annotated[str, Meta(max_length=9)] = "") -> Json:
        """How decisions went from the first to the newest, in stretches, and the retrains and safe modes meanwhile.

        hours : of a shift, which is a stretch then, the newest of them, or 0; start : when one begins, in hours since 1970.
        batch : likewise what parts' numbers begin with: so many characters, or up to the last of these, "-/".
        """
        whole = hours == 0.0 or hours >= SHORTEST
        expect(whole, f"hours of 0, or of {SHORTEST} or more, a second", hours)
        recipe, by = self.service.engine.recipe, {"seconds": 3600.0 * hours, "start": 3600.0 * start, "batch": batch}
        by = by if hours or batch else {}
        return answer("Course", await self.service.look(lambda store: read_course(store, recipe, AMONG, **by)))

    async def embedding(self) -> Json:
        """Where the known and the newest parts lie for the model that answers."""
        engine = self.service.engine
        return answer("PartMap", await self.service.look(lambda store: part_map(store, engine.recipe, engine.version)))

    async def versions(self) -> Json:
        """Every retrain; kept: its model can be rolled back to."""
        return answer("Versions", versions=await self.service.look(lambda store: store.versions()))

    async def events(self, limit: Limit = 20) -> Json:
        """What happened beside decisions, and who did it; newest first.  limit : how many at most."""
        return answer("Events", events=(await self.service.look(lambda store: store.events(limit)))[::-1])

    async def changes(self) -> Response:
        """Server-sent events: hello, with the server's version; changed, whenever something has; tick, in quiet."""

        async def told() -> AsyncIterator[str]:
            yield f"retry: {RETRY}\nevent: hello\ndata: {__version__}\n\n"
            async for changed in self.service.changes(TICK):
                yield f"event: {'changed' if changed else 'tick'}\ndata: -\n\n"

        return StreamingResponse(told(), media_type="text/event-stream")

    async def me(self) -> Json:
        """Whose token was shown, and what it may."""
        return answer("Me", CURRENT_TOKEN.get())

    async def metrics(self) -> Response:
        """What Prometheus reads."""
        body, kind = self._metrics.text()
        return Response(body, media_type=kind)

    async def healthz(self) -> Response:
        """Whether the engine answers: ok; degraded (200); down (503). It asks for no token.

        Degraded: the store cannot be written, or retrains are dropped again and again.
        """
        core, alive = self.service.core, self.service.silent < HUNG
        faults = core.store_fault, core.retrain_fault
        state = "down" if not alive else "degraded" if any(faults) else "ok"
        return api.answered(api.Health(state, *faults, self.service.waiting), 200 if alive else 503)

    async def openapi(self) -> Json:
        """The OpenAPI document."""
        return api.document(self.operations, __version__)

    async def docs(self) -> Response:
        """The same, to read."""
        return FileResponse(STATIC / "docs.html")

    async def _known(self, id_: str) -> StoredDecision:
        known = await self.service.find(id_)
        if known is None:
            raise unknown_decision(id_)
        return known

    async def _change(self, author: str, work: Callable[[DataEngine, str], Changed]) -> Json:
        by = _name(author)
        return answer("Changed", await self.service.ask(lambda engine: work(engine, by)))


def _name(author: str) -> str:
    """An author's name for the event log, the token's where it has one; Refusal for none, and for another than that."""
    owner, name = CURRENT_TOKEN.get().name, " ".join(author.split())
    if owner and name not in ("", owner):
        raise Refusal(422, f"Expected author to be {owner}, whose token it is, or to be left out.")
    if not is_name(owner or name):
        raise Refusal(422, "Expected author, the name of who asks for it, for the event log.")
    return owner or name


def _newest(store: SqlStore, where: HistoryFilter, limit: int, before: str | None, waiting: bool) -> list[StoredDecision]:
    """Newest first. A forgotten label is none that is waited for."""
    where = replace(where, action=Action.VERIFY, label="none") if waiting else where
    decisions = iterate_decisions(store, where, limit, before)
    return list(islice((past for past in decisions if not waiting or past.source is None), limit))


def _explained(store: SqlStore, id_: str) -> Json:
    found, labelled = explain(store, id_), store.labelled(AMONG)
    trace, band = found.trace, found.envelope
    bads = labelled.traces[labelled.labels == 0][-BADS:]
    bads = bads if bads.shape[1:] == trace.shape else np.zeros((0, *trace.shape))
    finite = np.nan_to_num(trace, posinf=0.0, neginf=0.0).astype(np.float64)  # float32's own range overflows
    digits = 4 - int(np.log10(np.ptp(finite) or 1.0))  # what lies around is a picture
    around = {name: getattr(band, name, None) for name in ("low", "median", "high")} | {"bads": bads}
    drawn = {name: None if each is None else np.round(each.astype(np.float64), digits) for name, each in around.items()}
    corrections = [each for each in store.corrections() if each.decision_id == found.decision.decision.id]
    return answer("Explanation", found, trace=trace, corrections=corrections, **drawn)


def _packed(source: Exportable) -> bytes:
    from ..export import export_torchscript

    with TemporaryDirectory(prefix="dengine-export-") as folder:
        (Path(folder) / "model").mkdir()
        export_torchscript(source, Path(folder) / "model" / "model.ts")
        return Path(make_archive(f"{folder}/packed", "zip", f"{folder}/model")).read_bytes()


async def _page(request: Request) -> Response:
    return FileResponse(STATIC / "index.html")


def create_app(
    service: CellService,
    access: Access | None = None,
    *,
    xmlrpc: bool = True,
    page: bool = True,
    beside: Sequence[Beside] = (),
    recorder: Recorder | None = None,
) -> Starlette:
    """The application; whoever made the service closes it, once the application has ended.

    access : who may ask, and how much; None: whoever is on this machine.
    xmlrpc, page : whether XML-RPC and the live page are served beside HTTP.
    beside : what runs in the same loop as long as the application does, an OPC UA server for one.
    recorder : of what a robot's program asks to decide on by `decide_recorded`; whoever made it closes it.
    """
    every: list[BaseRoute] = [Route(each.path, each.serve, methods=[each.method]) for each in HttpApi(service).operations]
    every += [Mount("/page/static", StaticFiles(directory=STATIC))]  # of /docs too
    every += xmlrpc_routes(service, recorder) if xmlrpc else []
    every += [Route(path, _page) for path in VIEWS] if page else []

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
