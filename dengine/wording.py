"""What errors and screens may say of a value: so much of it as a line holds, and never a password."""

from __future__ import annotations

import re
import reprlib
from collections.abc import Iterable
from typing import Any

HIDDEN = "***"
# Up to the last @: a password may hold one that is not escaped, or a blank. A path writes // as /.
URL = re.compile(r"(\w[\w+.-]*:/{1,2}[^\s:/@'\"]*):(\S*|[^\n'\"]*)@")
NAMED = re.compile(r"\b(password|passwd|sslpassword)=[^&\s'\"]+", re.IGNORECASE)  # in a URL's query, or of libpq
SHORT = reprlib.Repr()
SHORT.maxstring = SHORT.maxother = SHORT.maxlong = 60


def without_password(text: str) -> str:
    """A text with *** in the place of every password in a database URL: `scheme://user:***@host`, `password=***`."""
    return NAMED.sub(rf"\1={HIDDEN}", URL.sub(rf"\1:{HIDDEN}@", text))


def shortened(value: Any) -> str:
    """A value as `repr` shows it, at most some 60 characters of it: an error must not hold a megabyte."""
    try:
        return SHORT.repr(value)
    except ValueError:  # an integer of more digits than Python prints
        return f"a number of {value.bit_length()} bits" if isinstance(value, int) else f"a {type(value).__name__}"


def listed(names: Iterable[Any]) -> str:
    """The first few of some names, and how many more there are."""
    names = list(names)
    few = ", ".join(str(name)[:100] for name in names[:8])
    return f"{few} and {len(names) - 8} more" if len(names) > 8 else few
