"""Frozen records that travel between the layers, the values that they may hold, and their plain JSON."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from enum import StrEnum
from functools import cache
from html import escape
from importlib import import_module
from numbers import Integral, Real
from typing import Any, Self

import numpy as np

from .errors import ReportError, SettingError, StoreError, expect, instead, shortened, without_password


def is_whole(value: Any, least: int, most: int) -> bool:
    """Whether it is an integer, Python's or NumPy's, from `least` to `most`."""
    return isinstance(value, Integral) and not isinstance(value, bool) and least <= int(value) <= most


def is_number(value: Any) -> bool:
    """Whether it is a real number that a float can hold, infinities and NaN included; True and 10**400 are none."""
    if not isinstance(value, Real) or isinstance(value, bool):
        return False
    try:
        float(value)
    except OverflowError:
        return False
    return True


class Action(StrEnum):
    """What the cell does next. In exported files the position here is the integer, so zero is the safe one."""

    VERIFY = "verify"
    ACCEPT = "accept"
    REJECT = "reject"


class Reason(StrEnum):
    """Why a decision is what it is. In exported files the position here is the integer."""

    CERTAIN = "certain"  # the bound meets the policy
    UNCERTAIN = "uncertain"  # it does not
    NO_MODEL = "no_model"  # nothing was trained yet
    AUDIT = "audit"  # certain, and verified all the same to watch the model
    NOT_FINITE = "not_finite"  # a NaN or an infinity in the trace
    CONSTANT = "constant"  # every sample of every channel the same: a dead sensor
    SATURATED = "saturated"  # the trace touches the sensor's range, `TraceSpec.limit`
    MODEL_ERROR = "model_error"  # the model raised; the cell went on
    NOVEL = "novel"  # unlike all that was learned from, whatever its neighbours say
    SAFE_MODE = "safe_mode"  # everything is verified: what was accepted failed too often, or too much is novel
    NO_STORE = "no_store"  # the journal takes nothing, or whether the id is new cannot be looked up
    LATE = "late"  # the answer would have come too late: whoever asked verifies already
    OUTSIDE = "outside"  # it leaves one of the operator's windows, whatever the model says
    TOO_LARGE = "too_large"  # a sample beyond 1e18 either way, whose square float32 cannot sum


ACTIONS, REASONS = tuple(Action), tuple(Reason)  # by position: the integers of exported files


class Source(StrEnum):
    """Where a label came from."""

    VERIFICATION = "verification"  # the model was uncertain, the expensive verification decided
    AUDIT = "audit"  # the model was certain and was checked all the same
    STOP = "stop"  # accepted, and the system stopped: a failure
    CONFIRMED = "confirmed"  # accepted, and known to be fine
    INSPECTION = "inspection"  # rejected, and looked at afterwards: evidence that came unasked


class Outcome(StrEnum):
    """What the cell knows after it went on without a check."""

    STOPPED = "stopped"
    CONFIRMED = "confirmed"
    UNKNOWN = "unknown"  # silence is not a success


MOST = 10**9  # samples, or channels
FITS = ("strict", "cut", "pad", "resample")  # in exported files the position here is the integer


@dataclass(frozen=True, slots=True)
class TraceSpec:
    """The contract of a trace. SettingError for values that no trace can keep to.

    samples : per channel.  rate_hz : sampling rate in hertz.
    unit : of the samples, for people only; one for all, or one a channel, ("kN", "mm") or "kN, mm".
    channels : their number; a one-channel trace may come as `(samples,)`.
    limit : the sensor's range in `unit`; a sample at or beyond ±limit is saturated. None: not checked.
    fit : of a trace of another length (`traces.fitted`). strict: TraceError. cut: a longer one loses its end. pad: that,
        and a shorter one repeats its last sample. resample: linear interpolation. Else it becomes NaN, and is verified.
    columns : the channels' names, by which the columns of a DataFrame are picked; empty: they have none.
    """

    samples: int
    rate_hz: float = 500.0
    channels: int = 1
    unit: str | tuple[str, ...] = "N"
    limit: float | None = None
    fit: str = "strict"
    columns: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        with instead(SettingError, f"Expected the names of columns, got {shortened(self.columns)}", TypeError):
            columns = (self.columns,) if isinstance(self.columns, str) else tuple(self.columns)
        object.__setattr__(self, "columns", columns)
        rated = is_number(self.rate_hz) and 0 < self.rate_hz < float("inf")
        form = (self.samples, self.channels, self.rate_hz)
        held = is_whole(self.samples, 1, MOST) and is_whole(self.channels, 1, MOST) and rated
        expect(held, "a trace of at least 1 sample and 1 channel at a rate above 0 Hz", form)
        several = isinstance(self.unit, tuple | list)
        said: Any = tuple(self.unit) if several else (self.unit,)
        texts = all(isinstance(text, str) for text in (*said, *self.columns))
        expect(texts, "unit and columns of text", (self.unit, self.columns))
        expect(not several or len(said) == self.channels, f"{self.channels} units, one a channel", self.unit)
        units = said if several else tuple(text.strip() for text in said[0].split(","))
        if len(units) == self.channels:
            object.__setattr__(self, "unit", units if len(set(units)) > 1 else units[0])
        limited = self.limit is None or (is_number(self.limit) and self.limit > 0)
        expect(limited, "a limit above 0 in the trace's unit, or None", self.limit)
        expect(self.fit in FITS, f"fit to be one of {', '.join(FITS)}", self.fit)
        different = not self.columns or len(set(self.columns)) == self.channels
        expect(different, f"{self.channels} different columns, one a channel", self.columns)

    @property
    def units(self) -> tuple[str, ...]:
        """The unit of each channel."""
        return (self.unit,) * self.channels if isinstance(self.unit, str) else self.unit


@dataclass(frozen=True, slots=True)
class Window:
    """An operator's limits within a stretch of time, or of path; as text START:END:LOW:HIGH, where a limit may be empty,
    and more of its fields, :channel=1:along=2:reject. SettingError for values that hold nothing.

    start, end : in seconds from the first sample, both included; with `along` in that channel's unit.
    low, high : that the samples there must keep, in their unit, both included; one may be infinite.
    channel : theirs, from 0, or its name among the traces' columns.  along : of where the tool is, likewise; None: time.
    reject : what leaves it, or has no sample in the stretch, is rejected; else verified.
    """

    start: float
    end: float
    low: float = -math.inf
    high: float = math.inf
    channel: int | str = 0
    along: int | str | None = None
    reject: bool = False

    def __post_init__(self) -> None:
        numbers = all(map(is_number, (self.start, self.end, self.low, self.high)))
        held = numbers and -math.inf < self.start <= self.end < math.inf and self.low <= self.high
        held = held and (self.low, self.high) != (-math.inf, math.inf) and isinstance(self.reject, bool)
        for each in (self.channel, 0 if self.along is None else self.along):
            named = isinstance(each, str) and is_name(each) and not ({*" :="} & {*each} or each.isdecimal())  # in a text
            held = held and (named or is_whole(each, 0, MOST))
        expect(held, "a window with start <= end, low <= high, one of these finite, and channels from 0 on, or names", self)

    def __str__(self) -> str:
        said = [f"{repr(float(each)).removesuffix('.0')}" for each in (self.start, self.end, self.low, self.high)]
        said += [f"channel={self.channel}"] * (self.channel != 0) + [f"along={self.along}"] * (self.along is not None)
        return ":".join(["" if "inf" in each else each for each in said] + ["reject"] * self.reject)

    @classmethod
    def parse(cls, text: str) -> Self:
        """The window of a text; SettingError for one that is none."""
        words = [word.partition("=") for word in text.split(":")]
        try:
            start, end, low, high = (word for word, _, _ in words[:4])
            more: dict[str, Any] = {name: int(each) if each.isdecimal() else each or True for name, _, each in words[4:]}
            return cls(float(start), float(end), float(low or "-inf"), float(high or "inf"), **more)
        except SettingError:
            raise
        except (TypeError, ValueError) as error:
            wanted = "windows as START:END:LOW:HIGH, 0.2:0.4::60, with :channel=1, :along=2, :reject behind it"
            raise SettingError(f"Expected {wanted}, got {shortened(text)}.") from error


def trace_in(known: Mapping[str, str]) -> TraceSpec | None:
    """The traces' contract among a store's settings; None before the first trace. StoreError for what is none."""
    if "trace" not in known:
        return None
    said = f"Expected a trace's contract in the settings, got {shortened(known['trace'])}"
    with instead(StoreError, said, ValueError, TypeError, RecursionError, do="restore the store"):
        return TraceSpec(**json.loads(known["trace"]))


def in_html(record: Any) -> str:
    """A record's `repr` for a notebook, `_repr_html_`: its parts, a row each, and what it says in sentences below them."""
    head, _, rest = repr(record).strip("<>").partition(": ")
    rows = "".join(f"<tr><td style='text-align: left'>{escape(each)}</td></tr>" for each in rest.split(", "))
    said = "".join(f"<p>{escape(sentence)}</p>" for sentence in getattr(record, "said", ()))
    return f"<table><tr><th style='text-align: left'>{escape(head)}</th></tr>{rows}</table>{said}"


