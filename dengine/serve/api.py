"""The one schema of the server: what requests and answers hold, how they are read and written, and their OpenAPI document.

A request holds what the function takes that answers it, and is read strictly by msgspec; answers are derived from dengine's
records. JSON has no NaN: a sample that is null is one that the sensor did not give, a number that is not finite is null.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Awaitable, Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from functools import cache, cached_property, reduce
from http import HTTPStatus
from inspect import Parameter, signature
from operator import or_
from types import UnionType
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

import msgspec
import numpy as np
from msgspec import UNSET, Meta, Struct, UnsetType
from numpy.typing import NDArray
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response

from ..engine.corrections import Changed
from ..errors import (
    BusyError,
    DengineError,
    ReportConflictError,
    StoreError,
    TraceConflictError,
    TraceError,
    UnknownDecisionError,
    as_options,
    shortened,
    without_password,
)
from ..history.explain import Explanation
from ..history.map import PartMap
from ..history.status import Course, Status
from ..records import Action, Decision
from ..representation import to_jsonable
from ..store.records import Correction, Event, StoredDecision, StoredVersion, VersionError
from .service import Told

log = logging.getLogger("dengine")
T = TypeVar("T")
Json = dict[str, Any]
JSON, RAW, MSGPACK = "application/json", "application/octet-stream", "application/msgpack"
PROBLEM = "application/problem+json"
LATER = (429, 503)
RETRY_AFTER = 1  # seconds
NO_ROUTE = {404: "Expected one of the paths in /openapi.json, got another.", 405: "Expected another method on this path."}
DECODERS: Mapping[str, Callable[..., Any]] = {JSON: msgspec.json.decode, MSGPACK: msgspec.msgpack.decode}
STRINGS = re.compile(rb'"(?:[^"\\]|\\.)*+"(\s*:)?')  # of a JSON object; those before a colon are its keys
FIELD = re.compile(r"(?:^ *|  )((?:\w+, )*\w+) : ", re.MULTILINE)  # "name, name : what it is", in a docstring
REF = "#/components/schemas/{name}"
FEWEST, WILD, SOME = 32, 1e9, 0.025  # words, times the largest of the others, and the share that is so: of float64
PROBLEMATIC = {PROBLEM: {"schema": {"$ref": REF.format(name="Problem")}}}

# What is asked

Samples = list[float | list[float | None] | None]


class Refusal(Exception):  # noqa: N818  # it is an answer, not a fault
    """A request that is not served. status : of HTTP.  detail : what was expected, what came, what to do."""

    def __init__(self, status: int, detail: str, headers: Mapping[str, str] | None = None) -> None:
        super().__init__(detail)
        self.status, self.detail, self.headers = status, detail, dict(headers or {})


def fields_of(record: type, *without: str) -> Json:
    """The types of a record's fields but for some."""
    return {name: kind for name, kind in get_type_hints(record).items() if name not in without}


def _taken(run: Callable[..., Any], fields: Json) -> type[Struct]:
    """What a function takes, and fields that may be left out, as a struct; `id_` is `id` in a request."""
    hints, members = get_type_hints(run, include_extras=True), list[tuple[Any, ...]]()
    for name, each in signature(run).parameters.items():
        if each.kind is not Parameter.VAR_KEYWORD:
            members.append((name, hints[name], *([] if each.default is Parameter.empty else [each.default])))
    members += [(name, kind | UnsetType, UNSET) for name, kind in fields.items()]
    rules: Json = {"forbid_unknown_fields": True, "kw_only": True, "rename": lambda name: name.rstrip("_")}
    return msgspec.defstruct(f"{run.__name__.capitalize()}Request", members, namespace={"__doc__": run.__doc__}, **rules)


def media_type(request: Request) -> str:
    """What a request says that its body is, without parameters; "" where it says nothing."""
    return request.headers.get("content-type", "").partition(";")[0].strip().lower()


async def read_body(request: Request, kind: type[T], *others: str) -> T:
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


def read_query(request: Request, kind: type[T], **body: bytes) -> T:
    """A request's query, what its path names, and a raw body, as a struct; Refusal for another name, or a wrong value."""
    pairs = [*request.query_params.multi_items(), *request.path_params.items(), *body.items()]
    try:
        if len(dict(pairs)) < len(pairs):
            raise ValueError("Expected each name of the query once")
        return msgspec.convert(dict(pairs), kind, strict=False)
    except ValueError as error:
        raise Refusal(422, f"{error}, in the query.") from error


