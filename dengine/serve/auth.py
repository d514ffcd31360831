"""Access control of the HTTP server: `Guard` refuses a request by its token, host name, origin or
size, and `read_tokens` reads the tokens. `create_app` puts the `Guard` before the application.

A server that only this machine can reach needs no token. But a browser on this machine may also
send requests for web pages of other sites. `Guard` recognises these by the headers `Origin` and
`Sec-Fetch-Site`, and without a token by the host name that they use, and refuses them.
"""

import base64
import hmac
import os
import re
import ssl
import stat
from contextvars import ContextVar
from dataclasses import dataclass, field
from ipaddress import ip_address
from itertools import compress
from pathlib import Path
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from ..errors import SettingError, instead
from ..files import FilePath
from .api import problem_response

MIN_TOKEN_LENGTH = 16  # characters
# A secret, a role and the owner's name.
TOKEN_LINE = re.compile(rf"([!-~]{{{MIN_TOKEN_LENGTH},}})(?:\s+(viewer|operator)(?:\s+(.+))?)?")
SAFE_METHODS = "GET", "HEAD", "OPTIONS"  # they change nothing
RPC = "/RPC2"  # a robot that cannot send headers may append its token to this path
MAX_BODY = 1 << 20  # bytes, 250,000 samples


@dataclass(frozen=True, slots=True)
class Token:
    """A secret that authorizes requests, as a bearer token or as the password of HTTP Basic.

    Attributes
    ----------
    secret : str
    operates : bool
        Whether its owner may report, correct and change the policy. False: only read.
    name : str
        Recorded as the author of changes. "": a program's token; the request may name an author.
    """

    secret: str = field(default="", repr=False)
    operates: bool = True
    name: str = ""


Tokens = tuple[Token, ...]
ANYBODY = Token()  # of requests to a server that needs no token
CURRENT_TOKEN = ContextVar("CURRENT_TOKEN", default=ANYBODY)  # of the request being answered


def read_tokens(file: Path) -> Tokens:
    """Read tokens from a file that only its owner may use, in the order of its lines.

    A token authorizes requests. Each line is a secret, optionally followed by `viewer` (who may
    only read) or `operator` (who may also change something), and after that optionally by the name
    of the token's owner. A secret alone is an operator's, without a name. Empty lines are skipped,
    and what is beyond 64 KiB is not read. A file in the folder that the variable
    CREDENTIALS_DIRECTORY names (systemd sets it) may also be readable by its group. On Windows no
    permission is checked.

    Raises
    ------
    SettingError
        If the file cannot be read, others may use it, it has no token or one twice, a secret is
        shorter than 16 characters (`MIN_TOKEN_LENGTH`) or not printable ASCII, or a line is not of
        this form.
    """
    with (
        instead(SettingError, f"Cannot read the token file {file}", OSError),
        file.open("rb") as opened,
    ):
        mode = stat.S_IMODE(os.fstat(opened.fileno()).st_mode)
        text = opened.read(1 << 16)
    # From version 254 on, systemd gives a credential to the service's user by an ACL, which shows
    # as a permission of the group.
    is_credential = file.absolute().parent == Path(os.environ.get("CREDENTIALS_DIRECTORY", ""))
    # On Windows the mode does not say who may read.
    if hasattr(os, "getuid") and mode & (0o037 if is_credential else 0o077):
        raise SettingError(
            f"Expected a token file that only its owner may use, {file} has mode {mode:o}; "
            f"run: chmod 600 {file}"
        )
    lines = [line for line in text.decode("utf-8", "replace").splitlines() if line.strip()]
    matches = [TOKEN_LINE.fullmatch(line.strip()) for line in lines]
    tokens = tuple(
        Token(match[1], match[2] != "viewer", match[3] or "") for match in matches if match
    )
    if not tokens or len({token.secret for token in tokens}) < len(lines):
        raise SettingError(
            f"Expected tokens of at least {MIN_TOKEN_LENGTH} ASCII characters in {file}, one per "
            "line and each once, alone or followed by viewer or operator and then a name; make "
            f"one: (umask 077; openssl rand -hex 24 > {file})"
        )
    return tokens


