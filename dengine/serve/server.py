"""`serve`, which `dengine serve` runs: the process that serves one cell, with its port, TLS,
engine, signals and log, and its orderly end.

It puts the engine's service, the HTTP application and uvicorn together.
"""

from __future__ import annotations

import asyncio
import json
import logging
import signal
import socket
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import (
    AbstractAsyncContextManager,
    AbstractContextManager,
    AsyncExitStack,
    closing,
    contextmanager,
)
from functools import partial
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

import uvicorn

from ..engine.engine import DataEngine
from ..engine.garbage import frozen_objects
from ..errors import SettingError, instead, log, without_password
from .auth import check_key_pair, host_in_url, is_loopback, read_tokens
from .http import create_app
from .retraining import RetrainingProcess
from .service import CellService

if TYPE_CHECKING:
    from ..cells.ur.recorder import RtdeRecorder

Beside = Callable[[CellService], AbstractAsyncContextManager[object]]

KEEP_ALIVE = 75  # seconds that a connection may be idle: a robot's next part comes in this time
GRACE = 5  # seconds for requests under way when the server ends
MAX_CONNECTIONS = 500  # a process may usually have 1,024 open files
# Seconds after which a thread gives Python's lock to a waiting one. A robot may wait for either of
# the server's two threads.
SWITCH_INTERVAL = 0.0005
# uvicorn writes no log of its own, trusts no proxy's headers and serves no web sockets.
UVICORN_OPTIONS: dict[str, Any] = {
    "http": "h11",  # refuses a head of more than 16 KiB; httptools limits none
    "limit_concurrency": MAX_CONNECTIONS,
    "timeout_keep_alive": KEEP_ALIVE,
    "timeout_graceful_shutdown": GRACE,
    "ws": "none",
    "lifespan": "off",
    "server_header": False,
    "proxy_headers": False,
    "log_config": None,
    "log_level": "critical",
    "access_log": False,
}


class LineFormatter(logging.Formatter):
    """Formats a record as one line for machines: time, level, logger, and as JSON the message.

    A traceback follows the message in the same text. Passwords of database URLs are masked.
    """

    def format(self, record: logging.LogRecord) -> str:
        """Return a record as one line: "TIME level=LEVEL logger=NAME message=TEXT", the level in
        small letters, and the text, with a traceback if there is one, as a JSON string.
        """
        text = json.dumps(without_password(super().format(record)))
        return (
            f"{self.formatTime(record)} level={record.levelname.lower()} logger={record.name} "
            f"message={text}"
        )


def log_lines() -> None:
    """Write each log message of every library to stderr, on a line of its own.

    `LineFormatter` makes the line. The handlers that the root logger had are removed. dengine's own
    messages are written from level INFO on, those of other libraries from the level that is set for
    them, which is WARNING by default.
    """
    handler = logging.StreamHandler()
    handler.setFormatter(LineFormatter())
    logging.basicConfig(handlers=[handler], force=True)
    log.setLevel(logging.INFO)


