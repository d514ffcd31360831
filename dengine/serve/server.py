"""One process in front of one cell: the port, TLS, the engine, the signals, its log, and how it all ends in order."""

import json
import logging
import signal
import socket
import ssl
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import AbstractContextManager, contextmanager, nullcontext
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any, TextIO

import uvicorn

from ..engine.engine import DataEngine, frozen_objects
from ..errors import SettingError, instead, without_password
from .auth import Access, host_in_url, is_loopback, read_tokens
from .connections import ConnectionPool
from .http import Beside, create_app
from .retraining import END_SIGNALS, RetrainingProcess
from .robot_calls import Recorder
from .service import DEADLINE, CellService

log = logging.getLogger("dengine")


class Lines(logging.Formatter):
    """A record as one line of time, level, logger and message, as JSON has a text, for a machine to read; no password."""

    def format(self, record: logging.LogRecord) -> str:
        time = datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
        said = f"message={json.dumps(without_password(record.getMessage()))}"
        if record.exc_info:
            said += f" raised={json.dumps(without_password(self.formatException(record.exc_info)))}"
        return f"{time} level={record.levelname.lower()} logger={record.name} {said}"


@contextmanager
def log_lines_to(stream: TextIO) -> Iterator[None]:
    """Have every logger write such lines, ours what it is up to, too."""
    handler, root = logging.StreamHandler(stream), logging.getLogger()
    handler.setFormatter(Lines())
    handlers, level = root.handlers[:], log.level
    root.handlers[:] = [handler]
    log.setLevel(logging.INFO)
    try:
        yield
    finally:
        root.handlers[:] = handlers
        log.setLevel(level)


KEEP_ALIVE = 75  # seconds that a connection may be idle: a robot's next part comes in this time
GRACE = 5  # seconds in which requests under way are answered when the server ends
SWITCH = 0.0005  # seconds after which a thread gives Python's lock to one that waits: a robot waits for both of ours


def serve(
    make: Callable[[Executor], DataEngine],
    store: str | None,
    say: Callable[[str], object],
    *,
    host: str = "127.0.0.1",
    port: int = 8000,
    token_file: Path | None = None,
    cert: Path | None = None,
    key: Path | None = None,
    allow_hosts: Sequence[str] = (),
    deadline: float = DEADLINE,
    largest: int = Access().largest,
    rate: float = Access().rate,
    connections: int = 100,
    check_seconds: float = 5.0,
    opcua: int | None = None,
    opcua_cert: Path | None = None,
    opcua_key: Path | None = None,
    beside: Sequence[Beside] = (),
    recorder: Callable[[], AbstractContextManager[Recorder | None]] = nullcontext,
    **interfaces: bool,
) -> None:
    """Serve a cell until SIGTERM, SIGINT, or Windows' Ctrl-Break; then what is in line is answered, and the engine closed.

    make : opens the engine, given the executor that it retrains in.  store : its name, for what only reads.
    say : told where it listens, once it does.  recorder : makes what records for a robot's program.
    beside, xmlrpc, page : as of `create_app`.  The others are options of `dengine serve`, under their names.
    SettingError for a port that is in use, for files that cannot be used, and for an address that other machines reach
    without a token; what `make` raises.
    """
    if token_file is None and not is_loopback(host):
        raise SettingError(f"Expected --token-file FILE, for {host} is reached from other machines; or --host 127.0.0.1.")
    tls, tokens = _tls(cert, key), () if token_file is None else read_tokens(token_file)
    own = () if is_loopback(host) else (host, socket.gethostname())
    access = Access(tokens, (*own, *allow_hosts), largest, rate=rate)
    with bound(host, port) as listening, log_lines_to(sys.stderr), RetrainingProcess() as executor, recorder() as recording:
        service = CellService(lambda: make(executor), store, deadline, check_seconds=check_seconds)
        try:
            if opcua is not None:
                from .opcua import opcua_server

                operators = [each.secret for each in tokens if each.operates] if tokens else None
                spoken = partial(opcua_server, port=opcua, host=host, tokens=operators)
                beside = [*beside, partial(spoken, cert=opcua_cert or cert, key=opcua_key or key)]
            app = create_app(service, access, beside=beside, recorder=recording, **interfaces)
            config = uvicorn.Config(app, **uvicorn_options(connections) | tls)
            address = f"http{'s' if cert else ''}://{host_in_url(host)}:{listening.getsockname()[1]}"
            line = f"{service.engine.store.cell_id} is served at {address}{'' if tokens else ', to this machine alone'}."
            server = CellServer(config, service, lambda: say(line))
            try:
                with quick_switches():
                    server.run([listening])
            except SystemExit:  # as uvicorn says that the application did not start
                why = SettingError("The server did not start; its log says why.")
                raise getattr(app.state, "failure", why) from None
        finally:
            service.close()


