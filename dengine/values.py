"""What a setting's value is, whatever type it came as: True is no number, and 10**400 is no float."""

from __future__ import annotations

from numbers import Integral, Real
from typing import Any


def is_whole(value: Any, least: int, most: int) -> bool:
    """Whether it is an integer, Python's or NumPy's, from `least` to `most`."""
    return isinstance(value, Integral) and not isinstance(value, bool) and least <= int(value) <= most


def is_number(value: Any) -> bool:
    """Whether it is a real number that a float can hold, an infinity or a NaN among them: no range holds the latter."""
    if not isinstance(value, Real) or isinstance(value, bool):
        return False
    try:
        float(value)
    except OverflowError:
        return False
    return True
