"""The one schema of the server: what requests and answers hold, how they are read and written, and their OpenAPI document.

Requests are structs, read strictly by msgspec; answers are derived from the fields of dengine's records. JSON has no NaN: a
sample that is null is one that the sensor did not give, and a number that is not finite is answered as null.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Awaitable, Callable, Iterable, Mapping
from dataclasses import fields, is_dataclass
from functools import cache, reduce
from http import HTTPStatus
from operator import or_
from types import UnionType
from typing import Annotated, Any, Literal, NamedTuple, TypeVar, get_args, get_origin, get_type_hints

import msgspec
import numpy as np
from msgspec import UNSET, Meta, Struct, UnsetType
from numpy.typing import NDArray
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response

from ..decision.policy import Policy
from ..engine.corrections import Changed
from ..errors import (
    BusyError,
    DengineError,
    ReportConflictError,
    StoreError,
    TraceConflictError,
    UnknownDecisionError,
    shortened,
    without_password,
)
from ..history.explain import Explanation
from ..history.map import PartMap
from ..history.status import NEWEST, Course, Status
from ..records import Action, Decision, plain
from ..store.records import Correction, Event, StoredDecision, StoredVersion, VersionError
from ..store.views import HistoryFilter
from .service import Told

log = logging.getLogger("dengine")
T = TypeVar("T")
Json = dict[str, Any]
JSON, RAW, MSGPACK = "application/json", "application/octet-stream", "application/msgpack"
PROBLEM = "application/problem+json"
LATER = (429, 503)
RETRY_AFTER = 1  # seconds
DECODERS: Mapping[str, Callable[..., Any]] = {JSON: msgspec.json.decode, MSGPACK: msgspec.msgpack.decode}
STRINGS = re.compile(rb'"(?:[^"\\]|\\.)*+"(\s*:)?')  # of a JSON object; those before a colon are its keys
FIELD = re.compile(r"(?:^ *|  )((?:\w+, )*\w+) : ", re.MULTILINE)  # "name, name : what it is", in a docstring

# What is asked


class TraceRequest(Struct, forbid_unknown_fields=True):
    """A trace to decide on.

    trace : (samples,) or (channels, samples), null for a missing sample; or bytes, raw float32, little-endian.
    request : the caller's id of this trace, once for every trace: asked again, the answer is the same.
    part : the part's number, where one is known.
    """

    trace: bytes | list[float | list[float | None] | None]
    request: str | UnsetType | None = UNSET
    part: str | int | UnsetType | None = UNSET


class RawQuery(Struct, forbid_unknown_fields=True):
    """What stands beside a raw trace.  request, part : as in TraceRequest.  channels : of the body, one after another."""

    request: str | UnsetType = UNSET
    part: str | UnsetType = UNSET
    channels: Annotated[int, Meta(ge=1, le=99_999)] = 1


class Report(Struct, forbid_unknown_fields=True):
    """What became of a part; false for one that was accepted and came back is a system stop.

    id : of the decision.  part : its number in the place of that, where there is one decision of it; or the id.
    success : true, or 1: good; false, or 0: bad.  author : who says so, for the event log; a robot leaves it out.
    """

    success: bool | float
    id: str | UnsetType = UNSET
    part: str | UnsetType = UNSET
    author: str = ""


class Signed(Struct, forbid_unknown_fields=True):
    """Who asks for it.  author : a name, for the event log."""

    author: str


class Correct(Signed, forbid_unknown_fields=True):
    """A label to put right.  id : of the decision.  success : what it counts as from now on."""

    id: str
    success: bool


class Forget(Signed, forbid_unknown_fields=True):
    """Labels to leave out.  ids : of the decisions.  reason : for the event log."""

    ids: list[str]
    reason: str = ""


class Rollback(Signed, forbid_unknown_fields=True):
    """A version to go back to.  version : its number, as /versions lists it."""

    version: int


class StatusQuery(Struct, forbid_unknown_fields=True):
    """last : the newest so many decisions are looked at apart.  watch : how far the safe mode's detectors are, too."""

    last: Annotated[int, Meta(ge=1, le=100_000)] = NEWEST
    watch: bool = False


