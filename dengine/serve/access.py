"""Who may ask, and how much: a token, the names by which the server is called, sizes, times and rates.

Whoever is on this machine may ask without a token, but for web pages of others: a browser carries their requests here
too. They are known by the name that they call the server by (`Host`), and by what the browser says of where they come from.
"""

from __future__ import annotations

import base64
import binascii
import hmac
import os
import stat
import time
from collections import OrderedDict
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from ipaddress import ip_address
from pathlib import Path
from urllib.parse import parse_qsl, urlencode, urlsplit

from ..errors import SettingError

SHORTEST = 16  # characters of a token
CLIENTS = 4096  # whose rate is remembered
SAFE = frozenset({"GET", "HEAD", "OPTIONS"})
WITHOUT_TOKEN = frozenset({"/healthz"})
RPC = "/RPC2"  # where a robot that cannot send headers may have its token in the path or the query
NAMES = frozenset({"localhost"})


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

    def __init__(self, rate: float, burst: int, clock: Callable[[], float] = time.monotonic) -> None:
        self.rate, self.burst, self.clock = rate, burst, clock
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()  # tokens, and when they were counted

    def take(self, client: str) -> bool:
        """Take one token; False where there is none."""
        if self.rate <= 0.0:
            return True
        now = self.clock()
        tokens, since = self._buckets.pop(client, (float(self.burst), now))
        tokens = min(float(self.burst), tokens + (now - since) * self.rate)
        taken = tokens >= 1.0
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
    if mode & (0o037 if _is_credential(file) else 0o077):
        raise SettingError(f"Expected {file} to be its owner's alone, others may use it ({mode:o}): chmod 600 {file}")
    token = text.strip()
    if len(token) < SHORTEST or not token.isascii() or not token.decode("ascii").isprintable() or b" " in token:
        raise SettingError(
            f"Expected a token of at least {SHORTEST} characters of ASCII without blanks in {file}; "
            f"make one: (umask 077; openssl rand -hex 24 > {file})"
        )
    return token.decode("ascii")


def _is_credential(file: Path) -> bool:
    """Whether systemd handed this file to the service, `LoadCredential`: nobody else gets into its folder."""
    folder = os.environ.get("CREDENTIALS_DIRECTORY", "")
    return folder != "" and file.absolute().parent == Path(folder)


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
    name = host_name(host)
    if name is None:
        return False
    try:
        ip_address(name)
    except ValueError:
        return name in NAMES or name in {each.lower() for each in names}
    return True


def host_name(host: str | None) -> str | None:
    """The name in a `Host` header, without its port; None where it is none."""
    if not host or not host.isascii() or any(c in "/@?#\\ \t" for c in host):
        return None
    try:
        parts = urlsplit(f"//{host}")
        parts.port  # noqa: B018  # it raises for what is no port
    except ValueError:
        return None
    return parts.hostname


def is_own_page(origin: str | None, fetch_site: str | None, host: str | None) -> bool:
    """Whether what a browser says of a request lets it be one of this server's own pages, or of no page at all."""
    if fetch_site is not None and fetch_site not in ("same-origin", "none"):
        return False
    if origin is None:
        return True
    _, _, called = origin.partition("://")
    return host is not None and called.lower() == host.lower()


def may_ask(token: str, authorization: str | None) -> bool:
    """Whether a request says the token: as a bearer's, or as the password that a browser asks for."""
    kind, _, said = (authorization or "").partition(" ")
    if kind.lower() == "bearer":
        return is_same(token, said.strip())
    if kind.lower() == "basic":
        try:
            return is_same(token, base64.b64decode(said.strip(), validate=True).decode("utf-8").partition(":")[2])
        except (binascii.Error, UnicodeDecodeError, ValueError):
            return False
    return False


def is_same(token: str, said: str) -> bool:
    """Compare in a time that says nothing of where they differ."""
    return hmac.compare_digest(token.encode(), said.encode("utf-8", "surrogatepass"))


def split_rpc(path: str, query: bytes) -> tuple[str, bytes, str | None]:
    """The path and the query of a robot's request without the token in them, and that token; None where there is none."""
    if path.startswith(f"{RPC}/"):
        return RPC, query, path.removeprefix(f"{RPC}/")
    if path != RPC or b"token=" not in query:
        return path, query, None
    pairs = parse_qsl(query.decode("latin-1"), keep_blank_values=True, max_num_fields=None)
    said = [value for name, value in pairs if name == "token"]
    rest = urlencode([(name, value) for name, value in pairs if name != "token"]).encode("ascii")
    return path, rest, said[0] if len(said) == 1 else ""
