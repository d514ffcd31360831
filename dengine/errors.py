"""The exceptions of dengine, functions that raise them and build their messages, and the log. All
modules use them; a user catches `DengineError` or a subclass.

`expect` and `instead` raise messages of one form: what was expected, what came, what to do.
`shortened` and `listed` keep a message to one line, `without_password` masks passwords,
`percent` writes shares, and `as_options` turns advice for Python into advice for the command line.
"""

import logging
import math
import re
import reprlib
import shlex
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

log = logging.getLogger("dengine")
MASK = "***"
# Up to the last @, for a password may hold an unescaped one, or a blank. A path writes // as /.
URL = re.compile(r"(\w[\w+.-]*:/{1,2}[^\s:/@'\"]*):(\S*|[^\n'\"]*)@")
# In the query of a URL, or as libpq writes it.
PASSWORD = re.compile(
    r"\b(password|passwd|sslpassword)=('(\\.|[^'\\])*'|\"[^\"]*\"|[^&\s'\"]+)", re.IGNORECASE
)
QUOTES = ("'", '"')
OPTIONS = "channels?|fit|samples|rate_hz|unit|trigger|alpha|lower_bound|guarantee|stops|audit_rate"
OPTION = re.compile(
    rf"(?<![\w=])'[^']*'|(?<![:.])(?<!--set )\b({OPTIONS})=('[^']*'|\"[^\"]*\"|[\w.]+)"
    rf"|(?<=\()({OPTIONS})=?(?=\))"
)
TRACE_SPEC = re.compile(r"(?:DataEngine\(trace=)?TraceSpec\(([^()]*)\)\)?")
MOST = 1000  # characters of a text in which passwords are looked for: URL takes time to search
MAX_LENGTH = 60  # characters of a value in a message
_REPR = reprlib.Repr()
_REPR.maxstring = _REPR.maxother = _REPR.maxlong = MAX_LENGTH


def without_password(text: str) -> str:
    """Return a text in which *** stands for every password of a database URL.

    Two forms are masked, `scheme://user:***@host` and `password=***`, also with the names passwd
    and sslpassword. In the second form the password is in quotes, or ends before a blank, a quote
    or "&". The rest of the text stays.
    """
    return PASSWORD.sub(rf"\1={MASK}", URL.sub(rf"\1:{MASK}@", text))


def shortened(value: Any) -> str:
    """Return the `repr` of a value for a message.

    In a text of fewer than 1,000 characters the passwords of database URLs are masked first. If it
    is longer than 60 characters, "..." stands for its middle. A container shows only its first
    items (six of a list or tuple, four of a dict), each of them cut like this.
    """
    if isinstance(value, str) and len(value) < MOST:
        value = without_password(value)  # before it is cut, or half a password would stay
    return _REPR.repr(value)


def listed(names: Iterable[Any]) -> str:
    """Return the first eight names, joined by commas, and how many more there are, for a message.

    So ten names end in "and 2 more". Each name is cut to 100 characters. Without names it is "".
    """
    names = list(names)
    first = ", ".join(str(name)[:100] for name in names[:8])
    return f"{first} and {len(names) - 8} more" if len(names) > 8 else first


def as_options(text: str) -> str:
    """Return a message in which Python's arguments are written as options of the command line.

    `rate_hz=500` becomes `--rate-hz 500`, and a name alone in parentheses, `(samples)`, becomes
    `(--samples)`. Only the names in `OPTIONS` are rewritten (channel, channels, fit, samples,
    rate_hz, unit, trigger, alpha, lower_bound, guarantee, stops, audit_rate), and not after a
    colon, a point or `--set`. `TraceSpec(...)` around arguments is dropped, with a
    `DataEngine(trace=...)` around it, also within quotes. A value in quotes loses them unless a
    shell needs them. A value that begins neither with a quote nor with a letter, a digit, `_` or a
    point, like -1, stays with its name as it was. All other text stays, also text in single quotes,
    which messages use for data, unless a letter, a digit, `_` or `=` stands before the quote.
    """

    def to_option(match: re.Match[str]) -> str:
        """Return an option as typed, `--rate-hz 500`, of a match of `OPTION`; data as they are."""
        name = match[1] or match[3]
        if not name:
            return match[0]
        value = match[2] or ""
        if value[:1] in QUOTES:
            value = shlex.quote(value[1:-1])
        return f"--{name.replace('_', '-')} {value}".rstrip()

    return OPTION.sub(to_option, TRACE_SPEC.sub(r"\1", text))


def percent(share: float, form: str = ".1f") -> str:
    """Return a share as text, 0.123 as "12.3 %", and NaN as "-".

    `form` is Python's format of the number in percent, by default with one decimal.
    """
    return "-" if math.isnan(share) else f"{100 * share:{form}} %"


