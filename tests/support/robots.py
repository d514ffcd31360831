"""A simulated controller of Universal Robots with the faults that occur in practice."""

from collections import Counter
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import Any

from dengine.cells.ur.controller import Client, FakeController, Values, type_of
from dengine.cells.ur.protocol import IN_USE, NOT_FOUND, Package, PackageType

GARBAGE = b"\x00\x01\xff GET / HTTP/1.1"


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


class FaultyController(FakeController):
    """A controller with faults.

    refuses : requests to refuse, PackageType.VERSION or START; names of outputs that it does not
    have, and of inputs that another client writes. lost : part and sample of each package of an
    insertion that was sent to no client.
    """

    def __init__(
        self,
        program: Any = None,
        troubles: Iterable[Trouble] = (),
        refuses: Collection[PackageType | str] = (),
        **settings: Any,
    ) -> None:
        self.refuses = {*refuses}
        self.lost: set[tuple[int, int]] = set()
        self._troubles = {(trouble.part, trouble.sample): trouble for trouble in troubles}
        self._until = Counter[str]()  # by kind of trouble: the cycle at which it ends
        self._delayed = b""
        self._is_sent = False
        super().__init__(program, **settings)  # which starts the threads

    def hang_up(self, anew: bool = False) -> None:
        """Close every connection; anew : as switched off and on, the clock and inputs too."""
        with self.lock:
            if anew:
                self.inputs.clear()
                self.begin = self.cycle
            for client in self.clients:
                client.hang_up()

    def respond(self, client: Client, type_: PackageType, payload: bytes) -> None:
        is_output = type_ is PackageType.OUTPUTS
        names = payload[8:] if is_output else payload
        if type_ in self.refuses:
            client.socket.sendall(Package(type_, b"\0").to_bytes())
        elif is_output or type_ is PackageType.INPUTS:
            why = NOT_FOUND if is_output else IN_USE
            asked = names.decode().split(",")
            types = [why if name in self.refuses else type_of(name) for name in asked]
            if why not in types:
                super().respond(client, type_, payload)
            else:
                refusal = bytes([is_output]) + ",".join(types).encode()
                client.socket.sendall(Package(type_, refusal).to_bytes())
        else:
            super().respond(client, type_, payload)

    def step(self) -> bool:
        self._is_sent = False
        is_due = super().step()
        place = self.program.place if self.program else None
        if place is not None and not self._is_sent:
            self.lost.add(place)
        return is_due

    def send(self, client: Client, values: Values) -> None:
        trouble = self._troubles.pop(self.program.place, None) if self.program else None
        kind = trouble.kind if trouble else ""
        if trouble:
            self._until[kind] = max(self._until[kind], self.cycle + trouble.cycles)
        if kind == "reset":
            self.begin = self.cycle
            values["timestamp"] = 0.0
        if kind == "close":
            for other in self.clients:
                other.hang_up()
        if self.cycle < self._until["drop"] or client.output is None or not client.started:
            return
        data = client.output.pack(values)
        if kind in ("half", "garbage"):
            client.send(data[: len(data) // 2] if kind == "half" else GARBAGE)
            client.hang_up()
            return
        self._is_sent = True
        self._delayed += data * (2 if kind == "repeat" else 1)
        if self.cycle >= self._until["hold"]:
            client.send(self._delayed)
            self._delayed = b""
