"""Reads requests, writes responses, and derives the OpenAPI document of the HTTP interface.

`http.HttpApi` uses it. A request has the parameters of the function that handles it, and is read
strictly by msgspec. A response has the fields of a record of dengine. The OpenAPI document is
derived from the same types; what a field means is said by `msgspec.Meta` at its type. JSON has no
NaN: in a request, null is a sample that the sensor did not give; in a response, a number that is
not finite.
"""

from __future__ import annotations

import re
from collections.abc import Awaitable, Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from functools import cache, cached_property, reduce
from http import HTTPStatus
from inspect import Parameter, getdoc, signature
from operator import methodcaller, or_
from types import UnionType
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin, get_type_hints

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
    VersionError,
    as_options,
    log,
    shortened,
    without_password,
)
from ..history.explain import Explanation
from ..history.map import PartMap
from ..history.status import Course, Status
from ..records import Action, TraceArray
from ..representation import to_jsonable
from ..store.records import Correction, Event, StoredDecision, StoredVersion
from ..traces import LARGEST
from .service import ReportResponse, ServiceResponse

T = TypeVar("T", bound=msgspec.Struct)
Json = dict[str, Any]
JSON = "application/json"
RAW = "application/octet-stream"
PROBLEM = "application/problem+json"
RETRY_SECONDS = 1
NO_ROUTE = {
    404: "Expected one of the paths in /openapi.json, got another.",
    405: "Expected a method that /openapi.json lists for this path, got another.",
}
STRINGS = re.compile(rb'"(?:[^"\\]|\\.)*+"(\s*:)?')  # in JSON; a key is followed by a colon
REF = "#/components/schemas/{name}"
Samples = list[float | list[float | None] | None]

# Bytes are taken for float64 from so many words on, if this share of all words are low halves that
# are larger than a sample can be.
MIN_WORDS = 32
LARGE_SHARE = 0.025

# Requests


def field_types(record: type, *without: str) -> Json:
    """Return the types of a record's fields by name, except those of the names in `without`.

    The types are the annotations of the class, evaluated and without `Annotated`, in the order of
    the fields. A name in `without` that is no field has no effect.
    """
    return {name: hint for name, hint in get_type_hints(record).items() if name not in without}


def _request_type(handler: Callable[..., Any], optional_fields: Json) -> type[Struct]:
    """Return a msgspec struct type, into which a request is decoded.

    It has a field for each parameter of the handler (the method that answers the request), except a
    `**` parameter. A parameter with a default may be left out of a request, and has its default
    then. The `optional_fields`, given as types by name, may be left out too, and are msgspec's
    UNSET then. Decoding refuses unknown fields. Underscores at the end of a parameter's name are
    left out in a request: `id_` is `id` there. The type gets the handler's docstring. Its name is
    the handler's with a capital first letter, and `Request`: `ReportRequest` for `report`.
    """
    hints = get_type_hints(handler, include_extras=True)
    members: list[tuple[Any, ...]] = []
    for name, parameter in signature(handler).parameters.items():
        if parameter.kind is Parameter.VAR_KEYWORD:
            continue
        default = () if parameter.default is Parameter.empty else (parameter.default,)
        members.append((name, hints[name], *default))
    members += [(name, hint | UnsetType, UNSET) for name, hint in optional_fields.items()]
    return msgspec.defstruct(
        f"{handler.__name__.capitalize()}Request",
        members,
        namespace={"__doc__": handler.__doc__},
        forbid_unknown_fields=True,
        kw_only=True,
        rename=lambda name: name.rstrip("_"),
    )


def media_type(request: Request) -> str:
    """Return the media type of a request's body in lower case, without parameters; "" if the
    request names none.
    """
    return request.headers.get("content-type", "").partition(";")[0].strip().lower()


