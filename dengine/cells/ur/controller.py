"""`FakeController`, a simulated controller that speaks RTDE over TCP, for tests and trials. It runs
a `RobotProgram`, which carries out the orders of a `UrCell` with the traces of a data set, and can
produce the faults that occur in practice, each a `Trouble`.

    with FakeController(RobotProgram("insertion")) as fake:
        with UrCell(fake.host, port=fake.port) as cell: ...

It follows the published protocol as far as a client can see it, and sends 500 packages per second
(or more).
"""

import os
import re
import socket
import struct
import threading
import time
from collections import Counter
from collections.abc import Collection, Generator, Iterable, Iterator
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from itertools import repeat
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...datasets import load_dataset
from ...errors import CellError, expect
from .cell import ANSWER, ORDER, PHASE, RUNTIME, ResultCode, Runtime, Verb, encode_message
from .protocol import (
    CHANNELS,
    IN_USE,
    NOT_FOUND,
    VERSION,
    Package,
    PackageReader,
    PackageType,
    RtdeRecipe,
)

CHECK_CYCLES = 5  # control cycles of a height check
REST_CYCLES = 2  # at rest after an insertion, before its result
Values = dict[str, float]


class RobotProgram:
    """The robot's program: it inserts the traces of a labelled data set, one for each order.

    As with `ReplayCell`, an accepted bad part stops the line.

    Parameters
    ----------
    dataset : object
        Anything that `load_dataset` takes. A single channel is FZ_Base.
    confirm : bool, default False
        Whether an accepted good part is confirmed.
    approach : int, default 5
        Control cycles before an insertion.

    Attributes
    ----------
    played : list of int
        Indices of the inserted parts in the data set.
    place : tuple of int or None
        Part and sample of the present control cycle; None outside an insertion.
    outputs : dict
        Output values of the controller by column.
    """

    def __init__(self, dataset: Any, confirm: bool = False, approach: int = 5) -> None:
        self.data = load_dataset(dataset)
        self.confirm = confirm
        self.approach = approach
        X = self.data.X if self.data.X.ndim == 3 else self.data.X[:, None]
        names = (
            self.data.channels
            if len(self.data.channels) == X.shape[1] > 1
            else tuple(CHANNELS)[: X.shape[1]]
        )
        self._columns = [
            CHANNELS.get(name, name) for name in (("FZ_Base",) if X.shape[1] == 1 else names)
        ]
        self._traces: NDArray[np.float64] = X.astype(np.float64)
        self.played: list[int] = []
        self.place: tuple[int, int] | None = None
        self.outputs: Values = {RUNTIME: Runtime.PLAYING, ANSWER: 0, PHASE: 0}
        self._inputs: Values = {}
        self._run = self._run_program()

    def step(self, inputs: Values) -> Values:
        """Run one control cycle with these inputs; return all outputs. Both are values by column.

        The dict that is returned is `outputs` itself, which the next cycle changes.
        """
        self._inputs = inputs
        next(self._run)
        return self.outputs

    def restart(self) -> None:
        """Start the program anew at the next control cycle; a waiting order gets the result VOID.

        Parts that were inserted stay so.
        """
        self._run = self._run_program()

    def _run_program(self) -> Iterator[None]:
        """Run the program without an end; each yield ends a control cycle.

        At its start it writes the result VOID for an order that it finds. Then it carries out each
        order with a new number, and writes its result to the outputs.
        """
        self.place = None
        last = int(self._inputs.get(ORDER, 0)) // 10
        self.outputs.update({PHASE: 0, ANSWER: encode_message(last, ResultCode.VOID)})
        while True:
            number, verb = divmod(int(self._inputs.get(ORDER, 0)), 10)
            if number != last:
                result = yield from self._carry_out(number, verb)
                self.outputs[ANSWER] = encode_message(number, result)
                last = number
            yield

    def _carry_out(self, number: int, verb: int) -> Generator[None, None, ResultCode]:
        """Simulate one order, a yield per control cycle; return its result code (`yield from`).

        VERIFY, PROCEED and REJECT answer for the newest inserted part, by its label. FAILED if
        there is none, and for an unknown order.
        """
        if verb == Verb.INSERT:
            return (yield from self._insert(number))
        if verb not in tuple(Verb) or not self.played:
            return ResultCode.FAILED
        good = bool(self.data.y[self.played[-1]])
        if verb == Verb.VERIFY:
            yield from repeat(None, CHECK_CYCLES)
            return ResultCode.GOOD if good else ResultCode.BAD
        yield from repeat(None, 1)
        if verb == Verb.REJECT:
            return ResultCode.DONE
        if not good:
            return ResultCode.STOPPED
        return ResultCode.CONFIRMED if self.confirm else ResultCode.UNKNOWN

    def _insert(self, number: int) -> Generator[None, None, ResultCode]:
        """Play the next trace into the outputs, a yield per control cycle; return DONE (`yield
        from`).

        The part is added to `played`. Before the trace come `approach` cycles, after it two at
        rest. While it plays, the output PHASE has the order's number, and `place` is set. Returns
        FAILED at once, without a cycle, if all traces were played.
        """
        if len(self.played) == len(self.data):
            return ResultCode.FAILED  # the bin is empty
        part = len(self.played)
        self.played.append(part)
        yield from repeat(None, self.approach)
        self.outputs[PHASE] = number
        for sample in range(self._traces.shape[2]):
            self.place = part, sample
            self.outputs.update(
                zip(self._columns, self._traces[part, :, sample].tolist(), strict=True)
            )
            yield
        self.place = None
        self.outputs.update({PHASE: 0, **dict.fromkeys(self._columns, 0.0)})
        yield from repeat(None, REST_CYCLES)
        return ResultCode.DONE


