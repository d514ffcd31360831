"""What the server answers, as an OpenAPI 3.1 document, and as a page to read that asks nobody for anything."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from functools import cache
from html import escape

from .bodies import JSON, MSGPACK
from .problems import PROBLEM, RETRY_AFTER
from .schemas import PROBLEMS, SCHEMAS, Json, body, operation, response, text

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
