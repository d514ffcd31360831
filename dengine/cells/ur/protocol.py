"""Encoding and decoding of RTDE, the protocol over which a Universal Robots controller sends data.
`Package` and `PackageReader` convert between bytes and packages, `RtdeRecipe` between a data
package and its values, and `CHANNELS` has the names of forces and poses. The client in stream.py
uses them; nothing is sent here.

A package is its size (uint16, with the header), its type (uint8) and a payload; all numbers are
big-endian. A recipe is a list of fields to which the controller has assigned types. A data package
holds the recipe's number and the values of its fields.

References
----------
Universal Robots, "Real-Time Data Exchange (RTDE) Guide", protocol version 2.
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
NOT_FOUND = "NOT_FOUND"
IN_USE = "IN_USE"
TYPES = {  # by field type: a letter of `struct` for each of its values
    "BOOL": "?",
    "UINT8": "B",
    "UINT32": "I",
    "UINT64": "Q",
    "INT32": "i",
    "DOUBLE": "d",
    "VECTOR3D": "ddd",
    "VECTOR6D": "dddddd",
    "VECTOR6INT32": "iiiiii",
    "VECTOR6UINT32": "IIIIII",
}


class HeldError(CellError):
    """Another client of the controller writes this input.

    It may have gone already: the controller notices that after a short time.
    """


class PackageType(IntEnum):
    """Type of a package, the letter in its header."""

    VERSION, CONTROLLER, TEXT, DATA, OUTPUTS, INPUTS, START, PAUSE = b"VvMUOISP"


class Package(NamedTuple):
    """One package, without its header."""

    type: PackageType
    payload: bytes

    def to_bytes(self) -> bytes:
        """Return the package with its header of 3 bytes (size and type), as it is sent.

        Raise struct.error for a payload of more than 65,532 bytes.
        """
        return HEADER.pack(HEADER.size + len(self.payload), self.type) + self.payload


class PackageReader:
    """Splits a stream of bytes, received in pieces of any size, into packages.

    It keeps the bytes of a package that is not complete yet.
    """

    def __init__(self) -> None:
        self._bytes = bytearray()

    def feed(self, piece: bytes) -> Iterator[Package]:
        """Add bytes, and yield every package that is complete; an incomplete rest is kept.

        Nothing is added before the iteration begins. Raise CellError for bytes that are no package
        of RTDE, the protocol of the robot controller; packages before them have been yielded, and
        every later call raises it again.
        """
        self._bytes += piece
        while len(self._bytes) >= HEADER.size:
            size, letter = HEADER.unpack_from(self._bytes)
            if size < HEADER.size or letter not in PackageType._value2member_map_:
                raise CellError(
                    f"Expected an RTDE package, got {size} bytes of type {letter}; "
                    "is it port 30004?"
                )
            if len(self._bytes) < size:
                return
            package = Package(PackageType(letter), bytes(self._bytes[HEADER.size : size]))
            del self._bytes[:size]
            yield package


@dataclass(frozen=True)
class RtdeRecipe:
    """The fields of a data package, with the types that the controller assigned to them.

    number : of the recipe, from 0 to 255. names : the fields. types : the type of each, in `TYPES`.
    """

    number: int
    names: tuple[str, ...]
    types: tuple[str, ...]

    @cached_property
    def layout(self) -> struct.Struct:
        """Binary layout of a data package's payload: the recipe's number, then the values; cached.

        The numbers are big-endian.
        """
        return struct.Struct(">B" + "".join(TYPES[field_type] for field_type in self.types))

    @cached_property
    def columns(self) -> tuple[str, ...]:
        """Names of the values in a data package, in their order, cached.

        A data package is a set of values that the robot's controller sends at once. A single value
        has the name of its field, like `timestamp`, and an element of a vector a name like
        `actual_TCP_force[2]`.
        """
        sizes = [len(TYPES[field_type]) for field_type in self.types]
        return tuple(
            name if size == 1 else f"{name}[{i}]"
            for name, size in zip(self.names, sizes, strict=True)
            for i in range(size)
        )

    def pack(self, values: Mapping[str, float]) -> bytes:
        """Return a data package, with its header, that holds these values.

        `values` has numbers by column, the name of a value such as `timestamp` or
        `actual_TCP_force[2]`. Columns that are left out are 0, and names that are no columns are
        ignored. A number for an integer field loses its fraction. Raise struct.error for a number
        that its field cannot hold, for example one that is too large; in an integer field
        ValueError for NaN, and OverflowError for an infinity.
        """
        numbers = [
            (float if letter == "d" else int)(values.get(name, 0))
            for name, letter in zip(self.columns, self.layout.format[2:], strict=True)
        ]
        return Package(PackageType.DATA, self.layout.pack(self.number, *numbers)).to_bytes()

    def unpack(self, payload: bytes) -> dict[str, float]:
        """Return the values in the payload of a data package: a dict of numbers by their names.

        A name is like `timestamp`, or like `actual_TCP_force[2]` for an element of a vector. Raise
        CellError for a package of another size, or of another RTDE recipe (a numbered list of
        fields).
        """
        if len(payload) != self.layout.size or payload[0] != self.number:
            number = payload[0] if payload else "none"
            raise CellError(
                f"Expected a data package of recipe {self.number} with {self.layout.size} bytes, "
                f"got one of recipe {number} with {len(payload)}."
            )
        return dict(zip(self.columns, self.layout.unpack(payload)[1:], strict=True))


def read_recipe(payload: bytes, names: Sequence[str], direction: str) -> RtdeRecipe:
    """Return the RTDE recipe (a numbered list of fields and their types) that a controller made.

    RTDE is the protocol of the robot controller. The recipe is its response to a request for
    fields.

    Parameters
    ----------
    payload : bytes
        The response: the recipe's number and the types of the fields.
    names : sequence of str
        Fields that were requested.
    direction : str
        "input" or "output", for messages.

    Returns
    -------
    RtdeRecipe

    Raises
    ------
    CellError
        If the controller does not have a field or gives it a type that is not in `TYPES`, or the
        response has another number of types.
    HeldError
        If another client of the controller writes a field.
    """
    types = tuple(payload[1:].decode("ascii", errors="replace").split(",")) if payload else ()
    expect(
        len(types) == len(names),
        f"the types of {len(names)} {direction} fields",
        types,
        error=CellError,
    )
    type_by_name = dict(zip(names, types, strict=True))
    unknown = [name for name, type_ in type_by_name.items() if type_ not in (*TYPES, IN_USE)]
    if unknown:
        raise CellError(
            f"Expected {direction} fields that this controller has, it does not know "
            f"{', '.join(unknown)}; name others, or update its software "
            "(registers from 24 on: 3.9 / 5.3, ft_raw_wrench: 5.9)."
        )
    in_use = [name for name, type_ in type_by_name.items() if type_ == IN_USE]
    if in_use:
        raise HeldError(
            f"Expected to write {', '.join(in_use)}, another client of this controller does; close "
            "it, or its fieldbus unit (EtherNet/IP, PROFINET), or choose other registers."
        )
    return RtdeRecipe(payload[0], tuple(names), types)


AXES = ("FX_Base", "FY_Base", "FZ_Base", "MuX_Base", "MuY_Base", "MuZ_Base")
POSES = ("TCP_X", "TCP_Y", "TCP_Z", "TCP_RX", "TCP_RY", "TCP_RZ")
# Names in recordings of UR cells; newtons, newton metres, metres and radians in the robot's base.
CHANNELS = {
    **{name: f"actual_TCP_force[{i}]" for i, name in enumerate(AXES)},
    **{name: f"actual_TCP_pose[{i}]" for i, name in enumerate(POSES)},
}
