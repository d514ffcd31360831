"""Units of measurement: which stand for the same quantity, and the factor from one to another."""

import re

from ..errors import DataError

# Each unit with its quantity and the factor to that quantity's first unit.
QUANTITIES = {
    "force": {"N": 1.0, "Newton": 1.0, "kgf": 9.80665, "kp": 9.80665, "gf": 9.80665e-3}
    | {"lbf": 4.4482216152605, "lb": 4.4482216152605, "ozf": 0.27801385095378},
    "torque": {"Nm": 1.0, "N·m": 1.0, "N*m": 1.0, "N.m": 1.0, "Ncm": 0.01, "Nmm": 1e-3}
    | {"kgf.cm": 0.0980665, "kgf.m": 9.80665, "lbf.in": 0.1129848290276167}
    | {"lbf.ft": 1.3558179483314, "in.lbf": 0.1129848290276167, "ft.lbf": 1.3558179483314},
    "length": {"m": 1.0, "in": 0.0254, "inch": 0.0254, "ft": 0.3048},
    "angle": {"rad": 1.0, "deg": 0.017453292519943295, "°": 0.017453292519943295}
    | {"Grad": 0.017453292519943295},
    "pressure": {"Pa": 1.0, "bar": 1e5, "psi": 6894.757293168},
    "speed": {"m/s": 1.0, "mm/s": 1e-3, "mm/min": 1e-3 / 60},
    "voltage": {"V": 1.0},
    "current": {"A": 1.0},
    "mass": {"g": 1.0},
}
PREFIXES = {"M": 1e6, "k": 1e3, "da": 10.0, "c": 1e-2, "m": 1e-3, "u": 1e-6, "µ": 1e-6, "μ": 1e-6}
PREFIXED = {"N", "Nm", "m", "Pa", "bar", "V", "A", "g", "rad"}
MARKS = "[](){} "
OTHERS = {"%", "-", "°C", "1", "rpm", "1/min", "mV/V", "counts", "W", "Hz"}


def bare(unit: str) -> str:
    """Return a unit without brackets around it."""
    return unit.strip(MARKS)


def quantity_of(unit: str) -> tuple[str, float] | None:
    """Return the quantity of a unit, and the factor to its first unit; None for an unknown one."""
    for quantity, units in QUANTITIES.items():
        if unit in units:
            return quantity, units[unit]
        for prefix, factor in PREFIXES.items():
            base = unit.removeprefix(prefix)
            if base != unit and base in PREFIXED and base in units:
                return quantity, factor * units[base]
    return None


def is_unit(text: str) -> bool:
    """Return whether a text is a unit of this table, with or without brackets."""
    return bare(text) in OTHERS or quantity_of(bare(text)) is not None


def conversion(unit: str, wanted: str) -> float:
    """Return the factor from one unit to another; 1 if they are the same or one is not stated.

    Raises DataError if they are of different quantities, or one is unknown.
    """
    unit, wanted = bare(unit), bare(wanted)
    if unit == wanted or not unit or not wanted:
        return 1.0
    of_unit, of_wanted = quantity_of(unit), quantity_of(wanted)
    if of_unit is None or of_wanted is None or of_unit[0] != of_wanted[0]:
        raise DataError(f"Expected the unit {wanted}, or one that converts to it, got {unit}")
    return of_unit[1] / of_wanted[1]


def unit_in(name: str) -> str:
    """Return the unit in a column's name, like that of `Kraft [N]`, `t/ms` or `F_kN`; "" if none."""
    match = re.search(r"(?:[\[({<]|\bin |[/_])\s*([^\[\](){}<>/_ ]+)\s*[\])}>]?$", name)
    return match[1] if match and is_unit(match[1]) else ""