def check_key_pair(cert: FilePath | None, key: FilePath | None) -> None:
    """Check a certificate and its key: load both once.

    Parameters
    ----------
    cert, key : path or None
        PEM files. None for both: there is nothing to check.

    Raises
    ------
    SettingError
        For only one of the two, for files that cannot be used, and for a key with a password.
    """
    if cert is None and key is None:
        return
    if cert is None or key is None:
        raise SettingError(
            "Expected a certificate and its key together (--cert and --key, or --opcua-cert and "
            "--opcua-key), got one of them."
        )
    # OSError includes ssl.SSLError. Without a password OpenSSL would ask the terminal for one; no
    # key has this one.
    with instead(
        SettingError,
        f"Cannot use {cert} and {key} for TLS",
        OSError,
        do="use PEM files, and a key without a password",
    ):
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(cert, key, password=os.urandom(16))


def is_loopback(host: str) -> bool:
    """Return whether only this machine can reach a server that listens at `host`.

    True for the name localhost, in small letters, and for a loopback address, also in brackets;
    False for every other name or address, and for "". No name is looked up.
    """
    try:
        return ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host == "localhost"


def host_in_url(host: str) -> str:
    """Return a host like in a URL: an IPv6 address, which has none yet, gets brackets."""
    return f"[{host}]" if ":" in host else host


def names_this_machine(host: str) -> bool:
    """Return whether a request's `Host` header is localhost or a loopback address.

    It may have a port, and be in small or capital letters. The result is False for "", for brackets
    without an address and for an IPv6 address without brackets; what stands before an `@`, and
    behind a colon, `/`, `?` or `#`, is not checked. It is False as well for a web page of another
    site whose name was made to resolve to this machine (DNS rebinding): the browser sends that name
    as `Host`.
    """
    try:
        return is_loopback(urlsplit(f"//{host}").hostname or "")
    except ValueError:  # brackets without an address
        return False


def find_token(tokens: Tokens, secret: str) -> Token | None:
    """Return the token with this secret; None if there is none, also if `tokens` is empty.

    All tokens are compared, in constant time.
    """
    given = secret.encode("utf-8", "surrogatepass")
    is_same = [hmac.compare_digest(token.secret.encode(), given) for token in tokens]
    return next(compress(tokens, is_same), None)


def take_token(scope: Scope, authorization: str) -> str:
    """Return the secret that a request carries, or "" if it has none that can be read.

    If the path is /RPC2/SECRET, the secret is taken from it, and the path in `scope` is changed to
    /RPC2, so that the secret is not logged later; the header is then ignored. Otherwise the secret
    is a bearer token or the password of HTTP Basic, whose user name is ignored. It is "" for any
    other scheme, and for a password that is not in base64 and UTF-8. Whether the secret is right is
    not checked.

    Parameters
    ----------
    scope : Scope
        ASGI scope of the request.
    authorization : str
        Value of the header `Authorization`, "" without one.
    """
    if scope["path"].startswith(f"{RPC}/"):
        secret = str(scope["path"]).removeprefix(f"{RPC}/")
        scope.update(path=RPC, raw_path=RPC.encode())
        return secret
    scheme, _, value = authorization.partition(" ")
    if scheme.lower() == "bearer":
        return value.strip()
    if scheme.lower() != "basic":
        return ""
    try:
        return base64.b64decode(value.strip(), validate=True).decode().partition(":")[2]
    except ValueError:  # also binascii.Error and UnicodeDecodeError
        return ""