async def read_body(request: Request, struct_type: type[T]) -> T:
    """Decode a request's JSON body into a struct of `struct_type`, and return the struct.

    The body must be an object without nested objects; the media type is not checked. Raises
    HTTPException: 400 for a body that is no JSON or has a name twice, 422 for a missing field, an
    unknown name (if `struct_type` forbids unknown fields), and a value that the type does not take.
    Raises ClientDisconnect if the client goes away before the whole body has come. While the body
    is read, HTTPException 413 is raised if it is larger than the server's `Guard` allows (1 MiB).
    """
    body = await request.body()
    try:
        decoded = msgspec.json.decode(body, type=struct_type)
    except msgspec.ValidationError as error:
        # msgspec takes a text for bytes in base64; whoever sends one knows nothing of that.
        wanted = "Expected lists of numbers, or raw float32 in base64, got a text"
        text = str(error).replace("Invalid base64 encoded string", wanted)
        names = ", ".join(struct_type.__struct_encode_fields__)
        raise HTTPException(422, f"{text}. The names are {names}.") from error
    except (ValueError, RecursionError) as error:
        raise HTTPException(400, f"Expected {JSON}: {error}.") from error
    # msgspec takes the last of two equal keys.
    n_keys = sum(map(bool, STRINGS.findall(body)))
    if n_keys != len(msgspec.json.decode(body, type=dict[str, msgspec.Raw])):
        raise HTTPException(400, "Expected each name once, got one twice.")
    return decoded


def read_query(request: Request, struct_type: type[T], **body: bytes) -> T:
    """Convert the query of a request and the parameters in its path to a struct of `struct_type`.

    Keyword arguments (`body`) are further fields by name; a body of raw bytes is given in this way.
    Texts are converted to the types of the fields, like "1" or "true" to True. Raises HTTPException
    422 for an unknown name (if `struct_type` forbids unknown fields), a name that comes twice (also
    once in the query and once in the path or in `body`), a missing field and a wrong value.
    """
    pairs = [*request.query_params.multi_items(), *request.path_params.items(), *body.items()]
    try:
        if len(dict(pairs)) < len(pairs):
            raise ValueError("Expected each name of the query once")
        return msgspec.convert(dict(pairs), struct_type, strict=False)
    except ValueError as error:
        raise HTTPException(422, f"{error}, in the query.") from error


def as_samples(value: Any, channels: int = 1) -> TraceArray:
    """Convert a trace as clients send it to an array.

    Parameters
    ----------
    value : bytes, list of float, or list of list of float
        Bytes are raw float32, little-endian, channel after channel. A nested list has a list for
        each channel. None becomes NaN, and a number that is too large for float32 becomes infinity.
        No error is raised for either; the engine that gets the trace sees the fault.
    channels : int
        Number of channels in bytes, 1 or more; it has no effect on lists.

    Returns
    -------
    array of float32
        Of shape (channels, T) from bytes and nested lists, (T,) from a flat list. From bytes it is
        a view of them, which cannot be written to.

    Raises
    ------
    TraceError
        For a value of another type (also a NumPy array), lists of unequal length, no samples, bytes
        that are not the same whole number of samples for each channel, and bytes that look like
        float64.
    """
    if isinstance(value, bytes):
        if len(value) % (4 * channels):
            raise TraceError(
                "Expected a list of numbers, or raw float32, little-endian, channel after channel, "
                f"{channels} of them, got {len(value)} bytes."
            )
        words = np.frombuffer(value, dtype="<f4")
        if _look_like_float64(words):
            raise TraceError(
                f"Expected raw float32, little-endian, got {len(value)} bytes, twice as many bytes "
                "as float32 takes: float64? Convert the trace to float32."
            )
        samples = words.reshape(channels, -1)
    else:
        try:
            with np.errstate(over="ignore"):
                samples = np.array(msgspec.convert(value, Samples), np.float64).astype(np.float32)
        except (ValueError, OverflowError) as error:
            raise TraceError(
                "Expected numbers in a list, or a list of such lists of one length for channels."
            ) from error
    if not samples.size:
        raise TraceError("Expected at least one sample, got none.")
    return samples


