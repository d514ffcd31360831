"""What the server answers, as an OpenAPI 3.1 document, and as a page to read that asks nobody for anything.

What is answered to a request that is not served: a problem as RFC 9457 has it, and what the cell does all the same.

What a request's body says: a trace as JSON, as raw float32 or as MessagePack; a report.

JSON is taken strictly: a name twice, NaN, a bool in the place of a number, an unknown name are refused. A sample that is
null is one that the sensor did not give: it is NaN to the engine, which verifies the part.

The words of the OpenAPI document: what each answer holds, and what each method takes.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from html import escape
from http import HTTPStatus
from typing import Any

import numpy as np
from numpy.typing import NDArray
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response

from ..errors import BusyError, DengineError, StoreError, listed, shortened, without_password
from ..records import Action, Reason, Source

log = logging.getLogger("dengine")
RETRY_AFTER = 1  # seconds
PROBLEM = "application/problem+json"


class Refusal(Exception):  # noqa: N818  # it is an answer, not a fault
    """A request that is not served. status : of HTTP.  detail : what was expected, what came, what to do."""

    def __init__(self, status: int, detail: str, headers: Mapping[str, str] | None = None) -> None:
        super().__init__(detail)
        self.status = status
        self.detail = detail
        self.headers = dict(headers or {})


def problem(status: int, detail: str, headers: Mapping[str, str] | None = None) -> Response:
    """The answer of a request that is not served. Whatever is wrong, a part without a decision is verified."""
    title = HTTPStatus(status).phrase
    body = {
        "type": f"/docs#problem-{status}",
        "title": title,
        "status": status,
        "detail": " ".join(without_password(detail).split()),
        "action": Action.VERIFY.value,
    }
    said = dict(headers or {})
    if status in (HTTPStatus.TOO_MANY_REQUESTS, HTTPStatus.SERVICE_UNAVAILABLE):
        said.setdefault("Retry-After", str(RETRY_AFTER))
    return Response(json.dumps(body), status, said, PROBLEM)


def of_refusal(request: Request, error: Exception) -> Response:
    """The answer to a `Refusal`."""
    assert isinstance(error, Refusal)  # Starlette asks by class; for the type checker
    return problem(error.status, error.detail, error.headers)


def of_dengine_error(request: Request, error: Exception) -> Response:
    """The answer where the engine refuses: 503 where it may take the same later, 422 where it will not."""
    later = isinstance(error, BusyError | StoreError)
    return problem(HTTPStatus.SERVICE_UNAVAILABLE if later else HTTPStatus.UNPROCESSABLE_ENTITY, str(error))


def of_http_exception(request: Request, error: Exception) -> Response:
    """The answer to a path or a method that there is not."""
    assert isinstance(error, HTTPException)  # Starlette asks by class; for the type checker
    said = {404: "Expected one of the paths in /openapi.json, got another.", 405: "Expected another method on this path."}
    return problem(error.status_code, said.get(error.status_code, str(error.detail)), error.headers)


def of_disconnect(request: Request, error: Exception) -> Response:
    """What nobody reads: the client hung up within its request."""
    return problem(HTTPStatus.BAD_REQUEST, "Expected the whole of the request.")


def of_fault(request: Request, error: Exception) -> Response:
    """The answer to what nobody foresaw; the log says what it was, the answer does not."""
    log.error("a request failed: %s %s", request.method, request.scope["path"], exc_info=error)
    return problem(HTTPStatus.INTERNAL_SERVER_ERROR, "The server failed at this request; its log says why.")


HANDLERS = {
    Refusal: of_refusal,
    DengineError: of_dengine_error,
    HTTPException: of_http_exception,
    ClientDisconnect: of_disconnect,
    Exception: of_fault,
}


JSON, RAW, MSGPACK = "application/json", "application/octet-stream", "application/msgpack"
DEPTH = 8  # of arrays within arrays in MessagePack


@dataclass(frozen=True, slots=True)
class TraceRequest:
    """What is to be decided: a trace, (T,) or (channels, T), the caller's id of it, and its part's number."""

    trace: NDArray[Any]
    request: str | None = None
    part: str | int | None = None


@dataclass(frozen=True, slots=True)
class Report:
    """What became of a decision; `success` as it came: the engine says what a label is."""

    id: str
    success: Any


def media_type(request: Request) -> str:
    """What a request says that its body is, without parameters; "" where it says nothing."""
    return request.headers.get("content-type", "").partition(";")[0].strip().lower()


async def read_body(request: Request, most: int) -> bytes | None:
    """A request's body; None where it has more bytes than that, the rest of which are not read."""
    body = bytearray()
    async for piece in request.stream():
        body += piece
        if len(body) > most:
            return None
    return bytes(body)


