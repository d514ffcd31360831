"""Who may ask, and how much: a token, the names by which the server is called, sizes, times and rates.

Whoever is on this machine may ask without a token, but for web pages of others: a browser carries their requests here too.
They are known by the name that they call the server by (`Host`), and by what the browser says of where they come from.
"""

from __future__ import annotations

import asyncio
import base64
import hmac
import logging
import os
import stat
import time
from collections import OrderedDict
from collections.abc import Callable, Iterable, MutableMapping
from dataclasses import dataclass, field
from http import HTTPStatus
from ipaddress import ip_address
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from ..errors import SettingError
from .api import Refusal, problem

log = logging.getLogger("dengine")
SHORTEST = 16  # characters of a token
CLIENTS = 4096  # whose rate is remembered
RPC = "/RPC2"  # below which a robot that cannot send headers may have its token


@dataclass(frozen=True, slots=True)
class Access:
    """Who may ask, and how much.

    token : what `Authorization: Bearer` has to say, or Basic as its password; "" asks for none.
    hosts : names by which the server is called, beside localhost; an address of numbers is always taken.
    largest : bytes of a request's body.  body_seconds : in which it has to come.
    rate : requests a second of one client, on average; 0: as many as it likes.  burst : of them at once.
    """

    token: str = field(default="", repr=False)
    hosts: tuple[str, ...] = ()
    largest: int = 2**20
    body_seconds: float = 5.0
    rate: float = 500.0
    burst: int = 1000


class Rates:
    """A token bucket for each client; those that were not seen for longest are forgotten first."""

    def __init__(self, rate: float, burst: float, clock: Callable[[], float] = time.monotonic) -> None:
        self.rate, self.burst, self.clock = rate, burst, clock
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()  # tokens, and when they were counted

    def take(self, client: str) -> bool:
        """Take one token; False where there is none."""
        now = self.clock()
        tokens, since = self._buckets.pop(client, (self.burst, now))
        tokens = min(self.burst, tokens + (now - since) * self.rate)
        taken = self.rate <= 0.0 or tokens >= 1.0
        self._buckets[client] = (tokens - taken, now)
        if len(self._buckets) > CLIENTS:
            self._buckets.popitem(last=False)
        return taken


def read_token(file: Path) -> str:
    """The token in a file that nobody but its owner may read; SettingError where it is none, or others may."""
    try:
        with file.open("rb") as opened:
            mode, text = stat.S_IMODE(os.fstat(opened.fileno()).st_mode), opened.read(4096)
    except OSError as error:
        raise SettingError(f"Cannot read the token's file {file}: {error.strerror}.") from error
    # systemd, from 254 on, hands a credential to the service's user by an ACL, which shows as a right of the group.
    credentials = os.environ.get("CREDENTIALS_DIRECTORY", "")
    if mode & (0o037 if credentials and file.absolute().parent == Path(credentials) else 0o077):
        raise SettingError(f"Expected {file} to be its owner's alone, others may use it ({mode:o}): chmod 600 {file}")
    token = text.strip()
    if len(token) < SHORTEST or not token.isascii() or not token.decode("ascii").isprintable() or b" " in token:
        raise SettingError(
            f"Expected a token of at least {SHORTEST} characters of ASCII without blanks in {file}; "
            f"make one: (umask 077; openssl rand -hex 24 > {file})"
        )
    return token.decode("ascii")


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches a server that listens there."""
    try:
        return ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host == "localhost"


def in_url(host: str) -> str:
    """A host as an address has it, before its port."""
    return f"[{host}]" if ":" in host else host


def is_called(host: str | None, names: Iterable[str]) -> bool:
    """Whether a request calls the server by a name that is its own: a page that had its own name point here does not."""
    if not host or not host.isascii() or any(c in "/@?#\\ \t" for c in host):
        return False
    try:
        parts = urlsplit(f"//{host}")
        name = parts.hostname
        if name is None or parts.port == 0:
            return False
        if name != "localhost" and name not in {each.lower() for each in names}:
            ip_address(name)
    except ValueError:  # no port, or no address
        return False
    return True


def is_own_page(origin: str | None, fetch_site: str | None, host: str | None) -> bool:
    """Whether what a browser says of a request lets it be one of this server's own pages, or of no page at all."""
    if fetch_site is not None and fetch_site not in ("same-origin", "none"):
        return False
    return origin is None or (host is not None and origin.partition("://")[2].lower() == host.lower())


