"""When an insertion begins, told from signals, live ones or of a file; and where each of its samples goes.

A signal is a channel (`FZ_Base`), a field of the controller (`output_int_register_25`, `actual_TCP_speed[0]`), or a topic
of a file. What a timestamp leaves out is a NaN at its place, so that whoever decides finds it: nothing is filled in.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import SettingError, shortened

Signals = Mapping[str, NDArray[np.float64]]  # (n,) each
Active = NDArray[np.bool_]
NEAR = 1.5  # steps: to the next sample, when none is missing
SIZE = r"(?=.*[1-9])\d+(\.\d+)?"  # a number above zero
BITS, REGISTER = "actual_digital_output_bits", "output_int_register_25"
# Pattern of the number; the number, signal and quiet_s of one that says nothing else; whether it is on, of signals (1, n).
KINDS: dict[str, tuple[str, float | None, str, float, Callable[[Any, Any], Any]]] = {
    "bit": (r"[012]?\d|3[01]", None, BITS, 0.0, lambda held, bit: held[0].astype(np.int64) >> int(bit) & 1 != 0),
    "register": (r"(-?\d+)?", None, REGISTER, 0.0, lambda held, n: held[0] != 0 if n is None else held[0] == n),
    "contact": (SIZE, None, "FZ_Base", 0.2, lambda held, newtons: np.abs(held[0]) >= newtons),
    "motion": (f"({SIZE})?", 0.002, "actual_TCP_speed", 0.1, lambda v, speed: np.linalg.norm(v, axis=0) > speed),
}
EXAMPLES = "bit=0, register@output_int_register_25, register=1@/phase, contact=5, contact=5@FZ_Base, motion=0.002"


@dataclass(frozen=True, slots=True)
class Trigger:
    """When an insertion begins: where what it looks at goes on. `as_trigger` makes one.

    kind, number : bit: of a word of bits, this one is set, counted from 0.  register: the signal holds this value; None:
        any but zero.  contact: the force is this many newtons or more above what the sensor shows in free motion.
        motion: the tool moves faster than this, in metres a second; the signal is a vector.
    quiet_s : seconds that it must have been off before it counts as going on: a force that plays around the threshold is
        one contact.
    """

    kind: str
    number: float | None
    signal: str
    quiet_s: float

    @property
    def signals(self) -> tuple[str, ...]:
        """The names of the signals that it looks at."""
        return tuple(f"{self.signal}[{i}]" for i in range(3)) if self.kind == "motion" else (self.signal,)

    def active(self, signals: Signals) -> Active:
        """(n,) whether it is on; a NaN in a signal is off."""
        held = np.stack([np.nan_to_num(signals[name]) for name in self.signals])
        return np.asarray(KINDS[self.kind][-1](held, self.number))


def as_trigger(asked: Any) -> Trigger:
    """A trigger as it is, or from text: KIND, =NUMBER, @SIGNAL, the last two where they are not left to it.

    bit=0 is digital output 0; register@NAME any value but zero; contact=5 is 5 N of FZ_Base; motion=0.002 is 2 mm a second.
    """
    if isinstance(asked, Trigger):
        return asked
    found = re.fullmatch(r"(\w+)(?:=([^@]*))?(?:@(.+))?", asked.strip()) if isinstance(asked, str) else None
    kind, number, signal = found.groups(default="") if found else ("", "", "")
    if kind not in KINDS or not re.fullmatch(KINDS[kind][0], number):
        raise SettingError(f"Expected a trigger, as {EXAMPLES}; got {shortened(asked)}.")
    _, usual, usually, quiet_s, _ = KINDS[kind]
    return Trigger(kind, float(number) if number else usual, signal or usually, quiet_s)


class Placed(NamedTuple):
    """A window of a stream.

    trace : (C, T) float32, NaN where no sample came.  missing : (m,) the places of these.  repeated : samples.
    """

    trace: NDArray[np.float32]
    missing: NDArray[np.int64]
    repeated: int


class Start(NamedTuple):
    """Where an insertion begins. time : seconds.  seen : its first sample came; False: at `time`, or later in a gap."""

    time: float
    seen: bool = True


class StartFinder:
    """Finds where a trigger goes on, sample by sample. step : seconds from one to the next.  quiet_s : off before that."""

    def __init__(self, step: float, quiet_s: float = 0.0) -> None:
        self.step, self.quiet_s = step, quiet_s
        self.forget()

    def forget(self) -> None:
        """Begin anew: what is on at the first sample began before it, and is no start."""
        self._off_since: float | None = None
        self._last_off = 0.0

    def feed(self, time: float, active: bool) -> Start | None:
        """Where an insertion begins, if this sample shows it.

        Where samples are missing just before this one, it may have begun in any of them: then no sample's place in its
        trace is known.
        """
        if not active:
            self._off_since = time if self._off_since is None else self._off_since
            self._last_off = time
            return None
        began, self._off_since = self._off_since, None
        if began is None or time - began < self.quiet_s - self.step / 2:
            return None
        seen = time - self._last_off < NEAR * self.step
        return Start(time) if seen else Start(self._last_off + self.step, seen=False)


def place(times: Sequence[float], values: NDArray[np.float64], start: float, samples: int, step: float) -> Placed:
    """The samples from `start` on, each where its time puts it. times : (n,) seconds, increasing.  values : (n, C)."""
    trace = np.full((values.shape[1], samples), np.nan, dtype=np.float32)
    at = np.rint((np.asarray(times, dtype=np.float64) - start) / step).astype(np.int64)
    inside = (at >= 0) & (at < samples)
    places, first = np.unique(at[inside], return_index=True)
    with np.errstate(over="ignore"):  # beyond float32 becomes an infinity, which is found and reported as one
        trace[:, places] = values[inside][first].T
    return Placed(trace, np.setdiff1d(np.arange(samples), places), int(inside.sum()) - len(places))
