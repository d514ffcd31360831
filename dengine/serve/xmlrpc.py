"""The XML-RPC interface of a server, for a robot's program: `rpc_factory("xmlrpc",
"http://HOST:8000/RPC2")`.

The methods are those of `RobotCalls`. Every response is HTTP 200 with a value, or a fault with a
code and one line of text; only what is not XML-RPC at all gets 405 or 415. defusedxml reads the
XML: no document type, no entity, nothing from outside.
"""

from __future__ import annotations

import asyncio
import xmlrpc.client
from inspect import signature
from typing import Any

from defusedxml.xmlrpc import DefusedExpatParser  # type: ignore[import-untyped]
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from ..errors import DengineError, ReportError, as_options, log
from .api import media_type
from .auth import RPC
from .robot_calls import CALLS, RobotCalls, one_line

# Codes of faults. Negative ones are those that XML-RPC servers agreed on.
NOT_XML = -32700
NO_METHOD = -32601
WRONG_ARGUMENTS = -32602
INTERNAL_ERROR = -32603
REFUSED = 1  # a trace, or anything else, that breaks the contract
NO_REPORT = 2  # a report that does


def parse_call(body: bytes) -> tuple[str, tuple[Any, ...]]:
    """Return the method's name and a tuple of the arguments of an XML-RPC call.

    The arguments are Python values of the types that XML-RPC has, base64 as bytes; the tuple is
    empty for a call without arguments. Whether there is such a method is not checked. Raises
    ValueError for a body that is no XML, is no call, or has a document type declaration.
    """
    values: Any = xmlrpc.client.Unmarshaller(use_builtin_types=True)
    parser = DefusedExpatParser(values, forbid_dtd=True)
    try:
        parser.feed(body)
        parser.close()
        arguments = values.close()
        name = values.getmethodname()
    except Exception as error:  # malformed XML raises many types
        raise ValueError(
            f"Expected an XML-RPC call, got what cannot be read: {type(error).__name__}."
        ) from error
    if name is None:
        raise ValueError("Expected an XML-RPC call, got XML without a method's name.")
    return name, arguments


def rpc_route(calls: RobotCalls) -> Route:
    """Return the route of POST /RPC2, which calls the methods of `calls` (see `call_method`).

    A body of another media type than text/xml or application/xml gets 415.
    """

    async def rpc(request: Request) -> Response:
        """Respond with a value or a fault in XML; HTTPException 415 for another media type."""
        if media_type(request) not in ("text/xml", "application/xml"):
            raise HTTPException(415, "Expected an XML-RPC call, Content-Type: text/xml.")
        return Response(await call_method(calls, await request.body()), media_type="text/xml")

    return Route(RPC, rpc, methods=["POST"])


async def call_method(calls: RobotCalls, body: bytes) -> bytes:
    """Call the method that an XML-RPC request names, and return its value or a fault as XML.

    `calls` has the methods, of which those in `CALLS` may be called, and `body` is the request,
    which is parsed in another thread. It raises nothing: every error becomes a fault with one line
    of text and a code. The codes are -32700 for a body that cannot be read, -32601 for an unknown
    method, -32602 for a wrong number of arguments, 2 for a ReportError, and 1 for any other error
    that dengine raises on purpose (DengineError). Any other error of the method, and a value that
    XML-RPC cannot carry, have -32603; only these two are logged.
    """
    try:
        name, arguments = await asyncio.to_thread(parse_call, body)
    except ValueError as error:
        return fault(NOT_XML, str(error))
    if name not in CALLS:
        return fault(NO_METHOD, f"Expected one of {', '.join(CALLS)}.")
    call = getattr(calls, name)
    try:
        signature(call).bind(*arguments)
    except TypeError as error:
        return fault(
            WRONG_ARGUMENTS,
            f"Expected the arguments that {name} takes, got {len(arguments)}: {error}.",
        )
    try:
        return xmlrpc.client.dumps((await call(*arguments),), methodresponse=True).encode()
    except DengineError as error:
        code = NO_REPORT if isinstance(error, ReportError) else REFUSED
        return fault(code, as_options(str(error)))
    except Exception:
        log.exception("a call failed")
        return fault(INTERNAL_ERROR, "The server failed on this call: verify the part.")


def fault(code: int, text: str) -> bytes:
    """Return an XML-RPC fault, a method response in XML, as bytes.

    Its text is put on one printable line and cut to 300 characters (`one_line`).
    """
    return xmlrpc.client.dumps(
        xmlrpc.client.Fault(code, one_line(text)), methodresponse=True
    ).encode("utf-8", "replace")