def uvicorn_options(connections: int = 100) -> dict[str, Any]:
    """What uvicorn is told, whose loop is uvloop where that is installed; what it would log is answered, or told here."""
    limits = {
        "http": ConnectionPool(connections).new_connection,
        "timeout_keep_alive": KEEP_ALIVE,
        "timeout_graceful_shutdown": GRACE,
    }
    plain = {"loop": "auto", "ws": "none", "lifespan": "on", "server_header": False, "proxy_headers": False}
    return limits | plain | {"log_config": None, "log_level": "critical", "access_log": False}


class CellServer(uvicorn.Server):
    """A uvicorn server that says when it listens, and ends in order with exit code 0."""

    def __init__(self, config: uvicorn.Config, service: CellService, say: Callable[[], object]) -> None:
        super().__init__(config)
        self._service, self._say = service, say

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        if not self.should_exit:
            self._say()

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """These signals ask for an end; uvicorn would raise them again once it has come."""
        if threading.current_thread() is not threading.main_thread():  # Python delivers signals to that one alone
            yield
            return

        def end(number: int, frame: FrameType | None) -> None:
            log.info("%s: ending, what is in line is answered", signal.Signals(number).name)
            self._service.end_listening()
            self.handle_exit(number, frame)

        before = {number: signal.signal(number, end) for number in END_SIGNALS}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


@contextmanager
def quick_switches() -> Iterator[None]:
    """Have threads give each other Python's lock without delay, and Python's collector leave alone what is there now."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH)
    try:
        with frozen_objects():
            yield
    finally:
        sys.setswitchinterval(before)


@contextmanager
def bound(host: str, port: int) -> Iterator[socket.socket]:
    """A socket that listens there; SettingError, in one line, where it cannot."""
    said, do = f"Cannot listen at {host}, port {port}", "name another port or address, --port or --host"
    with instead(SettingError, said, OSError, OverflowError, UnicodeError, do=do):
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        listening = socket.create_server(address[:2], family=family, backlog=128)
    with listening:
        # Its connections inherit it: else an answer's second piece waits 40 ms for word that its first has come.
        listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        yield listening


def _tls(cert: Path | None, key: Path | None) -> dict[str, str]:
    """What uvicorn needs for TLS; SettingError for files that cannot be used, and for a key with a password."""
    if cert is None and key is None:
        return {}
    if cert is None or key is None:
        raise SettingError("Expected --cert and --key together, got one of them.")

    def no_password() -> str:
        raise SettingError(f"Expected a key without a password, {key} has one; protect the file instead: chmod 600 {key}")

    with instead(SettingError, f"Cannot use {cert} and {key} for TLS", OSError):  # ssl.SSLError too
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(cert, key, no_password)
    return {"ssl_certfile": str(cert), "ssl_keyfile": str(key)}


def tell_safe_mode(reason: str) -> None:
    """Log that the safe mode began, or ended."""
    log.warning("safe mode, every part is verified: %s", reason) if reason else log.info("the safe mode ended")
