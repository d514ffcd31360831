"""A controller that speaks RTDE over TCP without a robot: for tests, and for whoever has none.

    with FakeController(RobotProgram("insertion")) as fake:
        with UrCell(fake.host, port=fake.port) as cell: ...

It keeps to the published protocol as far as a client can see it, steps 500 times a second (or faster), and can be told to
do what real ones do on bad days: `Trouble`.
"""

import os
import re
import socket
import struct
import threading
import time
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from itertools import repeat
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...datasets import load_dataset
from ...errors import CellError, expect
from .cell import ANSWER, ORDER, PHASE, RUNTIME, Answer, Runtime, Verb, word
from .protocol import CHANNELS, IN_USE, NOT_FOUND, VERSION, Kind, Package, Packages, Recipe

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
        self._columns = [CHANNELS.get(name, name) for name in (("FZ_Base",) if X.shape[1] == 1 else names)]
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
# A client that does not read for five seconds is hung up on: milliseconds on Windows, else a timeval.
PATIENCE = 5000 if os.name == "nt" else struct.pack("ll", 5, 0)
GARBAGE = b"\x00\x01\xff GET / HTTP/1.1"
TROUBLES = ("drop", "hold", "close", "half", "garbage", "repeat", "reset")
FIELDS = {  # that it has: patterns of their names, and their types
    r"timestamp|speed_scaling|(in|out)put_double_register_\d+": "DOUBLE",
    r"actual_(q|qd|TCP_pose|TCP_speed|TCP_force)": "VECTOR6D",
    r"robot_mode|safety_mode|(in|out)put_int_register_\d+": "INT32",
    r"runtime_state": "UINT32",
    r"actual_digital_(in|out)put_bits": "UINT64",
    r"(in|out)put_bit_register_\d+": "BOOL",
}


def type_of(name: str) -> str:
    """The type of a field by its name; NOT_FOUND for none."""
    return next((kind for pattern, kind in FIELDS.items() if re.fullmatch(pattern, name)), NOT_FOUND)


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
        known = self.kind in TROUBLES and self.cycles >= 1
        expect(known, f"a trouble among {', '.join(TROUBLES)} of 1 or more cycles", self)


class Client:
    """One that is connected: its recipes, and what is held back of it."""

    def __init__(self, sock: socket.socket) -> None:
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, PATIENCE)
        self.socket = sock
        self.output: Recipe | None = None
        self.every = 1  # cycles
        self.inputs: dict[int, Recipe] = {}
        self.started = False
        self.held = b""

    def send(self, data: bytes) -> bool:
        """Whether the socket took it."""
        try:
            self.socket.sendall(data)
        except OSError:  # gone, or it does not read
            self.hang_up()
        return self.started

    def hang_up(self, how: int = socket.SHUT_WR) -> None:
        """In good order, as a rule: what was sent arrives."""
        self.started = False
        with suppress(OSError):
            self.socket.shutdown(how)