@dataclass(frozen=True, slots=True, repr=False)
class Decision:
    """What the engine decided on one trace, and on what evidence.

    id : the decision's key in the store.  action : what to do.  reason : why.
    predicted : what the model alone would have done: not `action` in an audit, and VERIFY where a window rejects.
    lower, upper : bound on the success probability in the ball around the trace; under the pooled guarantee what sorts it:
        of conv and rocket the mean probability by their heads, twice, else an interval at alpha 0.5.
    n_success, n_failure : labels counted in that ball.
    embedding : (K, d) nested tuples, scaled; None where no model embedded the trace.
    model_version : of the model that answered; 0 before the first retrain.
    audit : verified although the model was certain.
    propensity : probability with which it is verified: of a certain one the audit rate, where a window rejects 0, else 1.
    part : the number of the part, where it was given.
    """

    id: str
    action: Action
    predicted: Action
    lower: float
    upper: float
    n_success: int
    n_failure: int
    embedding: tuple[tuple[float, ...], ...] | None
    model_version: int
    reason: Reason
    audit: bool
    propensity: float
    part: str | None = None

    def __repr__(self) -> str:
        bound = f"bound {self.lower:.3f} to {self.upper:.3f}, {self.n_success} good, {self.n_failure} bad labels around it"
        alone = f", alone the model would {self.predicted.value}" if self.audit else ""
        what = f"{self.action.value}, {self.reason.value}: {bound}{alone}"
        return f"<Decision {what}, version {self.model_version}, id {self.id}>"

    _repr_html_ = in_html

    @property
    def looked(self) -> float:
        """Probability with which its outcome was asked for: 0 where it went on, and a label can only come unasked."""
        return self.propensity if self.action is Action.VERIFY else 0.0


