"""What was asked of `load_dataset`, handed from one reader to another."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from ..errors import DataError
from ..records import FITS


@dataclass(frozen=True, slots=True)
class Asked:
    """The options of `load_dataset`, under their names; `channels` are those of `channel`, taken apart."""

    samples: int | None = None
    part: str = "part"
    channels: tuple[str, ...] = ()
    label: str | None = None
    labels: str | os.PathLike[str] | None = None
    fit: str | None = None
    rate_hz: float | None = None
    trigger: Any = None
    topic: str | None = None

    def __post_init__(self) -> None:
        if self.label is not None and self.labels is not None:
            raise DataError(
                "Expected a pattern for the labels (label) or a file of them (labels), got both; leave one out."
            )
        if self.fit is not None and self.fit not in FITS:
            raise DataError(f"Expected fit to be one of {', '.join(FITS)}, got {self.fit!r}.")
        if self.rate_hz is not None and not self.rate_hz > 0:
            raise DataError(f"Expected a rate above 0 Hz, got {self.rate_hz}.")
        if self.samples is not None and self.samples < 1:
            raise DataError(f"Expected 1 or more samples, got {self.samples}.")
        if len(set(self.channels)) != len(self.channels):
            raise DataError(f"Expected each channel once, got {', '.join(self.channels)}.")

    def refuse_cutting(self, what: str) -> None:
        """DataError for options that cut a stream, where what is read is no stream."""
        idle = [name for name in ("trigger", "topic") if getattr(self, name) is not None]
        if idle:
            raise DataError(f"Expected no {' or '.join(idle)} for {what}: it is cut into insertions already; leave it out.")

    def refuse(self, what: str, *names: str) -> None:
        """DataError for options that say nothing to what is read."""
        idle = [name for name in names if getattr(self, name) is not None]
        if idle:
            raise DataError(f"Expected no {' or '.join(idle)} for {what}: it has its labels; leave it out.")


def names_of(channel: str | Sequence[str] | None) -> tuple[str, ...]:
    """`"FZ_Base,FX_Base"`, or a list of names, one by one."""
    listed = channel.split(",") if isinstance(channel, str) else channel or ()
    return tuple(name.strip() for name in listed if name.strip())
