"""Stands before every route: refuses what `Access` does not let in, before any of it is read."""

from __future__ import annotations

import asyncio
from collections.abc import MutableMapping
from http import HTTPStatus
from typing import Any

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from .access import RPC, SAFE, WITHOUT_TOKEN, Access, Rates, is_called, is_own_page, is_same, may_ask, split_rpc
from .problems import Refusal, problem

ASK = 'Bearer realm="dengine", Basic realm="dengine", charset="UTF-8"'
CLOSE = {"Connection": "close"}  # what was not read is not to be taken for the next request
HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Content-Security-Policy": "default-src 'self'; object-src 'none'; base-uri 'none'; form-action 'self'; "
    "frame-ancestors 'none'",
    "Cache-Control": "no-store",
}


class Guard:
    """ASGI middleware: names, tokens, rates and sizes; and the headers that every answer has."""

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self.app = app
        self.access = access
        self.rates = Rates(access.rate, access.burst)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let a request in, or answer it."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        if scope["type"] != "http":  # there is no websocket here
            await send({"type": "websocket.close", "code": 1008})
            return
        try:
            self._look(scope)
        except Refusal as refusal:
            answer = problem(refusal.status, refusal.detail, CLOSE | refusal.headers)
            await answer(scope, receive, _with_headers(send))
            return
        await self.app(scope, Body(receive, self.access).receive, _with_headers(send))

    def _look(self, scope: MutableMapping[str, Any]) -> None:
        headers = Headers(scope=scope)
        host, client = headers.get("host"), (scope.get("client") or ("", 0))[0]
        if not is_called(host, self.access.hosts):
            raise Refusal(
                HTTPStatus.MISDIRECTED_REQUEST,
                "Expected the server to be called by its address, localhost, or a name that it was given "
                "(dengine serve --allow-host NAME).",
            )
        self._must_have_token(scope, headers)
        if scope["method"] not in SAFE and not is_own_page(headers.get("origin"), headers.get("sec-fetch-site"), host):
            raise Refusal(HTTPStatus.FORBIDDEN, "Expected a request of this server's own pages, got one of another site.")
        if not self.rates.take(client):
            raise Refusal(
                HTTPStatus.TOO_MANY_REQUESTS, f"Expected at most {self.access.rate:g} requests a second of one client."
            )
        length = headers.get("content-length", "0")
        if not (length.isascii() and length.isdecimal()):
            raise Refusal(HTTPStatus.BAD_REQUEST, "Expected Content-Length to be a whole number.")
        if len(length) > 18 or int(length) > self.access.largest:
            raise _too_large(self.access.largest)

    def _must_have_token(self, scope: MutableMapping[str, Any], headers: Headers) -> None:
        path, query, said = split_rpc(scope["path"], scope["query_string"])
        if said is not None:  # it is nobody's business from here on, with a token or without
            scope.update(path=path, raw_path=RPC.encode("ascii"), query_string=query)
        token = self.access.token
        if not token or path in WITHOUT_TOKEN or (said is not None and is_same(token, said)):
            return
        if not may_ask(token, headers.get("authorization")):
            raise Refusal(
                HTTPStatus.UNAUTHORIZED,
                "Expected the server's token: Authorization: Bearer TOKEN, or any user name with it as the password.",
                {"WWW-Authenticate": ASK},
            )


class Body:
    """A request's body, that has to be of a size, and to come in time."""

    def __init__(self, receive: Receive, access: Access) -> None:
        self._receive, self._access = receive, access
        self._left, self._more = access.largest, True
        self._until = asyncio.get_running_loop().time() + access.body_seconds

    async def receive(self) -> Message:
        """The next piece; Refusal where it is too much, or too late."""
        if not self._more:  # what follows is the word that the client has gone, which may take as long as it likes
            return await self._receive()
        try:
            async with asyncio.timeout_at(self._until):
                message = await self._receive()
        except TimeoutError:
            seconds = self._access.body_seconds
            raise Refusal(HTTPStatus.REQUEST_TIMEOUT, f"Expected the request's body within {seconds:g} s.", CLOSE) from None
        self._more = bool(message.get("more_body", False))
        self._left -= len(message.get("body", b""))
        if self._left < 0:
            raise _too_large(self._access.largest)
        return message


def _too_large(largest: int) -> Refusal:
    text = f"Expected a request of at most {largest} bytes (dengine serve --largest), got a larger one."
    return Refusal(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, text, CLOSE)


def _with_headers(send: Send) -> Send:
    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            for name, value in HEADERS.items():
                headers.setdefault(name, value)
        await send(message)

    return sending