def as_samples(value: Any, channels: int = 1) -> NDArray[np.float32]:
    """A trace, (T,) or (channels, T); TraceError for anything else.

    value : raw float32, little-endian, so many channels one after another; a list of numbers; or one of such lists, a
        channel each. None becomes NaN, and a number beyond float32 an infinity, both of which are found and reported.
    """
    if isinstance(value, bytes):
        if len(value) % (4 * channels):
            held = f"float32, little-endian, channel after channel, {channels} of them"
            raise TraceError(f"Expected {held}, got {len(value)} bytes.")
        words = np.frombuffer(value, dtype="<f4")
        if _are_halves(words):
            got = f"{len(value)} bytes, twice as many bytes as float32 takes: float64?"
            raise TraceError(f"Expected raw float32, little-endian, got {got} Convert the trace to float32.")
        x = words.reshape(channels, -1)
    else:
        try:
            with np.errstate(over="ignore"):
                x = np.array(msgspec.convert(value, Samples), dtype=np.float64).astype(np.float32)
        except (ValueError, OverflowError) as error:
            raise TraceError("Expected numbers in a list, or a list of such lists of one length for channels.") from error
    if not x.size:
        raise TraceError("Expected at least one sample, got none.")
    return x


def _are_halves(words: NDArray[np.float32]) -> bool:
    """Whether these are numbers of float64, read as float32: every other word is the end of a fraction, or nothing."""
    if len(words) % 2 or len(words) < FEWEST:
        return False
    low, high = words[0::2], words[1::2]
    if not low.view(np.uint32).any():  # whole numbers, or halves
        return bool(high.view(np.uint32).any())
    low = low[np.isfinite(low)]
    most = float(np.abs(high[np.isfinite(high)]).max(initial=1.0))
    n_wild = int((np.abs(low) > WILD * most).sum())
    return n_wild >= SOME * len(words)


# What is answered


def _answer(name: str, about: str, record: type | None = None, without: tuple[str, ...] = (), **more: Any) -> type[Struct]:
    """The type of an answer: the fields of a record as JSON has them but for some, and more of them."""
    kinds = {key: kind for key, kind in _members(record).items() if key not in without} if record else {}
    doc = f"{about}\n{record.__doc__ if record else ''}"
    return msgspec.defstruct(name, (kinds | more).items(), namespace={"__doc__": doc}, kw_only=True)


def _members(record: type) -> Json:
    """A record's fields as `plain` gives them: without those that stand apart, and with those of one that is flat."""
    hints, found = get_type_hints(record), dict[str, Any]()
    for each in fields(record):
        if "flat" in each.metadata:
            found |= _members(hints[each.name])
        elif "apart" not in each.metadata:
            found[each.name] = _shape(hints[each.name])
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
    """Whether the engine answers.  store_fault : why the store cannot be written.  waiting : requests in line.

    retrain_fault : that retrains are dropped again and again, and why.
    """

    status: Annotated[str, Meta(extra_json_schema={"enum": ["ok", "degraded", "down"]})]
    store_fault: str
    retrain_fault: str
    waiting: int


class Me(Struct):
    """Whose token was shown.  name : that the event log gets; "": the one that is said.  operates : else he only looks."""

    name: str
    operates: bool


class Problem(Struct):
    """Why a request is not served, as RFC 9457 has it. A part that got no decision is verified.

    detail : what was expected, what came, what to do.  action : always verify.
    """

    title: str
    status: int
    detail: str
    type: str = "about:blank"
    action: Action = Action.VERIFY


LINE = """How the cell is doing.

waiting : requests in line.  late, busy : deadlines exceeded, and requests refused, since the server began.
deadline : seconds in line, after which the answer is verify.  check_seconds : that a verification takes.
alarm : what somebody should look at.
"""
ARRAYS = """Why a decision came out so.

trace : (channels, samples).  low, median, high : of the band of good parts, likewise; null while there is none.
bads : the newest bad parts' traces.  corrections : of its label, oldest first.
"""
LATE = "late : deadline exceeded in line; recorded as VERIFY.  seconds : from the request to the answer, in the server."
OLDER = "Newest first.  older : what `before` of the next request says for the ones before these; null: there are none."
IN_LINE = {"waiting": int, "late": int, "busy": int, "deadline": float, "check_seconds": float}
HASH, MUCH = ("content_hash",), ("settings", "retrains")  # 64 bits are no JavaScript's; `ever.retrains` counts those
Traces: Any = list[list[float | None]]
AROUND = {"trace": Traces, **dict.fromkeys(("low", "median", "high"), Traces | None), "bads": list[Traces]}
Known: Any = _answer("Decision", "trace : where it was asked for.", StoredDecision, HASH, trace=Traces | None)
SHAPES: dict[type, Any] = {each: list[_shape(each)] for each in (Correction, Event, StoredVersion)}  # type: ignore[misc]
ANSWERS = {
    each.__name__: each
    for each in (
        _answer("Answer", LATE, Decision, late=bool, seconds=float),
        _answer("Told", "The label is on the disk.", Told),
        _answer("Changed", "", Changed),
        Known,
        _answer("Decisions", OLDER, decisions=list[Known], older=str | None),
        _answer("Explanation", ARRAYS, Explanation, **AROUND, corrections=SHAPES[Correction]),
        _answer("Status", LINE, Status, MUCH, **IN_LINE, alarm=str),
        _answer("Course", "", Course),
        _answer("PartMap", "", PartMap),
        _answer("Events", "Newest first.", events=SHAPES[Event]),
        _answer("Versions", "Oldest first.", versions=SHAPES[StoredVersion]),
        Health,
        Me,
        Problem,
    )
}


