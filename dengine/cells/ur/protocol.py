"""RTDE on the wire: packages, recipes and field types, written from Universal Robots' published guide to the protocol.

A package is its size (uint16, header included), its kind (uint8) and what it carries; all numbers are big-endian. A recipe
is a list of fields that the controller has given types to: a data package is the recipe's number and the fields' values.
Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide", protocol version 2.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import NamedTuple

from ...errors import CellError, SettingError

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

    def pack(self, values: Sequence[float]) -> bytes:
        """A data package, whole; where a field is no double, its value is cut to a whole number."""
        letters = self.layout.format[2:]
        held = [value if letter == "d" else int(value) for value, letter in zip(values, letters, strict=True)]
        return Package(Kind.DATA, self.layout.pack(self.number, *held)).packed()

    def unpack(self, payload: bytes) -> tuple[float, ...]:
        """The values, one a column; CellError for a package of another size, or of another recipe."""
        if len(payload) != self.layout.size or payload[0] != self.number:
            raise CellError(
                f"Expected a data package of recipe {self.number} with {self.layout.size} bytes, got one of recipe "
                f"{payload[0] if payload else 'none'} with {len(payload)}."
            )
        return self.layout.unpack(payload)[1:]


def recipe_of(payload: bytes, names: Sequence[str], what: str) -> Recipe:
    """What the controller answered to a set-up; CellError names the fields that it does not have, or that others hold."""
    types = tuple(payload[1:].decode("ascii", errors="replace").split(",")) if payload else ()
    if len(types) != len(names):
        raise CellError(f"Expected the types of {len(names)} {what} fields, got {len(types)}: {', '.join(types)[:80]}.")
    named = dict(zip(names, types, strict=True))
    if unknown := [name for name, kind in named.items() if kind not in (*TYPES, IN_USE)]:
        raise CellError(
            f"Expected {what} fields that this controller has, it does not know {', '.join(unknown)}; name others, or "
            "bring its software up to date (registers from 24 on: 3.9 / 5.3, ft_raw_wrench: 5.9)."
        )
    if held := [name for name, kind in named.items() if kind == IN_USE]:
        raise HeldError(
            f"Expected to write {', '.join(held)}, another client of this controller does; close it, or its fieldbus "
            "unit (EtherNet/IP, PROFINET), or choose other registers."
        )
    return Recipe(payload[0], tuple(names), types)


INDEXED = re.compile(r"(input|output)_(bit|int|double)_register_(\d+)")
FIELDS: Mapping[str, str] = {  # of the guide, those that a controller gives out; registers with a number: `type_of`
    name: kind
    for kind, names in {
        "DOUBLE": (
            "timestamp actual_execution_time speed_scaling target_speed_fraction actual_momentum actual_main_voltage "
            "actual_robot_voltage actual_robot_current standard_analog_input0 standard_analog_input1 "
            "standard_analog_output0 standard_analog_output1 io_current payload tcp_force_scalar speed_slider_fraction "
            "standard_analog_output_0 standard_analog_output_1"
        ),
        "VECTOR6D": (
            "target_q target_qd target_qdd target_current target_moment actual_q actual_qd actual_current "
            "joint_control_output actual_TCP_pose actual_TCP_speed actual_TCP_force target_TCP_pose target_TCP_speed "
            "joint_temperatures actual_joint_voltage payload_inertia ft_raw_wrench external_force_torque"
        ),
        "VECTOR3D": "actual_tool_accelerometer payload_cog elbow_position elbow_velocity",
        "UINT64": "actual_digital_input_bits actual_digital_output_bits",
        "INT32": "robot_mode safety_mode safety_status",
        "UINT32": (
            "runtime_state robot_status_bits safety_status_bits output_bit_registers0_to_31 output_bit_registers32_to_63 "
            "input_bit_registers0_to_31 input_bit_registers32_to_63 speed_slider_mask script_control_line"
        ),
        "UINT8": (
            "standard_digital_output_mask standard_digital_output configurable_digital_output_mask "
            "tool_digital_output_mask tool_digital_output configurable_digital_output standard_analog_output_mask "
            "standard_analog_output_type"
        ),
        "VECTOR6INT32": "joint_mode",
    }.items()
    for name in names.split()
}


def type_of(name: str) -> str:
    """The type of a field by its name; NOT_FOUND for none."""
    found = INDEXED.fullmatch(name)
    if found is None:
        return FIELDS.get(name, NOT_FOUND)
    number = int(found[3])
    if found[2] == "bit":
        return "BOOL" if 64 <= number < 128 else NOT_FOUND
    return {"int": "INT32", "double": "DOUBLE"}[found[2]] if number < 48 else NOT_FOUND


AXES = ("FX_Base", "FY_Base", "FZ_Base", "MuX_Base", "MuY_Base", "MuZ_Base")
POSES = ("TCP_X", "TCP_Y", "TCP_Z", "TCP_RX", "TCP_RY", "TCP_RZ")
CHANNELS = {  # as recordings of UR cells call them; newtons and newton metres, metres and radians, in the robot's base
    **{name: f"actual_TCP_force[{i}]" for i, name in enumerate(AXES)},
    **{name: f"actual_TCP_pose[{i}]" for i, name in enumerate(POSES)},
}


def column_of(name: str) -> str:
    """The controller's number that a channel or a signal is: by a name of CHANNELS, or by its own, `actual_q[5]`."""
    column = CHANNELS.get(name, name)
    field, _, index = column.partition("[")
    kind = type_of(field)
    size = 0 if kind == NOT_FOUND else TYPES[kind][1]
    known = index == "" if size == 1 else index.endswith("]") and index[:-1].isdecimal() and int(index[:-1]) < size
    if not known:
        raise SettingError(
            f"Expected a channel among {', '.join(CHANNELS)}, or a number of the controller, as actual_q[5] or "
            f"output_double_register_24, got {name!r}."
        )
    return column