class FakeController(AbstractContextManager["FakeController"]):
    """Listens on host and port (0: any that is free) and plays a program, until it is closed.

    program : has `step` and `place`, as `RobotProgram` has them; None: the robot rests.
    speed : cycles against real time; None: as fast as clients read.  troubles : what goes wrong, and when.
    refuses : requests that it says no to, Kind.VERSION or Kind.START; names of outputs that it does not have, and of inputs
    that another client holds.  `lost` : part and sample of every package of an insertion that no client was sent.
    `inputs` : registers as clients have written them.
    """

    def __init__(
        self,
        program: Any = None,
        host: str = "127.0.0.1",
        port: int = 0,
        speed: float | None = 1.0,
        troubles: Iterable[Trouble] = (),
        refuses: Collection[Kind | str] = (),
    ) -> None:
        self.program, self.host, self.speed, self.refuses = program, host, speed, refuses
        self.lost: set[tuple[int, int]] = set()
        self._troubles = {(each.part, each.sample): each for each in troubles}
        self._server = socket.create_server((host, port))
        self.port: int = self._server.getsockname()[1]
        self.inputs: dict[str, float] = {}
        self._clients: list[Client] = []
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self._begin = self._cycle = 0
        self._until = Counter[str]()  # the cycle at which a trouble that lasts is over
        self._threads = [threading.Thread(target=each, daemon=True) for each in (self._accept, self._run)]
        for thread in self._threads[:]:
            thread.start()

    def close(self) -> None:
        """End all connections and threads."""
        self._closing.set()
        with suppress(OSError):
            self._server.shutdown(socket.SHUT_RDWR)
        self._server.close()
        with self._lock:
            for each in self._clients:
                each.hang_up(socket.SHUT_RDWR)  # what was sent may never arrive
        for thread in list(self._threads):
            thread.join()

    def __exit__(self, *raised: object) -> None:
        self.close()

    def hang_up(self, anew: bool = False) -> None:
        """Close every connection. anew : as it is switched off and on: its clock begins anew, and nothing is written."""
        with self._lock:
            if anew:
                self.inputs.clear()
                self._begin = self._cycle
            for each in self._clients:
                each.hang_up()

    def _accept(self) -> None:
        with suppress(OSError):  # until it is closed
            while True:
                sock, _ = self._server.accept()
                self._threads.append(threading.Thread(target=self._serve, args=(Client(sock),), daemon=True))
                self._threads[-1].start()

    def _serve(self, client: Client) -> None:
        with self._lock:
            self._clients.append(client)
        packages = Packages()
        with client.socket, suppress(*FOREIGN):
            while piece := client.socket.recv(65536):
                for package in packages.feed(piece):
                    with self._lock:
                        self._answer(client, package.kind, package.payload)
        with self._lock:
            client.started = False
            self._clients.remove(client)

    def _answer(self, client: Client, kind: Kind, payload: bytes) -> None:
        yes = kind not in self.refuses
        match kind:
            case Kind.TEXT:
                return
            case Kind.DATA:
                self.inputs.update(client.inputs[payload[0]].unpack(payload))
                return
            case Kind.OUTPUTS:
                (rate,) = struct.unpack_from(">d", payload)
                client.every = max(int(1 / (CYCLE_S * rate)), 1) if rate > 0 else 1
                recipe = self._recipe(1, payload[8:], self.refuses, NOT_FOUND)
                client.output = None if NOT_FOUND in recipe.types else recipe
                answer = bytes([1]) + ",".join(recipe.types).encode()
            case Kind.INPUTS:
                others = [each.names for other in self._clients if other is not client for each in other.inputs.values()]
                number = len(client.inputs) + 1
                recipe = self._recipe(number, payload, {*self.refuses}.union(*others), IN_USE)
                if {IN_USE, NOT_FOUND} & set(recipe.types):
                    number = 0
                else:
                    client.inputs[number] = recipe
                answer = bytes([number]) + ",".join(recipe.types).encode()
            case Kind.CONTROLLER:
                answer = struct.pack(">4I", 5, 11, 0, 0)  # of its software
            case Kind.VERSION:
                answer = bytes([yes and payload == struct.pack(">H", VERSION)])
            case _:
                answer = bytes([yes and (kind is not Kind.START or client.output is not None)])
        client.socket.sendall(Package(kind, answer).packed())
        client.started = kind is Kind.START and answer == b"\1"

    def _recipe(self, number: int, names: bytes, refused: Collection[Kind | str], why: str) -> Recipe:
        listed = names.decode().split(",")
        return Recipe(number, tuple(listed), tuple(why if name in refused else type_of(name) for name in listed))

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
        values = {**STATE, **self.inputs, **(self.program.step(dict(self.inputs)) if self.program else {})}
        place = self.program.place if self.program else None
        trouble = self._troubles.pop(place, None) if place else None
        kind = trouble.kind if trouble else ""
        if trouble:
            self._until[kind] = max(self._until[kind], self._cycle + trouble.cycles)
        if kind == "reset":
            self._begin = self._cycle
        for each in self._clients if kind == "close" else ():
            each.hang_up()
        values["timestamp"] = (self._cycle - self._begin) * CYCLE_S
        started = [each for each in self._clients if each.started and self._cycle % each.every == 0]
        sent = [self._send(each, values, kind) for each in started]
        if place is not None and not any(sent):
            self.lost.add(place)
        self._cycle += 1
        return bool(started)

    def _send(self, each: Client, values: Values, trouble: str) -> bool:
        """Whether the package of this cycle is on its way, now or later."""
        if self._cycle < self._until["drop"] or each.output is None:
            return False
        data = each.output.pack(values)
        if trouble in ("half", "garbage"):
            each.send(data[: len(data) // 2] if trouble == "half" else GARBAGE)
            each.hang_up()
            return False
        each.held += data * (2 if trouble == "repeat" else 1)
        if self._cycle < self._until["hold"]:
            return True
        data, each.held = each.held, b""
        return each.send(data)
