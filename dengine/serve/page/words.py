"""What the page says, in the reader's language: messages by key, and numbers and times as that language writes them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime

from .english import ENGLISH
from .german import GERMAN

CATALOGUES: Mapping[str, Mapping[str, str]] = {"en": ENGLISH, "de": GERMAN}
DEFAULT = "en"
MINUS, THIN = "\u2212", "\u202f"


@dataclass(frozen=True, slots=True)
class Words:
    """One language.  lang : its code, one of `CATALOGUES`."""

    lang: str = DEFAULT

    def __call__(self, key: str, **values: object) -> str:
        """The message of a key with its values filled in; an unknown key is a KeyError."""
        return CATALOGUES[self.lang][key].format(**values)

    def number(self, value: float | None, digits: int = 0) -> str:
        """1,234.5 in English, 1.234,5 in German; a dash where there is none."""
        if value is None or value != value:
            return "–"
        text = f"{abs(value):,.{digits}f}"
        if self.lang == "de":
            text = text.translate({ord(","): ".", ord("."): ","})
        negative = value < 0 and any(digit in text for digit in "123456789")
        return MINUS + text if negative else text

    def percent(self, share: float | None, digits: int = 0) -> str:
        """A share as per cent; a dash where there is none."""
        return "–" if share is None else f"{self.number(100.0 * share, digits)}{THIN}%"

    def moment(self, seconds: float | None) -> str:
        """Day and time of day, by the server's clock; seconds since 1970."""
        if seconds is None:
            return "–"
        form = "%d.%m.%Y, %H:%M:%S" if self.lang == "de" else "%Y-%m-%d %H:%M:%S"
        return f"{datetime.fromtimestamp(seconds):{form}}"

    def clock(self, seconds: float | None) -> str:
        """The time of day."""
        return "–" if seconds is None else f"{datetime.fromtimestamp(seconds):%H:%M:%S}"

    def duration(self, seconds: float) -> str:
        """90 s, 12 min, 3.4 h."""
        if abs(seconds) < 120:
            return f"{self.number(seconds)} s"
        if abs(seconds) < 7200:
            return f"{self.number(seconds / 60)} min"
        return f"{self.number(seconds / 3600, 1)} h"


def language(wanted: str | None, accepted: str = "") -> str:
    """The language to answer in: the one that was chosen, or the first one known of an Accept-Language header."""
    if wanted is not None and wanted in CATALOGUES:
        return wanted
    for _, code in sorted(_ranked(accepted), key=lambda each: -each[0]):
        if code in CATALOGUES:
            return code
    return DEFAULT


def _ranked(accepted: str) -> list[tuple[float, str]]:
    found = []
    for each in accepted.split(",")[:20]:
        name, _, weight = each.partition(";q=")
        try:
            rank = float(weight or 1.0)
        except ValueError:
            continue
        found.append((rank, name.strip().lower()[:2]))
    return found