def _look_like_float64(words: NDArray[np.float32]) -> bool:
    """Return whether float32 words (n,) look like halves of float64 numbers, each low half first.

    The low half of a float64 number, the words at even positions, is the end of its fraction:
    random bits, or zeros. So the result is True if all low halves are zero and some high half is
    not, as for whole numbers. It is also True if many low halves, at least 2.5 % of all words
    (`LARGE_SHARE`), are larger than any sample may be, 1e18 (`LARGEST`); words that are not finite
    do not count. It is False for fewer than 32 words (`MIN_WORDS`) and for an odd number.
    """
    if len(words) % 2 or len(words) < MIN_WORDS:
        return False
    low = words[0::2]
    if not low.any():
        return bool(words.any())
    n_large = int(((np.abs(low) > LARGEST) & np.isfinite(low)).sum())
    return n_large >= LARGE_SHARE * len(words)


# Responses


def _response_type(
    name: str, about: str, /, record: type | None = None, without: tuple[str, ...] = (), **more: Any
) -> type[Struct]:
    """Make and return a msgspec struct type named `name`, which describes a response.

    It has the fields of the dataclass `record`, if one is given, except those in `without`, with
    the types that they have in JSON; a field whose metadata has the key "apart" is left out, too
    (`_json_field_types`). It also has the fields of `more`, given as types by name; they replace
    fields of the record with the same name. No field has a default. Its docstring is `about`,
    followed by that of the record.
    """
    members = _json_field_types(record) if record else {}
    types = {key: hint for key, hint in members.items() if key not in without}
    doc = "\n\n".join(filter(None, [about, getdoc(record) if record else None]))
    return msgspec.defstruct(name, (types | more).items(), namespace={"__doc__": doc}, kw_only=True)


def _json_field_types(record: type) -> Json:
    """Return a dict: name of each field of the dataclass `record` -> its type in JSON.

    The names are those that `to_jsonable` uses. A field is left out if its metadata has the key
    "apart". If its metadata has the key "flat", the field holds a dataclass itself, and is replaced
    by the fields of that dataclass.
    """
    hints = get_type_hints(record)
    members: Json = {}
    for field_ in fields(record):
        if "flat" in field_.metadata:
            members |= _json_field_types(hints[field_.name])
        elif "apart" not in field_.metadata:
            members[field_.name] = _json_type(hints[field_.name])
    return members


@cache
def _json_type(hint: Any) -> Any:
    """Return the type that a value of the Python type `hint` has in JSON, as msgspec writes types.

    A dataclass becomes a struct type. `list[X]` and `tuple[X, ...]` become a list type; of a tuple
    with several types only the first type counts. `float` becomes `float | None`. In `X | Y` both
    types are converted. Other types are returned as they are. The result is cached.
    """
    if isinstance(hint, type) and is_dataclass(hint):
        return _response_type(hint.__name__, "", hint)
    if isinstance(hint, UnionType):
        return reduce(or_, map(_json_type, get_args(hint)))
    if get_origin(hint) in (list, tuple):
        return list[_json_type(get_args(hint)[0])]  # type: ignore[misc]  # made here
    return float | None if hint is float else hint


def _described(hint: Any, text: str) -> Any:
    """Return the type `hint`, annotated with `text`, its description in the OpenAPI document."""
    return Annotated[hint, Meta(description=text)]


class Problem(Struct):
    """Why a request is not served, in the form of RFC 9457. A part without a decision is
    verified.
    """

    title: str
    status: int
    detail: Annotated[str, Meta(description="What was expected, what came, what to do.")]
    type: str = "about:blank"
    action: Annotated[Action, Meta(description="Always verify.")] = Action.VERIFY


