"""Who may ask, and how much: tokens, the names by which the server is called, sizes, times and rates.

Whoever is on this machine may ask without a token, but for web pages of others: a browser carries their requests here too.
They are known by the name that they call the server by (`Host`), and by what the browser says of where they come from.
"""

import asyncio
import base64
import hmac
import logging
import os
import stat
import time
from collections import OrderedDict
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import lru_cache
from http import HTTPStatus
from ipaddress import ip_address
from itertools import compress
from pathlib import Path
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from ..errors import SettingError, instead
from .api import Refusal, problem

log = logging.getLogger("dengine")
SHORTEST = 16  # characters of a token
CLIENTS = 4096  # whose rate is remembered
LET_IN = "dengine.let_in"  # in the scope of a request of somebody who may ask, for `connections.Places`
LOOKS = "GET", "HEAD", "OPTIONS"  # methods that change nothing
RPC = "/RPC2"  # below which a robot that cannot send headers may have its token


@dataclass(frozen=True, slots=True)
class Token:
    """What `Authorization: Bearer` has to say, or Basic as its password.

    operates : reports, corrects, and changes the policy; else its owner only looks.
    name : the author of what is asked for by it; "": a machine's, or of whoever says his name.
    """

    secret: str = field(default="", repr=False)
    operates: bool = True
    name: str = ""


@dataclass(frozen=True, slots=True)
class Access:
    """Who may ask, and how much.

    tokens : one of which a request has to show; none: it need not.
    hosts : names by which the server is called, beside localhost; an address of numbers is always taken.
    largest : bytes of a request's body.  body_seconds : in which it has to come.
    rate : requests a second of one client, on average, twice as many at once; 0: as many as it likes.
    """

    tokens: tuple[Token, ...] = ()
    hosts: tuple[str, ...] = ()
    largest: int = 2**20
    body_seconds: float = 5.0
    rate: float = 500.0

    def shown(self, said: str) -> Token | None:
        """The token that this is; None where it is none. Each is compared, in the same time whatever was said."""
        same = [hmac.compare_digest(each.secret.encode(), said.encode("utf-8", "surrogatepass")) for each in self.tokens]
        return next(compress(self.tokens, same), None)


ANYBODY = Token()  # where no token is asked for
SHOWN = ContextVar("SHOWN", default=ANYBODY)  # by the request that is being answered, in a task of its own


class Rates:
    """A token bucket for each client; those that were not seen for longest are forgotten first."""

    def __init__(self, rate: float, burst: float) -> None:
        self.rate, self.burst = rate, burst
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()  # tokens, and when they were counted

    def take(self, client: str) -> bool:
        """Take one token; False where there is none."""
        now = time.monotonic()
        tokens, since = self._buckets.pop(client, (self.burst, now))
        tokens = min(self.burst, tokens + (now - since) * self.rate)
        taken = self.rate <= 0.0 or tokens >= 1.0
        self._buckets[client] = (tokens - taken, now)
        if len(self._buckets) > CLIENTS:
            self._buckets.popitem(last=False)
        return taken