class EventQuery(Struct, forbid_unknown_fields=True):
    """limit : how many at most."""

    limit: Annotated[int, Meta(ge=1, le=200)] = 20


class DecisionQuery(Struct, forbid_unknown_fields=True):
    """Which decision.  trace : with its samples too."""

    id: str
    trace: bool = False


class Nothing(Struct, forbid_unknown_fields=True):
    """There is nothing to ask for."""


def _optional(name: str, record: type, doc: str, without: tuple[str, ...] = (), **more: Any) -> type[Struct]:
    """A request of a record's fields, each of which may be left out, and of more of them: a type, and a default."""
    kinds = {key: (kind | UnsetType, UNSET) for key, kind in get_type_hints(record).items() if key not in without} | more
    members = [(key, *kind) for key, kind in kinds.items()]
    space = {"__doc__": f"{doc}\n{record.__doc__}"}
    return msgspec.defstruct(name, members, namespace=space, forbid_unknown_fields=True, kw_only=True)


ListQuery = _optional(
    "ListQuery",
    HistoryFilter,
    "Which decisions.  open : verified ones that wait for a label.  limit : how many at most.  before : older ones than "
    "the answer that said so as `older`.",
    label=(Literal["good", "bad", "none"] | UnsetType, UNSET),
    open=(bool, False),
    limit=(Annotated[int, Meta(ge=1, le=200)], 20),
    before=(str, ""),
)
# A guarantee may be a class by name, and nothing that is asked over the network may have one imported.
PolicyChange = _optional("PolicyChange", Policy, "What is to change.  author : who asks.", ("guarantee",), author=(str,))


def given(asked: Struct, record: type) -> Json:
    """What a request says of a record's fields."""
    names = {field.name for field in fields(record)}
    return {key: value for key, value in msgspec.structs.asdict(asked).items() if key in names and value is not UNSET}


class Refusal(Exception):  # noqa: N818  # it is an answer, not a fault
    """A request that is not served. status : of HTTP.  detail : what was expected, what came, what to do."""

    def __init__(self, status: int, detail: str, headers: Mapping[str, str] | None = None) -> None:
        super().__init__(detail)
        self.status, self.detail, self.headers = status, detail, dict(headers or {})


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


async def read_struct(request: Request, kind: type[T], *others: str) -> T:
    """A request's body as a struct. Refusal: 415 for another media type, 400 for what is none, 422 for other fields."""
    media = media_type(request)
    if media not in DECODERS:
        taken = ", ".join((*DECODERS, *others))
        raise Refusal(415, f"Expected a body of {taken}, got {shortened(media)}.", {"Accept": taken})
    body = await request.body()
    try:
        found: T = DECODERS[media](body, type=kind)
    except msgspec.ValidationError as error:
        raise Refusal(422, f"{error}.") from error
    except (ValueError, RecursionError) as error:
        raise Refusal(400, f"Expected {media}: {error}.") from error
    if _keys(media, body) != len(DECODERS[media](body, type=dict[str, msgspec.Raw])):
        raise Refusal(400, "Expected each name once, got one twice.")
    return found


def _keys(media: str, body: bytes) -> int:
    """How many keys an object has that holds no other; msgspec lets the last of two equal ones count."""
    if media == JSON:
        return sum(map(bool, STRINGS.findall(body)))
    return body[0] & 0x0F if body[0] < 0xDE else int.from_bytes(body[1 : 3 if body[0] == 0xDE else 5])


def read_query(request: Request, kind: type[T]) -> T:
    """A request's query, and what its path names, as a struct; Refusal for another name, a name twice, or a wrong value."""
    pairs = [*request.query_params.multi_items(), *request.path_params.items()]
    try:
        if len(dict(pairs)) < len(pairs):
            raise ValueError("Expected each name of the query once")
        return msgspec.convert(dict(pairs), kind, strict=False)
    except ValueError as error:
        raise Refusal(422, f"{error}, in the query.") from error


