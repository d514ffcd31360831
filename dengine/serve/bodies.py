"""What a request's body says: a trace as JSON, as raw float32 or as MessagePack; a report.

JSON is taken strictly: a name twice, NaN, a bool in the place of a number, an unknown name are refused. A sample that is
null is one that the sensor did not give: it is NaN to the engine, which verifies the part.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from starlette.requests import Request

from ..wording import listed, shortened
from .problems import Refusal

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
