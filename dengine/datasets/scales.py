"""Factors beside samples that are counts of a converter: `coefficient_multiply`, `Scale factor`.

Readers find them by their names, with `stated_factors`; `scale_of` tells which one a channel has.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import listed
from . import units

if TYPE_CHECKING:
    import pandas as pd

# What is multiplied, and what is divided, by the number; in lower case, without blanks and marks.
TIMES = (
    *("coefficient", "coefficientmultiply", "coefficientmultiplier", "coeff", "coef", "multiplier"),
    *("scale", "scalefactor", "scaling", "scalingfactor", "factor", "conversionfactor", "slope"),
    *("calibrationfactor", "lsb", "lsbsize", "increment", "mult", "ymult", "faktor"),
    *("skalierung", "skalierungsfaktor", "skalenfaktor", "umrechnungsfaktor"),
)
OVER = ("coefficientdivide", "coefficientdivisor", "divisor", "divider", "scaledivisor", "teiler")
ADDED = ("addoffset", "intercept")
PER = r"(?:per|pro)(?:counts?|digits?|lsb|bits?|ticks?|steps?)"
TIMES_PER = re.compile(rf"\w+{PER}")  # Nm per count
OVER_PER = re.compile(r"(?:counts?|digits?|lsb|bits?|ticks?)(?:per|pro)\w+")
# Words of names that may tell of a scale, in which way is not known.
UNSURE = re.compile(
    r"gain|sensitivity|calibration|resolution|coefficient|multiplier|divisor|factor|faktor|scale"
    r"|scaling|offset|auflösung|lsb|exponent|decimals|range|empfindlichkeit|verstärkung"
    r"|messbereich|skalierung|kennwert",
    re.IGNORECASE,
)
# Words that a name may have beside those of a factor: of any channel, and of some channels.
OF_ANY = {"sample", "samples", "trace", "signal", "raw", "data", "curve", "value", "values", "y"}
OF_ANY |= {"adc", "count", "counts", "channel", "messwert", "messwerte", "kurve"}
OF_SOME = {"torque", "drehmoment", "moment", "force", "kraft", "load", "angle", "winkel", "current"}
OF_SOME |= {"strom", "way", "weg", "stroke", "position", "pos", "pressure", "druck", "x", "time"}
COUNTS = ("counts", "digits")  # units of a converter
MEASURED = {"torque", "drehmoment", "moment", "force", "kraft", "load"}  # may name any channel
# A line above a header: Scale factor: 0.0122, Faktor;0,0122;N
LINE = re.compile(
    r"[#%\s\"']*(?P<name>[^\W\d][^\d:;=,|\t]*?)[\"'\s]*(?P<mark>:?[:;=,|\t])[\s\"']*"
    r"(?P<number>[-+]?(?:\d+(?:[.,]\d+)?|\.\d+)(?:e[-+]?\d+)?)(?P<rest>(?![\d.,:/]).*)?",
    re.IGNORECASE,
)
# Between a value and the next name in a line: Force Units:,N,Counts per Unit Force:,1000000
NEXT_NAME = re.compile(r"[,;\t](?=[^,;:\t\n]+:[,;\t])")


def words_of(name: str) -> list[str]:
    """Return the words in a name without its unit, `force` and `factor` of `forceFactor_N`."""
    return units.words_in(units.split(re.sub(r"\s*[\[(].*", "", name))[0])


def words_of_channel(channel: str) -> set[str]:
    """Return the words in a channel's name, with those of its quantity: of `force` for Fz."""
    words = set(words_of(channel))
    if units.TORQUE_NAME.fullmatch(channel) or units.TORQUE_AXIS.fullmatch(channel):
        return words | {"torque", "drehmoment", "moment"}
    return words | {"force", "kraft", "load"} if units.FORCE_NAME.fullmatch(channel) else words


def may_scale(name: str) -> bool:
    """Return whether a name may be that of a factor or an offset of samples."""
    return UNSURE.search(name) is not None or operation(name, "", 1) != ""


def stated_factors(stated: Mapping[str, Any]) -> dict[str, float]:
    """Return the numbers among values whose names may be those of factors or offsets."""
    result = dict[str, float]()
    for name in filter(may_scale, stated):
        with suppress(TypeError, ValueError):
            result[name] = float(stated[name])
    return result


def factors_in_columns(rows: pd.DataFrame) -> dict[str, float]:
    """Return what `stated_factors` finds in the columns that have one value in all rows."""
    cells = {str(name): cells for name, cells in rows.items() if may_scale(str(name))}
    return stated_factors({name: x.iloc[0] for name, x in cells.items() if (x == x.iloc[0]).all()})