LINE = {  # attributes of `CellService`
    "waiting": _described(int, "Requests in the queue."),
    "late": _described(int, "Decisions past the deadline since the server's start."),
    "busy": _described(int, "Requests refused because the queue was full, since the start."),
    "deadline": _described(float, "Seconds in the queue after which a part is verified."),
    "check_seconds": _described(float, "Duration of a verification."),
}
Traces: Any = list[list[float | None]]
DecisionResponse: Any = _response_type(
    "Decision",
    "A decision with its label.",
    StoredDecision,
    without=("content_hash",),  # JavaScript has no integers of 64 bits
)
RESPONSES = {
    response.__name__: response
    for response in (
        _response_type(
            "DecideResponse",
            "The response to a trace.",
            ServiceResponse,
            late=_described(bool, "The deadline passed; recorded as VERIFY."),
            seconds=_described(float, "From the request to the response, in the server."),
        ),
        _response_type("ReportResponse", "The label is on disk.", ReportResponse),
        _json_type(Changed),
        DecisionResponse,
        _response_type(
            "Decisions",
            "Decisions, newest first.",
            decisions=list[DecisionResponse],
            older=_described(
                str | None, "`before` of the request for the next older ones; null: none are left."
            ),
        ),
        _response_type(
            "Explanation",
            "Why a decision came out as it did.",
            Explanation,
            trace=_described(Traces, "Shape (channels, samples)."),
            low=_described(
                Traces | None, "Lower edge of the band of good parts; null without one."
            ),
            median=_described(Traces | None, "Median of the good parts; null without a band."),
            high=_described(Traces | None, "Upper edge of the band; null without one."),
            bads=_described(list[Traces], "The newest bad parts' traces."),
            corrections=_described(_json_type(list[Correction]), "Of the label, oldest first."),
        ),
        _response_type(
            "Status",
            "How the cell is doing.",
            Status,
            without=("settings", "retrains"),  # `ever.retrains` counts them
            **LINE,
            alarm=_described(str, "What somebody should look at, or empty."),
            claim=_described(str, "What the certificate says of accepted parts, as a sentence."),
        ),
        _json_type(Course),
        _json_type(PartMap),
        _response_type("Events", "Newest first.", events=_json_type(list[Event])),
        _response_type("Versions", "Oldest first.", versions=_json_type(list[StoredVersion])),
        _response_type(
            "Health",
            "Whether the engine answers, and what is wrong with it: the response of /healthz.",
            status=Literal["ok", "degraded", "down"],
            store_fault=_described(str, "Why the store cannot be written, or empty."),
            retrain_fault=_described(str, "Why retrains are dropped again and again, or empty."),
            waiting=LINE["waiting"],
        ),
        _response_type(
            "Me",
            "The owner of the token that a request has.",
            name=_described(str, "For the event log; empty: the author that a request names."),
            operates=_described(bool, "May report and change; else only read."),
        ),
        Problem,
    )
}


def response_fields(name: str, record: object = None, **more: Any) -> Json:
    """Return a dict for JSON with the fields of the response type that `RESPONSES` has by `name`.

    A value comes from `more`, as it is, else from the record, as `to_jsonable` converts it; fields
    without a value, and values without a field, are left out. The order is that of the fields of
    the response type. Raises KeyError for a name that `RESPONSES` does not have.
    """
    values = (to_jsonable(record) or {}) | more
    return {key: values[key] for key in RESPONSES[name].__struct_fields__ if key in values}


def json_response(
    body: Any, status: int = 200, headers: Mapping[str, str] | None = None, media: str = JSON
) -> Response:
    """Return an HTTP response with `body` as JSON; a number that is not finite becomes null.

    NumPy arrays become lists. `status` is the HTTP status, `headers` are added to the response, and
    `media` is its media type. Raises AttributeError for an object that JSON has no type for.
    """
    return Response(
        msgspec.json.encode(body, enc_hook=methodcaller("tolist")), status, headers, media
    )


