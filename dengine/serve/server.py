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
from .retraining import retraining_process
from .robot_calls import Recorder
from .service import DEADLINE, Answer, CellService, Told


class Lines(logging.Formatter):
    """A record as one line of time, level, logger and message, as JSON has a text, for a machine to read; no password."""

    def format(self, record: logging.LogRecord) -> str:
        """Time, level, logger, message; and what was raised."""
        time = datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
        told = {"message": record.getMessage()}
        if record.exc_info:
            told["raised"] = self.formatException(record.exc_info)
        said = " ".join(f"{name}={json.dumps(without_password(text))}" for name, text in told.items())
        return f"{time} level={record.levelname.lower()} logger={record.name} {said}"


@contextmanager
def log_lines_to(stream: TextIO) -> Iterator[None]:
    """Have every logger write such lines; uvicorn none, for what it refuses is answered, and what fails is told here."""
    handler = logging.StreamHandler(stream)
    handler.setFormatter(Lines())
    root, ours, theirs = (logging.getLogger(name) for name in ("", "dengine", "uvicorn"))
    handlers, levels = root.handlers[:], {logger: logger.level for logger in (root, ours, theirs)}
    root.handlers[:] = [handler]
    for logger, level in ((root, logging.WARNING), (ours, logging.INFO), (theirs, logging.CRITICAL)):
        logger.setLevel(level)
    try:
        yield
    finally:
        root.handlers[:] = handlers
        for logger, level in levels.items():
            logger.setLevel(level)


log = logging.getLogger("dengine")
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

    def address(self, port: int) -> str:
        """Where it is reached."""
        return f"http{'s' if self.cert else ''}://{in_url(self.host)}:{port}"


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
        retraining_process() as executor,
        serving.recorder() if serving.recorder else nullcontext() as recorder,
    ):
        service = CellService(lambda: make(executor), store, serving.deadline)
        service.observers.append(tell)
        try:
            beside = (*serving.beside, *_opcua(serving, access))
            app = create_app(service, access, serving.interfaces, beside, recorder)
            config = uvicorn.Config(app, **uvicorn_options(serving) | tls)
            port = listening.getsockname()[1]
            line = f"{service.engine.store.cell_id} is served at {serving.address(port)}"
            server = CellServer(config, service, lambda: say(f"{line}{'' if access.token else ', to this machine alone'}."))
            try:
                with quick_switches():
                    server.run([listening])
            except SystemExit:  # as uvicorn says that the application did not start
                why = SettingError("The server did not start; its log says why.")
                raise getattr(app.state, "failure", why) from None
        finally:
            service.close()


def _opcua(serving: Serving, access: Access) -> list[Beside]:
    """What speaks OPC UA, where it is asked for."""
    if serving.opcua is None:
        return []
    from .opcua import opcua_server

    token, cert, key = access.token or None, serving.opcua_cert or serving.cert, serving.opcua_key or serving.key
    return [partial(opcua_server, port=serving.opcua, host=serving.host, token=token, cert=cert, key=key)]


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
    """Have the engine's thread and the one that answers give each other Python's lock without delay, and Python's collector
    leave alone what is there now, the imported libraries: to look at all of it takes long.
    """
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
