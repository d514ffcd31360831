"""The exception tree, and what errors and screens may say of a value: a line of it, and never a password."""

import math
import re
import reprlib
import shlex
import unicodedata
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

HIDDEN = "***"
# Up to the last @: a password may hold one that is not escaped, or a blank. A path writes // as /.
URL = re.compile(r"(\w[\w+.-]*:/{1,2}[^\s:/@'\"]*):(\S*|[^\n'\"]*)@")
NAMED = re.compile(r"\b(password|passwd|sslpassword)=[^&\s'\"]+", re.IGNORECASE)  # in a URL's query, or of libpq
QUOTES = ("'", '"')
OPTIONS = "channels?|label_map|labels?|part|time|fit|samples|rate_hz|unit|trigger|topic|columns|decimal|thousands"
OPTION = re.compile(rf"(?<!:)\b({OPTIONS})=('[^']*'|\"[^\"]*\"|[\w.]+)|(?<=\()({OPTIONS})=?(?=\))")
LONG = 60  # characters of a value in an error
SHORT = reprlib.Repr()
SHORT.maxstring = SHORT.maxother = SHORT.maxlong = LONG


def without_password(text: str) -> str:
    """A text with *** in the place of every password in a database URL: `scheme://user:***@host`, `password=***`."""
    return NAMED.sub(rf"\1={HIDDEN}", URL.sub(rf"\1:{HIDDEN}@", text))


def shortened(value: Any) -> str:
    """A value as `repr` shows it, at most some 60 characters of it: an error must not hold a megabyte."""
    try:
        return SHORT.repr(value)
    except ValueError:  # an integer of more digits than Python prints
        return f"a number of {value.bit_length()} bits" if isinstance(value, int) else f"a {type(value).__name__}"


def excerpt(text: str, at: int = 0) -> str:
    """Some 60 characters of a text, as `repr` shows them, around the one at `at`, which is named if it is not ASCII."""
    begin = max(min(at - LONG // 2, len(text) - LONG), 0)
    said = f"{'...' if begin else ''}{text[begin : begin + LONG]!r}{'...' if len(text) > begin + LONG else ''}"
    odd = text[at : at + 1]
    if not odd or (odd.isascii() and odd.isprintable()):
        return said
    return f"{said}, with {unicodedata.name(odd, 'a control character')} (U+{ord(odd):04X}) at character {at + 1}"


def listed(names: Iterable[Any]) -> str:
    """The first few of some names, and how many more there are."""
    names = list(names)
    few = ", ".join(str(name)[:100] for name in names[:8])
    return f"{few} and {len(names) - 8} more" if len(names) > 8 else few


def as_options(text: str) -> str:
    """Advice for Python, `TraceSpec(rate_hz=500)`, in the words of the command, `--rate-hz 500`."""

    def typed(found: re.Match[str]) -> str:
        name, value = f"--{(found[1] or found[3]).replace('_', '-')}", found[2] or ""
        return f"{name} {shlex.quote(value[1:-1]) if value[:1] in QUOTES else value}".rstrip()

    return OPTION.sub(typed, re.sub(r"(?:DataEngine\(trace=)?TraceSpec\(([^()]*)\)\)?", r"\1", text))


def percent(share: float, form: str = ".1f") -> str:
    """A share as a person reads it, 12.3 %; "-" for NaN."""
    return "-" if math.isnan(share) else f"{100 * share:{form}} %"


class DengineError(Exception):
    """Base of every error that dengine raises on purpose; the passwords of database URLs in its text are masked."""

    def __init__(self, *said: object) -> None:
        super().__init__(*(without_password(each) if isinstance(each, str) else each for each in said))


class TraceError(DengineError, ValueError):
    """A trace of the wrong shape or type: the caller's bug, not the world's fault."""


class SettingError(DengineError, ValueError):
    """A setting (policy, recipe, reducer, cell) outside its range or unknown by name."""


class ImportRefusedError(SettingError):
    """A class that a store names, and that its caller neither named again nor allowed to be imported."""


class DataError(DengineError, ValueError):
    """A data set that cannot be read, or whose parts do not fit together."""


class ReportError(DengineError, ValueError):
    """A report that says nothing (no label, no id), on an unknown decision, a second one, or one against the first."""


class UnknownDecisionError(ReportError):
    """A report on a decision that this cell does not know."""


class ReportConflictError(ReportError):
    """A report against what is recorded: a second label."""


class TraceConflictError(TraceError):
    """Another trace under the id of a recorded decision."""


def expect(held: bool, wanted: str, got: Any, do: str = "", error: type[DengineError] = SettingError) -> None:
    """An error that says what was expected, what came and what to do, unless it held."""
    if not held:
        raise error(f"Expected {wanted}, got {shortened(got)}{'; ' if do else ''}{do}.")


@contextmanager
def instead(error: type[DengineError], said: str, *of: type[Exception], do: str = "") -> Iterator[None]:
    """An error of this kind in the place of others, with what these say; one of its own kind passes as it is."""
    try:
        yield
    except error:
        raise
    except of as raised:
        why = " ".join(str(getattr(raised, "strerror", None) or raised)[:300].split()) or type(raised).__name__
        raise error(f"{said}: {why.rstrip('.')}{'; ' if do else ''}{do}.") from raised


class StoreError(DengineError, RuntimeError):
    """A store that cannot be opened, belongs to something else, or lost its writer."""


class NotTakenError(StoreError):
    """A label that is not known to be on the disk: say the same again; it counts once."""


class BusyError(DengineError, RuntimeError):
    """A server that has as much to do as it takes, or is closing: whoever asked goes on without it, and verifies."""


class ExportError(DengineError, RuntimeError):
    """A model that cannot be exported, or an exported file that must not be used."""


class OutputError(DengineError, RuntimeError):
    """A file that cannot be written, or that holds something else than an earlier output of the same kind."""


class CellError(DengineError, RuntimeError):
    """A robot cell that cannot be reached, does not answer in time, or says that it could not do what it was told."""