CYCLE_S = 0.002
IDLE_S = 0.0002  # length of a cycle without a set speed while no client listens
STATE = {
    "robot_mode": 7.0,
    "safety_mode": 1.0,
    "speed_scaling": 1.0,
    RUNTIME: float(Runtime.PLAYING),
}
FOREIGN = (
    OSError,
    CellError,
    struct.error,
    ValueError,
    KeyError,
)  # of a client that has gone, or does not speak RTDE
# A client that does not read for five seconds is disconnected. Windows wants milliseconds.
SEND_TIMEOUT = 5000 if os.name == "nt" else struct.pack("ll", 5, 0)
GARBAGE = b"\x00\x01\xff GET / HTTP/1.1"
TROUBLES = ("drop", "hold", "close", "half", "garbage", "repeat", "reset")
FIELDS = {  # patterns of the names of fields, and their types
    r"timestamp|speed_scaling|(in|out)put_double_register_\d+": "DOUBLE",
    r"actual_(q|qd|TCP_pose|TCP_speed|TCP_force)": "VECTOR6D",
    r"robot_mode|safety_mode|(in|out)put_int_register_\d+": "INT32",
    r"runtime_state": "UINT32",
    r"actual_digital_(in|out)put_bits": "UINT64",
    r"(in|out)put_bit_register_\d+": "BOOL",
}


def type_of(name: str) -> str:
    """Return the RTDE type of a field by its name, such as "DOUBLE"; NOT_FOUND if there is none."""
    types = (type_ for pattern, type_ in FIELDS.items() if re.fullmatch(pattern, name))
    return next(types, NOT_FOUND)


@dataclass(frozen=True, slots=True)
class Trouble:
    """A fault at one sample of one insertion.

    Attributes
    ----------
    part, sample : int
        Where it happens.
    kind : str
        "drop": `cycles` packages are not sent, from this one on. "hold": so many are delayed and
        then sent at once. "repeat": the package is sent twice. "close": the connections are closed
        before it. "half": after half of it. "garbage": after bytes that are no package. "reset":
        the controller's clock starts anew.
    cycles : int
        Length of "drop" and "hold" in control cycles.
    """

    part: int
    sample: int
    kind: str
    cycles: int = 1

    def __post_init__(self) -> None:
        is_valid = self.kind in TROUBLES and self.cycles >= 1
        expect(is_valid, f"a trouble among {', '.join(TROUBLES)} of 1 or more cycles", self)