def problem_response(
    status: int, detail: str, headers: Mapping[str, str] | None = None
) -> Response:
    """Return the response to a request that is not served, in JSON with the fields of `Problem`.

    These are the status, its title, the detail, the type "about:blank", and the action "verify", by
    which the robot has the part checked. The media type is application/problem+json. The detail is
    put on one line, and passwords of URLs in it are masked. `headers` are added to the response;
    with status 503 it also has the header Retry-After, with 1 second, unless they have it. Raises
    ValueError for a status that HTTP does not know.
    """
    retry = {"Retry-After": str(RETRY_SECONDS)} if status == 503 else {}
    return json_response(
        Problem(HTTPStatus(status).phrase, status, " ".join(without_password(detail).split())),
        status,
        retry | dict(headers or {}),
        PROBLEM,
    )


def _error_response(request: Request, error: Any) -> Response:
    """Return the response that `problem_response` makes for an exception of a request.

    An HTTPException has a status, a text and headers of its own; but for the statuses 404 and 405,
    which only starlette raises, dengine has its own text. Another error gets the status of the
    first type in the table `STATUSES` that it is an instance of, and its own text, in which
    Python's arguments are written as options of the command line (`as_options`: `rate_hz=500`
    becomes `--rate-hz 500`). An exception of no such type gets 500 with a general text, and is
    logged with its traceback.
    """
    if isinstance(error, HTTPException):
        return problem_response(
            error.status_code, NO_ROUTE.get(error.status_code, error.detail), error.headers
        )
    for error_type, status in STATUSES.items():
        if isinstance(error, error_type):
            return problem_response(status, as_options(str(error)))
    log.error("a request failed: %s %s", request.method, request.scope["path"], exc_info=error)
    return problem_response(500, "The server failed at this request; its log says why.")


STATUSES: dict[type[Exception], int] = {  # the first that fits
    UnknownDecisionError: 404,
    ReportConflictError: 409,
    TraceConflictError: 409,
    VersionError: 404,
    BusyError: 503,
    StoreError: 503,
    DengineError: 422,
    ClientDisconnect: 400,  # nobody reads it
}
HANDLERS: Mapping[Any, Callable[[Request, Any], Response]] = dict.fromkeys(
    (HTTPException, *STATUSES, Exception), _error_response
)

# The OpenAPI document


