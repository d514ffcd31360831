"""Units as headers write them, `FZ [kN]`, `F/kN` or `FZ_kN`, and the factor between two of them."""

from __future__ import annotations

import re

PREFIXES = {
    "G": 1e9,
    "M": 1e6,
    "k": 1e3,
    "da": 1e1,
    "d": 1e-1,
    "c": 1e-2,
    "m": 1e-3,
    "u": 1e-6,
    "µ": 1e-6,
    "μ": 1e-6,
    "n": 1e-9,
    "": 1.0,
}
# What a prefix may stand before, with the dimension and the factor; and what stands alone.
BASES = {
    **dict.fromkeys(("N", "Newton", "newton", "Newtons"), ("N", 1.0)),
    **dict.fromkeys(("Nm", "N·m", "N*m", "N.m", "N m"), ("Nm", 1.0)),
    "Nmm": ("Nm", 1e-3),
    "N·mm": ("Nm", 1e-3),
    "Ncm": ("Nm", 1e-2),
    "m": ("m", 1.0),
    "s": ("s", 1.0),
    "V": ("V", 1.0),
    "A": ("A", 1.0),
    "g": ("g", 1.0),
    "Pa": ("Pa", 1.0),
    "bar": ("Pa", 1e5),
    "Hz": ("Hz", 1.0),
    "rad": ("rad", 1.0),
    **dict.fromkeys(("sec", "second", "seconds", "Sek.", "Sekunden"), ("s", 1.0)),
    "W": ("W", 1.0),
    "K": ("K", 1.0),
}
ALONE = (
    "°",
    "deg",
    "°C",
    "%",
    "lbf",
    "lb",
    "kgf",
    "kp",
    "counts",
    "digits",
    "a.u.",
    "in",
    "inch",
    "ft",
    "psi",
    "mV/V",
    "V/V",
)
CLOSED = re.compile(r"(?P<name>.*?)\s*[\[({<]\s*(?P<unit>[^\[\](){}<>]*?)\s*[\])}>]\s*")  # FZ [kN]
SLASHED = re.compile(r"(?P<name>.*\S)\s*/\s*(?P<unit>\S+)|(?P<other>.*\S) in (?P<such>\S+)")  # F/kN, F in kN
ENDING = re.compile(r"(?P<name>.*[^_. -])[_. -]+(?P<unit>[A-Za-zµμ·]+)")  # FZ_kN
LEADING = re.compile(r"^\s*[#%]+\s*")  # of a line that another program takes for a comment


def parse(unit: str) -> tuple[str, float] | None:
    """A unit's dimension and its factor, ("N", 1000.0) of kN; None for what is no unit."""
    if unit in ALONE:
        return unit, 1.0
    for base in sorted(BASES, key=len, reverse=True):
        prefix = unit.removesuffix(base)
        if unit.endswith(base) and prefix in PREFIXES:
            dimension, factor = BASES[base]
            return dimension, PREFIXES[prefix] * factor
    return None


def factor(unit: str, other: str) -> float | None:
    """What turns numbers in one unit into those in another; None where nothing does."""
    if unit == other:
        return 1.0
    one = parse(unit)
    two = parse(other)
    return None if one is None or two is None or one[0] != two[0] else float(f"{one[1] / two[1]:.12g}")


def split(name: str) -> tuple[str, str]:
    """A column's name without its unit, and the unit; "" where it says none."""
    plain = LEADING.sub("", name.strip())
    if match := CLOSED.fullmatch(plain):
        return (match["name"], match["unit"]) if parse(match["unit"]) else (plain, "")
    if match := SLASHED.fullmatch(plain):
        before = match["name"] or match["other"]
        unit = match["unit"] or match["such"]
        return (before, unit) if parse(unit) else (plain, "")
    match = ENDING.fullmatch(plain)
    unit = match["unit"] if match else ""
    # One letter is more often an axis or an index, as in v_s, than a unit; N is one. `pos_in` is no inch.
    is_unit = (len(unit) > 1 or unit == "N") and unit not in ALONE and parse(unit)
    return (match["name"], unit) if match and is_unit else (plain, "")
