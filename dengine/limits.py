"""An operator's limits of the force: the class `ForceLimits` and its text form, START:END:LOW:HIGH.
A `Policy` holds them, and a part whose trace leaves them is verified or rejected.

`Policy(force_limits=...)` takes them as objects or as texts, `--force-limit` as text, and a store
keeps the text. `traces.ForceLimitsGate` checks a trace against them, in the engine and in exported
files.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from .errors import SettingError, expect, instead, shortened
from .records import MOST, is_name, is_number, is_whole


@dataclass(frozen=True, slots=True)
class ForceLimits:
    """Limits of one channel within a stretch of time, or of another channel's values.

    `str` gives the text START:END:LOW:HIGH, in which a limit may be empty, followed by the other
    fields that are set, as in `0.2:0.4::60:channel=1:along=2:reject`; `parse` reads it.

    Parameters
    ----------
    start, end : float
        The stretch, both ends included: seconds from the first sample, or values of the channel
        `along`, in its unit.
    low, high : float
        Least and greatest value that the samples in the stretch may have, in their unit, both
        included. One of the two may be infinite.
    channel : int or str, default 0
        Channel that is limited: its index, or its name among the columns of the traces.
    along : int or str, optional
        Channel, say the position of the tool, whose values between `start` and `end` mark the
        stretch. None: time.
    reject : bool, default False
        Whether a trace that leaves the limits, or has no sample in the stretch, is rejected; if
        not, it is verified.

    Raises
    ------
    SettingError
        For values that describe no limits: NaN, `start` above `end` or not finite, `low` above
        `high` or both infinite, a `reject` that is no boolean, or a channel that is no index from 0
        to 1e9 and no name. A name is 1 to 200 printable characters, not digits alone, without a
        blank, a colon or `=`. Whether the channel exists is not checked here.
    """

    start: float
    end: float
    low: float = -math.inf
    high: float = math.inf
    channel: int | str = 0
    along: int | str | None = None
    reject: bool = False

    def __post_init__(self) -> None:
        expect(
            all(map(is_number, (self.start, self.end, self.low, self.high)))
            and isinstance(self.reject, bool)
            and -math.inf < self.start <= self.end < math.inf
            and self.low <= self.high
            and (self.low, self.high) != (-math.inf, math.inf)
            and _is_channel(self.channel)
            and (self.along is None or _is_channel(self.along)),
            "force_limits with start <= end, low <= high, one of these finite, and channels from 0 "
            "on, or names",
            self,
        )

    def __str__(self) -> str:
        """Return the text form, which `parse` reads; infinite limits are empty."""
        fields = [
            "" if math.isinf(value) else repr(float(value)).removesuffix(".0")
            for value in (self.start, self.end, self.low, self.high)
        ]
        if self.channel != 0:
            fields.append(f"channel={self.channel}")
        if self.along is not None:
            fields.append(f"along={self.along}")
        if self.reject:
            fields.append("reject")
        return ":".join(fields)

    @classmethod
    def parse(cls, text: str) -> ForceLimits:
        """Return the limits that a text START:END:LOW:HIGH describes; `str` writes this text.

        From START to END, in seconds or in values of the channel `along`, the samples must lie
        between LOW and HIGH (`start`, `end`, `low` and `high` of the class). An empty LOW or HIGH
        means no limit, but not both; START and END must be given. `:channel=1`, `:along=2` and
        `:reject` may follow in any order, and set the fields of these names: which channel is
        limited, and whether a part is rejected in place of checked. A channel in digits is an
        index, any other text is a name. Raises SettingError for a text of another form, and for
        values that `ForceLimits` refuses.
        """
        fields = text.split(":")
        options: dict[str, Any] = {}
        with instead(
            SettingError,
            "Expected force_limits as START:END:LOW:HIGH, 0.2:0.4::60, with :channel=1, :along=2, "
            f":reject behind it, got {shortened(text)}",
            TypeError,
            ValueError,
        ):
            start, end, low, high = fields[:4]
            for field in fields[4:]:
                name, _, value = field.partition("=")
                options[name] = int(value) if value.isdecimal() else value or True
            return cls(
                float(start), float(end), float(low or "-inf"), float(high or "inf"), **options
            )


def _is_channel(value: Any) -> bool:
    """Return whether a value can name a channel: an index, or a name that fits the text form.

    An index is 0 to 1e9. A name is 1 to 200 printable characters, not digits alone, without a
    blank, a colon or `=`.
    """
    if not isinstance(value, str):
        return is_whole(value, 0, MOST)
    return is_name(value) and not value.isdecimal() and {*" :="}.isdisjoint(value)
