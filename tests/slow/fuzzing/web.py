"""Malformed requests over HTTP: bodies, heads, XML-RPC, the page, and bytes that are no HTTP at all.

Each maker gives a whole request as bytes, from a random generator. What is broken on purpose is broken for sure; what is
only spoilt may still be good, and is then answered as such.
"""

from __future__ import annotations

import json
import random
import struct
import xmlrpc.client
from collections.abc import Callable
from typing import Any

SAMPLES = 40
JSON, RAW, PACK, XML = "application/json", "application/octet-stream", "application/msgpack", "text/xml"
GOOD = [float(i % 7) for i in range(SAMPLES)]
TRACES: list[Any] = [
    *(None, True, 1, -1.5, "", "1,2", "NaN", {}, {"a": 1}, [], [[]], [[], []], [None, "x"], [1, True], [[1], [1, 2]]),
    *([1.0], GOOD[:-1], [*GOOD, 1.0], [GOOD, GOOD], [[GOOD]], [10**400] * SAMPLES, ["1"] * SAMPLES, [[1.0]] * SAMPLES),
]
IDS: list[Any] = ["", "a\nb", "\0", "x" * 500, "\x1b[31m", "é" * 201, 5, 1.5, True, [], {}, ["a"], "\u202e\n"]
PATHS = [
    *("/", "//", "/../../etc/passwd", "/decisions/..%2f..%2fetc%2fpasswd", "/decisions/%00", "/decisions/" + "x" * 3000),
    *("/decisions/';DROP TABLE decision;--", "/decide/", "/DECIDE", "/report?x=" + "y" * 5000, "/%ff%fe", "/api/none"),
    *(
        "/page/static/../../acts.py",
        "/page/static/%2e%2e/%2e%2e/x",
        "/RPC2/wrong",
        "/RPC2?token=wrong",
        "/.env",
        "/page/static/..%2fx",
    ),
    *("/decisions?limit=-1", "/decisions?limit=1e9", "/decisions?open=maybe", "/decisions?limit=%00"),
]
TOKEN = "@" * 43  # in the place of the token that the page's own forms carry
ACTS = ["correct", "rollback", "shadow-on", "shadow-off", "retrain", "export", "none", "..%2f", "%00"]
FIELDS = [  # of a form: none of them is whole
    *(
        "",
        "author=",
        "author=%00",
        "author=" + "x" * 300,
        "a=b&" * 50,
        "author=%E2%80%AE",
    ),
    *("author=kim&id=unknown&label=good", "author=kim&id=&label=good", "author=kim&version=-1", "author=kim&version=x"),
    *("author=kim&version=" + "9" * 6000, "author=kim&version=%D9%A1", "author=kim&id=known-0&label=maybe"),
]
VIEWS = [
    "/part?id=",
    "/map?id=",
    "/history?id=",
    "/history?from=",
    "/history?page=",
    "/history?action=",
    "/how?last=",
    "/?x=",
]
ODD = ["", "%00", "x" * 900, "%ff", "';--", "<script>", "-1", "1e999", "9" * 5000, "%0d%0aSet-Cookie:a=b", "../../x"]
METHODS = ["PUT", "DELETE", "PATCH", "TRACE", "CONNECT", "BREW", "get", "PROPFIND"]


def request(
    body: bytes, path: str = "/decide", content: str = JSON, method: str = "POST", heads: tuple[str, ...] = ()
) -> bytes:
    """A request whose frame is right."""
    lines = [f"{method} {path} HTTP/1.1", "Host: localhost", f"Content-Type: {content}", f"Content-Length: {len(body)}"]
    return "\r\n".join([*lines, *heads, "", ""]).encode("utf-8", "replace") + body


def spoilt(rng: random.Random, body: bytes) -> bytes:
    """Bytes that are changed, cut out, put in, doubled."""
    out = bytearray(body)
    for _ in range(rng.choice((1, 1, 2, 8))):
        at, size = rng.randrange(len(out) + 1), rng.choice((1, 1, 2, 4, 16))
        match rng.randrange(4):
            case 0:
                out[at : at + size] = rng.randbytes(size)
            case 1:
                del out[at : at + size]
            case 2:
                out[at:at] = rng.randbytes(size)
            case _:
                out[at:at] = out[at : at + size]
    return bytes(out)


