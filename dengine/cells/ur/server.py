"""One client's connection, seen from the controller: its recipes, its requests, and what is held back of it."""

from __future__ import annotations

import socket
from collections.abc import Mapping
from contextlib import suppress

from .protocol import TYPES, Recipe


class Connection:
    """One client: its recipes, and what is held back of it."""

    def __init__(self, sock: socket.socket) -> None:
        self.socket = sock
        self.output: Recipe | None = None
        self.every = 1
        self.inputs: dict[int, Recipe] = {}
        self.started = False
        self.held: list[bytes] = []

    @property
    def writes(self) -> set[str]:
        """The input fields that are its own."""
        return {name for recipe in self.inputs.values() for name in recipe.names}

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


def named(payload: bytes) -> list[str]:
    """The fields of a set-up; ur_rtde ends its list with a comma, which real controllers let pass."""
    return payload.decode().rstrip(",").split(",")


def packed(recipe: Recipe, values: Mapping[str, float]) -> bytes:
    """A data package; what nobody set is zero."""
    letters = [TYPES[kind] for kind in recipe.types]
    whole = [letter != "d" for letter, n in letters for _ in range(n)]
    row = [values.get(name, 0.0) for name in recipe.columns]
    return recipe.pack([int(value) if is_whole else value for value, is_whole in zip(row, whole, strict=True)])