@dataclass(frozen=True)
class Operation:
    """One method on one path.

    Attributes
    ----------
    method, path : str
    handler : callable
        Called with the request's fields as keyword arguments. Its docstring is the summary. It
        returns the fields of the response as a dict, a record that has these fields, or a whole
        response.
    response : str
        A name in `RESPONSES`, or a media type.
    optional_fields : dict
        Types of further fields that the handler takes if they are given.
    raw_parameter : str
        Name of the parameter that gets the body if the body is bytes; the other parameters are then
        read from the query. "": the body must be JSON.
    """

    method: str
    path: str
    handler: Callable[..., Awaitable[object]]
    response: str
    optional_fields: Json = field(default_factory=dict)
    raw_parameter: str = ""

    @cached_property
    def request_type(self) -> type[Struct]:
        """The struct type with the fields of a POST's body or a GET's query and path; cached."""
        return _request_type(self.handler, self.optional_fields)

    async def serve(self, request: Request) -> Response:
        """Read a request, call the handler with its fields, and return the response.

        The fields of a GET are read from its query and path, those of a POST from its JSON body. If
        the operation has a `raw_parameter` and the body is bytes (application/octet-stream), the
        body is the field of this name, and the other fields are read from the query. Optional
        fields that were left out are not passed on. If the handler returns no response, its result
        is sent as JSON: a dict as it is, a record with the fields of the response type. Raises
        HTTPException for a request that cannot be read (415 for a body of another media type; see
        `read_body` and `read_query`), ClientDisconnect for one that is cut off, and whatever the
        handler raises; the application turns all into responses.
        """
        media = media_type(request)
        if self.method == "GET":
            values = read_query(request, self.request_type)
        elif media == JSON:
            values = await read_body(request, self.request_type)
        elif media == RAW and self.raw_parameter:
            body = {self.raw_parameter: await request.body()}
            values = read_query(request, self.request_type, **body)
        else:
            accepted = f"{JSON}, {RAW}" if self.raw_parameter else JSON
            problem = f"Expected a body of {accepted}, got {shortened(media)}."
            raise HTTPException(415, problem, {"Accept": accepted})
        given = msgspec.structs.asdict(values).items()
        result = await self.handler(**{key: value for key, value in given if value is not UNSET})
        if isinstance(result, Response):
            return result
        is_json = isinstance(result, dict)
        return json_response(result if is_json else response_fields(self.response, result))

    def describe(self, schemas: Json) -> Json:
        """Return the operation, a method on a path, as an OpenAPI operation object, a dict.

        It has the summary (the docstring of the handler that answers), the responses (200, and for
        any other status a problem, the JSON object that tells an error), and for a POST the
        request's body. The fields of the request are parameters of a GET, and also of a POST whose
        body may be raw bytes, except the field that gets these bytes; only fields in the path are
        marked as required. `schemas` has the JSON schema of every request type and response by
        name; it is only read.
        """
        request_schema = schemas[self.request_type.__name__]
        if self.response in RESPONSES:
            content = _json_content(self.response)
        else:
            content = {self.response: {"schema": {"type": "string"}}}
        problem = _json_content("Problem", PROBLEM)
        in_path = set(re.findall(r"{(\w+)", self.path))
        parameters = [
            {
                "name": name,
                "in": "path" if name in in_path else "query",
                "required": name in in_path,
                "schema": field_schema,
            }
            for name, field_schema in request_schema["properties"].items()
            if name != self.raw_parameter
        ]
        description: Json = {
            "summary": request_schema["description"],
            "parameters": parameters if self.method == "GET" or self.raw_parameter else [],
            "responses": {
                "200": {"description": "Done.", "content": content},
                "default": {"description": "A problem.", "content": problem},
            },
        }
        if self.method == "GET":
            return description
        body = _json_content(self.request_type.__name__)
        if self.raw_parameter:
            body[RAW] = {
                "schema": {
                    "type": "string",
                    "format": "binary",
                    "description": "float32, little-endian.",
                }
            }
        return description | {"requestBody": {"required": True, "content": body}}


def _json_content(name: str, media: str = JSON) -> Json:
    """Return an OpenAPI content object, a dict: `media` -> a reference to the schema `name`."""
    return {media: {"schema": {"$ref": REF.format(name=name)}}}


def openapi_document(operations: Iterable[Operation], version: str) -> Json:
    """Return the OpenAPI 3.1 document of these operations, a dict that can be encoded as JSON.

    An operation is a method on a path, with the function that answers it. `version` is the version
    of the interface that the document states. `operations` is gone through twice, so pass a list,
    not an iterator. Tokens, which authorize requests, are described as optional.
    """
    types = [*RESPONSES.values(), *(operation.request_type for operation in operations)]
    _, schemas = msgspec.json.schema_components(types, ref_template=REF)
    paths: dict[str, Json] = {}
    for operation in operations:
        path = paths.setdefault(operation.path.replace(":path", ""), {})
        path[operation.method.lower()] = operation.describe(schemas)
    schemes = {name: {"type": "http", "scheme": name} for name in ("bearer", "basic")}
    return {
        "openapi": "3.1.0",
        "info": {
            "title": "dengine serve",
            "version": version,
            "description": "A robot cell's data engine.",
        },
        "paths": paths,
        "components": {"schemas": schemas, "securitySchemes": schemes},
        "security": [{}, {"bearer": []}, {"basic": []}],
    }