def as_json(rng: random.Random) -> bytes:
    """JSON with wrong values, wrong names, or that is none."""
    match rng.randrange(8):
        case 0 | 1:
            return request(json.dumps({"trace": rng.choice(TRACES)}).encode())
        case 2:
            return request(json.dumps({"trace": GOOD, rng.choice(("request", "part")): rng.choice(IDS[:5])}).encode())
        case 3:
            label = rng.choice((None, "OK", -1, 2, 0.5, [], {}, "true"))
            return request(json.dumps({"id": rng.choice(("known", "x", 5, None)), "success": label}).encode(), "/report")
        case 4:
            doubled = '{"trace": [1], "trace": ' + json.dumps(GOOD) + "}"
            odd = ("NaN", "[NaN]", "{", "", "\ufeff{}", "[" * 50_000, '{"trace": [Infinity]}', doubled, '{"a": 1}', "nul")
            return request(rng.choice(odd).encode())
        case 5:
            whole = json.dumps({"trace": GOOD, "request": f"spoilt-{rng.randrange(10**12)}"}).encode()
            return request(spoilt(rng, whole))
        case 6:
            return request(json.dumps({"trace": GOOD}).encode(rng.choice(("utf-16", "utf-32"))))
        case _:
            return request(json.dumps({"trace": GOOD}).encode(), content=rng.choice(("text/plain", "", "a/b", XML, "\x7f")))


def as_raw(rng: random.Random) -> bytes:
    """Raw samples of a wrong number, or with a wrong query."""
    whole = struct.pack(f"<{SAMPLES}f", *GOOD)
    queries = ("channels=0", "channels=-1", "channels=3", "channels=x", "channels=1&channels=1", "a=b", "request=%00")
    queries += ("request=" + "x" * 500, "part=%0a", "channels=99999999999999999999", "channels=%D9%A1")
    match rng.randrange(3):
        case 0:
            return request(rng.randbytes(rng.choice((0, 1, 3, 4, 159, 161, 1000))), content=RAW)
        case 1:
            return request(whole, f"/decide?{rng.choice(queries)}", RAW)
        case _:
            return request(whole * rng.choice((2, 3, 100)), content=RAW)