async def read_trace(request: Request) -> tuple[NDArray[Any], str | None, str | int | None]:
    """The trace to decide on, (T,) or (channels, T), its request id and its part; Refusal where there is none."""
    asked: TraceRequest | RawQuery
    if media_type(request) == RAW:
        asked = read_query(request, RawQuery)
        trace = _samples(await request.body(), asked.channels)
    else:
        asked = await read_struct(request, TraceRequest, RAW)
        trace = _samples(asked.trace, 1)
    return trace, None if asked.request is UNSET else asked.request, None if asked.part is UNSET else asked.part


def _samples(given: bytes | list[Any], channels: int) -> NDArray[Any]:
    try:
        if isinstance(given, bytes):
            samples = np.frombuffer(given, dtype="<f4")
            samples = samples if channels == 1 else samples.reshape(channels, -1)
        else:
            samples = np.array(given, dtype=np.float64)  # None becomes NaN
    except ValueError as error:
        if isinstance(given, bytes):
            held = f"float32, little-endian, channel after channel, {channels} of them"
            raise Refusal(422, f"Expected {held}, got {len(given)} bytes.") from error
        raise Refusal(422, "Expected a list of numbers, or a list as long for each channel.") from error
    if not samples.size:
        raise Refusal(422, "Expected a trace of at least one sample, got none.")
    return samples


# What is answered


def _answer(name: str, about: str, *records: type, without: tuple[str, ...] = (), **more: Any) -> type[Struct]:
    """The type of an answer: the fields of records as JSON has them but for some, and more of them."""
    kinds = {key: kind for each in records for key, kind in _members(each).items() if key not in without} | more
    doc = "\n".join([about, *(each.__doc__ or "" for each in records)])
    return msgspec.defstruct(name, kinds.items(), namespace={"__doc__": doc}, kw_only=True)


def _members(record: type) -> Json:
    """A record's fields as `plain` gives them: without those that stand apart, and with those of one that is flat."""
    hints, found = get_type_hints(record), dict[str, Any]()
    for field in fields(record):
        if "flat" in field.metadata:
            found |= _members(hints[field.name])
        elif "apart" not in field.metadata:
            found[field.name] = _shape(hints[field.name])
    return found


@cache
def _shape(kind: Any) -> Any:
    """A type as JSON has it; a number that is not finite is null."""
    if isinstance(kind, type) and is_dataclass(kind):
        return _answer(kind.__name__, "", kind)
    if isinstance(kind, UnionType):
        return reduce(or_, map(_shape, get_args(kind)))
    if get_origin(kind) in (list, tuple):
        return list[_shape(get_args(kind)[0])]  # type: ignore[misc]  # made here
    return float | None if kind is float else kind


class Health(Struct):
    """Whether the engine answers.  store_fault : why the store cannot be written.  waiting : requests in line."""

    status: Annotated[str, Meta(extra_json_schema={"enum": ["ok", "degraded", "down"]})]
    store_fault: str
    waiting: int


class Problem(Struct):
    """Why a request is not served, as RFC 9457 has it. A part that got no decision is verified.

    detail : what was expected, what came, what to do.  action : always verify.
    """

    title: str
    status: int
    detail: str
    type: str = "about:blank"
    action: Action = Action.VERIFY


