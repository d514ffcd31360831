"""What is answered to a request that is not served: a problem as RFC 9457 has it, and what the cell does all the same."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from http import HTTPStatus

from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response

from ..errors import BusyError, DengineError, StoreError
from ..records import Action
from ..wording import without_password

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
