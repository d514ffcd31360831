"""A controller that speaks RTDE over TCP without a robot: for tests, and for whoever has none.

    with FakeController(RobotProgram("insertion")) as fake:
        with UrCell(fake.host, port=fake.port) as cell: ...

It keeps to the published protocol as far as a client can see it, steps 500 times a second (or faster), and can be told to
do what real ones do on bad days: `Trouble`.
"""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections.abc import Collection, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Protocol

from ...errors import CellError, SettingError
from .orders import RUNTIME, Runtime
from .protocol import IN_USE, NOT_FOUND, VERSION, Kind, Package, Packages, Recipe, type_of
from .server import Connection, named, packed

CYCLE_S = 0.002
IDLE_S = 0.0002  # of a cycle at no set speed, while nobody listens
STATE = {"robot_mode": 7.0, "safety_mode": 1.0, "speed_scaling": 1.0, RUNTIME: float(Runtime.PLAYING)}
GARBAGE = b"\x00\x01\xff GET / HTTP/1.1"
TROUBLES = ("drop", "hold", "close", "half", "garbage", "repeat", "reset")


class Program(Protocol):
    """What runs on the robot."""

    place: tuple[int, int] | None

    def step(self, inputs: dict[str, float]) -> Mapping[str, float]:
        """One control cycle: outputs by column, from inputs by field."""
        ...


@dataclass(frozen=True, slots=True)
class Trouble:
    """What goes wrong at one sample of one insertion.

    drop : `cycles` packages are never sent, from this on.  hold : so many wait, and come at once.  repeat : it comes twice.
    close : the connections are closed before it.  half : after half of its package.  garbage : after what is no package.
    reset : the controller's clock begins anew.
    """

    part: int
    sample: int
    kind: str
    cycles: int = 1

    def __post_init__(self) -> None:
        if self.kind not in TROUBLES or self.cycles < 1:
            raise SettingError(f"Expected a trouble among {', '.join(TROUBLES)} of 1 or more cycles, got {self}.")


