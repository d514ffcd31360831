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
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from itertools import repeat
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ...datasets import load_dataset
from ...errors import CellError, SettingError
from .cell import ANSWER, ORDER, PHASE, RUNTIME, Answer, Runtime, Verb, word
from .protocol import CHANNELS, IN_USE, NOT_FOUND, TYPES, VERSION, Kind, Package, Packages, Recipe, column_of, type_of


class Connection:
    """One client: its recipes, and what is held back of it."""

    def __init__(self, sock: socket.socket) -> None:
        self.socket = sock
        self.output: Recipe | None = None
        self.every = 1  # cycles
        self.inputs: dict[int, Recipe] = {}
        self.started = False
        self.held: list[bytes] = []

    def send(self, data: bytes) -> bool:
        """Whether the socket took it."""
        try:
            self.socket.sendall(data)
        except OSError:  # gone, or it does not read
            self.hang_up()
        return self.started

    def hang_up(self) -> None:
        """In good order: what was sent arrives."""
        self.started = False
        with suppress(OSError):
            self.socket.shutdown(socket.SHUT_WR)


CHECK, REST = 5, 2  # control cycles of a height check, and of standstill before an insertion is answered
Values = dict[str, float]


class RobotProgram:
    """Inserts the traces of a labelled data set, one an order, and behaves as `ReplayCell` does: accepted failures stop.

    dataset : anything that `load_dataset` takes; a single channel is FZ_Base.  confirm : whether an accepted good part is
    confirmed.  approach : cycles before an insertion.
    `played` : the parts inserted, by their place in the data set.  `place` : part and sample of this cycle, None outside.
    """

    def __init__(self, dataset: Any, confirm: bool = False, approach: int = 5) -> None:
        self.data = load_dataset(dataset)
        self.confirm, self.approach = confirm, approach
        X = self.data.X if self.data.X.ndim == 3 else self.data.X[:, None]
        names = self.data.channels if len(self.data.channels) == X.shape[1] > 1 else tuple(CHANNELS)[: X.shape[1]]
        self._columns = [column_of(name) for name in (("FZ_Base",) if X.shape[1] == 1 else names)]
        self._traces: NDArray[np.float64] = X.astype(np.float64)
        self.played: list[int] = []
        self.place: tuple[int, int] | None = None
        self.outputs: Values = {RUNTIME: Runtime.PLAYING, ANSWER: 0, PHASE: 0}
        self._inputs: Values = {}
        self._run = self._cycles()

    def step(self, inputs: Values) -> Values:
        """One control cycle. inputs : registers as clients have written them.  Returns the outputs, by column."""
        self._inputs = inputs
        next(self._run)
        return self.outputs

    def restart(self) -> None:
        """Start it anew: what was ordered is void."""
        self._run = self._cycles()

    def _cycles(self) -> Iterator[None]:
        """The program; each yield ends a control cycle."""
        self.place, last = None, int(self._inputs.get(ORDER, 0)) // 10
        self.outputs.update({PHASE: 0, ANSWER: word(last, Answer.VOID)})
        while True:
            number, verb = divmod(int(self._inputs.get(ORDER, 0)), 10)
            if number != last:
                answer = yield from self._carry_out(number, verb)
                self.outputs[ANSWER] = word(number, answer)
                last = number
            yield

    def _carry_out(self, number: int, verb: int) -> Any:
        if verb == Verb.INSERT:
            return (yield from self._insert(number))
        if verb not in tuple(Verb) or not self.played:
            return Answer.FAILED
        good = bool(self.data.y[self.played[-1]])
        if verb == Verb.VERIFY:
            yield from repeat(None, CHECK)
            return Answer.GOOD if good else Answer.BAD
        yield from repeat(None, 1)
        if verb == Verb.REJECT:
            return Answer.DONE
        return (Answer.CONFIRMED if self.confirm else Answer.UNKNOWN) if good else Answer.STOPPED

    def _insert(self, number: int) -> Any:
        if len(self.played) == len(self.data):
            return Answer.FAILED  # the bin is empty
        part = len(self.played)
        self.played.append(part)
        yield from repeat(None, self.approach)
        self.outputs[PHASE] = number
        for sample in range(self._traces.shape[2]):
            self.place = part, sample
            self.outputs.update(zip(self._columns, self._traces[part, :, sample].tolist(), strict=True))
            yield
        self.place = None
        self.outputs.update({PHASE: 0, **dict.fromkeys(self._columns, 0.0)})
        yield from repeat(None, REST)
        return Answer.DONE


CYCLE_S = 0.002
IDLE_S = 0.0002  # of a cycle at no set speed, while nobody listens
STATE = {"robot_mode": 7.0, "safety_mode": 1.0, "speed_scaling": 1.0, RUNTIME: float(Runtime.PLAYING)}
FOREIGN = (OSError, CellError, struct.error, ValueError, KeyError)  # of a client that is gone, or speaks otherwise
PATIENCE = struct.pack("ll", 5, 0)  # seconds, a timeval: a client that does not read is hung up on
GARBAGE = b"\x00\x01\xff GET / HTTP/1.1"
TROUBLES = ("drop", "hold", "close", "half", "garbage", "repeat", "reset")


