"""One process in front of one cell: the port, TLS, the engine, the signals, its log, and how it all ends in order."""

from __future__ import annotations

import gc
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
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any, TextIO

import uvicorn

from ..engine.engine import DataEngine
from ..errors import SettingError, without_password
from ..records import RetrainReport
from .auth import Access, in_url, is_loopback, read_token
from .connections import Places
from .http import INTERFACES, Beside, create_app
from .retraining import RetrainingProcess
from .robot_calls import Recorder
from .service import DEADLINE, Answer, CellService, Told

log = logging.getLogger("dengine")


class Lines(logging.Formatter):
    """A record as one line of time, level, logger and message, as JSON has a text, for a machine to read; no password."""

    def format(self, record: logging.LogRecord) -> str:
        """Time, level, logger, message; and what was raised."""
        time = datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
        said = f"message={json.dumps(without_password(record.getMessage()))}"
        if record.exc_info:
            said += f" raised={json.dumps(without_password(self.formatException(record.exc_info)))}"
        return f"{time} level={record.levelname.lower()} logger={record.name} {said}"


@contextmanager
def log_lines_to(stream: TextIO) -> Iterator[None]:
    """Have every logger write such lines; uvicorn none, for what it refuses is answered, and what fails is told here."""
    handler, root = logging.StreamHandler(stream), logging.getLogger()
    handler.setFormatter(Lines())
    levels = {root: logging.WARNING, log: logging.INFO, logging.getLogger("uvicorn"): logging.CRITICAL}
    handlers, before = root.handlers[:], {logger: logger.level for logger in levels}
    root.handlers[:] = [handler]
    try:
        for logger, level in levels.items():
            logger.setLevel(level)
        yield
    finally:
        root.handlers[:] = handlers
        for logger, level in before.items():
            logger.setLevel(level)


KEEP_ALIVE = 75  # seconds that a connection may be idle: a robot's next part comes in this time
GRACE = 5  # seconds in which requests under way are answered when the server ends
SWITCH = 0.0005  # seconds after which a thread gives Python's lock to one that waits: a robot waits for both of ours


@dataclass(frozen=True, slots=True)
class Serving:
    """How a cell is served.

    token_file : of the token; None only where no other machine reaches the server.
    cert, key : PEM files; None: no TLS.
    allow_hosts : names by which the server is called, beside localhost.
    opcua : the port of OPC UA, at the same host, with the same token; None: it is not spoken.
    opcua_cert, opcua_key : its PEM files, where they are not those of TLS, which URScript's XML-RPC does not speak.
    check_seconds : that a verification takes, for the time that was saved.
    recorder : makes what records for a robot's program that asks over XML-RPC; None: nothing does.
    """

    host: str = "127.0.0.1"
    port: int = 8000
    token_file: Path | None = None
    cert: Path | None = None
    key: Path | None = None
    allow_hosts: Sequence[str] = ()
    deadline: float = DEADLINE
    largest: int = Access().largest
    rate: float = Access().rate
    connections: int = 100
    check_seconds: float = 5.0
    interfaces: Sequence[str] = tuple(INTERFACES)
    beside: Sequence[Beside] = ()
    opcua: int | None = None
    opcua_cert: Path | None = None
    opcua_key: Path | None = None
    recorder: Callable[[], AbstractContextManager[Recorder]] | None = None

    def access(self) -> Access:
        """Who may ask; SettingError where other machines reach the server and it has no token."""
        if self.token_file is None and not is_loopback(self.host):
            raise SettingError(
                f"Expected --token-file FILE, for {self.host} is reached from other machines; or --host 127.0.0.1."
            )
        token = "" if self.token_file is None else read_token(self.token_file)
        names = () if is_loopback(self.host) else (self.host, socket.gethostname())
        return Access(token, (*names, *self.allow_hosts), self.largest, rate=self.rate, burst=max(1, int(2 * self.rate)))


