r"""`HttpApi`, the handlers of the HTTP interface of a cell, and `create_app`, the Starlette
application that serves it together with XML-RPC and the web page.

curl -d '{"trace": [0.1, 0.3, ...], "request": "order-7"}' \
    -H 'Content-Type: application/json' localhost:8000/decide
app = create_app(CellService(lambda: DataEngine.open_or_create("cell.db"), "cell.db"))
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from dataclasses import replace
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from msgspec import Meta
from prometheus_client import CONTENT_TYPE_LATEST
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import FileResponse, Response, StreamingResponse
from starlette.routing import BaseRoute, Mount, Route
from starlette.staticfiles import StaticFiles

from .. import __version__
from ..decision.policy import Policy
from ..engine.corrections import Changed
from ..engine.engine import DataEngine
from ..history.explain import explain, find_decision_id
from ..history.map import PartMap, part_map
from ..history.status import Course, iterate_decisions, read_course
from ..records import Action, is_name
from ..store.records import StoredDecision, unknown_decision
from ..store.views import HistoryFilter
from . import api
from .api import Json, Operation, field_types, response_fields
from .auth import CURRENT_TOKEN, Guard, Token
from .metrics import Metrics
from .robot_calls import RobotCalls
from .service import CellService, ReportResponse, ServiceResponse
from .xmlrpc import rpc_route

if TYPE_CHECKING:
    from ..cells.ur.recorder import RtdeRecorder
    from ..store.sql import SqlStore

MAX_SILENT = 60.0  # seconds without a sign of the engine's thread, after which the server is down
TICK = 5.0  # seconds without a change, after which a listener to /changes gets a sign of life
RECONNECT_MS = 1000  # after which a browser that lost /changes connects again
N_BADS = 10  # newest bad parts drawn in an explanation
N_LABELS = 200  # newest labels among which they are looked for
STATIC = Path(__file__).parent / "page" / "static"
# All are index.html, whose script shows the view of the URL.
VIEWS = ("/", "/overview", "/map", "/part", "/history", "/actions")

# Types of requests' fields
Id = Annotated[str, Meta(description="Of the decision.")]
PartNumber = Annotated[
    str,
    Meta(
        description="The part's number, in place of the id, if it has one decision beside rejects."
    ),
]
Author = Annotated[
    str,
    Meta(
        description="Who asks, for the event log; may be left out if the token has a name, and "
        "left out by a robot that reports."
    ),
]
Limit = Annotated[int, Meta(ge=1, le=200, description="How many at most.")]
ShiftHours = Annotated[
    int,
    Meta(ge=0, le=10**7, description="Length of a shift, which is then a stretch; 0: no shifts."),
]
ShiftStart = Annotated[
    float, Meta(ge=0.0, le=1e7, description="When a shift begins, in hours since 1970.")
]


class HttpApi:
    """The handlers of all HTTP requests.

    A handler's parameters are the request's fields, and its docstring is its summary in the OpenAPI
    document. What it may return is said by `Operation`. What it raises becomes a `Problem`, as
    `api.STATUSES` says.

    Parameters
    ----------
    service : CellService
    """

    def __init__(self, service: CellService) -> None:
        self.service = service
        self._metrics = Metrics(service)

    @cached_property
    def operations(self) -> list[Operation]:
        """List the `Operation` of every path and method of the HTTP interface; cached.

        An `Operation` has the path, the method, the handler that answers, and the type of its
        response. XML-RPC and the web page are not among them (see `create_app`).
        """
        # A guarantee may name a class, and no request over the network may cause an import.
        policy = field_types(Policy, "guarantee") | {"force_limits": list[str]}
        return [
            Operation("POST", "/decide", self.decide, "DecideResponse", raw_parameter="trace"),
            Operation("POST", "/report", self.report, "ReportResponse"),
            Operation("POST", "/correct", self.correct, "Changed"),
            Operation("POST", "/forget", self.forget, "Changed"),
            Operation("POST", "/rollback", self.rollback, "Changed"),
            Operation("POST", "/release", self.release, "Changed"),
            Operation("POST", "/policy", self.policy, "Changed", policy),
            Operation("POST", "/retrain", self.retrain, "Changed"),
            Operation("GET", "/status", self.status, "Status"),
            Operation("GET", "/decisions", self.decisions, "Decisions", field_types(HistoryFilter)),
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
        trace: Annotated[
            bytes | api.Samples,
            Meta(
                description="(samples,) or (channels, samples), null for a missing sample; or "
                "bytes, raw float32, little-endian, channel after channel."
            ),
        ],
        request: Annotated[
            str | None,
            Meta(description="The caller's id of this trace, a different one for each trace."),
        ] = None,
        part: Annotated[str | int | None, Meta(description="The part's number.")] = None,
        channels: Annotated[int, Meta(ge=1, le=99_999, description="Of bytes.")] = 1,
    ) -> ServiceResponse:
        """Decide on a trace. The same trace and request id get the same decision; another trace
        with that id gets 409; a trace that the engine does not take, such as one of a wrong shape,
        and an invalid id or part, get 422.

        If the body is bytes, the other fields are in the query. A decision that is not begun before
        the deadline is VERIFY with the reason late; if the store cannot take it, it is VERIFY with
        the reason no_store. 503: the queue is full or the server is closing, and nothing was
        recorded; verify the part.
        """
        return await self.service.decide(api.as_samples(trace, channels), request, part)

    async def report(
        self,
        success: Annotated[
            bool | float,
            Meta(
                description="true or 1: good; false or 0: bad, for an accepted part a line stop. "
                "For a rejected part the result of an inspection."
            ),
        ],
        id_: Id = "",
        part: PartNumber = "",
        author: Author = "",
    ) -> ReportResponse:
        """Report the outcome of a part. The label is on disk when the response comes.

        State either the decision's id or the part; both or neither is 422, and so are an invalid
        id, a value that is no label, and an author that is not the token's. An unknown id or part
        is 404. Only the newest 20 decisions on a part are looked at, and rejects count only if
        there is nothing else; if several decisions count, it is 409. The same report twice is no
        error; a report that contradicts an earlier one is 409. But `false` for an accepted part
        that was confirmed as good before is a late line stop, and corrects the label. If the
        request has an author or the token has a name, a new label is also recorded as an event.
        503: the queue is full, or the label may not be on disk; report it again. The response has
        the label, whether it was known already, and the retrain that it set off if that is
        finished.
        """
        checked = _checked_author(author) if author or CURRENT_TOKEN.get().name else ""
        decision_id = await self._find_id(id_, part)
        return await self.service.report(decision_id, success, checked)

    async def _find_id(self, id_: str, part: str) -> str:
        """Return the id of a decision, given by its id or by its part's number.

        An id is returned as it is, neither looked up nor checked. For a part the newest 20
        decisions on it are looked at: the result is the only decision that is no REJECT or, if
        there are only rejects, the only REJECT. If no part has this number, but a decision has it
        as its id, this is the result. Raises HTTPException 422 for both or neither of id and part,
        UnknownDecisionError for a part without a decision, and ReportConflictError if several
        decisions count. For a part it waits in the queue of requests, and raises BusyError if that
        is full or the service is closing, and StoreError if the store cannot be read.
        """
        if bool(id_) == bool(part):
            raise HTTPException(
                422, "Expected the id of a decision, or the part's number in its place."
            )
        return id_ or await self.service.read(lambda store: find_decision_id(store, part))

    async def correct(
        self,
        success: Annotated[bool, Meta(description="The right label.")],
        id_: Id = "",
        part: PartNumber = "",
        author: Author = "",
    ) -> Changed:
        """Correct a wrong label, from the next decision on, and return what changed.

        The decision is named by its id or by its part's number. The change is recorded as an event
        in the log, with its author; the label as it was reported stays on record. A label that
        /forget withdrew counts again. If the part already counts with this label, nothing changes,
        but a training under way begins again. Of a part the newest 20 decisions are looked at, and
        rejects count only if there is nothing else; if several decisions count, the response is
        409. 404: an unknown id or part. 422: a decision without a label, both or neither of id and
        part, no author of 1 to 200 printable characters (unless the token has a name), or an author
        that is not the token's. 503: the queue of requests is full, the store does not answer, or
        the decision's stored trace is damaged.
        """
        decision_id = await self._find_id(id_, part)
        return await self._change(
            author, lambda engine, by: engine.correct(decision_id, success, by)
        )

    async def forget(
        self,
        ids: Annotated[list[str], Meta(description="Of the decisions.")],
        author: Author = "",
        reason: Annotated[str, Meta(description="For the event log.")] = "",
    ) -> Changed:
        """Leave the labels of decisions out of training and all counts; return what changed.

        `ids` are those of the decisions. The change is recorded as an event in the log, with its
        author and the reason, in which each run of white space becomes a space. /correct makes a
        forgotten label count again. If the id of one decision is unknown (404), a decision has no
        label, or no id is given (422), no label is forgotten. 422 also for a request without an
        author, unless the token has a name, and for an author that is not the token's, is longer
        than 200 characters or not printable.

        The certificate, which bounds the share of wrong decisions, counts a forgotten outcome as
        wrong if the part was accepted, or was checked at random though the model was certain. If a
        rollback pinned the version that decides now, so that no automatic retrain replaces it, this
        is undone if the version was trained with one of the labels, or if one of them is older than
        all labels of its training. A training under way begins again, even if the labels are
        forgotten already; no event is recorded then. 503: the queue of requests is full, the store
        does not answer, or the stored trace of a decision is damaged.
        """
        line = " ".join(reason.split())
        return await self._change(
            author, lambda engine, by: engine.forget(*ids, author=by, reason=line)
        )

    async def rollback(
        self,
        version: Annotated[int, Meta(description="Its number, as /versions lists it.")],
        author: Author = "",
    ) -> Changed:
        """Let an earlier version of the model decide again, as a new version, and pin it: no
        automatic retrain replaces it, until /release or /retrain, or until /forget of a label that
        it was trained with. A training under way is discarded. If it is pinned already, nothing
        else changes. 404: a version that is not kept, or whose state is damaged; 422: no author
        (unless the token has a name), or an author that is not the token's; 503: the queue is full,
        the store does not answer, or the version cannot be restored.
        """
        return await self._change(author, lambda engine, by: engine.rollback(version, by))

    async def release(self, author: Author = "") -> Changed:
        """Let retrains replace a version again that /rollback pinned; if none is pinned, nothing
        changes, but a training under way begins again. 422: no author (unless the token has a
        name), or an author that is not the token's; 503: the queue is full, or the store does not
        answer.
        """
        return await self._change(author, DataEngine.release)

    async def policy(self, author: Author = "", **changes: Any) -> Changed:
        """Change settings of the policy, from the next decision on; shadow verifies every part.

        Settings that are left out stay as they are. Many changes start the decision rule anew, so
        that it learns from later parts only. If all are in force already, nothing changes;
        otherwise a training under way begins again. 422: a value that a setting cannot have, no
        author (unless the token has a name), or an author that is not the token's. 503: the queue
        is full, or the store does not answer.
        """
        return await self._change(
            author, lambda engine, by: engine.set_policy(engine.policy.changed(**changes), by)
        )

    async def retrain(self, author: Author = "") -> Changed:
        """Begin a retrain, record who asked for it as an event, and do not wait for its end.

        The version of the model that a rollback pinned, so that no automatic retrain replaces it,
        is released: the new version may replace it. If a retrain is under way already, or was asked
        for and cannot begin yet, the response says so, and nothing changes. If no other process can
        train, the response comes after the retrain. /versions tells afterwards whether the new
        version decides now or was dropped. 422: no author of 1 to 200 printable characters (unless
        the token has a name), or an author that is not the token's. 503: the queue of requests is
        full, or the store does not answer.
        """

        def begin(engine: DataEngine, by: str) -> Changed:
            """Release a pinned version, record an event, begin the retrain, and return what
            changed.

            If a retrain is under way, or waits until it can begin, nothing is done, and the
            `Changed` has no event.
            """
            event = None
            text = "A retrain is under way already; nothing changed."
            if not engine.state.is_retraining:
                engine.release(by)
                event = engine.store.events.put("retrain", "asked for by hand", author=by)
                engine.retrain(wait=False)
                text = "The retrain has begun."
            return Changed("retrain", text, event, engine.version)

        return await self._change(author, begin)

    async def status(
        self,
        watch: Annotated[
            bool, Meta(description="Include the state of the safe mode's detectors.")
        ] = False,
    ) -> Json:
        """Return how the robot cell is doing: counts, version, faults, queue of requests and alarm.

        The counts are of all decisions, and of the newest 500. The version is that of the model
        that decides now. The alarm is the most urgent thing that somebody should look at, empty if
        there is none. `claim` says in a sentence what share of the accepted parts was bad at most.
        With `watch` the response also has the state of the detectors whose alarm begins a safe
        mode, in which every part is checked. 422: the stored recipe, the settings of the engine,
        cannot be read; 503: the queue is full, the server is closing, or the store cannot be read.
        """
        status = await self.service.status(watch)
        line = {name: getattr(self.service, name) for name in api.LINE}
        return response_fields(
            "Status", status, alarm=status.alarm, claim=status.certificate.sentence, **line
        )

    async def decision(self, id_: Id) -> StoredDecision:
        """Return one decision with its label; 404 for an unknown id, 422 for an invalid one, 503 if
        the queue is full or the id cannot be looked up.
        """
        stored = await self.service.find(id_)
        if stored is None:
            raise unknown_decision(id_)
        return stored

    async def decisions(
        self,
        open_: Annotated[
            bool, Meta(description="Only verified parts whose result was not reported.")
        ] = False,
        limit: Limit = 20,
        before: Annotated[
            str,
            Meta(description="Only decisions older than this id, `older` of the last response."),
        ] = "",
        **where: Any,
    ) -> Json:
        """Return up to `limit` decisions, newest first, as one page.

        `older` in the response is the id that `before` takes for the next page, null if none are
        left. Only decisions with the given label, action, reason, predicted (what the model alone
        would have done) and part (the part's number) are returned, if these are given, and only
        those between the times since (included) and until (not included), in seconds since 1970.
        With open, only decisions to check a part whose result was not reported are returned, and
        label and action are ignored. 404: an unknown `before`; 422: a value that a field cannot
        have, or an invalid `before`; 503: the queue of requests is full, the store cannot be read,
        or the stored trace of the decision `before` is damaged.
        """
        selection = HistoryFilter(**where)
        if open_:
            selection = replace(selection, action=Action.VERIFY, label="none")

        def read_newest(store: SqlStore) -> list[StoredDecision]:
            """Return the newest decisions that were asked for, newest first, and one more if there
            are more; with `open_` without those whose label was forgotten.
            """
            decisions = iterate_decisions(store, selection, limit + 1, before or None)
            if open_:  # a forgotten label was reported
                decisions = (stored for stored in decisions if stored.source is None)
            return list(islice(decisions, limit + 1))

        if before:
            await self.decision(before)  # raises if there is none
        stored = await self.service.read(read_newest)
        page = stored[:limit]
        return {
            "decisions": [response_fields("Decision", item) for item in page],
            "older": page[-1].decision.id if len(stored) > limit else None,
        }

    async def explanation(
        self, id_: Annotated[str, Meta(description="Of the decision, or its part's number.")]
    ) -> Json:
        """Explain a decision, with its trace, the band of good parts, and the newest bad parts.
        404: an unknown id or part; 409: a part with several decisions that are no rejects, or with
        nothing but several rejects; 503: the queue is full, the store cannot be read, or the trace
        of the decision or of a neighbour is damaged.
        """
        return await self.service.read(lambda store: _read_explanation(store, id_))

    async def course(self, hours: ShiftHours = 0, start: ShiftStart = 0.0) -> Course:
        """Return counts of the decisions in stretches, oldest first, with retrains.

        A stretch is a number of decisions that are counted together. With `hours` a stretch is a
        shift of this length, and `start` is when one of the shifts begins. Without it all decisions
        are split into at most 120 stretches of at least 20 decisions; the newest stretch may have
        fewer. At most the newest 120 stretches with decisions are returned, but all retrains of the
        robot cell. 503: the queue is full, or the store cannot be read.
        """
        return await self.service.read(
            lambda store: read_course(store, seconds=3600.0 * hours, start=3600.0 * start)
        )

    async def embedding(self) -> PartMap:
        """Return where parts lie in the model's embedding, in two dimensions.

        The parts are the newest 250 references with a label of this robot cell and, of its newest
        10 decisions, those that the version in force made and for which it embedded the trace.
        There are none before the first version, and no references if the version's state is not
        kept. 503: the queue is full, or the store cannot be read.
        """
        engine = self.service.engine
        return await self.service.read(lambda store: part_map(store, engine.recipe, engine.version))

    async def versions(self) -> Json:
        """Return every retrain of the robot cell or its product, dropped ones included, oldest
        first; a version that is kept can be rolled back to. 503: the queue is full, or the store
        cannot be read.
        """
        return response_fields(
            "Versions", versions=await self.service.read(lambda store: store.versions.all())
        )

    async def events(self, limit: Limit = 20) -> Json:
        """Return the newest events, such as changes by hand, safe modes and faults, and who caused
        them, newest first. 503: the queue is full, or the store cannot be read.
        """
        events = await self.service.read(lambda store: store.events.newest(limit))
        return response_fields("Events", events=events[::-1])

    async def changes(self) -> Response:
        """Return a stream of server-sent events, by which a client hears of changes.

        The stream ends when the server ends. The first event is `hello`, with the server's version,
        and the second always `changed`. Then comes `changed` whenever decisions, reports of
        outcomes, changes by hand, like a corrected label (also refused ones), or retrains have come
        since the last event, and `tick` after each 5 seconds without any. Nothing says what has
        changed.
        """

        async def event_stream() -> AsyncIterator[str]:
            """Yield hello, then changed or tick, as texts of server-sent events, until the service
            ends its iterations.
            """
            yield f"retry: {RECONNECT_MS}\nevent: hello\ndata: {__version__}\n\n"
            async for changed in self.service.changes(TICK):
                yield f"event: {'changed' if changed else 'tick'}\ndata: -\n\n"

        return StreamingResponse(event_stream(), media_type="text/event-stream")

    async def me(self) -> Token:
        """Return the name and the rights of the request's token, without its secret. If the server
        needs no token, the name is empty, and everything is allowed.
        """
        return CURRENT_TOKEN.get()

    async def metrics(self) -> Response:
        """Return the metrics for Prometheus."""
        return Response(self._metrics.text(), media_type=CONTENT_TYPE_LATEST)

    async def healthz(self) -> Response:
        """Return whether the engine answers: ok or degraded (200), down (503). It needs no token.

        Degraded: the store, or the journal (the file that takes its records first), cannot be
        written or does not answer in time, the store differs from its ledger (a hash chain of its
        rows), or the last three or more retrains were dropped (their models do not decide). Down:
        the engine's thread has ended, or was busy with one thing for a minute. The response also
        has the texts of the faults, and the number of requests in the queue.
        """
        running = self.service.engine.state
        is_alive = self.service.silent_seconds < MAX_SILENT
        faults = {"store_fault": running.store_fault, "retrain_fault": running.retrain_fault}
        state = "degraded" if any(faults.values()) else "ok"
        if not is_alive:
            state = "down"
        health = response_fields("Health", status=state, waiting=self.service.waiting, **faults)
        return api.json_response(health, 200 if is_alive else 503)

    async def openapi(self) -> Json:
        """Return the OpenAPI document."""
        return api.openapi_document(self.operations, __version__)

    async def docs(self) -> Response:
        """Return the OpenAPI document as a page."""
        return FileResponse(STATIC / "docs.html")

    async def _change(self, author: str, work: Callable[[DataEngine, str], Changed]) -> Changed:
        """Call `work` in the engine's thread with the engine and the author, and return its
        `Changed`.

        Raises HTTPException for an author that `_checked_author` does not take, BusyError if the
        queue is full or the service is closing, and what `work` raises.
        """
        by = _checked_author(author)
        return await self.service.call(lambda engine: work(engine, by))


def _checked_author(author: str) -> str:
    """Return the author of a change for the event log: the token's name, or else the given name.

    The token is that of the present request (`CURRENT_TOKEN`); its name is empty if it is a
    program's. In the given name each run of white space becomes a single space. Raises
    HTTPException 422 if there is no name, if the name is longer than 200 characters or not
    printable, and if both names are given and differ.
    """
    owner = CURRENT_TOKEN.get().name
    name = " ".join(author.split())
    if owner and name not in ("", owner):
        raise HTTPException(
            422, f"Expected author to be {owner}, whose token it is, or to be left out."
        )
    if not is_name(owner or name):
        raise HTTPException(422, "Expected author, the name of who asks for it, for the event log.")
    return owner or name


def _read_explanation(store: SqlStore, id_: str) -> Json:
    """Return the explanation of a decision, named by its id or its part's number, as a JSON dict.

    Beside the fields of the `Explanation` it has the decision's trace, the corrections of its
    label, the band of the traces of good parts (low, median, high; None without one), and up to 10
    (`N_BADS`) traces of bad parts. These are the newest among the newest 200 (`N_LABELS`) labels of
    this robot cell, and of the cells that make the same product, oldest first; none if their shape
    is not that of the decision's trace. Raises what `explain` raises, such as UnknownDecisionError,
    and StoreError for a damaged trace of the decision or of one of its nearest neighbours. Raises
    StoreError also if one of the 200 labels is neither 0 nor 1, or their traces differ in shape.
    Other damaged traces are left out, and an event in the store says so.
    """
    explanation = explain(store, id_)
    trace = explanation.trace
    labelled = store.labels.with_traces(N_LABELS)
    bads = labelled.traces[labelled.labels == 0][-N_BADS:]
    if bads.shape[1:] != trace.shape:
        bads = np.zeros((0, *trace.shape))
    band = {name: getattr(explanation.envelope, name, None) for name in ("low", "median", "high")}
    corrections = [
        item
        for item in store.corrections.after()
        if item.seq == explanation.decision.label_seq  # an id may be another cell's, too
    ]
    return response_fields(
        "Explanation", explanation, trace=trace, bads=bads, corrections=corrections, **band
    )


async def _index_page(request: Request) -> Response:
    return FileResponse(STATIC / "index.html")


def create_app(
    service: CellService,
    tokens: tuple[Token, ...] = (),
    *,
    recorder: RtdeRecorder | None = None,
) -> Starlette:
    """Create the Starlette application that serves a robot cell.

    It serves the operations of `HttpApi`, XML-RPC at POST /RPC2 (`RobotCalls`), and the web page.
    Every request first passes `Guard`, which refuses those that are not allowed. Errors are
    answered as JSON (`Problem`), and those of an XML-RPC call as XML-RPC faults. The service gets
    an observer, which counts its responses for `GET /metrics`. The caller closes the service after
    the application has ended.

    Parameters
    ----------
    service : CellService
        The engine with its queue of requests.
    tokens : tuple of Token, optional
        Empty: no request needs a token, and `Guard` refuses requests whose host is neither
        localhost nor a loopback address. Serve the application at a loopback address alone then;
        this is not checked here.
    recorder : RtdeRecorder, optional
        Records the traces for the XML-RPC call `decide_recorded`; the caller closes it. None: the
        answer to that call is a fault.

    Returns
    -------
    Starlette
    """
    routes: list[BaseRoute] = [
        *(
            Route(operation.path, operation.serve, methods=[operation.method])
            for operation in HttpApi(service).operations
        ),
        rpc_route(RobotCalls(service, recorder)),
        *(Route(path, _index_page) for path in VIEWS),
        Mount("/page/static", StaticFiles(directory=STATIC)),
    ]
    app = Starlette(
        routes=routes,
        middleware=[Middleware(Guard, tokens=tokens)],
        exception_handlers=api.HANDLERS,
    )
    # A robot does not follow redirects, whose target a request's Host would determine.
    app.router.redirect_slashes = False
    return app
