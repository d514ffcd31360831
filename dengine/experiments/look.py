"""How every picture looks: colours, marks, panels, legends; and saving one.

No pyplot: its global state would leak figures into a user's notebook. Colours: Okabe and Ito (2008), distinct to all eyes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import OutputError
from ..outputs import PICTURE, write_output
from ..records import Action

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]

BLUE, RED, GREEN, PINK, SKY, ORANGE = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00"
GREY, BLACK = "#6E6E6E", "#000000"
GOOD, BAD, VERIFIED = BLUE, RED, GREY  # of parts, and of the decisions that call them so
RECIPES = (GREEN, PINK, ORANGE, SKY, BLUE, RED)  # first those that mean nothing else
LIMIT: dict[str, Any] = {"color": BLACK, "linestyle": ":", "linewidth": 1.2}  # a bound, or a moment, that is given
SMALL = 9  # points: legends and notes


@dataclass(frozen=True)
class Mark:
    """How one kind of part is drawn on a map."""

    name: str
    colour: str
    marker: str
    size: int


ACTION_MARKS = {  # drawn in this order, so that the few certain ones lie on top
    Action.VERIFY: Mark("verify", VERIFIED, "o", 9),
    Action.ACCEPT: Mark("accept", GOOD, "o", 26),
    Action.REJECT: Mark("reject", BAD, "X", 30),
}
TRUTH_MARKS = {True: Mark("good part", GOOD, "o", 22), False: Mark("bad part", BAD, "X", 26)}


def sliding_sum(values: NDArray[Any], window: int) -> Floats:
    """(..., n) -> (..., n): sum over the last `window` values, over all so far where there are fewer."""
    total = np.cumsum(np.asarray(values, dtype=np.float64), axis=-1)
    out = total.copy()
    out[..., window:] -= total[..., :-window]
    return out


def panels(rows: int, size: tuple[float, float], heights: Sequence[float] | None = None) -> tuple[Figure, list[Axes]]:
    """A figure of panels one below the other, with one axis of cycles."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    axes = list(figure.subplots(rows, 1, sharex=True, height_ratios=heights))
    for each in axes:
        plain(each)
    return figure, axes


def plain(axes: Axes) -> None:
    """A light grid, and no box."""
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)


def legend_above(axes: Axes, columns: int = 3) -> None:
    """The legend above the axes: inside, it would lie on one curve or another."""
    axes.legend(
        loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=columns, frameon=False, fontsize=SMALL, borderaxespad=0.2
    )


def draw_errors(axes: Axes, false_positive: NDArray[np.bool_], false_negative: NDArray[np.bool_]) -> None:
    """Wrong decisions so far, (n,) each: bad parts accepted, good parts rejected."""
    from matplotlib.ticker import MaxNLocator

    x = np.arange(1, len(false_positive) + 1)
    axes.step(x, np.cumsum(false_positive), "-", where="post", color=BAD, label="bad part accepted (FP)")
    axes.step(x, np.cumsum(false_negative), "--", where="post", color=GOOD, label="good part rejected (FN)")
    axes.yaxis.set_major_locator(MaxNLocator(nbins=6, integer=True))


def draw_verified(
    axes: Axes, verified: NDArray[np.bool_], window: int, colour: str = VERIFIED, label: str = "verified"
) -> None:
    """Share of the parts that were checked, (n,), over the last `window` cycles."""
    x, seen = np.arange(1, len(verified) + 1), sliding_sum(np.ones(len(verified)), window)
    axes.plot(x, 100 * sliding_sum(verified, window) / seen, color=colour, label=label)
    axes.set(ylim=(0, 104))


def save(figure: Figure, path: str | Path, dpi: int = 120, force: bool = False) -> Path:
    """Write a figure as its suffix says; makes the folder. OutputError where the file there is no picture, or `force`."""
    buffer = BytesIO()
    try:
        figure.savefig(buffer, dpi=dpi, format=Path(path).suffix.removeprefix(".") or "png")
    except ValueError as error:
        raise OutputError(f"Cannot draw {path}: {error}; name it .png, .pdf or .svg.") from error
    return write_output(path, buffer.getvalue(), PICTURE, force, make_folder=True)