def as_msgpack(rng: random.Random) -> bytes:
    """MessagePack with wrong values, endless lengths, other types, or that is none."""
    from msgspec.msgpack import encode

    def table(**values: Any) -> bytes:
        return bytes(encode(values))

    match rng.randrange(5):
        case 0:
            trace = rng.choice([each for each in TRACES if "10000" not in str(each)[:8]] + [b"", b"abc", b"1234"])
            return request(table(trace=trace), content=PACK)
        case 1:
            lengths = (b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", b"\xdb\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff")
            return request(rng.choice(lengths) + rng.randbytes(4), content=PACK)
        case 2:
            odd = (b"", b"\xc1", b"\x91" * 5000, b"\x81\x01\x02", b"\xd6\xff\0\0\0\0", b"\xc7\x04\x05abcd", b"\x80\x80")
            return request(rng.choice(odd), content=PACK)
        case 3:
            return request(table(id=rng.choice(("x", 5, None)), success=rng.choice((None, "OK", -1, 2))), "/report", PACK)
        case _:
            return request(spoilt(rng, table(trace=GOOD, request=f"spoilt-{rng.randrange(10**12)}")), content=PACK)


def as_head(rng: random.Random) -> bytes:
    """Wrong methods, paths and headers."""
    body = json.dumps({"trace": GOOD}).encode()
    match rng.randrange(6):
        case 0:
            return request(b"", rng.choice(("/decide", "/report", "/status", "/RPC2")), method=rng.choice(METHODS))
        case 1:
            return (
                request(b"", rng.choice(PATHS), method=rng.choice(("GET", "POST")))
                if rng.random() < 0.9
                else b"GET\r\n\r\n"
            )
        case 2:
            heads = ("Origin: http://evil.example", "Sec-Fetch-Site: cross-site", "Origin: null")
            return request(body, heads=(rng.choice(heads),))
        case 3:
            return request(body).replace(
                b"Host: localhost", rng.choice((b"Host: evil.example", b"X: y", b"Host: a/b@c", b"Host:"))
            )
        case 4:
            length = rng.choice((b"-1", b"x", b"99999999999999999999", b"1e3", b"+5", b"2000000000", b""))
            return request(body).replace(f"Content-Length: {len(body)}".encode(), b"Content-Length: " + length)
        case _:
            return request(b"", rng.choice(("/decide", "/report")), method="GET")


def as_xml(rng: random.Random) -> bytes:
    """XML-RPC that is none, that wants too much, or that calls what there is not."""

    def call(name: str, *arguments: Any) -> bytes:
        return xmlrpc.client.dumps(arguments, name, allow_none=True).encode("utf-8", "replace")

    small = [each for each in TRACES if "10000" not in str(each)[:8]]
    match rng.randrange(6):
        case 0:
            return request(call("decide", rng.choice(small)), "/RPC2", XML)
        case 1:
            name = rng.choice(
                ("system.listMethods", "__class__", "", "decide.x", "report", "add", "eval", "decide_recorded")
            )
            return request(call(name, *rng.choice(((), (1,), ("a", "b", "c", "d")))), "/RPC2", XML)
        case 2:
            bomb = "".join(f'<!ENTITY a{i} "{f"&a{i - 1};" * 10}">' for i in range(1, 10))
            odd = (f'<!DOCTYPE b [<!ENTITY a0 "ha">{bomb}]><a>&a9;</a>', '<!DOCTYPE a SYSTEM "file:///etc/passwd"><a/>')
            odd += ("", "<", "<a/>", "<?xml version='1.0' encoding='utf-7'?><a/>", "<array>" * 10_000, "\0")
            return request(rng.choice(odd).encode(), "/RPC2", XML)
        case 3:
            values = (
                "<int>" + "9" * 6000 + "</int>",
                "<base64>=!</base64>",
                "<nil/>",
                "<struct><member/></struct>",
                "<int/>",
            )
            param = f"<params><param><value>{rng.choice(values)}</value></param></params>"
            xml = f"<methodCall><methodName>report</methodName>{param}</methodCall>"
            return request(xml.encode(), "/RPC2", XML)
        case 4:
            return request(spoilt(rng, call("decide", GOOD, f"spoilt-{rng.randrange(10**12)}")), "/RPC2", XML)
        case _:
            return request(call("status"), "/RPC2", rng.choice((JSON, "text/plain", "")))


def as_page(rng: random.Random) -> bytes:
    """What the page's own requests are not: acts with wrong forms, of others, without the token; views of nothing."""
    form, act = rng.choice(FIELDS), rng.choice(ACTS)
    kind, own = "application/x-www-form-urlencoded", "Origin: http://localhost"
    match rng.randrange(5):
        case 0 | 1:
            wrong = act if "author=kim" not in form or act in ("correct", "rollback") else "none"
            return request(f"token={TOKEN}&{form}".encode(), f"/acts/{wrong}", kind, heads=(own,))
        case 2:
            heads = ("Origin: http://evil.example", "Sec-Fetch-Site: cross-site", "Cookie: " + "a=b;" * 200)
            return request(b"author=kim", f"/acts/{act}", kind, heads=(rng.choice(heads),))
        case 3:
            body = rng.choice((b"token=x&author=kim", b"{}", rng.randbytes(60), b"&" * 5000, b"author=kim&" * 40))
            return request(body, f"/acts/{act}", kind, heads=(own,))
        case _:
            return request(b"", rng.choice(VIEWS) + rng.choice(ODD), kind, "GET")


def as_bytes(rng: random.Random) -> bytes:
    """No HTTP, half of it, or too much of it."""
    good = request(json.dumps({"trace": GOOD}).encode(), heads=("Connection: close",))
    match rng.randrange(6):
        case 0:
            return rng.randbytes(rng.choice((1, 10, 100, 3000)))
        case 1:
            return good[: rng.randrange(1, len(good) - 1)]
        case 2:
            return b"GET /status HTTP/1.1\r\n" + b"X: " + b"y" * 100_000 + b"\r\n\r\n"
        case 3:
            return (
                b"GET /status HTTX/1.1\r\nHost: localhost\r\n\r\n"
                if rng.random() < 0.5
                else b"\x16\x03\x01\x02\x00\x01\x00"
            )
        case 4:
            chunks = rng.choice((b"zz\r\n", b"-1\r\n", b"FFFFFFFFFFFFFFFF\r\n", b"5\r\nabc"))
            lines = (
                b"POST /decide HTTP/1.1",
                b"Host: localhost",
                b"Transfer-Encoding: chunked",
                b"Content-Type: a/b",
                b"",
                b"",
            )
            return b"\r\n".join(lines) + chunks
        case _:
            both = ("Transfer-Encoding: chunked", "Connection: close")
            return request(b"0\r\n\r\n", heads=both)


MAKERS: dict[str, Callable[[random.Random], bytes]] = {
    "json": as_json,
    "raw": as_raw,
    "msgpack": as_msgpack,
    "head": as_head,
    "xmlrpc": as_xml,
    "page": as_page,
    "bytes": as_bytes,
}