def serve(
    make: Callable[[Executor], DataEngine],
    store: str | None,
    say: Callable[[str], object],
    beside: Sequence[Beside],
    recorder: Callable[[], AbstractContextManager[RtdeRecorder | None]],
    *,
    host: str,
    port: int,
    token_file: Path | None,
    cert: Path | None,
    key: Path | None,
    deadline: float,
    check_seconds: float,
    opcua: int | None,
    opcua_cert: Path | None,
    opcua_key: Path | None,
) -> None:
    """Serve a robot cell until SIGTERM, SIGINT, or Ctrl-Break of Windows; it blocks until then.

    It opens the engine, and answers requests for decisions, reports and the like over HTTP and
    XML-RPC and, if wanted, OPC UA.

    After a signal the requests under way have `GRACE` (5) seconds to be answered; a SIGINT after
    another of these signals ends without waiting for them. The engine does what is in the queue,
    and is closed. In a thread other than the main thread no signal ends the call. A signal that
    comes before the server listens acts like in any other program. The handlers of the root logger
    are replaced for good: every log message becomes a line on stderr (`log_lines`).

    Parameters
    ----------
    make : callable
        Opens the engine, given the executor that it retrains in, a process of its own.
    store : str or None
        Name of the store that `make` opens, for a second connection that only reads; None: a store
        in memory.
    say : callable
        Called with a line that says where the server listens, once it does.
    beside : sequence of callable
        Each is called with the `CellService` (the engine with its queue of requests) and returns an
        async context, which lasts as long as the server, in the same event loop. If the start of a
        context fails, no request is answered, and the error is raised.
    recorder : callable
        Returns a context manager that opens the recorder of a robot's insertions for as long as the
        server runs, or gives None.
    host : str
        Address to listen on.
    port : int
        0: any free one.
    token_file : path or None
        Access tokens, one in each line (`read_tokens`). None: no request needs a token, and only
        this machine may reach the server.
    cert, key : path or None
        PEM files for TLS, both or none.
    deadline : float
        Seconds that a request for a decision may wait in the queue; then the answer is VERIFY: the
        part must be checked.
    check_seconds : float
        Duration of one check of a part, from which the time saved by other decisions is computed.
    opcua : int or None
        Port of OPC UA; None: off. Its passwords are the tokens of operators, not those that only
        permit reading.
    opcua_cert, opcua_key : path or None
        None: `cert` and `key`.

    Raises
    ------
    SettingError
        For a port in use, files that cannot be used, only one of `cert` and `key`, and an address
        that other machines can reach without a token; for OPC UA such an address needs the token of
        an operator and a certificate.
    Exception
        What `make`, `recorder`, or a start of one of `beside` or of OPC UA raises, such as OSError
        for its port in use; StoreError if the second connection to the store cannot be opened,
        OSError if the process for retrains cannot be started, and ImportError for OPC UA without
        asyncua.
    """
    if token_file is None and not is_loopback(host):
        raise SettingError(
            f"Expected --token-file FILE, for {host} is reached from other machines; or "
            "--host 127.0.0.1."
        )
    tokens = () if token_file is None else read_tokens(token_file)
    check_key_pair(cert, key)
    if opcua is not None:
        from .opcua import opcua_server

        start = partial(
            opcua_server,
            port=opcua,
            host=host,
            tokens=tokens,
            cert=opcua_cert or cert,
            key=opcua_key or key,
        )
        beside = [*beside, start]
    log_lines()
    with (
        listening_socket(host, port) as listening,
        RetrainingProcess() as executor,
        recorder() as opened_recorder,
        closing(
            CellService(lambda: make(executor), store, deadline, check_seconds=check_seconds)
        ) as service,
    ):
        app = create_app(service, tokens, recorder=opened_recorder)
        scheme = "http" if cert is None else "https"
        address = f"{scheme}://{host_in_url(host)}:{listening.getsockname()[1]}"
        audience = "" if tokens else ", to this machine alone"
        line = f"{service.engine.store.cell_id} is served at {address}{audience}."
        config = uvicorn.Config(app, ssl_certfile=cert, ssl_keyfile=key, **UVICORN_OPTIONS)
        server = CellServer(config, service, lambda: say(line))

        async def run() -> None:
            """Start what runs beside the server, serve until a signal comes, and end it."""
            async with AsyncExitStack() as stack:
                for start in beside:
                    await stack.enter_async_context(start(service))
                await server.serve([listening])

        with quick_switches():
            asyncio.run(run())


class CellServer(uvicorn.Server):
    """A uvicorn server that says when it listens, and whose process ends with exit code 0.

    Parameters
    ----------
    config : uvicorn.Config
    service : CellService
    say : callable
        Called once the server listens.
    """

    def __init__(
        self, config: uvicorn.Config, service: CellService, say: Callable[[], object]
    ) -> None:
        super().__init__(config)
        self._service = service
        self._say = say

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Listen on the given sockets like `uvicorn.Server.startup`, and then call `say` once."""
        await super().startup(sockets)
        self._say()

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Handle SIGINT, SIGTERM and Ctrl-Break as a request to end in order.

        Each signal is logged, ends every iteration over `CellService.changes` (by which clients
        wait for changes), and asks uvicorn to end after the requests under way, which have `GRACE`
        (5) seconds; a SIGINT after another of these signals makes it end without waiting for them.
        Unlike uvicorn's own method it does not note the signal to be raised again after the end, so
        the exit code is 0.
        """
        log.info("%s: ending, what is in line is answered", signal.Signals(sig).name)
        self._service.end_listening()
        self.force_exit = self.force_exit or (self.should_exit and sig == signal.SIGINT)
        self.should_exit = True


@contextmanager
def quick_switches() -> Iterator[None]:
    """Shorten, within the block, the time that a decision can wait for another thread.

    For the whole process it shortens the interval after which Python switches threads to
    `SWITCH_INTERVAL` (0.0005) seconds, and excludes the objects that exist now from garbage
    collection. The end of the block sets the old interval, and lets all objects be collected again,
    also those that other code froze (`gc.freeze`).
    """
    before = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_INTERVAL)
    try:
        with frozen_objects():
            yield
    finally:
        sys.setswitchinterval(before)


@contextmanager
def listening_socket(host: str, port: int) -> Iterator[socket.socket]:
    """Open a listening TCP socket, yield it, and close it when the block ends.

    The host is an IPv4 address, an IPv6 address without brackets, or a name that has an IPv4
    address. Port 0 takes a free port. Raises SettingError if the socket cannot be opened, for
    example because the port is in use or the host is unknown.
    """
    with instead(
        SettingError,
        f"Cannot listen at {host}, port {port}",
        OSError,
        OverflowError,
        UnicodeError,
        do="name another port or address, --port or --host",
    ):
        listening = socket.create_server(
            (host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET
        )
    with listening:
        # Its connections inherit this option. Without it the second piece of a response waits 40 ms
        # for the confirmation of the first.
        listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        yield listening


def log_safe_mode(reason: str) -> None:
    """Log that the safe mode began or ended.

    In safe mode, after an alarm, every part is checked until new outcomes allow decisions. `reason`
    says why it began, which is logged as a warning; "" means that it ended.
    """
    if reason:
        log.warning("safe mode, parts are verified until outcomes allow decisions: %s", reason)
    else:
        log.info("the safe mode ended")
