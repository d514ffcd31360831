"""RTDE on the wire: packages, recipes and field types, written from Universal Robots' published guide to the protocol.

A package is its size (uint16, header included), its kind (uint8) and what it carries; all numbers are big-endian. A recipe
is a list of fields that the controller has given types to: a data package is the recipe's number and the fields' values.
Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide", protocol version 2.
"""

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import NamedTuple

from ...errors import CellError, expect

PORT = 30004
VERSION = 2
HEADER = struct.Struct(">HB")
NOT_FOUND, IN_USE = "NOT_FOUND", "IN_USE"
TYPES = {  # struct's letter, and how many of it
    "BOOL": ("?", 1),
    "UINT8": ("B", 1),
    "UINT32": ("I", 1),
    "UINT64": ("Q", 1),
    "INT32": ("i", 1),
    "DOUBLE": ("d", 1),
    "VECTOR3D": ("d", 3),
    "VECTOR6D": ("d", 6),
    "VECTOR6INT32": ("i", 6),
    "VECTOR6UINT32": ("I", 6),
}


class HeldError(CellError):
    """An input that another client writes; it may be one that has just gone, which the controller has not noticed yet."""


class Kind(IntEnum):
    """Of a package: the letter that its header names it by."""

    VERSION = ord("V")
    CONTROLLER = ord("v")
    TEXT = ord("M")
    DATA = ord("U")
    OUTPUTS = ord("O")
    INPUTS = ord("I")
    START = ord("S")
    PAUSE = ord("P")


class Package(NamedTuple):
    """One package, without its header."""

    kind: Kind
    payload: bytes

    def packed(self) -> bytes:
        """As it goes over the wire."""
        return HEADER.pack(HEADER.size + len(self.payload), self.kind) + self.payload


class Packages:
    """Takes bytes as they come, in pieces of any size, and gives whole packages in their order."""

    def __init__(self) -> None:
        self._bytes = bytearray()

    def feed(self, piece: bytes) -> Iterator[Package]:
        """Every package that is whole now; CellError for what can be no package."""
        self._bytes += piece
        while len(self._bytes) >= HEADER.size:
            size, letter = HEADER.unpack_from(self._bytes)
            if size < HEADER.size or letter not in Kind._value2member_map_:
                raise CellError(f"Expected an RTDE package, got {size} bytes of kind {letter}; is it port 30004?")
            if len(self._bytes) < size:
                return
            package = Package(Kind(letter), bytes(self._bytes[HEADER.size : size]))
            del self._bytes[:size]
            yield package


@dataclass(frozen=True)
class Recipe:
    """The fields of a data package, with the types that the controller gave them."""

    number: int
    names: tuple[str, ...]
    types: tuple[str, ...]

    @cached_property
    def layout(self) -> struct.Struct:
        """Of a data package: the recipe's number, and the values."""
        return struct.Struct(">B" + "".join(n * letter for letter, n in map(TYPES.__getitem__, self.types)))

    @cached_property
    def columns(self) -> tuple[str, ...]:
        """A name for each number: `timestamp`, and `actual_TCP_force[2]` for one of a vector."""
        sizes = [TYPES[each][1] for each in self.types]
        named = zip(self.names, sizes, strict=True)
        return tuple(name if size == 1 else f"{name}[{i}]" for name, size in named for i in range(size))

    def pack(self, values: Mapping[str, float]) -> bytes:
        """A data package of these columns, 0 where one is left out; a field that is no double takes a whole number."""
        letters = zip(self.columns, self.layout.format[2:], strict=True)
        held = [values.get(name, 0) if letter == "d" else int(values.get(name, 0)) for name, letter in letters]
        return Package(Kind.DATA, self.layout.pack(self.number, *held)).packed()

    def unpack(self, payload: bytes) -> dict[str, float]:
        """The values by column; CellError for a package of another size, or of another recipe."""
        if len(payload) != self.layout.size or payload[0] != self.number:
            got = f"one of recipe {payload[0] if payload else 'none'} with {len(payload)}"
            raise CellError(f"Expected a data package of recipe {self.number} with {self.layout.size} bytes, got {got}.")
        return dict(zip(self.columns, self.layout.unpack(payload)[1:], strict=True))


def recipe_of(payload: bytes, names: Sequence[str], what: str) -> Recipe:
    """What the controller answered to a set-up; CellError names the fields that it does not have, or that others hold."""
    types = tuple(payload[1:].decode("ascii", errors="replace").split(",")) if payload else ()
    expect(len(types) == len(names), f"the types of {len(names)} {what} fields", types, error=CellError)
    named = dict(zip(names, types, strict=True))
    if unknown := [name for name, kind in named.items() if kind not in (*TYPES, IN_USE)]:
        do = "name others, or bring its software up to date (registers from 24 on: 3.9 / 5.3, ft_raw_wrench: 5.9)"
        raise CellError(f"Expected {what} fields that this controller has, it does not know {', '.join(unknown)}; {do}.")
    if held := [name for name, kind in named.items() if kind == IN_USE]:
        do = "close it, or its fieldbus unit (EtherNet/IP, PROFINET), or choose other registers"
        raise HeldError(f"Expected to write {', '.join(held)}, another client of this controller does; {do}.")
    return Recipe(payload[0], tuple(names), types)


AXES = ("FX_Base", "FY_Base", "FZ_Base", "MuX_Base", "MuY_Base", "MuZ_Base")
POSES = ("TCP_X", "TCP_Y", "TCP_Z", "TCP_RX", "TCP_RY", "TCP_RZ")
CHANNELS = {  # as recordings of UR cells call them; newtons and newton metres, metres and radians, in the robot's base
    **{name: f"actual_TCP_force[{i}]" for i, name in enumerate(AXES)},
    **{name: f"actual_TCP_pose[{i}]" for i, name in enumerate(POSES)},
}