def answer(name: str, record: object = None, **more: Any) -> Json:
    """An answer: what it has of a record's fields, and more of them."""
    said = (to_jsonable(record) or {}) | more
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
        return problem(error.status_code, NO_ROUTE.get(error.status_code, str(error.detail)), error.headers)
    if isinstance(error, ClientDisconnect):
        return problem(400, "Expected the whole of the request.")  # which nobody reads
    for kind, status in STATUSES.items():
        if isinstance(error, kind):
            return problem(status, as_options(str(error)))
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


@dataclass(frozen=True)
class Operation:
    """One method on one path.

    run : answers what its parameters name; its docstring says what it does, and what each is.
    answer : of `ANSWERS`, or a media type.  fields : that `run` takes as well, where they are given.
    raw : of its parameters, the one that a body of bytes is; the others are a query then.  examples : of the body.
    """

    method: str
    path: str
    run: Callable[..., Awaitable[Json | Response]]
    answer: str
    fields: Json = field(default_factory=dict)
    raw: str = ""
    examples: tuple[Json, ...] = ()

    @cached_property
    def takes(self) -> type[Struct]:
        """What stands in the body of a POST, in the query and the path of a GET."""
        return _taken(self.run, self.fields)

    async def serve(self, request: Request) -> Response:
        if self.method == "GET":
            asked = read_query(request, self.takes)
        elif self.raw and media_type(request) == RAW:
            asked = read_query(request, self.takes, **{self.raw: await request.body()})
        else:
            asked = await read_body(request, self.takes, *([RAW] if self.raw else []))
        given = msgspec.structs.asdict(asked).items()
        found = await self.run(**{name: value for name, value in given if value is not UNSET})
        return found if isinstance(found, Response) else answered(found)

    def described(self, schemas: Json) -> Json:
        """It, as the document has it. schemas : of all that is asked and answered."""
        takes, known = schemas[self.takes.__name__], self.answer in ANSWERS
        schema = {"$ref": REF.format(name=self.answer)} if known else {"type": "string"}
        responses = {
            "200": {"description": "Done.", "content": {JSON if known else self.answer: {"schema": schema}}},
            "default": {"description": "A problem.", "content": PROBLEMATIC},
        }
        said: Json = {"summary": takes["description"], "parameters": [], "responses": responses}
        if self.method == "GET" or self.raw:
            for name, kind in takes["properties"].items():
                place = "path" if f"{{{name}" in self.path else "query"
                if name != self.raw:
                    said["parameters"].append({"name": name, "in": place, "required": place == "path", "schema": kind})
        if self.method == "GET":
            return said
        body: Json = {"schema": {"$ref": REF.format(name=self.takes.__name__)}}
        examples = {"examples": {str(i): {"value": value} for i, value in enumerate(self.examples)}}
        content = {JSON: body | examples, MSGPACK: body}
        if self.raw:
            content[RAW] = {"schema": {"type": "string", "format": "binary", "description": "float32, little-endian."}}
        return said | {"requestBody": {"required": True, "content": content}}


def _schemas(kinds: Iterable[Any]) -> Json:
    """The schemas of these types; what a docstring says of a field stands with the field."""
    _, schemas = msgspec.json.schema_components(list(kinds), ref_template=REF)
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
    schemas, paths = _schemas([*ANSWERS.values(), *(each.takes for each in operations)]), dict[str, Json]()
    for each in operations:
        paths.setdefault(each.path.replace(":path", ""), {})[each.method.lower()] = each.described(schemas)
    return {
        "openapi": "3.1.0",
        "info": {"title": "dengine serve", "version": version, "description": "A robot cell's data engine."},
        "paths": paths,
        "components": {
            "schemas": schemas,
            "securitySchemes": {name: {"type": "http", "scheme": name} for name in ("bearer", "basic")},
        },
        "security": [{}, {"bearer": []}, {"basic": []}],
    }