CHALLENGES = 'Basic realm="dengine", charset="UTF-8"', 'Bearer realm="dengine"'
CLOSE = {"Connection": "close"}  # bytes of the body that were not read are no next request
TOO_LARGE = 413, f"Expected a request of at most {MAX_BODY} bytes, got a larger one.", CLOSE
HEADERS = [  # of every response
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
    """ASGI middleware that refuses requests that are not allowed.

    It also adds the security headers to every response.

    Parameters
    ----------
    app : ASGIApp
        Gets the allowed requests.
    tokens : tuple of Token
        A request must have one of them. Empty: no token is needed, and requests must call the
        server localhost, or by a loopback address.
    """

    def __init__(self, app: ASGIApp, tokens: Tokens) -> None:
        self.app = app
        self.tokens = tokens

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass an allowed request on to the application, or answer it with the refusal.

        A refusal is a `Problem` in JSON. It closes the connection, and with 401 it has two headers
        WWW-Authenticate, for Basic and Bearer. What is no HTTP request, like the application's
        start and end, passes unchecked. The size of an allowed request's body is limited while the
        application reads it, by `_limit_body`.
        """
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        try:
            self._check(scope)
        except HTTPException as refusal:
            response = problem_response(refusal.status_code, refusal.detail, CLOSE)
            if refusal.status_code == 401:
                # Each has a header of its own: Chromium reads only the first scheme of a header.
                for challenge in CHALLENGES:
                    response.headers.append("WWW-Authenticate", challenge)
            await response(scope, receive, _with_headers(send))
        else:
            await self.app(scope, _limit_body(receive), _with_headers(send))

    def _check(self, scope: Scope) -> None:
        """Raise HTTPException for a request that is not allowed, and set the token of the request.

        The checks are, in this order. A request to a server without tokens must call it localhost
        or by a loopback address (421). The request must have a token of the server, unless it is
        for /healthz (401), and a token that may only read does not allow a request that may change
        something, one that is not GET, HEAD or OPTIONS (403); `_check_token` checks this, and sets
        the context variable `CURRENT_TOKEN` to the token, or to `ANYBODY`, which allows everything,
        on a server without tokens. A request that may change something must not come from a web
        page of another host or port, by its headers Origin and Sec-Fetch-Site (403). The announced
        length of the body must be at most 1 MiB, `MAX_BODY` (413). A token in the path
        (/RPC2/TOKEN) is removed from `scope`.
        """
        headers = Headers(scope=scope)
        host = headers.get("host", "")
        # A web page on another name has no token: browsers send Basic credentials by origin.
        if not self.tokens and not names_this_machine(host):
            raise HTTPException(
                421,
                "Expected the server to be called as localhost or 127.0.0.1, for it has no token.",
            )
        self._check_token(scope, headers)
        # Browsers say from which site a request comes. It must be this one, or no page at all.
        origin = headers.get("origin")
        is_same_origin = origin is None or origin.partition("://")[2].lower() == host.lower()
        is_same_site = headers.get("sec-fetch-site", "none") in ("same-origin", "none")
        if scope["method"] not in SAFE_METHODS and not (is_same_origin and is_same_site):
            raise HTTPException(
                403,
                "Expected a request of this server's own pages, got one of another site.",
            )
        if int(headers.get("content-length", 0)) > MAX_BODY:
            raise HTTPException(*TOO_LARGE)

    def _check_token(self, scope: Scope, headers: Headers) -> None:
        """Check a request's token, and set the context variable `CURRENT_TOKEN` to it.

        Raises HTTPException: 401 for a missing or wrong token, 403 for a viewer's token, which may
        only read, on a request that may change something (a method other than GET, HEAD and
        OPTIONS). A request for /healthz without a right token is allowed, and `CURRENT_TOKEN` is
        then not set. A server without tokens allows every request, with the token `ANYBODY`. A
        secret in the path (/RPC2/SECRET) is removed from `scope`, the ASGI scope of the request.
        """
        secret = take_token(scope, headers.get("authorization", ""))
        token = find_token(self.tokens, secret) if self.tokens else ANYBODY
        if token is not None:
            CURRENT_TOKEN.set(token)
            if not token.operates and scope["method"] not in SAFE_METHODS:
                raise HTTPException(403, "Expected an operator's token, got a viewer's token.")
        elif scope["path"] != "/healthz":
            raise HTTPException(
                401,
                "Expected the server's token: Authorization: Bearer TOKEN, or any user name with "
                "it as the password.",
            )


def _limit_body(receive: Receive) -> Receive:
    """Return an ASGI `receive` that passes on the messages of the given one.

    It raises HTTPException 413 once the body of the request has more than `MAX_BODY` bytes (1 MiB),
    in place of the message that has too many.
    """
    bytes_left = MAX_BODY

    async def receive_body() -> Message:
        """Return the next message, and subtract its bytes from those that are left; raise
        HTTPException 413 for too many.
        """
        nonlocal bytes_left
        message = await receive()
        bytes_left -= len(message.get("body", b""))
        if bytes_left < 0:
            raise HTTPException(*TOO_LARGE)
        return message

    return receive_body


def _with_headers(send: Send) -> Send:
    """Return an ASGI `send` that adds the security headers in `HEADERS` to every response.

    They come after the response's own headers. All messages are passed on to the given `send`.
    """

    async def send_with_headers(message: Message) -> None:
        if message["type"] == "http.response.start":
            message["headers"] = [*message.get("headers", ()), *HEADERS]
        await send(message)

    return send_with_headers