LATE = (
    "late : deadline exceeded in the queue; recorded as VERIFY.  seconds : from the request to the answer, in the server."
)
LINE = (
    "waiting : requests in line.  late, busy : deadlines exceeded, and requests refused, since the server began.  "
    "deadline : seconds in line, after which the answer is verify.  alarm : what somebody should look at.  "
    "check_seconds : that a verification takes."
)
ARRAYS = (
    "trace : (channels, samples).  low, median, high : of the band of good parts, likewise; null while there is none.  "
    "bads : the newest bad parts' traces.  corrections : of its label, oldest first."
)
Samples = list[list[float | None]]
HASH, MUCH = ("content_hash",), ("settings", "retrains")  # 64 bits are no JavaScript's; `ever.retrains` counts those
IN_LINE = {"waiting": int, "late": int, "busy": int, "deadline": float, "check_seconds": float}
ANSWERS: dict[str, type[Struct]] = {
    "Answer": _answer("Answer", f"A decision, as it is recorded.\n{LATE}", Decision, late=bool, seconds=float),
    "Told": _answer("Told", "The label is on the disk.", Told),
    "Changed": _answer("Changed", "", Changed),
    "Decision": _answer("Decision", "A decision with its label.", StoredDecision, without=HASH),
    "Traced": _answer("Traced", "A decision with its label and trace.", StoredDecision, without=HASH, trace=Samples | None),
    "Explanation": _answer(
        "Explanation",
        ARRAYS,
        Explanation,
        trace=Samples,
        low=Samples | None,
        median=Samples | None,
        high=Samples | None,
        bads=list[Samples],
        corrections=list[_shape(Correction)],  # type: ignore[misc]  # made above
    ),
    "Status": _answer("Status", LINE, Status, without=MUCH, **IN_LINE, alarm=str),
    "Course": _answer("Course", "", Course),
    "PartMap": _answer("PartMap", "", PartMap),
    "Events": _answer("Events", "Newest first.", events=list[_shape(Event)]),  # type: ignore[misc]
    "Versions": _answer("Versions", "Oldest first.", versions=list[_shape(StoredVersion)]),  # type: ignore[misc]
    "Health": Health,
    "Problem": Problem,
}
OLDER = "Newest first.  older : what `before` of the next request says for the ones before these; null: there are none."
Known: Any = ANSWERS["Decision"]
ANSWERS["Decisions"] = _answer("Decisions", OLDER, decisions=list[Known], older=str | None)


def answer(name: str, *records: object, **more: Any) -> Json:
    """An answer: what it has of records' fields, and more of them."""
    said = {key: value for each in records for key, value in plain(each).items()} | more
    return {key: said[key] for key in ANSWERS[name].__struct_fields__ if key in said}


def answered(body: Any, status: int = 200, headers: Mapping[str, str] | None = None, kind: str = JSON) -> Response:
    """A JSON answer; a number that is not finite is null."""

    def encoded(value: Any) -> Any:
        return value.tolist() if isinstance(value, np.ndarray | np.generic) else str(value)

    return Response(msgspec.json.encode(body, enc_hook=encoded), status, headers, kind)


def problem(status: int, detail: str, headers: Mapping[str, str] | None = None) -> Response:
    """The answer of a request that is not served. Whatever is wrong, a part without a decision is verified."""
    said = ({"Retry-After": str(RETRY_AFTER)} if status in LATER else {}) | dict(headers or {})
    line = " ".join(without_password(detail).split())
    return answered(Problem(HTTPStatus(status).phrase, status, line), status, said, PROBLEM)


def _refused(request: Request, error: Any) -> Response:
    """What is not served, by the nearest class of what was raised."""
    if isinstance(error, Refusal):
        return problem(error.status, error.detail, error.headers)
    if isinstance(error, HTTPException):
        said = {
            404: "Expected one of the paths in /openapi.json, got another.",
            405: "Expected another method on this path.",
        }
        return problem(error.status_code, said.get(error.status_code, str(error.detail)), error.headers)
    if isinstance(error, ClientDisconnect):
        return problem(400, "Expected the whole of the request.")  # which nobody reads
    for kind, status in STATUSES.items():
        if isinstance(error, kind):
            return problem(status, str(error))
    log.error("a request failed: %s %s", request.method, request.scope["path"], exc_info=error)
    return problem(500, "The server failed at this request; its log says why.")


