"""The frozen records that travel between the layers, and the enumerations of their fields:
`TraceSpec`, `Decision`, `RetrainReport` and `Cycle`; `Action`, `Reason`, `Source` and `Outcome`.

An engine makes a `Decision` of each trace and a `Cycle` of each turn of its loop; a `TraceSpec`
says what traces look like. The `as_...` functions check values that come from outside: labels, ids,
what a cell returned.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import IntEnum, StrEnum
from numbers import Integral, Real
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import ReportError, SettingError, StoreError, expect, instead, shortened

PartNumber = str | int | None  # as a caller gives it
Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
TraceArray = NDArray[np.float32]  # the samples of a trace, (channels, samples), or of n of them
State = dict[str, NDArray[Any]]  # arrays of a version of the model, by name
Arrays = Mapping[str, NDArray[Any]]  # the same, only read
StoredSettings = Mapping[str, str]  # of an engine, as texts by name
Embedding = tuple[tuple[float, ...], ...]  # (K, d): a point in each space


def is_whole(value: Any, least: int, most: int) -> bool:
    """Return whether a value is an integer, Python's or NumPy's, from `least` to `most`.

    Both ends are included. True, False and floats such as 1.0 are no integers here.
    """
    return (
        isinstance(value, Integral) and not isinstance(value, bool) and least <= int(value) <= most
    )


def is_number(value: Any) -> bool:
    """Return whether a value is a real number, Python's or NumPy's, that a float can hold.

    Infinities and NaN count as numbers; True, 10**400, a Decimal, complex numbers and texts do not.
    """
    if not isinstance(value, Real) or isinstance(value, bool):
        return False
    try:
        float(value)
    except OverflowError:
        return False
    return True


class Action(StrEnum):
    """What the cell does next. Compiled modules and exported files give its `ActionCode`."""

    VERIFY = "verify"
    ACCEPT = "accept"
    REJECT = "reject"


class ActionCode(IntEnum):
    """The integer that stands for an `Action`, its position there: 0 is the safe action."""

    VERIFY = 0
    ACCEPT = 1
    REJECT = 2


class Reason(StrEnum):
    """Why a decision is what it is. Exported files give the position in this list."""

    CERTAIN = "certain"  # the bound meets the policy
    UNCERTAIN = "uncertain"  # the bound does not meet the policy
    NO_MODEL = "no_model"  # no model was trained yet
    AUDIT = "audit"  # the model is certain, and the part is verified to check the model
    NOT_FINITE = "not_finite"  # a NaN or an infinity in the trace
    CONSTANT = "constant"  # every sample of every channel the same: a dead sensor
    SATURATED = "saturated"  # the trace touches the sensor's range, `TraceSpec.limit`
    MODEL_ERROR = "model_error"  # the model raised an exception
    NOVEL = "novel"  # the trace is unlike every trace that the model learned from
    SAFE_MODE = "safe_mode"  # a drift detector raised an alarm, and outcomes must show recovery
    NO_STORE = "no_store"  # the journal cannot be written, or the id cannot be looked up
    LATE = "late"  # the caller timed out and verifies already
    OUTSIDE = "outside"  # the trace leaves the operator's `ForceLimits`
    TOO_LARGE = "too_large"  # a sample beyond 1e18 in size, whose square float32 cannot sum


ACTIONS = tuple(Action)  # by the integer that stands for them in exported files
REASONS = tuple(Reason)


class Source(StrEnum):
    """Where a label came from."""

    VERIFICATION = "verification"  # the model was uncertain, the expensive verification decided
    AUDIT = "audit"  # the model was certain, and the part was verified all the same
    STOP = "stop"  # the part was accepted, failed, and stopped the system
    CONFIRMED = "confirmed"  # the part was accepted, and is known to be good
    INSPECTION = "inspection"  # the part was rejected, and somebody inspected it afterwards


class Outcome(StrEnum):
    """What a cell learned of an accepted part when it went on without verification."""

    STOPPED = "stopped"  # the part was bad and stopped the system
    CONFIRMED = "confirmed"  # the part was good
    UNKNOWN = "unknown"  # nothing was heard, which is no success


MOST = 10**9  # samples, or channels
FITS = ("strict", "cut", "pad", "resample")  # exported files give the position


@dataclass(frozen=True, slots=True)
class TraceSpec:
    """What the traces of an engine look like.

    A rate or a unit that nobody stated is unknown. Times are then shown in samples and values
    without a unit, and force limits in seconds are refused.

    Parameters
    ----------
    samples : int
        Samples per channel, 1 to 1e9.
    rate_hz : float, optional
        Sampling rate in hertz, above 0 and finite. None: unknown.
    channels : int, default 1
        Number of channels, 1 to 1e9. A trace of one channel may have the shape `(samples,)`.
    unit : str or tuple of str, optional
        Unit of the samples, shown to people and used by `limit`: one unit for all channels, or one
        for each, for example ("kN", "mm") or "kN, mm"; "" for a channel of an unknown unit. None:
        unknown. Blanks around a unit are dropped. The field then holds a tuple only if the units
        differ; equal ones become one text, and unknown ones None. A text with commas that does not
        name a unit for each channel is kept as one unit of all.
    limit : float, optional
        Range of the sensor, in `unit`, above 0: a sample at or beyond ±limit is saturated. None:
        not checked.
    fit : {"strict", "cut", "pad", "resample"}, default "strict"
        What happens to a trace of another length, see `traces.fit_length`. strict: TraceError. cut:
        a longer trace loses its end. pad: like cut, and a shorter trace repeats its last sample.
        resample: linear interpolation. A trace of half to twice the length can be padded or
        resampled; any other length is a TraceError.
    columns : tuple of str, default ()
        Names of the channels, by which the columns of a DataFrame are selected: none, or one for
        each channel. A single text becomes a tuple of one.

    Raises
    ------
    SettingError
        For values that no trace can have.
    """

    samples: int
    rate_hz: float | None = None
    channels: int = 1
    unit: str | tuple[str, ...] | None = None
    limit: float | None = None
    fit: str = "strict"
    columns: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        with instead(
            SettingError, f"Expected the names of columns, got {shortened(self.columns)}", TypeError
        ):
            columns = (self.columns,) if isinstance(self.columns, str) else tuple(self.columns)
        object.__setattr__(self, "columns", columns)
        rate = self.rate_hz
        expect(
            is_whole(self.samples, 1, MOST)
            and is_whole(self.channels, 1, MOST)
            and (rate is None or (is_number(rate) and 0 < rate < float("inf"))),
            "a trace of at least 1 sample and 1 channel at a rate above 0 Hz",
            (self.samples, self.channels, rate),
        )
        unit: Any = "" if self.unit is None else self.unit
        several = isinstance(unit, tuple | list)
        units: Any = tuple(unit) if several else (unit,)
        expect(
            all(isinstance(text, str) for text in (*units, *columns)),
            "unit and columns of text",
            (self.unit, columns),
        )
        expect(
            not several or len(units) == self.channels,
            f"{self.channels} units, one a channel",
            self.unit,
        )
        units = tuple(text.strip() for text in (units if several else units[0].split(",")))
        if len(units) == self.channels or units == ("",):
            unit = units if len(set(units)) > 1 else units[0] or None
            object.__setattr__(self, "unit", unit)
        expect(
            self.limit is None or (is_number(self.limit) and self.limit > 0),
            "a limit above 0 in the trace's unit, or None",
            self.limit,
        )
        expect(self.fit in FITS, f"fit to be one of {', '.join(FITS)}", self.fit)
        expect(
            not columns or len(set(columns)) == len(columns) == self.channels,
            f"{self.channels} different columns, one a channel",
            columns,
        )

    @property
    def units(self) -> tuple[str, ...]:
        """The unit of each channel, a tuple of `channels` texts; "" for an unknown unit."""
        return self.unit if isinstance(self.unit, tuple) else (self.unit or "",) * self.channels

    @property
    def names(self) -> tuple[str, ...]:
        """The name of each channel: the name of its column if known, else "channel 0" and so on."""
        return self.columns or tuple(f"channel {i}" for i in range(self.channels))

    def completed(self, other: "TraceSpec | None") -> "TraceSpec":
        """Return a copy whose unknown rate, units and columns are taken from another `TraceSpec`.

        A `TraceSpec` says what traces look like; its columns are the channels' names. What this one
        states is kept; a unit is taken for each channel that has none; `limit` (the sensor's range)
        and `fit` (what happens to a trace of another length) are never taken. It is returned
        unchanged if `other` is None or has another number of samples or channels.
        """
        if other is None or (self.samples, self.channels) != (other.samples, other.channels):
            return self
        return replace(
            self,
            rate_hz=other.rate_hz if self.rate_hz is None else self.rate_hz,
            unit=tuple(a or b for a, b in zip(self.units, other.units, strict=True)),
            columns=self.columns or other.columns,
        )


def stored_trace_spec(settings: StoredSettings) -> TraceSpec | None:
    """Parse the `TraceSpec` among the settings of a store, which are texts by name.

    A `TraceSpec` says what traces look like: shape, sampling rate, units. Returns None if there is
    none, like before the first trace. Raises StoreError if its text describes no `TraceSpec`.
    """
    if "trace" not in settings:
        return None
    with instead(
        StoreError,
        f"Expected a TraceSpec in the settings, got {shortened(settings['trace'])}",
        ValueError,
        TypeError,
        RecursionError,
        do="restore the store",
    ):
        return TraceSpec(**json.loads(settings["trace"]))


@dataclass(frozen=True, slots=True)
class Decision:
    """What the engine decided on one trace, and on what evidence.

    Parameters
    ----------
    id : str
        Key of the decision in the store.
    action : Action
        What the cell does next.
    predicted : Action
        What the model alone would have done. Differs from `action` in an audit; VERIFY if the
        operator's `ForceLimits` reject.
    lower, upper : float
        Bounds of the success probability in the neighbourhood of the trace. Under the guarantees
        "pooled" and "cost" they are the score by which parts are sorted. With conv and rocket both
        are the mean probability of their heads; otherwise they are an interval at alpha 0.5.
    n_success, n_failure : int
        Labels of each kind in that neighbourhood.
    embedding : tuple of tuple of float, shape (K, d), or None
        The scaled embedding of the trace in each space. None if no model embedded it.
    model_version : int
        Version of the model that decided; 0 before the first retrain.
    reason : Reason
        Why `action` was chosen.
    audit : bool
        Whether the part is verified although the model was certain.
    propensity : float
        Probability with which the part is verified: the audit rate if the model is certain, 0 if
        the operator's limits reject, else 1.
    part : str, optional
        Number of the part, if the caller gave it.
    """

    id: str
    action: Action
    predicted: Action
    lower: float
    upper: float
    n_success: int
    n_failure: int
    embedding: Embedding | None
    model_version: int
    reason: Reason
    audit: bool
    propensity: float
    part: str | None = None

    @property
    def inclusion_probability(self) -> float:
        """Probability, fixed in advance, that the part's outcome would be asked for.

        0 if the part was accepted or rejected: its label, if one comes, was not asked for.
        """
        return self.propensity if self.action is Action.VERIFY else 0.0


TRAINED = "accepted"  # begins the reason of a version that was trained and put in force
REPEATS = "traces nearly repeat another"  # in a note of a retrain's reason
REPEATS_MEANING = (
    "If parts come twice, under two numbers or none, a label counts as two independent trials, and "
    "too many parts are certain: give a part the same number each time it comes. A process may "
    "also repeat that well with distinct parts; decisions stay as they are."
)


@dataclass(frozen=True, slots=True)
class RetrainReport:
    """One retrain, from taking the data to the candidate being put in force or dropped.

    Parameters
    ----------
    version : int
        Number of the version in force afterwards.
    seconds : float
        Wall time from taking the data until that version decides, without the time to store it.
    n_traces : int
        Labelled traces that the candidate was trained on.
    n_steps : int
        Optimiser steps taken; 0 for closed-form reducers and baselines.
    accepted : bool
        Whether the candidate replaced the old version.
    reason : str
        Why, in words.
    """

    version: int
    seconds: float
    n_traces: int
    n_steps: int
    accepted: bool
    reason: str


@dataclass(frozen=True, slots=True)
class Cycle:
    """One turn of the loop.

    Parameters
    ----------
    index : int
        Number of the cycle in this run, from 0.
    decision : Decision
        What the engine decided.
    outcome : Outcome or None
        What the cell learned after an accept; None after other actions.
    success : bool or None
        Label that was reported; None if there was none.
    source : Source or None
        Where that label came from.
    decide_seconds : float
        Wall time of the decision.
    retrain : RetrainReport or None
        Retrain that this cycle started or saw finish.
    safe_mode : str, default ""
        Why the engine is in safe mode after this cycle; "" if it is not.
    """

    index: int
    decision: Decision
    outcome: Outcome | None
    success: bool | None
    source: Source | None
    decide_seconds: float
    retrain: RetrainReport | None
    safe_mode: str = ""


LONGEST = 200  # characters of an id, or of a part's number


def as_success(value: Any, owner: str = "") -> bool:
    """Convert a label to bool, True for success, and return it. Nothing is stored.

    Parameters
    ----------
    value : object
        A bool, Python's or NumPy's, or a real number or 0-d array that is exactly 1 or 0. Nothing
        else, such as a text, None or NaN, is guessed at: `bool("NG")` is True, and -1 is what some
        controllers call true.
    owner : str
        Whose label it is, for the error: "decision 1a2b".

    Raises
    ------
    ReportError
        For any other value.
    """
    plain = value[()] if isinstance(value, np.ndarray) and value.ndim == 0 else value
    if isinstance(plain, np.bool_ | Real) and (plain == 0 or plain == 1):
        return bool(plain)
    whose = f" of {owner}," if owner else ""
    raise ReportError(
        f"Expected a label, True (success) or False (failure), or exactly 1 or 0,{whose} got "
        f"{shortened(value)}; nothing was stored: turn it into one of these first, as in "
        "success=(answer == 'OK')."
    )


def as_outcome(value: Any, owner: str) -> Outcome:
    """Convert an `Outcome`, or its text such as "stopped", to an `Outcome`, and return it.

    Raises ReportError for any other value, also for True and None. Its message says whose value it
    is, the `owner`'s, like "decision 1a2b".
    """
    with instead(
        ReportError,
        f"Expected an Outcome, {', '.join(Outcome)}, of {owner}, got {shortened(value)}",
        ValueError,
        TypeError,
        do="return Outcome.UNKNOWN where nothing is known",
    ):
        return Outcome(value)


def source_of(decision: Decision, success: bool) -> Source:
    """Return the source of a label, from its decision and the label itself.

    A source says where a label came from: INSPECTION after a reject. After a check it is AUDIT if
    the part was drawn at random although the model was certain, else VERIFICATION; after an accept
    CONFIRMED if the part is good (`success`), else STOP, because a bad part stops the line.
    """
    if decision.action is Action.REJECT:
        return Source.INSPECTION
    if decision.action is Action.VERIFY:
        return Source.AUDIT if decision.audit else Source.VERIFICATION
    return Source.CONFIRMED if success else Source.STOP


def is_name(value: Any) -> bool:
    """Return whether a value may be an id or a part's number.

    Both are texts of 1 to 200 (`LONGEST`) printable characters.
    """
    return isinstance(value, str) and 1 <= len(value) <= LONGEST and value.isprintable()


def as_id(value: Any) -> str:
    """Check that a value can be the id of a decision, and return it.

    Raises ReportError for anything but a text of 1 to 200 printable characters.
    """
    expect(
        is_name(value),
        f"the id of a decision, a text of 1 to {LONGEST} characters that print",
        value,
        "report the `Decision.id` that `decide` returned",
        ReportError,
    )
    return str(value)
