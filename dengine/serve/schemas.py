"""The words of the OpenAPI document: what each answer holds, and what each method takes."""

from __future__ import annotations

from typing import Any

from ..records import Action, Reason, Source

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
