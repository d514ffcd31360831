"""A simulated Universal Robots controller for tests: `FakeController` speaks RTDE over TCP, as far
as a client can see it, with the faults that occur in practice. `RobotProgram` is a robot's program
that carries out the orders of a `UrCell` with the traces of a data set.
"""

import re
import select
import socket
import threading
import time
from collections import Counter
from collections.abc import Collection, Generator, Iterable, Iterator
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, field
from itertools import cycle, repeat
from types import SimpleNamespace
from typing import Any

import numpy as np

from dengine import Dataset
from dengine.cells.ur.cell import (
    ANSWER,
    ORDER,
    PHASE,
    RUNTIME,
    ResultCode,
    Runtime,
    Verb,
    encode_message,
)
from dengine.cells.ur.protocol import (
    CHANNELS,
    IN_USE,
    NOT_FOUND,
    Package,
    PackageReader,
    PackageType,
    RtdeRecipe,
)

FORCE = "actual_TCP_force[2]"
CYCLE_S = 0.002
SEND_TIMEOUT_S = 5.0  # a client that does not read for so long is disconnected
GARBAGE = b"\x00\x01\xff GET / HTTP/1.1"
FIELDS = {  # patterns of the names of fields, and their types
    "timestamp": "DOUBLE",
    r"actual_(q|TCP_pose|TCP_speed|TCP_force)": "VECTOR6D",
    r"(in|out)put_int_register_\d+": "INT32",
    "runtime_state": "UINT32",
    "actual_digital_output_bits": "UINT64",
    r"output_bit_register_\d+": "BOOL",
}
Values = dict[str, float]  # of inputs or outputs, by column


class RobotProgram:
    """A robot's program that inserts the traces of a labelled data set, one for each order.

    As with `ReplayCell`, an accepted bad part stops the line. confirm : whether an accepted good
    part is confirmed. approach : control cycles before an insertion. played : number of inserted
    parts. place : part and sample of the present control cycle; None outside an insertion.
    """

    def __init__(self, data: Dataset, confirm: bool = False, approach: int = 5) -> None:
        self.data, self.confirm, self.approach = data, confirm, approach
        self.played, self._order = 0, 0
        self.outputs: Values = {RUNTIME: Runtime.PLAYING}
        self.restart()

    def step(self, inputs: Values) -> Values:
        """Run one control cycle with these inputs; return all outputs."""
        self._order = int(inputs.get(ORDER, 0))
        next(self._run)
        return self.outputs

    def restart(self) -> None:
        """Start anew at the next control cycle; a waiting order gets the result VOID."""
        self.place: tuple[int, int] | None = None
        self._run = self._run_program()

    def _run_program(self) -> Iterator[None]:
        last = self._order // 10
        self.outputs |= {PHASE: 0, ANSWER: encode_message(last, ResultCode.VOID)}
        while True:
            number, verb = divmod(self._order, 10)
            if number != last:
                result = yield from self._carry_out(number, verb)
                self.outputs[ANSWER] = encode_message(number, result)
                last = number
            yield

    def _carry_out(self, number: int, verb: int) -> Generator[None, None, ResultCode]:
        if verb == Verb.INSERT:
            return (yield from self._insert(number))
        yield
        is_good = bool(self.data.y[self.played - 1])
        if verb == Verb.VERIFY:
            return ResultCode.GOOD if is_good else ResultCode.BAD
        if verb == Verb.REJECT:
            return ResultCode.DONE
        if not is_good:
            return ResultCode.STOPPED
        return ResultCode.CONFIRMED if self.confirm else ResultCode.UNKNOWN

    def _insert(self, number: int) -> Generator[None, None, ResultCode]:
        if self.played == len(self.data):
            return ResultCode.FAILED  # the bin is empty
        yield from repeat(None, self.approach)
        self.outputs[PHASE] = number
        for sample, force in enumerate(self.data.X[self.played].tolist()):
            self.place = self.played, sample
            self.outputs[FORCE] = force
            yield
        self.place = None
        self.played += 1
        self.outputs |= {PHASE: 0, FORCE: 0.0}
        yield from repeat(None, 2)  # at rest
        return ResultCode.DONE


@dataclass(frozen=True)
class Trouble:
    """A fault at one sample of one insertion.

    kind : "drop": `cycles` packages are not sent, from this one on. "hold": so many are delayed
    and then sent at once. "repeat": the package is sent twice. "close": the connections are closed
    before it. "half": after half of it. "garbage": after bytes that are no package. "reset": the
    controller's clock starts anew.
    """

    part: int
    sample: int
    kind: str
    cycles: int = 1


@dataclass(eq=False)
class Client:
    """A connected client."""

    socket: socket.socket
    packages: PackageReader = field(default_factory=PackageReader)
    recipes: dict[PackageType, RtdeRecipe] = field(default_factory=dict)
    started: bool = False

    def send(self, data: bytes) -> None:
        try:
            self.socket.sendall(data)
        except OSError:  # it has gone, or does not read
            self.hang_up()

    def hang_up(self) -> None:
        """Send nothing more; what was sent still arrives."""
        self.started = False
        with suppress(OSError):
            self.socket.shutdown(socket.SHUT_WR)


