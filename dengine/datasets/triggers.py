"""When an insertion begins, told from signals: live ones of a controller, and those of a file, by the same strategies.

A trigger looks at signals by name and says at which samples it is on; the insertion begins where it goes on. A signal is a
channel (`FZ_Base`), a field of the controller (`output_int_register_25`, `actual_TCP_speed[0]`), or a topic of a file.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from ..errors import SettingError

Signals = Mapping[str, NDArray[np.float64]]  # (n,) each
Active = NDArray[np.bool_]
MOST_BITS = 18  # of a UR controller's digital outputs: 8 standard, 8 configurable, 2 of the tool


@runtime_checkable
class Trigger(Protocol):
    """When an insertion begins."""

    @property
    def signals(self) -> tuple[str, ...]: ...  # the names of those that it looks at

    @property
    def quiet_s(self) -> float: ...  # seconds that it must have been off before it counts as going on

    def active(self, signals: Signals) -> Active: ...  # (n,) whether it is on; a NaN in a signal is off


@dataclass(frozen=True, slots=True)
class BitTrigger:
    """A digital output, or one bit of a register of bits, is on. bit : counted from 0."""

    bit: int
    signal: str = "actual_digital_output_bits"
    quiet_s: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.bit < 32:
            raise SettingError(f"Expected a bit from 0 to 31, got {self.bit}; digital outputs are 0 to {MOST_BITS - 1}.")

    @property
    def signals(self) -> tuple[str, ...]:
        return (self.signal,)

    def active(self, signals: Signals) -> Active:
        word = np.nan_to_num(signals[self.signal]).astype(np.uint64)
        return np.asarray((word >> np.uint64(self.bit)) & np.uint64(1), dtype=np.bool_)


@dataclass(frozen=True, slots=True)
class RegisterTrigger:
    """A register, or a topic of numbers or truths, holds a value; None: any but zero."""

    signal: str = "output_int_register_25"
    value: float | None = None
    quiet_s: float = 0.0

    @property
    def signals(self) -> tuple[str, ...]:
        return (self.signal,)

    def active(self, signals: Signals) -> Active:
        held = np.nan_to_num(signals[self.signal])
        return np.asarray(held != 0 if self.value is None else held == self.value)


@dataclass(frozen=True, slots=True)
class ContactTrigger:
    """The force is at or beyond a threshold, either way. newtons : above what the sensor shows in free motion.

    quiet_s : without contact before the next insertion can begin: a force that plays around the threshold is one contact.
    """

    newtons: float
    signal: str = "FZ_Base"
    quiet_s: float = 0.2

    def __post_init__(self) -> None:
        if not 0 < self.newtons < float("inf"):
            raise SettingError(f"Expected a contact threshold above 0 N, got {self.newtons}.")

    @property
    def signals(self) -> tuple[str, ...]:
        return (self.signal,)

    def active(self, signals: Signals) -> Active:
        return np.asarray(np.abs(np.nan_to_num(signals[self.signal])) >= self.newtons)


@dataclass(frozen=True, slots=True)
class MotionTrigger:
    """The tool moves faster than this, in metres a second: the start of a move out of a standstill."""

    speed: float = 0.002
    signal: str = "actual_TCP_speed"
    quiet_s: float = 0.1

    def __post_init__(self) -> None:
        if not 0 < self.speed < float("inf"):
            raise SettingError(f"Expected a speed above 0 m/s, got {self.speed}.")

    @property
    def signals(self) -> tuple[str, ...]:
        return tuple(f"{self.signal}[{i}]" for i in range(3))

    def active(self, signals: Signals) -> Active:
        each = np.stack([np.nan_to_num(signals[name]) for name in self.signals])
        return np.asarray(np.linalg.norm(each, axis=0) > self.speed)


KINDS: dict[str, tuple[type, str, Callable[[str], float], str]] = {  # class, field of the number, its type and pattern
    "bit": (BitTrigger, "bit", int, r"\d+"),
    "register": (RegisterTrigger, "value", float, r"-?\d+|"),
    "contact": (ContactTrigger, "newtons", float, r"\d+(\.\d+)?"),
    "motion": (MotionTrigger, "speed", float, r"\d+(\.\d+)?|"),
}
EXAMPLES = "bit=0, register@output_int_register_25, register=1@/phase, contact=5, contact=5@FZ_Base, motion=0.002"


def as_trigger(asked: Any) -> Trigger:
    """A trigger as it is, or from text: KIND, =NUMBER, @SIGNAL, the last two where they are not left to it.

    bit=0 is digital output 0; register@NAME any value but zero; contact=5 is 5 N of FZ_Base; motion=0.002 is 2 mm a second.
    """
    if isinstance(asked, Trigger):
        return asked
    if not isinstance(asked, str):
        raise SettingError(f"Expected a trigger or its text, as {EXAMPLES}; got {type(asked).__name__}.")
    found = re.fullmatch(r"(\w+)(?:=([^@]*))?(?:@(.+))?", asked.strip())
    kind, number, signal = found.groups(default="") if found else ("", "", "")
    if kind not in KINDS or not re.fullmatch(KINDS[kind][3], number):
        raise SettingError(f"Expected a trigger, as {EXAMPLES}; got {asked!r}.")
    make, name, cast, _ = KINDS[kind]
    trigger: Trigger = make(**({name: cast(number)} if number else {}), **({"signal": signal} if signal else {}))
    return trigger
