"""Units as headers of recordings write them, and columns by their names without unit.

`split` takes the unit off a name, `FZ [kN]`, `F/kN` or `FZ_kN`; `factor` converts between two
units; `seconds_in` reads the units of clocks; `find_columns` finds a column as a user writes it.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Sequence
from importlib.resources import files
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas as pd

TABLES = tomllib.loads((files("dengine") / "data" / "units.toml").read_text("utf-8"))
PREFIXES: dict[str, float] = TABLES["prefixes"]
BASES: dict[str, tuple[str, float]] = TABLES["bases"]  # with their dimension and factor
SECONDS: dict[str, float] = TABLES["seconds"]
ALONE: list[str] = TABLES["alone"]
FORCES: list[str] = TABLES["forces"]
USUAL_PREFIXES = ("", "k", "m", "M")  # by which a unit is known that is spelled in another case
BRACKETED = re.compile(
    r"(?P<name>.*?)\s*[\[({<]\s*(?P<unit>[^\[\](){}<>]*?)\s*[\])}>]\s*"
)  # FZ [kN]
SLASHED = re.compile(
    r"(?P<name>.*\S)\s*/\s*(?P<unit>\S+)|(?P<other>.*\S) in (?P<such>\S+)"
)  # F/kN, F in kN
ENDING = re.compile(r"(?P<name>.*[^_. -])[_. -]+(?P<unit>[A-Za-zµμ·]+)")  # FZ_kN, force_kn
JOINED = re.compile(r"(?P<name>.*?[a-ln-z])(?P<unit>(?:[kM]?N|Kn|KN)(?:[cm]?m)?)")  # ForcekN
# A line above a header that states a unit: # Force unit: kN, or Einheit Kraft;kN.
UNIT_LINE = re.compile(
    r"(?P<before>[\w -]*?)(?<![^\W_])(?:units?|einheit(?:en)?|unité|unidad|unità)(?![^\W_])"
    r"(?P<behind>[\w ]*)"
    r"[:=;,\t]\s*[\"'\[(]*(?P<unit>[^\s\"';,\])]+)",
    re.IGNORECASE,
)
FORCE_NAME = re.compile(r"f[xyz]?([_ ].*)?|.*(force|kraft|last|load).*", re.IGNORECASE)
# Of a torque whose unit nobody knows, and of one that robots and sensors give in N·m: MuZ_Base.
TORQUE_NAME = re.compile(r"m[d]?([_ ].*)?|.*(torque|moment|couple|torsion).*", re.IGNORECASE)
TORQUE_AXIS = re.compile(r"(mu?|t)[xyz](_.*)?", re.IGNORECASE)
# Axes of a robot's or a sensor's force, which is in newtons: FZ_Base, wrench.force.z.
FORCE_AXIS = re.compile(r"f[xyz]([_ ]base)?|.*\bforce[._][xyz]|.*tcp_force(_\d)?", re.IGNORECASE)
# Words of a force's name that may be its unit, beside those in `SPELLINGS`.
MAYBE_UNIT = re.compile(
    r"%|V|g|(?i:percent|pct|.*(newton|pound|kilogram|gram)s?)|.*([a-z]m|[A-Z]k)N"
)
# Dimensions that a sensor of force has none of.
NO_FORCE = ("m", "s", "Hz", "rad", "W", "K", "Nm", "°", "deg", "°C", "in", "inch", "ft")
# A column that names the signal of each row, as InfluxDB's _field.
FIELD_COLUMN = re.compile(
    r"_?field|(signal|channel|var(iable)?|kanal|quantity)([ _]?name)?", re.IGNORECASE
)
COMMENT_MARK = re.compile(r"^\s*[#%]+\s*")  # by which other programs know a comment


def parse(unit: str) -> tuple[str, float] | None:
    """Return the dimension of a unit and its factor, ("N", 1000.0) for kN; None if it is none.

    A unit in `ALONE`, which is not converted, is a dimension of its own.
    """
    if unit in ALONE:
        return unit, 1.0
    for base in sorted(BASES, key=len, reverse=True):
        prefix = unit.removesuffix(base)
        if unit.endswith(base) and prefix in PREFIXES:
            dimension, base_factor = BASES[base]
            return dimension, PREFIXES[prefix] * base_factor
    return None


SPELLINGS = dict[str, dict[str, None]]()  # the units that a text may mean, in lower case
for _base, (_dimension, _) in BASES.items():
    for _prefix in PREFIXES if _dimension == "Nm" else USUAL_PREFIXES:
        SPELLINGS.setdefault(f"{_prefix}{_base}".lower(), {})[f"{_prefix}{_base}"] = None
for _unit in ("daN", *ALONE):
    SPELLINGS.setdefault(_unit.lower(), {})[_unit] = None


def spelling(unit: str) -> str:
    """Return a unit as it is usually spelled: kN for KN; the same text if it is no unit.

    A unit of one letter, and one that two units could be, as mn of mN and MN, is not changed.
    """
    if len(unit) < 2 or parse(unit) is not None:
        return unit
    alike = list(SPELLINGS.get(unit.lower(), ()))
    return alike[0] if len({parse(name) for name in alike}) == 1 else unit


def stated_in_preamble(text: str, header: Sequence[str], places: Sequence[int]) -> list[str]:
    """Return the unit that the text above a header states for each of some columns; "" for none.

    A line is of the columns that it names; one that names none is of the only column, or a unit of
    force is of those with the name of a force. A line may list the units of all columns, or those
    of all but the clock in the first column, above which the line has its name, as LabVIEW writes.

    places : positions of the columns without a unit that are no clock.
    """
    names = [header[i] for i in places]
    result = [""] * len(names)
    for match in UNIT_LINE.finditer(text):
        is_cell = text[match.end("behind")] in ";,\t"  # the next cell may be empty
        start = match.end("behind") + 1 if is_cell else match.start("unit")
        line = text[start:].partition("\n")[0]
        items = [spelling(item.strip(" \"'[]()")) for item in re.split(r"[,;\t]", line)]
        n_items = max((i for i, item in enumerate(items, start=1) if item), default=0)
        is_behind_name = 0 not in places and seconds_in(items[0]) is None
        are_units = sum(map(bool, items)) > 1 and all(parse(item) for item in filter(None, items))
        if is_behind_name and are_units and n_items < len(header):
            items = ["", *items[:n_items]] + [""] * (len(header) - n_items - 1)
        if len(items) == len(header) > 1:
            return [items[i] if parse(items[i]) else "" for i in places]
        unit = spelling(match["unit"])
        if parse(unit) is None or seconds_in(unit) is not None:
            continue
        stated = set(re.findall(r"\w+", f"{match['before']} {match['behind']}".lower()))
        words = [set(re.findall(r"[^\W_]+", name.lower())) for name in names]
        chosen = [i for i, name_words in enumerate(words) if name_words & stated]
        if not chosen and len(names) == 1:
            chosen = [0]
        elif not chosen and factor(unit, "N") is not None:
            chosen = [i for i, name in enumerate(names) if FORCE_NAME.fullmatch(name)]
        for i in chosen:
            result[i] = unit
    return result


def guess(channel: str) -> str:
    """Return the unit in a channel's name, else "N" for a force and "N·m" for a robot's torque.

    "" for any other, as `Torque`, which is often in N·cm, and for a force with a `maybe_unit`.
    """
    if unit := split(channel)[1]:
        return unit
    if TORQUE_AXIS.fullmatch(channel):
        return "N·m"
    return "N" if _quantity(channel) == "N" and not maybe_unit(channel) else ""


def maybe_unit(channel: str) -> str:
    """Return what may be a unit, other than N, in the name of a force that states none; or "".

    It is "kN" for kN_force, and "mN or MN" for FORCE_MN.
    """
    if _quantity(channel) != "N" or split(channel)[1]:
        return ""
    for word in re.findall(r"%|[^\W\d_]+", re.sub(r"(?<=[a-z])(?=[A-Z][a-z])", " ", channel)):
        meant = [] if len(word) < 2 else list(SPELLINGS.get(word.lower(), ()))
        parsed = {parse(unit) for unit in meant}
        if any(item and item[0] not in NO_FORCE and item != ("N", 1.0) for item in parsed):
            return " or ".join(meant[: len(parsed)])
        if MAYBE_UNIT.fullmatch(word) and not meant:
            return str(word)
    return ""


def _quantity(channel: str) -> str:
    """Return the dimension of a channel by its name: "Nm" for a torque, "N" for a force, or ""."""
    if TORQUE_NAME.fullmatch(channel) or TORQUE_AXIS.fullmatch(channel):
        return "Nm"
    return "N" if FORCE_NAME.fullmatch(channel) else ""


def is_force(name: str) -> bool:
    """Return whether a name has a word for a force or a torque, in one of several languages."""
    return any(word in name.lower() for word in FORCES)


def factor(unit: str, other: str) -> float | None:
    """Return the factor that converts numbers in one unit to another; None if there is none.

    It is 1.0 for equal texts, even if they are no units.
    """
    if unit == other:
        return 1.0
    source = parse(unit)
    target = parse(other)
    if source is None or target is None or source[0] != target[0]:
        return None
    return float(f"{source[1] / target[1]:.12g}")


def seconds_in(unit: str) -> float | None:
    """Return the seconds in one unit of a clock, in any case; None for what is no unit of time."""
    return SECONDS.get(unit.lower())


def of_field(frame: pd.DataFrame, n: int = 1) -> str:
    """Return the unit that the names of signals in a column tell, as force_N in `_field`.

    "" for several units, and for several channels, n.
    """
    for column in filter(FIELD_COLUMN.fullmatch, map(str, frame.columns) if n == 1 else ()):
        guesses = set(map(guess, map(str, frame[column].unique())))
        if len(guesses) == 1:
            return guesses.pop()
    return ""


def split(name: str) -> tuple[str, str]:
    """Return the name of a column without its unit and a comment mark before it, and the unit.

    The unit is "" if the name states none that is known.
    """
    plain = COMMENT_MARK.sub("", name.strip())
    if match := BRACKETED.fullmatch(plain):
        unit = _spelling_of(match["name"], match["unit"])
        return (match["name"], unit) if parse(unit) else (plain, "")
    if match := SLASHED.fullmatch(plain):
        before = match["name"] or match["other"]
        unit = _spelling_of(before, match["unit"] or match["such"])
        return (before, unit) if parse(unit) else (plain, "")
    match = ENDING.fullmatch(plain)
    if match is None:
        match = JOINED.fullmatch(plain)
        match = match if match and _quantity(match["name"]) else None
    unit = _unit_at_end(*match.groups()) if match else ""
    return (match["name"], unit) if match and unit else (plain, "")


def _spelling_of(name: str, unit: str) -> str:
    """Return a unit as `spelling` does; nm of a torque is Nm."""
    return "Nm" if unit == "nm" and _quantity(name) == "Nm" else spelling(unit)


def _unit_at_end(name: str, text: str) -> str:
    """Return the unit that stands at the end of a name, behind `name`, in any case; "" for none.

    A unit of the quantity that the name has is preferred: Nm in torque_nm. It is "" for a text that
    may be two units, as MN if all is in capitals. One letter is more often an axis or an index, as
    in v_s, than a unit, except N; the `in` of `pos_in` is no inch, and `F_rad` is radial.
    """
    quantity = _quantity(name)
    alike = {unit: parse(unit) for unit in (text, *SPELLINGS.get(text.lower(), ()))}
    meant = {unit: parsed for unit, parsed in alike.items() if parsed is not None}
    meant = {unit: meant[unit] for unit in meant if meant[unit][0] == quantity} or meant
    is_rate = text == "Hz" and name[-1:].isdigit()  # SR: 400 Hz
    no_units = {"Nm": ALONE, "N": ["rad", "in", "ft"]}.get(quantity, ["in", "ft"])
    if is_rate or text.lower() in no_units or (len(text) < 2 and text != "N"):
        return ""
    if text in meant and not (name + text).isupper():
        return text
    return next(iter(meant)) if len(set(meant.values())) == 1 else ""


def likely_channel(names: Sequence[str]) -> str:
    """Return the channel that users most likely mean, by its name and unit.

    A force or torque by its name comes first, best with such a unit; then another unit than that of
    a position or time; then none; then theirs. Of equals it is the first.
    """

    def score(name: str) -> int:
        """Return 2 for a name of a force, more with such a unit, less with that of another."""
        dimension, _ = parse(split(name)[1]) or ("", 1.0)
        is_named = _quantity(name) != "" or is_force(name)
        is_other = dimension in NO_FORCE and dimension != "Nm"
        return 2 * is_named + (dimension != "") - 4 * is_other

    return max(names, key=score)


def words_in(name: str) -> list[str]:
    """Return the words in a name in lower case, `block` and `no` of `blockNo_1`."""
    return re.findall(r"[^\W\d_]+", re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name).lower())


def find_columns(name: str, columns: Sequence[str]) -> list[int]:
    """Return the positions of the columns that have a name.

    Columns that are written so come first; only without any those in another case, and without
    these those that are alike without their units. The list is empty if no column has it, and
    longer than one if several have.
    """
    bare = split(name)[0].lower()
    for is_same in (
        lambda column: column == name,
        lambda column: column.lower() == name.lower(),
        lambda column: split(column)[0].lower() == bare,
    ):
        places = [i for i, column in enumerate(columns) if is_same(column)]
        if places:
            return places
    return []