class Program(Protocol):
    """What runs on the robot."""

    place: tuple[int, int] | None

    def step(self, inputs: dict[str, float]) -> Mapping[str, float]: ...  # a control cycle: outputs by column


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
    refuses : requests that it says no to, Kind.VERSION or Kind.START.
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
    ) -> None:
        self.program, self.host, self.speed = program, host, speed
        self.held, self.unknown, self.refuses = set(held), set(unknown), set(refuses)
        self.lost: set[tuple[int, int]] = set()
        self.said: list[str] = []
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
        with self._lock:
            for each in self._connections:
                each.send(Package(Kind.TEXT, bytes([len(words)]) + words + b"\x04fake\x01").bytes)

    # The server's side of a connection.

    def _accept(self) -> None:
        while not self._closing.is_set():
            try:
                sock, _ = self._server.accept()
            except OSError:  # closed
                return
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, PATIENCE)
            thread = threading.Thread(target=self._serve, args=(Connection(sock),), daemon=True)
            self._threads.append(thread)
            thread.start()

    def _serve(self, connection: Connection) -> None:
        with self._lock:
            self._connections.append(connection)
        packages = Packages()
        with connection.socket, suppress(*FOREIGN):
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
                answer = self._reply(connection, package.kind, package.payload)
                connection.socket.sendall(Package(package.kind, answer).bytes)
                connection.started = package.kind is Kind.START and answer == b"\1"

    def _reply(self, connection: Connection, kind: Kind, payload: bytes) -> bytes:
        if kind is Kind.OUTPUTS:
            return self._set_outputs(connection, payload)
        if kind is Kind.INPUTS:
            return self._set_inputs(connection, payload)
        if kind is Kind.CONTROLLER:
            return struct.pack(">4I", 5, 11, 0, 0)  # of its software
        agrees = {Kind.VERSION: payload == struct.pack(">H", VERSION), Kind.START: connection.output is not None}
        return bytes([agrees.get(kind, True) and kind not in self.refuses])

    def _set_outputs(self, connection: Connection, payload: bytes) -> bytes:
        (rate,) = struct.unpack_from(">d", payload)
        names = payload[8:].decode().rstrip(",").split(",")  # ur_rtde ends its list with a comma
        types = [NOT_FOUND if name in self.unknown else type_of(name) for name in names]
        if NOT_FOUND not in types:
            connection.output = Recipe(1, tuple(names), tuple(types))
        connection.every = max(int(1 / (CYCLE_S * rate)), 1) if rate > 0 else 1
        return bytes([1]) + ",".join(types).encode()

    def _set_inputs(self, connection: Connection, payload: bytes) -> bytes:
        names = payload.decode().rstrip(",").split(",")
        others = [recipe for each in self._connections if each is not connection for recipe in each.inputs.values()]
        taken = self.held.union(*(recipe.names for recipe in others))
        types = [IN_USE if name in taken else type_of(name) for name in names]
        number = 0 if {IN_USE, NOT_FOUND} & set(types) else len(connection.inputs) + 1
        if number:
            connection.inputs[number] = Recipe(number, tuple(names), tuple(types))
        return bytes([number]) + ",".join(types).encode()

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
        kind, cycles = (trouble.kind, trouble.cycles) if trouble else ("", 0)
        self._drop, self._hold = max(self._drop, cycles * (kind == "drop")), max(self._hold, cycles * (kind == "hold"))
        self._begin = self._cycle if kind == "reset" else self._begin
        for each in self._connections if kind == "close" else ():
            each.hang_up()
        values["timestamp"] = (self._cycle - self._begin) * CYCLE_S
        started = [each for each in self._connections if each.started and self._cycle % each.every == 0]
        sent = [self._send(each, values, kind) for each in started]
        if place is not None and not any(sent):
            self.lost.add(place)
        self._drop, self._hold, self._cycle = max(self._drop - 1, 0), max(self._hold - 1, 0), self._cycle + 1
        return bool(started)

    def _send(self, each: Connection, values: Mapping[str, float], trouble: str) -> bool:
        """Whether the package of this cycle is on its way, now or later."""
        if self._drop or each.output is None:
            return False
        row = [values.get(name, 0.0) for name in each.output.columns]
        whole = [letter != "d" for letter, n in map(TYPES.__getitem__, each.output.types) for _ in range(n)]
        data = each.output.pack([int(value) if is_whole else value for value, is_whole in zip(row, whole, strict=True)])
        if trouble in ("half", "garbage"):
            each.send(data[: len(data) // 2] if trouble == "half" else GARBAGE)
            each.hang_up()
            return False
        if self._hold:
            each.held.append(data)
            return True
        data = b"".join(each.held) + data * (2 if trouble == "repeat" else 1)
        each.held.clear()
        return each.send(data)
