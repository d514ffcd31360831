"""One RTDE connection: set up, started, and read package by package."""

from __future__ import annotations

import socket
import struct
from collections.abc import Sequence
from contextlib import suppress

from ...errors import CellError
from .protocol import PORT, VERSION, Kind, Package, Packages, Recipe, recipe_of, text_of

PIECE = 65536  # bytes asked of the socket at once


class RtdeClient:
    """Connects, agrees on the recipes and starts; then every package that comes is given, in its order.

    outputs : fields to receive, `timestamp` first.  inputs : fields to write, set together by `send`.
    rate_hz : packages a second.  timeout : seconds of silence after which the connection counts as lost.
    CellError where the controller cannot be reached, refuses something, falls silent, hangs up or sends what is no package.
    """

    def __init__(
        self,
        host: str,
        port: int = PORT,
        outputs: Sequence[str] = ("timestamp",),
        inputs: Sequence[str] = (),
        rate_hz: float = 500.0,
        timeout: float = 2.0,
    ) -> None:
        self.where = f"{host}:{port}"
        self.said = ""  # the controller's last text message
        self._packages = Packages()
        self._waiting: list[Package] = []
        self._lost: CellError | None = None
        try:
            self._socket = socket.create_connection((host, port), timeout)
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        except OSError as error:
            raise CellError(
                f"Expected an RTDE controller at {self.where}, it cannot be reached: {error}; is the robot on, and "
                "RTDE enabled under Settings, Security, Services?"
            ) from error
        try:
            self._set_up(outputs, inputs, rate_hz)
        except BaseException:
            self.close()
            raise

    def _set_up(self, outputs: Sequence[str], inputs: Sequence[str], rate_hz: float) -> None:
        accepted = self._ask(Kind.VERSION, struct.pack(">H", VERSION))
        if accepted[:1] != b"\1":
            raise CellError(
                f"Expected RTDE protocol version {VERSION} at {self.where}, it is refused; update the controller."
            )
        named = ",".join(outputs).encode()
        self.outputs = recipe_of(self._ask(Kind.OUTPUTS, struct.pack(">d", rate_hz) + named), outputs, "output")
        self.inputs: Recipe | None = None
        if inputs:
            self.inputs = recipe_of(self._ask(Kind.INPUTS, ",".join(inputs).encode()), inputs, "input")
        if self._ask(Kind.START, b"")[:1] != b"\1":
            raise CellError(f"Expected {self.where} to start sending, it refuses to{self._why()}.")

    def rows(self) -> list[tuple[float, ...]]:
        """The data packages that came, at least one, each as a value a column of `outputs`; blocks until then."""
        while not any(package.kind is Kind.DATA for package in self._waiting):
            if self._lost is not None:
                raise self._lost
            try:
                self._receive()
            except CellError as error:  # what came whole before it counts
                self._lost = error
        found = [self.outputs.unpack(package.payload) for package in self._waiting if package.kind is Kind.DATA]
        self._waiting.clear()
        return found

    def send(self, values: Sequence[float]) -> None:
        """Write the input fields, all of them in one package."""
        if self.inputs is None:
            raise CellError("Expected input fields to write, this connection was set up without.")
        try:
            self._socket.sendall(self.inputs.pack(values))
        except OSError as error:
            raise CellError(f"Expected {self.where} to take its inputs, the connection is lost: {error}.") from error

    def close(self) -> None:
        """Hang up."""
        with suppress(OSError):  # it may have hung up first
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()

    def _ask(self, kind: Kind, payload: bytes) -> bytes:
        """Send a request and wait for its answer; text messages and early data may come between."""
        try:
            self._socket.sendall(Package(kind, payload).bytes)
        except OSError as error:
            raise CellError(f"Expected {self.where} to take a request, the connection is lost: {error}.") from error
        while True:
            for i, package in enumerate(self._waiting):
                if package.kind is kind:
                    return self._waiting.pop(i).payload
                if kind is Kind.START and package.kind is Kind.DATA:  # its first data can overtake its yes
                    return b"\1"
            self._receive()

    def _receive(self) -> None:
        try:
            piece = self._socket.recv(PIECE)
        except OSError as error:
            silent = isinstance(error, TimeoutError)
            what = f"it was silent for {self._socket.gettimeout():g} s" if silent else f"the connection is lost: {error}"
            raise CellError(f"Expected packages from {self.where}, {what}{self._why()}.") from error
        if not piece:
            raise CellError(f"Expected packages from {self.where}, it hung up{self._why()}.")
        for package in self._packages.feed(piece):
            if package.kind is Kind.TEXT:
                self.said = text_of(package.payload)
            elif package.kind is not Kind.PAUSE:
                self._waiting.append(package)

    def _why(self) -> str:
        return f' (it said: "{self.said[:200]}")' if self.said else ""
