"""XML-RPC, as a robot's program speaks it: `rpc_factory("xmlrpc", "http://HOST:8000/RPC2")`.

The calls are those of `RobotCalls`. Every answer is HTTP's 200 with a value or a fault, a code and one line; only what is
no XML-RPC at all is a 405 or 415. The XML is read by defusedxml: no document type, no entity, nothing from outside.
"""

import asyncio
import logging
import xmlrpc.client
from inspect import signature
from typing import Any

from defusedxml.xmlrpc import DefusedExpatParser  # type: ignore[import-untyped]
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route

from ..errors import DengineError, ReportError, as_options
from .api import media_type
from .auth import RPC
from .robot_calls import Call, Recorder, RobotCalls, one_line
from .service import CellService

log = logging.getLogger("dengine")
SMALL = 1 << 16  # bytes of a call that is read at once; more is read in a thread
TAGS = ("int", "i4", "double", "boolean", "string", "base64", "array", "value", "params", "methodName")

NOT_XML, NO_METHOD, WRONG_ARGUMENTS, OURS = -32700, -32601, -32602, -32603  # as XML-RPC servers agreed on
REFUSED, NO_REPORT = 1, 2  # a trace, or anything else, that breaks the contract; a report that does


def parsed(body: bytes) -> tuple[str, tuple[Any, ...]]:
    """A call's name and arguments, numbers, booleans, texts, bytes and lists; ValueError for what is none."""
    values: Any = xmlrpc.client.Unmarshaller(use_builtin_types=True)
    values.dispatch = {name: values.dispatch[name] for name in TAGS}
    parser = DefusedExpatParser(values, forbid_dtd=True)
    try:
        parser.feed(body)
        parser.close()
        arguments, name = values.close(), values.getmethodname()
    except Exception as error:  # whatever malformed XML does to its readers, it is malformed
        raise ValueError(f"Expected an XML-RPC call, got what cannot be read: {type(error).__name__}.") from error
    if name is None:
        raise ValueError("Expected an XML-RPC call, got XML without a method's name.")
    return name, arguments


def routes(service: CellService, recorder: Recorder | None = None) -> list[Route]:
    """POST /RPC2. recorder : of the traces of `decide_recorded`, whose owner closes it."""
    calls = RobotCalls(service, recorder).table()

    async def rpc(request: Request) -> Response:
        if media_type(request) not in ("text/xml", "application/xml"):
            return PlainTextResponse("Expected an XML-RPC call, Content-Type: text/xml.\n", 415)
        if request.headers.get("content-encoding", "identity") != "identity":
            return PlainTextResponse("Expected a call that is not compressed.\n", 415)
        return Response(await answered(calls, await request.body()), media_type="text/xml")

    return [Route(RPC, rpc, methods=["POST"])]


async def answered(calls: dict[str, Call], body: bytes) -> bytes:
    """The answer to a call, as XML; what goes wrong is a fault."""
    try:
        name, arguments = parsed(body) if len(body) <= SMALL else await asyncio.to_thread(parsed, body)
    except ValueError as error:
        return fault(NOT_XML, str(error))
    if name not in calls:
        return fault(NO_METHOD, f"Expected one of {', '.join(calls)}.")
    call = calls[name]
    try:
        signature(call).bind(*arguments)
    except TypeError as error:
        return fault(WRONG_ARGUMENTS, f"Expected the arguments that {name} takes, got {len(arguments)}: {error}.")
    try:
        return xmlrpc.client.dumps((await call(*arguments),), methodresponse=True).encode()
    except DengineError as error:
        return fault(NO_REPORT if isinstance(error, ReportError) else REFUSED, as_options(str(error)))
    except Exception:  # ours: the log has it, the caller verifies
        log.exception("a call failed")
        return fault(OURS, "The server failed on this call: verify the part.")


def fault(code: int, text: str) -> bytes:
    """A fault of one line, of characters that print."""
    return xmlrpc.client.dumps(xmlrpc.client.Fault(code, one_line(text)), methodresponse=True).encode("utf-8", "replace")