class FakeController:
    """Listens on host and port (0: any that is free) and plays a program. Opened by `with`, or `open`.

    speed : cycles against real time; None: as fast as clients read.  troubles : what goes wrong, and when.
    held : input fields that another client holds.  unknown : output fields that it does not have.
    refuses : requests that it says no to, Kind.VERSION or Kind.START.  version : of its software.
    patience : seconds after which it hangs up on a client that does not read, as real ones do when their buffer is full.
    `lost` : part and sample of every package of an insertion that no client was sent.  `said` : texts that clients sent.
    """

    def __init__(
        self,
        program: Program | None = None,
        host: str = "127.0.0.1",
        port: int = 0,
        speed: float | None = 1.0,
        troubles: Iterable[Trouble] = (),
        held: Collection[str] = (),
        unknown: Collection[str] = (),
        refuses: Collection[Kind] = (),
        version: tuple[int, int, int, int] = (5, 11, 0, 0),
        patience: float = 5.0,
    ) -> None:
        self.program, self.host, self.speed = program, host, speed
        self.held, self.unknown, self.refuses, self.version = set(held), set(unknown), set(refuses), version
        self.patience = struct.pack("ll", int(patience), int(patience % 1 * 10**6))  # a timeval
        self.lost: set[tuple[int, int]] = set()
        self.said: list[str] = []
        self.connections_made = 0
        self.runtime: int | None = None  # another state than the program's, if any
        self._troubles = {(each.part, each.sample): each for each in troubles}
        self._server = socket.create_server((host, port))
        self.port: int = self._server.getsockname()[1]
        self._inputs: dict[str, float] = {}
        self._connections: list[Connection] = []
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self._begin = self._cycle = 0
        self._drop = self._hold = 0
        self._threads = [threading.Thread(target=each, daemon=True) for each in (self._accept, self._run)]

    def open(self) -> FakeController:
        """Begin to listen, and to count cycles."""
        for thread in self._threads:
            thread.start()
        return self

    def close(self) -> None:
        """End all connections and threads."""
        self._closing.set()
        with suppress(OSError):
            self._server.shutdown(socket.SHUT_RDWR)
        self._server.close()
        self.hang_up(abruptly=True)
        for thread in list(self._threads):
            thread.join()

    def __enter__(self) -> FakeController:
        return self.open()

    def __exit__(self, *raised: object) -> None:
        self.close()

    def hang_up(self, abruptly: bool = False) -> None:
        """Close every connection; abruptly: what was sent may never arrive."""
        with self._lock:
            for each in self._connections:
                each.hang_up()
                if abruptly:
                    with suppress(OSError):
                        each.socket.shutdown(socket.SHUT_RDWR)

    def say(self, text: str) -> None:
        """Send every client a text message, as of an error."""
        words = text.encode()
        payload = bytes([len(words)]) + words + b"\x04fake\x01"
        with self._lock:
            for each in self._connections:
                each.send(Package(Kind.TEXT, payload).bytes)

    # The server's side of a connection.

    def _accept(self) -> None:
        while not self._closing.is_set():
            try:
                sock, _ = self._server.accept()
            except OSError:  # closed
                return
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, self.patience)
            thread = threading.Thread(target=self._serve, args=(Connection(sock),), daemon=True)
            self._threads.append(thread)
            thread.start()

    def _serve(self, connection: Connection) -> None:
        with self._lock:
            self._connections.append(connection)
            self.connections_made += 1
        packages = Packages()
        with connection.socket, suppress(OSError, CellError):
            while piece := connection.socket.recv(65536):
                for package in packages.feed(piece):
                    self._answer(connection, package)
        with self._lock:
            connection.started = False
            self._connections.remove(connection)

    def _answer(self, connection: Connection, package: Package) -> None:
        with self._lock:
            if package.kind is Kind.DATA:
                recipe = connection.inputs[package.payload[0]]
                self._inputs.update(zip(recipe.columns, recipe.unpack(package.payload), strict=True))
            elif package.kind is Kind.TEXT:
                self.said.append(package.payload[1 : 1 + package.payload[0]].decode())
            else:
                answer = getattr(self, f"_on_{package.kind.name.lower()}")(connection, package.payload)
                connection.socket.sendall(Package(package.kind, answer).bytes)
                connection.started = package.kind is Kind.START and answer == b"\1"

    def _on_version(self, connection: Connection, payload: bytes) -> bytes:
        return bytes([struct.unpack(">H", payload)[0] == VERSION and Kind.VERSION not in self.refuses])

    def _on_controller(self, connection: Connection, payload: bytes) -> bytes:
        return struct.pack(">4I", *self.version)

    def _on_outputs(self, connection: Connection, payload: bytes) -> bytes:
        (rate,) = struct.unpack_from(">d", payload)
        names = named(payload[8:])
        types = [NOT_FOUND if name in self.unknown else type_of(name) for name in names]
        if NOT_FOUND not in types:
            connection.output = Recipe(1, tuple(names), tuple(types))
        connection.every = max(int(1 / (CYCLE_S * rate)), 1) if rate > 0 else 1
        return bytes([1]) + ",".join(types).encode()

    def _on_inputs(self, connection: Connection, payload: bytes) -> bytes:
        names = named(payload)
        others = {
            name for each in self._connections if each is not connection for r in each.inputs.values() for name in r.names
        }
        types = [IN_USE if name in self.held | others else type_of(name) for name in names]
        number = 0 if {IN_USE, NOT_FOUND} & set(types) else len(connection.inputs) + 1
        if number:
            connection.inputs[number] = Recipe(number, tuple(names), tuple(types))
        return bytes([number]) + ",".join(types).encode()

    def _on_start(self, connection: Connection, payload: bytes) -> bytes:
        return bytes([connection.output is not None and Kind.START not in self.refuses])

    def _on_pause(self, connection: Connection, payload: bytes) -> bytes:
        return b"\1"

    # The control cycle.

    def _run(self) -> None:
        due = time.monotonic()
        while not self._closing.is_set():
            with self._lock:
                listened = self._step()
            if self.speed is not None:
                due += CYCLE_S / self.speed
                self._closing.wait(max(due - time.monotonic(), 0.0))
            elif not listened:
                time.sleep(IDLE_S)

    def _step(self) -> bool:
        """One cycle; whether anyone was listening."""
        values = {**STATE, **self._inputs, **(self.program.step(dict(self._inputs)) if self.program else {})}
        if self.runtime is not None:
            values[RUNTIME] = self.runtime
        place = self.program.place if self.program else None
        trouble = self._troubles.pop(place, None) if place else None
        if trouble is not None:
            self._begin_trouble(trouble)
        values["timestamp"] = (self._cycle - self._begin) * CYCLE_S
        started = [each for each in self._connections if each.started and self._cycle % each.every == 0]
        sent = [self._send(each, values, trouble) for each in started]
        if place is not None and not any(sent):
            self.lost.add(place)
        self._drop, self._hold, self._cycle = max(self._drop - 1, 0), max(self._hold - 1, 0), self._cycle + 1
        return bool(started)

    def _begin_trouble(self, trouble: Trouble) -> None:
        if trouble.kind == "drop":
            self._drop = trouble.cycles
        elif trouble.kind == "hold":
            self._hold = trouble.cycles
        elif trouble.kind == "reset":
            self._begin = self._cycle
        elif trouble.kind == "close":
            for each in self._connections:
                each.hang_up()

    def _send(self, each: Connection, values: Mapping[str, float], trouble: Trouble | None) -> bool:
        """Whether the package of this cycle is on its way, now or later."""
        if self._drop or each.output is None:
            return False
        data = packed(each.output, values)
        if trouble is not None and trouble.kind in ("half", "garbage"):
            each.send(data[: len(data) // 2] if trouble.kind == "half" else GARBAGE)
            each.hang_up()
            return False
        if self._hold:
            each.held.append(data)
            return True
        data = b"".join(each.held) + data * (2 if trouble is not None and trouble.kind == "repeat" else 1)
        each.held.clear()
        return each.send(data)