def serve(
    make: Callable[[Executor], DataEngine], store: str | None, serving: Serving, say: Callable[[str], object]
) -> None:
    """Serve a cell until SIGTERM or SIGINT; then what is in line is answered, and the engine closed.

    make : opens the engine, given the executor that it retrains in.  store : its name, for what only reads.
    say : told where it listens, once it does.
    SettingError for a port that is in use, and for files that cannot be used; what `make` raises.
    """
    tls, access = _tls(serving.cert, serving.key), serving.access()
    with (
        bound(serving.host, serving.port) as listening,
        log_lines_to(sys.stderr),
        RetrainingProcess() as executor,
        serving.recorder() if serving.recorder else nullcontext() as recorder,
    ):
        service = CellService(lambda: make(executor), store, serving.deadline, check_seconds=serving.check_seconds)
        service.observers.append(tell)
        try:
            beside = list(serving.beside)
            if serving.opcua is not None:
                from .opcua import opcua_server

                cert, key = serving.opcua_cert or serving.cert, serving.opcua_key or serving.key
                how = partial(opcua_server, port=serving.opcua, host=serving.host, token=access.token or None)
                beside.append(partial(how, cert=cert, key=key))
            app = create_app(service, access, serving.interfaces, beside, recorder)
            config = uvicorn.Config(app, **uvicorn_options(serving) | tls)
            port = listening.getsockname()[1]
            address = f"http{'s' if serving.cert else ''}://{in_url(serving.host)}:{port}"
            alone = "" if access.token else ", to this machine alone"
            line = f"{service.engine.store.cell_id} is served at {address}{alone}."
            server = CellServer(config, service, lambda: say(line))
            try:
                with quick_switches():
                    server.run([listening])
            except SystemExit:  # as uvicorn says that the application did not start
                why = SettingError("The server did not start; its log says why.")
                raise getattr(app.state, "failure", why) from None
        finally:
            service.close()


def uvicorn_options(serving: Serving) -> dict[str, Any]:
    """What uvicorn is told; its own words in the log are ours to say."""
    limits = {"timeout_keep_alive": KEEP_ALIVE, "timeout_graceful_shutdown": GRACE, "ws": "none", "lifespan": "on"}
    silent = {"log_config": None, "access_log": False, "server_header": False, "proxy_headers": False}
    return {"http": Places(serving.connections).connection, "loop": "asyncio"} | limits | silent


class CellServer(uvicorn.Server):
    """A uvicorn server that says when it listens, and ends in order with exit code 0."""

    def __init__(self, config: uvicorn.Config, service: CellService, say: Callable[[], object]) -> None:
        super().__init__(config)
        self._service, self._say = service, say

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Listen, and say so."""
        await super().startup(sockets)
        if not self.should_exit:
            self._say()

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """SIGTERM and SIGINT ask for an end; uvicorn would raise them again once it has come."""
        if threading.current_thread() is not threading.main_thread():  # Python delivers signals to that one alone
            yield
            return

        def end(number: int, frame: FrameType | None) -> None:
            log.info("%s: ending, what is in line is answered", signal.Signals(number).name)
            self._service.end_listening()
            self.handle_exit(number, frame)

        before = {number: signal.signal(number, end) for number in (signal.SIGTERM, signal.SIGINT)}
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
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
        sys.setswitchinterval(before)


@contextmanager
def bound(host: str, port: int) -> Iterator[socket.socket]:
    """A socket that listens there; SettingError, in one line, where it cannot."""
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        listening = socket.create_server(address[:2], family=family, backlog=128)
    except (OSError, OverflowError, UnicodeError) as error:
        why = getattr(error, "strerror", None) or error
        raise SettingError(f"Cannot listen at {host}, port {port}: {why}; name another with --port or --host.") from error
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

    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(cert, key, no_password)
    except OSError as error:  # ssl.SSLError too
        raise SettingError(f"Cannot use {cert} and {key} for TLS: {error.strerror or error}.") from error
    return {"ssl_certfile": str(cert), "ssl_keyfile": str(key)}


def tell(news: Answer | Told | RetrainReport) -> None:
    """Log a retrain; decisions and reports are in the store."""
    if isinstance(news, RetrainReport):
        log.info("version %d answers after a retrain of %.2f s: %s", news.version, news.seconds, news.reason)


def tell_safe_mode(reason: str) -> None:
    """Log that the safe mode began, or ended."""
    log.warning("safe mode, every part is verified: %s", reason) if reason else log.info("the safe mode ended")
