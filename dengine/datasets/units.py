"""Units of measurement: which stand for the same quantity, the factor from one to another, and the
units of times.

They are listed in `dengine/data/units.toml`.
"""

import re
import tomllib
from importlib.resources import files

TABLE = tomllib.loads((files("dengine") / "data" / "units.toml").read_text("utf-8"))
OTHERS = TABLE.pop("others")["units"]
TIME_UNITS: dict[str, float] = TABLE.pop("time")  # in seconds
# Each unit with its quantity, like "force", and the factor to that quantity's first, like N. A unit
# that is converted to no other, like `%` or `Hz`, is not here.
UNITS: dict[str, tuple[str, float]] = {
    unit: (name, factor) for name, units in TABLE.items() for unit, factor in units.items()
}
# A unit, also behind a number, as in `2 ms`.
QUANTITY = re.compile(rf"(\d[\d.,]* ?)?(k?Hz|{'|'.join(map(re.escape, UNITS))})")
MARKS = "[](){} "


def bare(unit: str) -> str:
    """Return a unit without the brackets `[] () {}` and blanks around it."""
    return unit.strip(MARKS)


def is_load(unit: str) -> bool:
    """Return whether a unit, without brackets, is one of force or torque."""
    return UNITS.get(unit, ("",))[0] in ("force", "torque")


def is_unit(text: str) -> bool:
    """Return whether a text is a unit of samples, with or without brackets.

    Units that are converted to no other, like `%`, count, those of times do not. Capital and small
    letters differ.
    """
    return bare(text) in OTHERS or bare(text) in UNITS


def conversion(unit: str, wanted: str) -> float | None:
    """Return the factor from a unit to the unit `wanted`; 1 if they are the same or either is "".

    Brackets around a unit are ignored. None if the units are of different quantities, like force
    and length, or if they differ and one is unknown or is converted to no other, like `rpm`.
    """
    units = (bare(unit), bare(wanted))
    if not all(units):
        return 1.0
    (quantity, factor), (other, wanted_factor) = (
        UNITS.get(name, (f"unknown {name}", 1.0)) for name in units
    )
    return factor / wanted_factor if quantity == other else None


def unit_in(name: str) -> str:
    """Return the unit at the end of a column's name, as in `Kraft [N]` or `F_kN`; "" if none.

    It must be a unit of samples (`is_unit`), in brackets, or behind `in`, `/`, `_` or `..`, and is
    returned without them; a point or `_` behind it (`Force..N.`, `Force_N_`) is left out. What is
    in brackets or behind `in` counts as a whole: `Force [N/mm]` has none. Behind `/` or `_`
    neither `in` is one (`Force_in` may be an input) nor a single character but N (`Fz_W` is a force
    in world axes).
    """
    match = re.search(r"(?:[\[({<]|\bin )\s*([^\[\](){}<>_]+?)\s*[\])}>_.]?$", name) or re.search(
        r"(?:\.\.|[/_](?!(?:[^N]|in)[_.]?$))\s*([^\[\](){}<>/_ ]+?)[_.]?$", name
    )
    return match[1] if match and is_unit(match[1]) else ""