@dataclass(frozen=True, slots=True)
class RetrainReport:
    """One retrain, from taking the data to the new version answering.

    version : of the model that answers afterwards.  n_traces : labelled traces the candidate was given.
    seconds : wall time from taking the data until the version answers; committing it to the store comes on top.
    n_steps : optimiser steps taken (0 for closed-form reducers and baselines).
    accepted : whether the candidate replaced the old version.  reason : why, in words.
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

    index : cycle number of this run, from 0.  decision : what the engine decided, in `decide_seconds` of wall time.
    outcome : after an accept, what the cell found out; None otherwise.
    success, source : of the label that was reported; None where nothing was learned.
    retrain : the retrain this cycle set off or saw finish, if any.
    safe_mode : why everything is being verified after this cycle; "" where it is not.
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


def as_success(value: Any, of: str = "") -> bool:
    """A bool, or a number or 0-d array of exactly 1 or 0, as a bool; else ReportError. of : whose label, for the error.

    A label that is guessed is worse than none: `bool("NG")` is True, and -1 is what some controllers call true.
    """
    plain = value[()] if isinstance(value, np.ndarray) and value.ndim == 0 else value
    if isinstance(plain, bool | np.bool_ | Real) and (plain == 0 or plain == 1):
        return bool(plain)
    wanted = f"a label, True (success) or False (failure), or exactly 1 or 0,{of and f' of {of},'}"
    do = "nothing was stored: turn it into one of these first, as in success=(answer == 'OK')"
    raise ReportError(f"Expected {wanted} got {shortened(value)}; {do}.")


def as_outcome(value: Any, of: str = "") -> Outcome:
    """What a cell's `proceed` returned, as an `Outcome`; ReportError for anything else, which would pass for silence."""
    said = f"Expected an Outcome, {', '.join(Outcome)},{of and f' of {of},'} got {shortened(value)}"
    with instead(ReportError, said, ValueError, TypeError, do="return Outcome.UNKNOWN where nothing is known"):
        return Outcome(value)