class FakeController(AbstractContextManager):
    """A controller that runs a program, in a thread, until it is closed.

    program : has `step`, which returns the outputs for the inputs of a control cycle, and `place`;
    without one the robot does nothing. refuses : requests to refuse, PackageType.VERSION or START;
    names of outputs that it does not have, and of inputs that another client writes. speed :
    relative to real time. inputs : as clients have written them. lost : part and sample of each
    package of an insertion that was sent to no client.
    """

    host = "127.0.0.1"

    def __init__(
        self,
        program: Any = None,
        troubles: Iterable[Trouble] = (),
        refuses: Collection[PackageType | str] = (),
        speed: float = 1.0,
    ) -> None:
        self.program = program or SimpleNamespace(place=None, step=lambda inputs: {})
        self.inputs, self.lost = {}, set()
        self._refuses = refuses
        self._troubles = {(trouble.part, trouble.sample): trouble for trouble in troubles}
        self._until = Counter[str]()  # by kind of trouble: the cycle at which it ends
        self._clients, self._delayed = [], b""
        self._cycle, self._begin = 0, -(10**5)  # the latter is the one at which the clock began
        self._period = CYCLE_S / speed
        self._lock = threading.Lock()
        self._server = socket.create_server((self.host, 0))
        self.port = self._server.getsockname()[1]
        self._is_closing = False
        self._thread = threading.Thread(target=self._run_loop, daemon=True)
        self._thread.start()

    def __exit__(self, *raised: object) -> None:
        self._is_closing = True
        self._thread.join()

    def hang_up(self, anew: bool = False) -> None:
        """Close every connection; anew : as switched off and on, the clock and inputs too."""
        with self._lock:
            if anew:
                self.inputs.clear()
                self._begin = self._cycle
            for client in self._clients:
                client.hang_up()

    def _run_loop(self) -> None:
        """Answer clients until the next control cycle is due, and run it."""
        due = time.monotonic()
        while not self._is_closing:
            waiting = [self._server, *(client.socket for client in self._clients)]
            wait = max(due - time.monotonic(), 0.0)
            ready, _, _ = select.select(waiting, [], [], wait)
            with self._lock:
                if self._server in ready:
                    self._accept()
                for client in [*self._clients]:
                    if client.socket in ready:
                        self._receive(client)
                if not ready:
                    self._step()
                    due += self._period
        for sock in waiting:
            sock.close()

    def _accept(self) -> None:
        sock, _ = self._server.accept()
        sock.settimeout(SEND_TIMEOUT_S)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._clients.append(Client(sock))

    def _receive(self, client: Client) -> None:
        """Carry out what a client sent; forget one that has gone."""
        piece = b""
        with suppress(OSError):
            piece = client.socket.recv(65536)
        for package in client.packages.feed(piece):
            self._respond(client, *package)
        if not piece:
            self._clients.remove(client)
            client.socket.close()

    def _respond(self, client: Client, type_: PackageType, payload: bytes) -> None:
        if type_ is PackageType.DATA:
            self.inputs.update(client.recipes[PackageType.INPUTS].unpack(payload))
            return
        response = bytes([type_ not in self._refuses])
        if type_ in (PackageType.OUTPUTS, PackageType.INPUTS):
            is_output = type_ is PackageType.OUTPUTS
            names = payload[8 if is_output else 0 :].decode().split(",")  # after the rate
            types = [self._type_of(name, NOT_FOUND if is_output else IN_USE) for name in names]
            client.recipes[type_] = RtdeRecipe(1, tuple(names), tuple(types))
            response += ",".join(types).encode()
        client.send(Package(type_, response).to_bytes())
        client.started = type_ is PackageType.START and response == b"\1"

    def _type_of(self, name: str, refusal: str) -> str:
        if name in self._refuses:
            return refusal
        types = (type_ for pattern, type_ in FIELDS.items() if re.fullmatch(pattern, name))
        return next(types, NOT_FOUND)

    def _step(self) -> None:
        """Run one control cycle: the program, and a package to each client."""
        outputs = self.program.step(dict(self.inputs))
        sent = [
            self._send(client, {**self.inputs, **outputs})
            for client in self._clients
            if client.started
        ]
        if self.program.place is not None and not any(sent):
            self.lost.add(self.program.place)
        self._cycle += 1

    def _send(self, client: Client, values: Values) -> bool:
        """Send the package of this cycle, unless a trouble is in its way; return whether it was."""
        trouble = self._troubles.pop(self.program.place, None)
        kind = trouble.kind if trouble else ""
        if trouble:
            self._until[kind] = self._cycle + trouble.cycles
        if kind == "reset":
            self._begin = self._cycle
        if kind == "close":
            client.hang_up()
        if self._cycle < self._until["drop"] or not client.started:
            return False
        values["timestamp"] = (self._cycle - self._begin) * CYCLE_S
        data = client.recipes[PackageType.OUTPUTS].pack(values)
        if kind in ("half", "garbage"):
            client.send(data[: len(data) // 2] if kind == "half" else GARBAGE)
            client.hang_up()
            return False
        self._delayed += data * (2 if kind == "repeat" else 1)
        if self._cycle >= self._until["hold"]:
            client.send(self._delayed)
            self._delayed = b""
        return True


class Signals:
    """Plays columns of numbers, again and again."""

    place = None

    def __init__(self, **columns: np.ndarray) -> None:
        names = [CHANNELS.get(name, name) for name in columns]
        rows = np.stack(list(columns.values()), axis=1).tolist()
        self._rows = cycle([dict(zip(names, row, strict=True)) for row in rows])

    def step(self, inputs: Values) -> Values:
        return next(self._rows)
