"""`FakeController`, a simulated controller that speaks RTDE over TCP, for tests and trials. It runs
a `RobotProgram`, which carries out the orders of a `UrCell` with the traces of a data set.

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
from collections.abc import Generator, Iterator
from contextlib import AbstractContextManager, suppress
from itertools import repeat
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...datasets import load_dataset
from ...errors import CellError
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

        Parts that were inserted stay inserted.
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
        """Play the next trace into the outputs, a yield per control cycle; return its result code.

        The result, by `yield from`, is DONE, or FAILED at once, without a cycle, if all traces were
        played. The part is added to `played`. Before the trace come `approach` cycles, after it two
        at rest. While it plays, the output PHASE has the order's number, and `place` is part and
        sample.
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


class Client:
    """A connected client of `FakeController`, and its recipes."""

    def __init__(self, sock: socket.socket) -> None:
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, SEND_TIMEOUT)
        self.socket = sock
        self.output: RtdeRecipe | None = None
        self.every = 1  # sends a package in each n-th cycle
        self.inputs: dict[int, RtdeRecipe] = {}
        self.started = False

    def send(self, data: bytes) -> None:
        """Send bytes; a client that has gone, or does not read for 5 s, is disconnected.

        Nothing is raised then, and nothing more is sent to it.
        """
        try:
            self.socket.sendall(data)
        except OSError:
            self.hang_up()

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
        Has `step`. None: the robot does nothing.
    host : str, default "127.0.0.1"
    port : int, default 0
        0: any free port, which the attribute `port` names.
    speed : float or None, default 1
        Relative to real time. None: as fast as clients read from the socket. An `RtdeStream`
        reads in a thread of its own and buffers 60 s of packages of robot time, so if nobody takes
        them, as during a retrain, it soon drops the oldest.

    Attributes
    ----------
    inputs : dict
        Registers as clients have written them, by column.
    clients : list of Client
        Those that are connected.
    cycle, begin : int
        The present control cycle, and that at which the controller's clock began.
    lock : threading.Lock
        Held during a control cycle, and while a client's request is carried out.
    """

    def __init__(
        self,
        program: Any = None,
        host: str = "127.0.0.1",
        port: int = 0,
        speed: float | None = 1.0,
    ) -> None:
        self.program = program
        self.host = host
        self.speed = speed
        self.inputs: Values = {}
        self.clients: list[Client] = []
        self.cycle = 0
        self.begin = 0
        self.lock = threading.Lock()
        self._server = socket.create_server((host, port))
        self.port: int = self._server.getsockname()[1]
        self._closing = threading.Event()
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
        with self.lock:
            for client in self.clients:
                client.hang_up(socket.SHUT_RDWR)  # packages under way may be lost
        for thread in list(self._threads):
            thread.join()

    def __exit__(self, *raised: object) -> None:
        self.close()

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
        with self.lock:
            self.clients.append(client)
        packages = PackageReader()
        with client.socket, suppress(*FOREIGN):
            while piece := client.socket.recv(65536):
                for package in packages.feed(piece):
                    with self.lock:
                        self.respond(client, package.type, package.payload)
        with self.lock:
            client.started = False
            self.clients.remove(client)

    def respond(self, client: Client, type_: PackageType, payload: bytes) -> None:
        """Carry out one request of a client, and send the response if the protocol has one.

        The caller holds the lock. A request with text is ignored, and a request with data writes
        `inputs`; both have no response. The other requests are: declare outputs or inputs, start
        (packages are sent until the next of these requests), pause, and ask for versions. An input
        of another client is refused. A malformed request raises one of `FOREIGN`.
        """
        match type_:
            case PackageType.TEXT:
                return
            case PackageType.DATA:
                self.inputs.update(client.inputs[payload[0]].unpack(payload))
                return
            case PackageType.OUTPUTS:
                (rate,) = struct.unpack_from(">d", payload)
                client.every = max(int(1 / (CYCLE_S * rate)), 1) if rate > 0 else 1
                names = payload[8:].decode().split(",")
                recipe = RtdeRecipe(1, tuple(names), tuple(map(type_of, names)))
                client.output = None if NOT_FOUND in recipe.types else recipe
                response = bytes([1]) + ",".join(recipe.types).encode()
            case PackageType.INPUTS:
                response = self._declare_inputs(client, payload.decode().split(","))
            case PackageType.CONTROLLER:
                response = struct.pack(">4I", 5, 11, 0, 0)  # of its software
            case PackageType.VERSION:
                response = bytes([payload == struct.pack(">H", VERSION)])
            case _:
                response = bytes([type_ is not PackageType.START or client.output is not None])
        client.socket.sendall(Package(type_, response).to_bytes())
        client.started = type_ is PackageType.START and response == b"\1"

    def _declare_inputs(self, client: Client, names: list[str]) -> bytes:
        """Note the inputs that a client will write, and return the payload of the response.

        If another client writes one of them, or there is no input of a name, none is noted, and the
        response has the number 0 and says which.
        """
        in_use = {
            name
            for other in self.clients
            if other is not client
            for recipe in other.inputs.values()
            for name in recipe.names
        }
        types = [IN_USE if name in in_use else type_of(name) for name in names]
        number = 0
        if not {IN_USE, NOT_FOUND} & set(types):
            number = len(client.inputs) + 1
            client.inputs[number] = RtdeRecipe(number, tuple(names), tuple(types))
        return bytes([number]) + ",".join(types).encode()

    def _run_loop(self) -> None:
        """Run control cycles until the server is closed: the body of a thread.

        They come at the set speed; without one, as fast as the clients read.
        """
        due = time.monotonic()
        while not self._closing.is_set():
            with self.lock:
                listened = self.step()
            if self.speed is not None:
                due += CYCLE_S / self.speed
                self._closing.wait(max(due - time.monotonic(), 0.0))
            elif not listened:
                time.sleep(IDLE_S)

    def step(self) -> bool:
        """Run one control cycle: the program, and a package to each client that is due.

        Return whether a client was to receive one. The caller holds the lock.
        """
        outputs = self.program.step(dict(self.inputs)) if self.program else {}
        values = {**STATE, **self.inputs, **outputs}
        listening = [client for client in self.clients if client.started]
        due = [client for client in listening if not self.cycle % client.every]
        for client in due:
            values["timestamp"] = (self.cycle - self.begin) * CYCLE_S
            self.send(client, values)
        self.cycle += 1
        return bool(due)

    def send(self, client: Client, values: Values) -> None:
        """Send a client that has started the package of this cycle; the caller holds the lock."""
        if client.output is not None:
            client.send(client.output.pack(values))