def may_ask(token: str, authorization: str | None) -> bool:
    """Whether a request says the token: as a bearer's, or as the password that a browser asks for."""
    kind, _, said = (authorization or "").partition(" ")
    if kind.lower() == "bearer":
        return is_same(token, said.strip())
    try:
        password = base64.b64decode(said.strip(), validate=True).decode("utf-8").partition(":")[2]
    except ValueError:  # binascii's and UnicodeDecodeError are such
        return False
    return kind.lower() == "basic" and is_same(token, password)


def is_same(token: str, said: str) -> bool:
    """Compare in a time that says nothing of where they differ."""
    return hmac.compare_digest(token.encode(), said.encode("utf-8", "surrogatepass"))


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
        self.lines = Rates(0.1, 3)  # of the log, on a client's wrong tokens

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let a request in, or answer it."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        if scope["type"] != "http":  # there is no websocket here
            await send({"type": "websocket.close", "code": 1008})
            return
        connection = scope.get("state", {}).get("connection")  # of `connections`; a test has none
        if connection is not None:
            connection.begin_request()
        try:
            self._look(scope)
        except Refusal as refusal:
            answer = problem(refusal.status, refusal.detail, CLOSE | refusal.headers)
            if refusal.status == HTTPStatus.UNAUTHORIZED:  # a line of its own: Chromium looks at the first name of each
                answer.headers.append("WWW-Authenticate", 'Bearer realm="dengine"')
            await answer(scope, receive, _with_headers(send))
        else:
            await self.app(scope, _limited(receive, self.access), _with_headers(send))
        finally:
            if connection is not None:
                connection.end_request()

    def _look(self, scope: MutableMapping[str, Any]) -> None:
        headers, access = Headers(scope=scope), self.access
        host, client = headers.get("host"), (scope.get("client") or ("", 0))[0]
        if not is_called(host, access.hosts):
            names = "its address, localhost, or a name that it was given (dengine serve --allow-host NAME)"
            raise Refusal(HTTPStatus.MISDIRECTED_REQUEST, f"Expected the server to be called by {names}.")
        if not self.rates.take(client):
            raise Refusal(
                HTTPStatus.TOO_MANY_REQUESTS, f"Expected at most {access.rate:g} requests a second of one client."
            )
        self._must_have_token(scope, headers.get("authorization"), client)
        own = is_own_page(headers.get("origin"), headers.get("sec-fetch-site"), host)
        if scope["method"] not in ("GET", "HEAD", "OPTIONS") and not own:
            raise Refusal(HTTPStatus.FORBIDDEN, "Expected a request of this server's own pages, got one of another site.")
        length = headers.get("content-length", "0")
        if not (length.isascii() and length.isdecimal()):
            raise Refusal(HTTPStatus.BAD_REQUEST, "Expected Content-Length to be a whole number.")
        if len(length) > 18 or int(length) > access.largest:
            raise _too_large(access.largest)

    def _must_have_token(self, scope: MutableMapping[str, Any], authorization: str | None, client: str) -> None:
        token, said = self.access.token, ""
        if scope["path"].startswith(f"{RPC}/"):  # it is nobody's business from here on, with a token or without
            said = scope["path"].removeprefix(f"{RPC}/")
            scope.update(path=RPC, raw_path=RPC.encode("ascii"))
        if not token or scope["path"] == "/healthz" or is_same(token, said) or may_ask(token, authorization):
            return
        if (authorization or said) and self.lines.take(client):
            log.warning("a wrong token came from %s", client)
        how = "Authorization: Bearer TOKEN, or any user name with it as the password"
        ask = {"WWW-Authenticate": 'Basic realm="dengine", charset="UTF-8"'}
        raise Refusal(HTTPStatus.UNAUTHORIZED, f"Expected the server's token: {how}.", ask)


def _limited(receive: Receive, access: Access) -> Receive:
    """What receives a request's body, which has to be of a size and to come in time; else Refusal."""
    left, more = access.largest, True
    until = asyncio.get_running_loop().time() + access.body_seconds

    async def receiving() -> Message:
        nonlocal left, more
        if not more:  # what follows is the word that the client has gone, which may take as long as it likes
            return await receive()
        try:
            async with asyncio.timeout_at(until):
                message = await receive()
        except TimeoutError:
            text = f"Expected the request's body within {access.body_seconds:g} s."
            raise Refusal(HTTPStatus.REQUEST_TIMEOUT, text, CLOSE) from None
        more = bool(message.get("more_body", False))
        left -= len(message.get("body", b""))
        if left < 0:
            raise _too_large(access.largest)
        return message

    return receiving


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