def source_of(action: Action, audit: bool, success: bool) -> Source:
    """Where a label on a decision comes from."""
    if action is Action.REJECT:
        return Source.INSPECTION
    if action is Action.VERIFY:
        return Source.AUDIT if audit else Source.VERIFICATION
    return Source.CONFIRMED if success else Source.STOP


def is_name(value: Any) -> bool:
    """Whether a store can keep it as an id, or a part's number: text that prints, of 1 to LONGEST characters."""
    return isinstance(value, str) and 1 <= len(value) <= LONGEST and value.isprintable()


def as_id(value: Any) -> str:
    """A decision's id; ReportError for what is none."""
    wanted = f"the id of a decision, a text of 1 to {LONGEST} characters that print"
    expect(is_name(value), wanted, value, "report the `Decision.id` that `decide` returned", ReportError)
    return str(value)


def plain(value: Any) -> Any:
    """A value that `json` takes: records as objects, paths and enums as text, NaN and infinities as None, no passwords.

    A field whose metadata say "flat" gives its own fields, one that says "apart" none.
    """
    if isinstance(value, float):  # what there is most of first: every answer of a server is such an object
        return value if math.isfinite(value) else None
    if isinstance(value, str):
        return without_password(value)
    if isinstance(value, bool | int) or value is None:
        return value
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    if is_dataclass(value) and not isinstance(value, type):
        found: dict[str, Any] = {}
        for name, flat in _told(type(value)):
            said = plain(getattr(value, name))
            found |= said if flat else {name: said}
        return found
    if isinstance(value, Mapping):
        return {str(key): plain(each) for key, each in value.items()}
    if hasattr(value, "tolist"):  # of NumPy
        return plain(value.tolist())
    return without_password(str(value))


@cache
def _told(kind: type) -> tuple[tuple[str, bool], ...]:
    """A record's fields that do not stand apart, and whether each gives its own fields."""
    return tuple((each.name, "flat" in each.metadata) for each in fields(kind) if "apart" not in each.metadata)


def find_class(where: str) -> type:
    """The class that `module:Class` names; SettingError where there is none."""
    module, _, name = where.partition(":")
    said = f"Expected module:Class that can be imported here, got {shortened(where)}"
    with instead(SettingError, said, Exception):  # whatever a module of the user's raises while it is imported
        found = getattr(import_module(module), name)
    if not isinstance(found, type):
        raise SettingError(f"Expected module:Class, {shortened(where)} is a {type(found).__name__} and no class.")
    return found