def read_tokens(file: Path) -> tuple[Token, ...]:
    """The tokens in a file that nobody but its owner may read, one a line; SettingError where it has none, or others may.

    A line is a token; or that, `viewer` or `operator`, and the name of who has it.
    """
    with instead(SettingError, f"Cannot read the token's file {file}", OSError), file.open("rb") as opened:
        mode, text = stat.S_IMODE(os.fstat(opened.fileno()).st_mode), opened.read(1 << 16)
    # systemd, from 254 on, hands a credential to the service's user by an ACL, which shows as a right of the group.
    credentials = os.environ.get("CREDENTIALS_DIRECTORY", "")
    has_owners = hasattr(os, "getuid")  # the bits of Windows say nothing of who may read
    if has_owners and mode & (0o037 if credentials and file.absolute().parent == Path(credentials) else 0o077):
        raise SettingError(f"Expected {file} to be its owner's alone, others may use it ({mode:o}): chmod 600 {file}")
    lines = [line.split() for line in text.decode("utf-8", "replace").splitlines() if line.strip()]
    tokens = tuple(Token(line[0], line[1:2] != ["viewer"], " ".join(line[2:])) for line in lines)
    secrets = {each.secret for each in tokens if each.secret.isascii() and each.secret.isprintable()}
    if not tokens or len(secrets) < len(tokens) or min(map(len, secrets)) < SHORTEST:
        wanted = f"tokens of at least {SHORTEST} characters of ASCII in {file}, each once, one a line"
        raise SettingError(f"Expected {wanted}; make one: (umask 077; openssl rand -hex 24 > {file})")
    if any(line[1:2] not in ([], ["viewer"], ["operator"]) for line in lines):
        raise SettingError(f"Expected viewer or operator behind each token of {file}, then a name; or the token alone.")
    return tokens


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches a server that listens there."""
    try:
        return ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host == "localhost"


def in_url(host: str) -> str:
    """A host as an address has it, before its port."""
    return f"[{host}]" if ":" in host else host


@lru_cache(64)
def is_called(host: str | None, names: tuple[str, ...]) -> bool:
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


def said_token(scope: Scope, authorization: str) -> str:
    """What a request says for the token: as a bearer's, as the password that a browser asks for, or behind /RPC2/.

    What stands there is nobody's business from here on: the scope is of /RPC2 afterwards.
    """
    if scope["path"].startswith(f"{RPC}/"):
        said = str(scope["path"]).removeprefix(f"{RPC}/")
        scope.update(path=RPC, raw_path=RPC.encode("ascii"))
        return said
    kind, _, said = authorization.partition(" ")
    if kind.lower() != "basic":
        return said.strip() if kind.lower() == "bearer" else ""
    try:
        return base64.b64decode(said.strip(), validate=True).decode("utf-8").partition(":")[2]
    except ValueError:  # binascii's and UnicodeDecodeError are such
        return ""


CLOSE = {"Connection": "close"}  # what was not read is not to be taken for the next request
HEADERS = [  # of every answer
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
    (b"referrer-policy", b"same-origin"),
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (
        b"content-security-policy",
        b"default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
        b"connect-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'",
    ),
    (b"cache-control", b"no-store"),
]


class Guard:
    """ASGI middleware: names, tokens, rates and sizes; and the headers that every answer has."""

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self.app = app
        self.access = access
        self.rates = Rates(access.rate, max(1.0, 2.0 * access.rate))
        self.lines = Rates(0.1, 3)  # of the log, on a client's wrong tokens

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let a request in, or answer it; the application has no websockets, and uvicorn is told to speak none."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        try:
            self._look(scope)
        except Refusal as refusal:
            answer = problem(refusal.status, refusal.detail, CLOSE | refusal.headers)
            if refusal.status == HTTPStatus.UNAUTHORIZED:  # a line of its own: Chromium looks at the first name of each
                answer.headers.append("WWW-Authenticate", 'Bearer realm="dengine"')
            await answer(scope, receive, _with_headers(send))
        else:
            await self.app(scope, _limited(receive, self.access), _with_headers(send))

    def _look(self, scope: Scope) -> None:
        headers, access = Headers(scope=scope), self.access
        host, client = headers.get("host"), (scope.get("client") or ("", 0))[0]
        if not is_called(host, access.hosts):
            names = "its address, localhost, or a name that it was given (dengine serve --allow-host NAME)"
            raise Refusal(HTTPStatus.MISDIRECTED_REQUEST, f"Expected the server to be called by {names}.")
        said = said_token(scope, headers.get("authorization", ""))
        known = access.shown(said) if access.tokens else ANYBODY
        # Who uses it up without the token keeps out nobody who has it.
        if not self.rates.take(client if known else f"{client}, without"):
            most = f"Expected at most {access.rate:g} requests a second of one client."
            raise Refusal(HTTPStatus.TOO_MANY_REQUESTS, most)
        if known is not None:
            scope[LET_IN] = True
            SHOWN.set(known)
            if not known.operates and scope["method"] not in LOOKS:
                raise Refusal(HTTPStatus.FORBIDDEN, "Expected an operator's token, got a viewer's, who only looks.")
        elif scope["path"] != "/healthz":
            if (said or "authorization" in headers) and self.lines.take(client):
                log.warning("a wrong token came from %s", client)
            how = "Authorization: Bearer TOKEN, or any user name with it as the password"
            ask = {"WWW-Authenticate": 'Basic realm="dengine", charset="UTF-8"'}
            raise Refusal(HTTPStatus.UNAUTHORIZED, f"Expected the server's token: {how}.", ask)
        # What a browser says of a request has to be that it is of one of this server's own pages, or of no page at all.
        origin, site = headers.get("origin"), headers.get("sec-fetch-site", "none")
        own = origin is None or origin.partition("://")[2].lower() == str(host).lower()
        if scope["method"] not in LOOKS and not (own and site in ("same-origin", "none")):
            raise Refusal(HTTPStatus.FORBIDDEN, "Expected a request of this server's own pages, got one of another site.")
        length = headers.get("content-length", "0")
        if not (length.isascii() and length.isdecimal()):
            raise Refusal(HTTPStatus.BAD_REQUEST, "Expected Content-Length to be a whole number.")
        if len(length) > 18 or int(length) > access.largest:
            raise _too_large(access.largest)


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
            message["headers"] = [*message.get("headers", ()), *HEADERS]
        await send(message)

    return sending