def lines_of_factors(text: str) -> dict[str, float]:
    """Return what `stated_factors` finds in the lines above a header."""
    stated = dict[str, str]()
    lines = NEXT_NAME.sub("\n", text).splitlines()
    for match in filter(None, map(LINE.fullmatch, lines)):
        number = match["number"]
        # Other numbers behind it are those of other channels, or a comma stands between the two.
        is_single = re.search(r"[;,|\t]\s*[-+.\d]", match["rest"] or "") is None
        if is_single and not ("," in number and match["mark"][-1] == ","):
            stated.setdefault(match["name"].strip(), number.replace(",", "."))
    return stated_factors(stated)


def _is_of_another(name: str, channel: str) -> bool:
    """Return whether a name has the word of a quantity that is not that of a channel."""
    of_channel = words_of_channel(channel)
    others = set(words_of(name)) & OF_SOME - of_channel
    return bool(others and (others - MEASURED or of_channel & OF_SOME))


def operation(name: str, channel: str, n_channels: int) -> str:
    """Return how a factor or offset of this name converts raw counts: "*", "/", "+" or "".

    "" also if it names another channel or, with several channels, not this one.
    """
    of_channel = words_of_channel(channel)
    is_named = not of_channel.isdisjoint(words_of(name))
    if _is_of_another(name, channel) or (n_channels > 1 and not is_named):
        return ""
    last = name.rpartition(".")[2]
    letters = re.sub(r"[\W\d_]", "", last.lower())
    beside = OF_ANY | OF_SOME | of_channel
    core = "".join(word for word in words_of(last) if word not in beside)
    if core in TIMES or TIMES_PER.fullmatch(letters):
        return "*"
    if core in OVER or OVER_PER.fullmatch(letters):
        return "/"
    return "+" if core in ADDED else ""


class Scale(NamedTuple):
    """What makes a quantity of the counts of a channel.

    note : str
        What is applied, or what may be a scale but is not.
    factors, offsets : array of float, shape (n,)
        Of each recording: counts times factor, plus offset. A factor is NaN where none is stated;
        both are empty if none is applied.
    """

    note: str
    factors: NDArray[np.float64] = np.empty(0)
    offsets: NDArray[np.float64] = np.empty(0)


def scale_of(
    stated: Sequence[Mapping[str, float]], channel: str, n_channels: int, is_whole: bool
) -> Scale | None:
    """Return the scale of a channel, or only a note on one that is not applied; None for neither.

    A factor is applied if its name is known to `operation`, and it is the only one or the only one
    that names the channel. The channel's name must state no unit other than counts, and all samples
    must be whole numbers (`is_whole`).

    stated : `stated_factors` of each recording.
    """
    import pandas as pd

    frame = pd.DataFrame(list(stated), dtype=float)
    frame = frame[[name for name in frame if not _is_of_another(name, channel)]]
    texts = {name: _with_range(name, cells.min(), cells.max()) for name, cells in frame.items()}
    names = [name for name in frame if operation(name, channel, n_channels) in ("*", "/")]
    named = [name for name in names if set(words_of(name)) & words_of_channel(channel) - OF_ANY]
    if len(named or names) != 1:
        differing = [name for name in frame if frame[name].min() < frame[name].max()]
        unsure = [texts[name] for name in dict.fromkeys([*names, *differing])]
        do = "which is not done: convert them if so"
        note = f"{listed(unsure)} may scale the whole numbers of {channel}, {do}"
        return Scale(note) if is_whole and unsure else None
    name = (named or names)[0]
    values = frame[name].to_numpy()
    added = [other for other in frame if operation(other, channel, n_channels) == "+"]
    if (values == 1).all() and not frame[added].any(axis=None):
        return None
    if not is_whole or units.split(channel)[1] not in ("", *COUNTS):
        why = "have a unit, by its name" if is_whole else "are no whole numbers"
        return Scale(f"{texts[name]} is not applied, for the samples of {channel} {why}")
    word = "times"
    if operation(name, channel, n_channels) == "/":
        word = "over"
        with np.errstate(divide="ignore"):
            values = 1 / values
    parts = [f"{channel} is in counts, {word} {texts[name]}", *(texts[other] for other in added)]
    note = ", plus ".join(parts)
    for other in frame.columns.difference(added):
        if "offset" in words_of(other) and frame[other].any():
            note += f"; {texts[other]} is not applied: subtract or add it"
    return Scale(note, values, frame[added].sum(axis=1).to_numpy())


def _with_range(name: str, low: float, high: float) -> str:
    """Return a name with the range of its values: `scale (0.001 to 0.004)`."""
    return f"{name} ({low:g})" if low == high else f"{name} ({low:g} to {high:g})"