STATUSES: dict[type[Exception], int] = {  # the first that fits
    UnknownDecisionError: 404,
    ReportConflictError: 409,
    TraceConflictError: 409,
    VersionError: 404,
    BusyError: 503,
    StoreError: 503,
    DengineError: 422,
}
HANDLERS: Mapping[Any, Callable[[Request, Any], Response]] = dict.fromkeys(
    (Refusal, HTTPException, ClientDisconnect, *STATUSES, Exception), _refused
)

# The OpenAPI document


PROBLEMATIC = {PROBLEM: {"schema": {"$ref": "#/components/schemas/Problem"}}}


class Operation(NamedTuple):
    """One method on one path.

    run : answers what is asked; its docstring says what it does.  answer : of `ANSWERS`, or a media type.
    takes : the struct of a POST's body, of a GET's query and path; None: it is not looked at.
    raw : whether the body may be bytes: `run` reads the request itself.  examples : of the body.
    """

    method: str
    path: str
    run: Callable[[Any], Awaitable[Json | Response]]
    answer: str
    takes: type[Struct] | None = None
    raw: bool = False
    examples: tuple[Json, ...] = ()

    async def serve(self, request: Request) -> Response:
        """Read what is asked, and answer it."""
        asked: Any = request
        if self.takes is not None and not self.raw:
            asked = read_query(request, self.takes) if self.method == "GET" else await read_struct(request, self.takes)
        found = await self.run(asked)
        return found if isinstance(found, Response) else answered(found)

    def described(self) -> Json:
        """It, as the document has it."""
        known = self.answer in ANSWERS
        schema = {"$ref": f"#/components/schemas/{self.answer}"} if known else {"type": "string"}
        responses = {
            "200": {"description": "Done.", "content": {JSON if known else self.answer: {"schema": schema}}},
            "default": {"description": "A problem.", "content": PROBLEMATIC},
        }
        said: Json = {"summary": " ".join((self.run.__doc__ or "").split()), "parameters": [], "responses": responses}
        if self.takes is None:
            return said
        query = RawQuery if self.raw else self.takes
        if self.method == "GET" or self.raw:
            for name, kind in _schemas([query])[query.__name__]["properties"].items():
                here = f"{{{name}" in self.path
                place = {"name": name, "in": "path" if here else "query", "required": here, "schema": kind}
                said["parameters"].append(place)
        if self.method == "GET":
            return said
        body: Json = {"schema": {"$ref": f"#/components/schemas/{self.takes.__name__}"}}
        examples = {"examples": {str(i): {"value": value} for i, value in enumerate(self.examples)}}
        content = {JSON: body | examples, MSGPACK: body}
        if self.raw:
            content[RAW] = {"schema": {"type": "string", "format": "binary", "description": "float32, little-endian."}}
        return said | {"requestBody": {"required": True, "content": content}}


def _schemas(kinds: Iterable[Any]) -> Json:
    """The schemas of these types; what a docstring says of a field stands with the field."""
    _, schemas = msgspec.json.schema_components(list(kinds), ref_template="#/components/schemas/{name}")
    for schema in schemas.values():
        about, *told = FIELD.split(schema.get("description", ""))
        schema["description"] = " ".join(about.split())
        for names, text in zip(told[::2], told[1::2], strict=True):
            for name in names.split(", "):
                if name in schema.get("properties", {}):
                    schema["properties"][name].setdefault("description", " ".join(text.split()))
    return schemas


def document(operations: Iterable[Operation], version: str) -> Json:
    """The OpenAPI document of these operations."""
    paths: Json = {}
    for each in operations:
        paths.setdefault(each.path.replace(":path", ""), {})[each.method.lower()] = each.described()
    bodies = {each.takes for each in operations if each.takes and each.method == "POST"}
    return {
        "openapi": "3.1.0",
        "info": {"title": "dengine serve", "version": version, "description": "A robot cell's data engine."},
        "paths": paths,
        "components": {
            "schemas": _schemas([*ANSWERS.values(), *bodies]),
            "securitySchemes": {name: {"type": "http", "scheme": name} for name in ("bearer", "basic")},
        },
        "security": [{}, {"bearer": []}, {"basic": []}],
    }