class Client:
    """A connected client of `FakeController`: its recipes, and bytes that are delayed for it."""

    def __init__(self, sock: socket.socket) -> None:
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, SEND_TIMEOUT)
        self.socket = sock
        self.output: RtdeRecipe | None = None
        self.every = 1  # sends a package in each n-th cycle
        self.inputs: dict[int, RtdeRecipe] = {}
        self.started = False
        self.delayed = b""

    def send(self, data: bytes) -> bool:
        """Send bytes; return whether the client is still connected and has started to receive.

        A client that has gone, or does not read for 5 s, is disconnected.
        """
        try:
            self.socket.sendall(data)
        except OSError:  # gone, or it does not read
            self.hang_up()
        return self.started

    def hang_up(self, how: int = socket.SHUT_WR) -> None:
        """Shut the connection down; by default, what was sent still arrives.

        Nothing is sent any more. `how` is the argument of `socket.shutdown`.
        """
        self.started = False
        with suppress(OSError):
            self.socket.shutdown(how)


class FakeController(AbstractContextManager["FakeController"]):
    """A server on a port that runs a program until it is closed, in threads that it starts at once.

    Parameters
    ----------
    program : RobotProgram, optional
        Has `step` and `place`. None: the robot does nothing.
    host : str, default "127.0.0.1"
    port : int, default 0
        0: any free port, which the attribute `port` names.
    speed : float or None, default 1
        Relative to real time. None: as fast as clients read from the socket. An `RtdeStream`
        reads in a thread of its own and buffers 60 s of packages of robot time, so if nobody takes
        them, as during a retrain, it soon drops the oldest.
    troubles : iterable of Trouble
        Faults to produce.
    refuses : collection
        Requests to refuse, PackageType.VERSION or START; names of outputs that it does not have,
        and of inputs that another client writes.

    Attributes
    ----------
    inputs : dict
        Registers as clients have written them, by column.
    lost : set of (int, int)
        Part and sample of each package of an insertion that was sent to no client.
    """

    def __init__(
        self,
        program: Any = None,
        host: str = "127.0.0.1",
        port: int = 0,
        speed: float | None = 1.0,
        troubles: Iterable[Trouble] = (),
        refuses: Collection[PackageType | str] = (),
    ) -> None:
        self.program = program
        self.host = host
        self.speed = speed
        self.refuses = refuses
        self.lost: set[tuple[int, int]] = set()
        self._troubles = {(trouble.part, trouble.sample): trouble for trouble in troubles}
        self._server = socket.create_server((host, port))
        self.port: int = self._server.getsockname()[1]
        self.inputs: dict[str, float] = {}
        self._clients: list[Client] = []
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self._begin = self._cycle = 0
        self._until = Counter[str]()  # by kind of trouble: the cycle at which it ends
        self._threads = [
            threading.Thread(target=loop, daemon=True)
            for loop in (self._accept_loop, self._run_loop)
        ]
        for thread in self._threads[:]:
            thread.start()

    def close(self) -> None:
        """End all connections, and wait until all threads have ended."""
        self._closing.set()
        with suppress(OSError):
            self._server.shutdown(socket.SHUT_RDWR)
        self._server.close()
        with self._lock:
            for client in self._clients:
                client.hang_up(socket.SHUT_RDWR)  # packages under way may be lost
        for thread in list(self._threads):
            thread.join()

    def __exit__(self, *raised: object) -> None:
        self.close()

    def hang_up(self, anew: bool = False) -> None:
        """Close every connection; clients may connect again.

        Parameters
        ----------
        anew : bool, default False
            Act as switched off and on: the clock starts anew, and all inputs are forgotten. The
            program goes on.
        """
        with self._lock:
            if anew:
                self.inputs.clear()
                self._begin = self._cycle
            for client in self._clients:
                client.hang_up()

    def _accept_loop(self) -> None:
        """Accept connections, each served by a thread of its own, until the server is closed."""
        with suppress(OSError):  # until it is closed
            while True:
                sock, _ = self._server.accept()
                self._threads.append(
                    threading.Thread(target=self._serve_client, args=(Client(sock),), daemon=True)
                )
                self._threads[-1].start()

    def _serve_client(self, client: Client) -> None:
        """Carry out a client's requests until it disconnects, or sends something else than RTDE.

        It is the body of the client's thread; afterwards the client is forgotten.
        """
        with self._lock:
            self._clients.append(client)
        packages = PackageReader()
        with client.socket, suppress(*FOREIGN):
            while piece := client.socket.recv(65536):
                for package in packages.feed(piece):
                    with self._lock:
                        self._respond(client, package.type, package.payload)
        with self._lock:
            client.started = False
            self._clients.remove(client)

    def _respond(self, client: Client, type_: PackageType, payload: bytes) -> None:
        """Carry out one request of a client, and send the response if the protocol has one; the
        caller holds the lock.

        Text is ignored, and data sets `inputs`; neither has a response. The others are: declare
        outputs or inputs, start (packages are sent until the next of these requests), pause, and
        ask for versions. What is in `refuses`, and an input of another client, is refused. A
        malformed request raises one of `FOREIGN`.
        """
        is_allowed = type_ not in self.refuses
        match type_:
            case PackageType.TEXT:
                return
            case PackageType.DATA:
                self.inputs.update(client.inputs[payload[0]].unpack(payload))
                return
            case PackageType.OUTPUTS:
                (rate,) = struct.unpack_from(">d", payload)
                client.every = max(int(1 / (CYCLE_S * rate)), 1) if rate > 0 else 1
                recipe = self._make_recipe(1, payload[8:], self.refuses, NOT_FOUND)
                client.output = None if NOT_FOUND in recipe.types else recipe
                response = bytes([1]) + ",".join(recipe.types).encode()
            case PackageType.INPUTS:
                others = [
                    recipe.names
                    for other in self._clients
                    if other is not client
                    for recipe in other.inputs.values()
                ]
                number = len(client.inputs) + 1
                recipe = self._make_recipe(number, payload, {*self.refuses}.union(*others), IN_USE)
                if {IN_USE, NOT_FOUND} & set(recipe.types):
                    number = 0
                else:
                    client.inputs[number] = recipe
                response = bytes([number]) + ",".join(recipe.types).encode()
            case PackageType.CONTROLLER:
                response = struct.pack(">4I", 5, 11, 0, 0)  # of its software
            case PackageType.VERSION:
                response = bytes([is_allowed and payload == struct.pack(">H", VERSION)])
            case _:
                response = bytes(
                    [is_allowed and (type_ is not PackageType.START or client.output is not None)]
                )
        client.socket.sendall(Package(type_, response).to_bytes())
        client.started = type_ is PackageType.START and response == b"\1"

    def _make_recipe(
        self, number: int, names: bytes, refused: Collection[PackageType | str], why: str
    ) -> RtdeRecipe:
        """Return a recipe of the fields in `names`, a text with commas between them.

        Refused ones have the type `why`, the others that of `type_of`, which may be NOT_FOUND.
        """
        listed = names.decode().split(",")
        return RtdeRecipe(
            number,
            tuple(listed),
            tuple(why if name in refused else type_of(name) for name in listed),
        )

    def _run_loop(self) -> None:
        """Run control cycles until the server is closed: the body of a thread.

        They come at the set speed; without one, as fast as the clients read.
        """
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
        """Run one control cycle: the program, troubles, and a package to each client that is due.

        Return whether a client was to receive one. Part and sample of an insertion's package that
        no client was sent are added to the set `lost`. The caller holds the lock.
        """
        values = {
            **STATE,
            **self.inputs,
            **(self.program.step(dict(self.inputs)) if self.program else {}),
        }
        place = self.program.place if self.program else None
        trouble = self._troubles.pop(place, None) if place else None
        kind = trouble.kind if trouble else ""
        if trouble:
            self._until[kind] = max(self._until[kind], self._cycle + trouble.cycles)
        if kind == "reset":
            self._begin = self._cycle
        if kind == "close":
            for client in self._clients:
                client.hang_up()
        values["timestamp"] = (self._cycle - self._begin) * CYCLE_S
        started = [
            client for client in self._clients if client.started and self._cycle % client.every == 0
        ]
        sent = [self._send(client, values, kind) for client in started]
        if place is not None and not any(sent):
            self.lost.add(place)
        self._cycle += 1
        return bool(started)

    def _send(self, client: Client, values: Values, trouble: str) -> bool:
        """Send a client the package of this cycle, or what `trouble` makes of it.

        Return whether the package will arrive, now or later. After "half" and "garbage" the client
        is disconnected.
        """
        if self._cycle < self._until["drop"] or client.output is None:
            return False
        data = client.output.pack(values)
        if trouble in ("half", "garbage"):
            client.send(data[: len(data) // 2] if trouble == "half" else GARBAGE)
            client.hang_up()
            return False
        client.delayed += data * (2 if trouble == "repeat" else 1)
        if self._cycle < self._until["hold"]:
            return True
        data = client.delayed
        client.delayed = b""
        return client.send(data)