async def trace_request(request: Request) -> TraceRequest:
    """What a request asks to be decided; Refusal where it says nothing that can be."""
    kind = media_type(request)
    read = READERS.get(kind)
    if read is None:
        raise Refusal(
            415, f"Expected a trace as {', '.join(READERS)}, got {shortened(kind)}.", {"Accept": ", ".join(READERS)}
        )
    return read(request, await request.body())


async def report_request(request: Request) -> Report:
    """What a request reports; Refusal where it reports nothing."""
    kind = media_type(request)
    if kind not in (JSON, MSGPACK):
        raise Refusal(415, f"Expected a report as {JSON} or {MSGPACK}, got {shortened(kind)}.")
    table = _table(PARSERS[kind](await request.body()), ("id", "success"), ("id", "success"))
    if not isinstance(table["id"], str):
        raise Refusal(422, f"Expected id to be a text, got {shortened(table['id'])}.")
    return Report(table["id"], table["success"])


def strict_json(body: bytes) -> Any:
    """What JSON says; Refusal for what is none, for a name that comes twice, for NaN and infinities."""
    try:
        return json.loads(body.decode("utf-8"), object_pairs_hook=_once, parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:  # UnicodeDecodeError and JSONDecodeError among them
        raise Refusal(400, f"Expected JSON in UTF-8: {shortened_text(str(error))}.") from error


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    table = dict(pairs)
    if len(table) < len(pairs):
        raise Refusal(400, f"Expected each name once, got {listed(name for name, _ in pairs)}.")
    return table


def _no_constant(name: str) -> Any:
    raise Refusal(400, f"Expected numbers that JSON has, got {name}; send null for a sample that is missing.")


def msgpack(body: bytes) -> Any:
    """What MessagePack says; Refusal for what is none."""
    from msgpack import unpackb  # type: ignore[import-untyped]  # it ships no types

    try:
        return unpackb(body, object_pairs_hook=_once, strict_map_key=True, raw=False)
    except Refusal:
        raise
    except Exception as error:  # msgpack's own errors have no common base
        raise Refusal(400, f"Expected MessagePack: {shortened_text(str(error) or type(error).__name__)}.") from error


def shortened_text(text: str) -> str:
    """A line of a parser's complaint."""
    return " ".join(text.split())[:160].rstrip(".")


PARSERS: Mapping[str, Callable[[bytes], Any]] = {JSON: strict_json, MSGPACK: msgpack}


def _table(value: Any, known: tuple[str, ...], needed: tuple[str, ...]) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise Refusal(422, f"Expected an object with {', '.join(known)}, got {shortened(value)}.")
    if unknown := [name for name in value if name not in known]:
        raise Refusal(422, f"Expected {', '.join(known)} and nothing else, got {listed(map(shortened, unknown))} too.")
    if missing := [name for name in needed if name not in value]:
        raise Refusal(422, f"Expected {', '.join(needed)}, {', '.join(missing)} is missing.")
    return value


def _parsed(request: Request, body: bytes, parse: Callable[[bytes], Any]) -> TraceRequest:
    table = _table(parse(body), ("trace", "request", "part"), ("trace",))
    return TraceRequest(_samples(table["trace"]), _text(table.get("request")), _part(table.get("part")))


def _raw(request: Request, body: bytes) -> TraceRequest:
    query = request.query_params
    table = _table(dict(query), ("request", "part", "channels"), ())
    channels = table.get("channels", "1")
    if len(query.multi_items()) > len(table) or not (channels.isdecimal() and channels.isascii() and len(channels) < 6):
        raise Refusal(422, f"Expected ?request=, part= and channels= once each, channels a whole number, got {channels!r}.")
    if int(channels) < 1 or not body or len(body) % (4 * int(channels)):
        raise Refusal(
            422, f"Expected float32, little-endian, channel after channel, {channels} of them, got {len(body)} bytes."
        )
    values = np.frombuffer(body, dtype="<f4")
    trace = values if channels == "1" else values.reshape(int(channels), -1)
    return TraceRequest(trace, table.get("request"), table.get("part"))


def _samples(value: Any) -> NDArray[Any]:
    """(T,) or (channels, T) numbers; a trace as bytes is raw float32, as in a body of its own."""
    if isinstance(value, bytes):
        if not value or len(value) % 4:
            raise Refusal(422, f"Expected float32, little-endian, 4 bytes a sample, got {len(value)} bytes.")
        return np.frombuffer(value, dtype="<f4")
    if not isinstance(value, list) or not value:
        raise Refusal(422, f"Expected a trace, a list of numbers or a list of such lists, got {shortened(value)}.")
    if not isinstance(value[0], list):
        return _row(value)
    if not all(isinstance(row, list) and len(row) == len(value[0]) for row in value):
        raise Refusal(422, "Expected a list as long for each channel.")
    return np.stack([_row(row) for row in value])


def _row(row: list[Any]) -> NDArray[np.float64]:
    kinds = set(map(type, row))
    if not kinds <= {int, float, type(None)}:
        wrong = next(each for each in row if type(each) not in (int, float, type(None)))
        raise Refusal(422, f"Expected numbers, or null for a missing sample, got {shortened(wrong)} among them.")
    try:
        return np.array(row, dtype=np.float64)  # None becomes NaN
    except OverflowError:
        raise Refusal(422, "Expected numbers that a float holds, got a whole number beyond.") from None


def _text(value: Any) -> str | None:
    if value is None or isinstance(value, str):
        return value
    raise Refusal(422, f"Expected request to be a text, got {shortened(value)}.")


def _part(value: Any) -> str | int | None:
    if value is None or (isinstance(value, str | int) and not isinstance(value, bool)):
        return value
    raise Refusal(422, f"Expected part to be a text or a whole number, got {shortened(value)}.")


READERS: Mapping[str, Callable[[Request, bytes], TraceRequest]] = {
    JSON: lambda request, body: _parsed(request, body, strict_json),
    RAW: _raw,
    MSGPACK: lambda request, body: _parsed(request, body, msgpack),
}


Json = dict[str, Any]
OPEN, MOST_OPEN = 20, 200  # decisions that a page of `/decisions` holds


def text(about: str = "", **more: Any) -> Json:
    """A text."""
    return {"type": "string"} | ({"description": about} if about else {}) | more


def number(about: str = "", kind: str = "number", **more: Any) -> Json:
    """A number."""
    return {"type": kind} | ({"description": about} if about else {}) | more


def flag(about: str = "") -> Json:
    """True or false."""
    return {"type": "boolean"} | ({"description": about} if about else {})


def maybe(schema: Json) -> Json:
    """The same, or null."""
    return schema | {"type": [schema["type"], "null"]}


def record(about: str, properties: Json, optional: tuple[str, ...] = ()) -> Json:
    """An object with these properties and no others."""
    required = [name for name in properties if name not in optional]
    closed = {"additionalProperties": False, "required": required}
    return {"type": "object", "description": about, "properties": properties} | closed


def several(items: Json, about: str = "") -> Json:
    """A list."""
    return {"type": "array", "items": items} | ({"description": about} if about else {})


ACTION = text("What to do with the part: verify it, go on without (accept), or take it back (reject).", enum=list(Action))
REASON = text("Why.", enum=list(Reason))
SAMPLES = several(maybe(number()), "Samples; null for a missing one: the part is then verified.")
REQUEST = text("The caller's id of this trace, once for every trace: asked again, the answer is the same.", maxLength=200)
PART = {"type": ["string", "integer", "null"], "description": "The part's number, where one is known."}
DECISION: Json = {
    "id": text("Of the decision: the request's, where one was given. `/report` takes it."),
    "action": ACTION,
    "predicted": ACTION | {"description": "What the model alone would have done; differs in an audit."},
    "reason": REASON,
    "lower": maybe(number("Bound on the success probability in the ball around the trace.")),
    "upper": maybe(number("Its other side.")),
    "n_success": number("Good parts counted in that ball.", "integer"),
    "n_failure": number("Bad parts counted in it.", "integer"),
    "audit": flag("Verified although the model was certain."),
    "propensity": maybe(number("Probability with which this decision is verified.")),
    "model_version": number("Of the model that answered; 0 before the first retrain.", "integer"),
    "embedding": maybe(several(several(maybe(number())), "Where the trace lies, in each of the model's spaces.")),
    "part": maybe(text("The part's number.")),
}
LATE = {
    "late": flag("Verified since the line was too long for the deadline; recorded so."),
    "seconds": number("From the request to the answer, in the server."),
}
STORED = {
    "quarantined": flag("A bad trace: kept, and never learned from."),
    "success": maybe(flag("The label as it counts.")),
    "source": maybe(text("Where it came from.")) | {"enum": [*Source, None]},
    "trace": several(SAMPLES, "Channel after channel, where trace=true asked for it."),
}
PAST = {
    **{name: DECISION[name] for name in DECISION if name != "embedding"},
    **{name: STORED[name] for name in ("quarantined", "success", "source")},
    "time": number("Of the decision, in seconds since 1970."),
    "label_seq": maybe(number("The label's number.", "integer")),
    "label_time": maybe(number("When it came, in seconds since 1970.")),
}
RETRAIN = record(
    "A retrain.",
    {
        "version": number("Of the model that answers afterwards.", "integer"),
        "seconds": number("From the data to the new version answering."),
        "n_traces": number("Labelled traces it was given.", "integer"),
        "n_steps": number("Optimiser steps taken.", "integer"),
        "accepted": flag("Whether the candidate took the old version's place."),
        "reason": text("Why."),
    },
)
SCHEMAS: Json = {
    "TraceRequest": record(
        "A trace to decide on.",
        {
            "trace": {"oneOf": [SAMPLES, several(SAMPLES)], "description": "(samples,) or (channels, samples)."},
            "request": maybe(REQUEST),
            "part": PART,
        },
        optional=("request", "part"),
    ),
    "Answer": record("A decision, as it is recorded.", DECISION | LATE),
    "Report": record(
        "What became of a part.",
        {
            "id": text("Of the decision."),
            "success": {"enum": [True, False, 1, 0], "description": "true, or 1: good; false, or 0: bad."},
        },
    ),
    "Told": record(
        "The label is on the disk.",
        {
            "decision_id": text(),
            "success": flag(),
            "repeated": flag("The same label was reported before, and nothing changed."),
            "retrain": {"oneOf": [RETRAIN, {"type": "null"}], "description": "What it set off in line, if anything."},
            "seconds": number("From the request to the answer, in the server."),
        },
    ),
    "Decision": record("A decision with its label.", DECISION | STORED, optional=("trace",)),
    "Decisions": record("Decisions, newest first.", {"decisions": several(record("A decision as it was recorded.", PAST))}),
    "Status": record(
        "How the engine stands.",
        {
            "cell": text("The cell's name in its store."),
            "version": number("Of the model that answers.", "integer"),
            "policy": {"type": "object", "description": "The user's numbers in force."},
            "reducer": text(),
            "trace": {"type": ["object", "null"], "description": "The traces' contract; null before the first."},
            "shadow": flag("Every part is verified, and the model only says what it would have done."),
            "safe_mode": text("Why everything is verified; empty where it is not."),
            "retraining": flag(),
            "new_labels": number("Since the last retrain began.", "integer"),
            "retrain_every": number("Labels that set one off.", "integer"),
            "store_fault": text("Why the store cannot be written, and labels wait in its journal; empty where it can."),
            "waiting": number("Requests in line.", "integer"),
            "late": number("Decisions verified since the line was too long, since the server began.", "integer"),
            "busy": number("Requests refused since too many waited, since it began.", "integer"),
            "deadline": number("Seconds in line, after which the answer is verify."),
            "store": {"type": "object", "description": "What the store counts, and its newest events."},
        },
    ),
    "Health": record(
        "Whether the engine answers.",
        {"status": text(enum=["ok", "degraded", "down"]), "store_fault": text(), "waiting": number("", "integer")},
    ),
    "Problem": record(
        "Why a request is not served, as RFC 9457 has it. A part that got no decision is verified.",
        {
            "type": text("Where to read of it."),
            "title": text(),
            "status": number("", "integer"),
            "detail": text("What was expected, what came, what to do."),
            "action": text("Always verify.", enum=["verify"]),
        },
    ),
}
PROBLEMS = {
    400: "No JSON or MessagePack, or a header that makes no sense.",
    401: "The token is missing or another.",
    403: "A web page of another site asks.",
    404: "There is no such path, or no such decision.",
    405: "The path has no such method.",
    408: "The request's body did not come in time.",
    409: "The id is another trace's, or the label is against what was reported first.",
    413: "The request is larger than the server takes.",
    415: "The body is of a type that is not read here.",
    421: "The server was called by a name that is not its own.",
    422: "The body says something that cannot be: what was expected stands in detail.",
    429: "Too many requests of one client; Retry-After says when.",
    500: "The server failed; its log says why.",
    503: "Too many wait, the store is away, or the server is closing; Retry-After says when.",
}
EVERYWHERE = (401, 421, 429, 500)
QUERY: Json = {
    "request": REQUEST,
    "part": text("The part's number."),
    "channels": number("Of a raw body, channel after channel.", "integer", default=1, minimum=1),
    "trace": flag("With the trace."),
    "open": flag("Only verified decisions that wait for a label: what a controller that died goes on with."),
    "limit": number("How many at most.", "integer", default=OPEN, minimum=1, maximum=MOST_OPEN),
}


def operation(
    summary: str,
    answer: str,
    problems: tuple[int, ...],
    query: tuple[str, ...] = (),
    also: Json | None = None,
    **more: Any,
) -> Json:
    """What one method on one path does.  answer : a schema's name, or a type of text.  also : answers beside problems."""
    said = {"200": response("Done.", answer)}
    for status in sorted({*problems, *EVERYWHERE}):
        said[str(status)] = {"$ref": f"#/components/responses/{status}"}
    said |= also or {}
    found = [{"name": name, "in": "query", "required": False, "schema": QUERY[name]} for name in query]
    return {"summary": summary, "parameters": [*found, *more.pop("parameters", [])], "responses": said} | more


def response(about: str, answer: str) -> Json:
    """What a method answers: by a schema's name as JSON, else a text of that type."""
    kind, schema = ("application/json", _of(answer)) if answer in SCHEMAS else (answer, text())
    return {"description": about, "content": {kind: {"schema": schema}}}


def _of(schema: str) -> Json:
    return {"$ref": f"#/components/schemas/{schema}"}


def body(schema: str, kinds: tuple[str, ...], examples: Json, raw: bool = False) -> Json:
    """What a method takes."""
    same: Json = {"schema": _of(schema)}
    content: Json = {kind: same | ({"examples": examples} if "json" in kind else {}) for kind in kinds}
    if raw:
        content["application/octet-stream"] = {"schema": text("float32, little-endian.", format="binary")}
    return {"required": True, "content": content}


LATER = (429, 503)
TRACES: Json = {
    "one channel": {"value": {"trace": [0.1, 1.5, 2.25, None, 0.4], "request": "order-7", "part": "P-1007"}},
    "two channels": {"value": {"trace": [[0.1, 1.5, 2.25], [0.0, 0.2, 0.1]]}},
}
REPORTS: Json = {"a good part": {"value": {"id": "order-7", "success": True}}}
ID: Json = {"name": "id", "in": "path", "required": True, "schema": text("The decision's id.")}
DOWN = {"503": response("The engine's thread has ended, or gives no sign.", "Health")}
UNREAD = (400, 403, 408, 413, 415)
PATHS: Json = {
    "/decide": {
        "post": operation(
            "Decide on a trace. With a request id, whoever died before the answer asks again and has the same.",
            "Answer",
            (*UNREAD, 409, 422, 503),
            ("request", "part", "channels"),
            requestBody=body("TraceRequest", (JSON, MSGPACK), TRACES, raw=True),
            description="The query belongs to a raw body, application/octet-stream; JSON and MessagePack hold it all.",
        )
    },
    "/report": {
        "post": operation(
            "Report what became of a part; the label is on the disk when this answers. The same twice is no error.",
            "Told",
            (*UNREAD, 404, 409, 422, 503),
            requestBody=body("Report", (JSON, MSGPACK), REPORTS),
        )
    },
    "/status": {"get": operation("How the engine stands, and what its store counts.", "Status", (503,))},
    "/decisions": {
        "get": operation(
            "The newest decisions, newest first; open=true: those that wait for a label.",
            "Decisions",
            (422, 503),
            ("open", "limit"),
        )
    },
    "/decisions/{id}": {
        "get": operation("One decision with its label.", "Decision", (404, 422, 503), ("trace",), parameters=[ID])
    },
    "/metrics": {"get": operation("What Prometheus reads.", "text/plain", ())},
    "/healthz": {
        "get": operation("Whether the engine answers; asks for no token.", "Health", (), also=DOWN, security=[]),
    },
    "/openapi.json": {"get": operation("This document.", JSON, ())},
    "/docs": {"get": operation("This document, to read.", "text/html", ())},
}


@cache
def document(version: str) -> Json:
    """The OpenAPI document of this version."""
    answer = {PROBLEM: {"schema": {"$ref": "#/components/schemas/Problem"}}}
    after = {"Retry-After": {"schema": {"type": "integer"}, "description": f"Seconds, {RETRY_AFTER} as a rule."}}
    responses = {
        str(status): {"description": about, "content": answer} | ({"headers": after} if status in LATER else {})
        for status, about in PROBLEMS.items()
    }
    schemes = {"bearer": {"type": "http", "scheme": "bearer"}, "basic": {"type": "http", "scheme": "basic"}}
    info = {"title": "dengine serve", "version": version, "description": "A robot cell's data engine."}
    return {
        "openapi": "3.1.0",
        "info": info,
        "paths": PATHS,
        "components": {"schemas": SCHEMAS, "responses": responses, "securitySchemes": schemes},
        "security": [{}, {"bearer": []}, {"basic": []}],
    }


def as_page(openapi: Json) -> str:
    """The document as a page of plain HTML."""
    info = openapi["info"]
    head = f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{escape(info["title"])}</title>'
    return head + "<main>" + "\n".join(_sections(openapi)) + "</main></html>\n"


def _sections(openapi: Json) -> Iterator[str]:
    info = openapi["info"]
    yield f"<h1>{escape(info['title'])} {escape(info['version'])}</h1>"
    yield '<p>The same for machines: <a href="/openapi.json">/openapi.json</a>.</p>'
    for path, methods in openapi["paths"].items():
        for method, said in methods.items():
            yield f"<h2><code>{method.upper()} {escape(path)}</code></h2><p>{escape(said['summary'])}</p>"
            yield from _takes(said)
            codes = ", ".join(said["responses"])
            yield f"<p>Answers: {escape(codes)}.</p>"
    yield "<h2>Objects</h2>"
    for name, schema in openapi["components"]["schemas"].items():
        yield f'<h3 id="{escape(name)}">{escape(name)}</h3><p>{escape(schema["description"])}</p>'
        yield _list((key, _about(each)) for key, each in schema["properties"].items())
    yield "<h2>Problems</h2>"
    for status, answer in openapi["components"]["responses"].items():
        yield f'<h3 id="problem-{status}">{status}</h3><p>{escape(answer["description"])}</p>'


def _takes(said: Json) -> Iterator[str]:
    if said["parameters"]:
        yield _list((each["name"], _about(each["schema"])) for each in said["parameters"])
    for kind, content in said.get("requestBody", {}).get("content", {}).items():
        yield f"<p>Takes <code>{escape(kind)}</code>.</p>"
        for example in content.get("examples", {}).values():
            yield f"<pre>{escape(json.dumps(example['value']))}</pre>"


def _list(items: Iterable[tuple[str, str]]) -> str:
    return "<dl>" + "".join(f"<dt><code>{escape(k)}</code></dt><dd>{escape(v)}</dd>" for k, v in items) + "</dl>"


def _about(schema: Json) -> str:
    kind = schema.get("type", "")
    kinds = " or ".join(kind) if isinstance(kind, list) else kind
    among = ", ".join(json.dumps(each) for each in schema.get("enum", ()))
    return " ".join(filter(None, (schema.get("description", ""), f"({kinds})" if kinds else "", among)))
