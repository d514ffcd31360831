"""When an insertion begins, told from live signals or those of a file, and where its samples go.

A signal is a channel (`FZ_Base`), a field of the controller (`output_int_register_25`,
`actual_TCP_speed[0]`), or a topic of a bag. The recorder of the UR cell and the reader of bags use
`as_trigger` and `StartFinder`; the recorder also uses `place`. A sample that did not come is NaN at
its place: no value is made up, and the engine verifies such a trace.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import SettingError, shortened
from ..records import Floats, TraceArray

MAX_STEP = 1.5  # steps from one sample to the next if none is missing


@dataclass(frozen=True, slots=True)
class Trigger:
    """When an insertion begins: as soon as a condition on a signal is met. Made by `as_trigger`.

    Parameters
    ----------
    kind : {"bit", "register", "contact", "motion"}
        bit: bit `number` of an integer is set, counted from 0. register: the signal has the value
        `number`, or any value but zero if that is None. contact: the force is at least `number`
        newtons, in either direction, as recorded. motion: the tool moves faster than `number`
        metres a second; the signal is a vector.
    number : float or None
    signal : str
        Name of the signal.
    quiet_s : float
        Seconds that the condition must not have been met before. So a force that varies around the
        threshold is one contact.
    """

    kind: str
    number: float | None
    signal: str
    quiet_s: float

    @property
    def signals(self) -> tuple[str, ...]:
        """Names of the signals that are read: `signal`, or `signal[0]` to `[2]` for motion."""
        vector = tuple(f"{self.signal}[{axis}]" for axis in range(3))
        return vector if self.kind == "motion" else (self.signal,)

    def active(self, signals: Mapping[str, Floats]) -> NDArray[np.bool_]:
        """Return whether the condition is met at each sample, (n,) bool; False if a signal is NaN.

        `quiet_s` does not count here.

        signals : arrays of shape (n,) by the names of the signals; others than `self.signals` are
        not read.
        """
        values = np.stack([signals[name] for name in self.signals])
        active = KINDS[self.kind][2](np.nan_to_num(values), self.number)
        return np.asarray(active & ~np.isnan(values).any(axis=0))


POSITIVE = r"(?=.*[1-9])\d+(\.\d+)?"
# Each kind of trigger: the pattern of its number in a text; what holds for a text that does not
# state it; and whether it is on, shape (n,), by the values of its signals (k, n) and its number.
KINDS: dict[str, tuple[str, Trigger, Any]] = {
    "bit": (
        r"[012]?\d|3[01]",
        Trigger("bit", None, "actual_digital_output_bits", 0.0),
        lambda values, bit: values[0].astype(np.int64) >> int(bit) & 1 != 0,
    ),
    "register": (
        r"(-?\d+)?",
        Trigger("register", None, "output_int_register_25", 0.0),
        lambda values, number: values[0] != 0 if number is None else values[0] == number,
    ),
    "contact": (
        POSITIVE,
        Trigger("contact", None, "FZ_Base", 0.2),
        lambda values, newtons: np.abs(values[0]) >= newtons,
    ),
    "motion": (
        f"({POSITIVE})?",
        Trigger("motion", 0.002, "actual_TCP_speed", 0.1),
        lambda values, speed: np.linalg.norm(values, axis=0) > speed,
    ),
}


def as_trigger(value: Any) -> Trigger:
    """Return a trigger as it is, or make one from a text, KIND[=NUMBER][@SIGNAL].

    A trigger is a condition on a signal; when it is met, an insertion begins. "bit=0": digital
    output 0 is on. "register@NAME": the signal NAME is not zero; "register=1@NAME": it is 1.
    "contact=5": the force is 5 N or more, in either direction. "motion=0.002": the tool moves
    faster than 2 mm a second. Only bit and contact need a number; without it, register means any
    value but zero and motion 0.002. A bit is 0 to 31, a register's number any integer; a force and
    a speed are decimals above 0, without an exponent. They are compared with the signal as it was
    recorded: no unit is converted. Without @SIGNAL the signal is `actual_digital_output_bits` for
    bit, `output_int_register_25` for register, `FZ_Base` for contact and `actual_TCP_speed` for
    motion. The trigger's `quiet_s`, the seconds for which the condition must not have been met
    before, is 0.2 for contact, 0.1 for motion and else 0. Raises SettingError for any other value.
    """
    if isinstance(value, Trigger):
        return value
    match = re.fullmatch(r"(\w+)(?:=([^@]*))?(?:@(.+))?", str(value).strip())
    kind, number, signal = match.groups(default="") if match else ("", "", "")
    if kind not in KINDS or not re.fullmatch(KINDS[kind][0], number):
        raise SettingError(
            "Expected a trigger, as bit=0, register@output_int_register_25, register=1@/phase, "
            f"contact=5, contact=5@FZ_Base, motion=0.002; got {shortened(value)}."
        )
    default = KINDS[kind][1]
    stated = float(number) if number else default.number
    return replace(default, number=stated, signal=signal or default.signal)


class Start(NamedTuple):
    """Where an insertion begins.

    time : float
        In seconds.
    seen : bool
        Whether the first sample of the insertion came. If False, samples are missing, and the
        insertion began at `time` or later.
    """

    time: float
    seen: bool


@dataclass(slots=True)
class StartFinder:
    """Finds where a trigger starts, sample by sample.

    A trigger that is on at the first sample is no start.

    Parameters
    ----------
    step : float
        Seconds from one sample to the next.
    quiet_s : float
        Seconds that the trigger must have been off before a start.
    """

    step: float
    quiet_s: float = 0.0
    _off_since: float | None = None
    _last_off: float = 0.0

    def feed(self, time: float, active: bool) -> Start | None:
        """Take the next sample; return where an insertion begins if the sample shows it, else None.

        It begins if the trigger, a condition on a signal, is on at this sample (`active`), was off
        at the sample before, and the first sample of this stretch of off is `quiet_s`, less half a
        step, or more ago. A trigger that is on at the first sample gives no start until it was off.
        `time` is in seconds and increases.

        If the sample before came 1.5 steps (`step`, the seconds between samples) ago or more,
        samples are missing; the insertion may have begun in this gap, and `seen` of the result is
        False. Its `time` is then one step after the sample before, else the time of this sample.
        """
        if not active:
            if self._off_since is None:
                self._off_since = time
            self._last_off = time
            return None
        off_since = self._off_since
        self._off_since = None
        if off_since is None or time - off_since < self.quiet_s - self.step / 2:
            return None
        seen = time - self._last_off < MAX_STEP * self.step
        return Start(time if seen else self._last_off + self.step, seen)


def place(
    times: Sequence[float], values: Floats, start: float, samples: int, step: float
) -> tuple[TraceArray, int]:
    """Put samples into a trace, each at the place (index of the trace) nearest to its time.

    Parameters
    ----------
    times : sequence of n floats
        Times of the samples in seconds, increasing.
    values : array of float64, shape (n, C)
        The samples of the channels at these times.
    start : float
        Time of the first place, in seconds.
    samples : int
        Number of places in the trace.
    step : float
        Seconds from one place to the next.

    Returns
    -------
    trace : array of float32, shape (C, samples)
        NaN at a place for which no sample came. Of several samples nearest to one place the first
        counts; halfway between two places, the even one gets the sample. Samples nearest to a place
        before the first or after the last are left out. A value that is too large for float32
        becomes an infinity.
    n_missing : int
        Number of places for which no sample came.
    """
    trace = np.full((values.shape[1], samples), np.nan, dtype=np.float32)
    at = np.rint((np.asarray(times) - start) / step).astype(np.int64)
    inside = (at >= 0) & (at < samples)
    places, first = np.unique(at[inside], return_index=True)
    with np.errstate(over="ignore"):  # what overflows becomes an infinity, which the engine finds
        trace[:, places] = values[inside][first].T
    return trace, samples - len(places)