def outward(lower: float, upper: float, digits: int) -> tuple[float, float]:
    """Return an interval with the lower end rounded down and the upper end rounded up, to `digits`.

    So 0.8999 is shown as 0.89 with two digits, and does not seem to reach a threshold of 0.9. Both
    ends are first rounded to nine further digits, so that errors of floats do not count. `digits`
    are those behind the point. Raise ValueError for NaN and OverflowError for an infinite end.
    """
    scale = 10**digits
    return math.floor(round(lower * scale, 9)) / scale, math.ceil(round(upper * scale, 9)) / scale


def counted(n: int, noun: str) -> str:
    """Return a number with its noun, of which the plural ends in s: "1 part", "1,200 parts"."""
    return f"{n:,} {noun}{'' if n == 1 else 's'}"


def capitalized(text: str) -> str:
    """Return the text with its first letter in upper case."""
    return text[0].upper() + text[1:]


def amount(value: float) -> str:
    """Return a cost of 0 or more as text: three significant digits, and whole from 1,000 on.

    So 12.34 becomes "12.3" and 1234.5 "1,234". Zeros at the end of decimals are left out, 12.0
    becomes "12", and a cost below 0.0001 is written like "1e-05".
    """
    return f"{value:,.0f}" if value >= 999.5 else f"{value:.3g}"


class DengineError(Exception):
    """Base of all errors that dengine raises on purpose.

    Passwords of database URLs in its message are masked.
    """

    def __init__(self, *args: object) -> None:
        super().__init__(*(without_password(arg) if isinstance(arg, str) else arg for arg in args))


class TraceError(DengineError, ValueError):
    """A trace of the wrong shape or type, which is a bug of the caller."""


class SettingError(DengineError, ValueError):
    """A setting of a policy, recipe, reducer or cell with an unknown name or out of its range."""


class ImportRefusedError(SettingError):
    """A store names a class of the user that the caller did not allow to be imported."""


class DataError(DengineError, ValueError):
    """A data set that cannot be read, or whose arrays do not fit together."""


class ReportError(DengineError, ValueError):
    """A report without a valid label or id, or on a decision that is unknown or was reported."""


class UnknownDecisionError(ReportError):
    """A report on a decision that is not in the store."""


class ReportConflictError(ReportError):
    """A report that contradicts the label that is recorded."""


class TraceConflictError(TraceError):
    """A trace other than the recorded one, under the id of a recorded decision."""


def expect(
    valid: bool, wanted: str, actual: Any, do: str = "", error: type[DengineError] = SettingError
) -> None:
    """Raise an error unless `valid`.

    Parameters
    ----------
    valid : bool
    wanted : str
        What was expected.
    actual : object
        What came. The message has its `repr`, cut to 60 characters.
    do : str
        What the user can do about it; "" leaves it out of the message.
    error : type, default SettingError
        Class of the error that is raised. Its message is "Expected `wanted`, got `actual`; `do`."
    """
    if not valid:
        advice = f"; {do}" if do else ""
        raise error(f"Expected {wanted}, got {shortened(actual)}{advice}.")


@contextmanager
def instead(
    error: type[DengineError], message: str, *caught: type[Exception], do: str = ""
) -> Iterator[None]:
    """Raise `error` in place of the exceptions `caught`, which become its cause; a context manager.

    Parameters
    ----------
    error : type
        Class of the new error. An exception of this class or a subclass passes unchanged.
    message : str
        Beginning of the new message. The text of the caught exception follows, on one line and cut
        to 300 characters; if it is empty, the name of its class. For an OSError that has a
        `strerror`, this text alone follows; it lacks the file's name, so `message` must name the
        file.
    *caught : type
        Exceptions to catch. All others pass unchanged.
    do : str
        What the user can do about it, the end of the new message.
    """
    try:
        yield
    except error:
        raise
    except caught as exception:
        text = str(getattr(exception, "strerror", None) or exception)
        why = " ".join(text[:300].split()) or type(exception).__name__
        advice = f"; {do}" if do else ""
        raise error(f"{message}: {why.rstrip('.')}{advice}.") from exception


class StoreError(DengineError, RuntimeError):
    """A store that cannot be opened or written, is damaged, or is no store of this package."""


class VersionError(StoreError):
    """A version's state is not kept, damaged, or of another model; the store itself is well."""


class NotTakenError(StoreError):
    """A label that may not be on disk. Report it again: it counts once."""


class BusyError(DengineError, RuntimeError):
    """A server that is overloaded or is closing. The cell should verify the part."""


class ExportError(DengineError, RuntimeError):
    """A model that cannot be exported, or an exported file that must not be used."""


class OutputError(DengineError, RuntimeError):
    """A file that cannot be written, or that must not be overwritten."""


class CellError(DengineError, RuntimeError):
    """A robot cell that cannot be reached, does not respond in time, or reports a failure."""
