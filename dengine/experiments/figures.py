"""Pictures of replays and runs, as matplotlib figures that are saved and forgotten.

    save(curves({"conv": replays}), "out/curves.png")

No pyplot: its global state would leak figures into a user's notebook. Colours: Okabe and Ito (2008), distinct to all eyes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..records import Action
from .live import RunLog
from .replay import Replay

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
BLUE, RED, GREEN, PINK, SKY, ORANGE = COLOURS
GREY = "#6E6E6E"
WINDOW = 300  # cycles, the paper's
ACTION_MARKS = {  # drawn in this order, so that the few certain ones lie on top
    Action.VERIFY: ("verify", GREY, ".", 14),
    Action.ACCEPT: ("accept", BLUE, "o", 26),
    Action.REJECT: ("reject", RED, "X", 30),
}
TRUTH_MARKS = {True: ("good part", BLUE, "o", 22), False: ("bad part", RED, "X", 26)}


def sliding_sum(values: NDArray[Any], window: int) -> Floats:
    """(..., n) -> (..., n): sum over the last `window` values, over all so far where there are fewer."""
    total = np.cumsum(np.asarray(values, dtype=np.float64), axis=-1)
    out = total.copy()
    out[..., window:] -= total[..., :-window]
    return out


def window_curves(replays: Sequence[Replay], window: int = WINDOW) -> dict[str, Floats]:
    """What the paper plots, in percent, (n,) each, over a sliding window and all replays, which must be equally long.

    certain, false_positive, false_negative : of all cycles in the window.
    precision : of the accepted parts in the windows of all replays together; NaN where none was accepted.
    certain_low, certain_high : 10th and 90th percentile over the replays.
    """
    action, truth = np.stack([r.action for r in replays]), np.stack([r.truth for r in replays])
    accept, reject = action == Action.ACCEPT, action == Action.REJECT
    seen = sliding_sum(np.ones(action.shape[1]), window)
    accepted, certain = sliding_sum(accept, window), sliding_sum(accept | reject, window) / seen
    false_positive, false_negative = sliding_sum(accept & ~truth, window), sliding_sum(reject & truth, window)
    with np.errstate(invalid="ignore"):
        precision = 1.0 - false_positive.sum(axis=0) / accepted.sum(axis=0)
    curves = {
        "certain": certain.mean(axis=0),
        "certain_low": np.quantile(certain, 0.1, axis=0),
        "certain_high": np.quantile(certain, 0.9, axis=0),
        "precision": precision,
        "false_positive": (false_positive / seen).mean(axis=0),
        "false_negative": (false_negative / seen).mean(axis=0),
    }
    return {name: 100.0 * values for name, values in curves.items()}


def curves(by_recipe: Mapping[str, Sequence[Replay]], title: str = "", window: int = WINDOW) -> Figure:
    """The paper's two-part curve, a colour a recipe: certain and precision above, errors below."""
    figure, (top, bottom) = _axes(2, (9.0, 7.0), heights=(3, 2))
    length = max(len(r.action) for replays in by_recipe.values() for r in replays)
    window = min(window, max(1, length // 3))
    for colour, (name, replays) in zip(cycle(COLOURS), by_recipe.items(), strict=False):
        _draw_curves(top, bottom, window_curves(replays, window), colour, name if len(by_recipe) > 1 else "")
    _draw_tolerance(top, bottom, {r.recipe.policy.lower_bound for replays in by_recipe.values() for r in replays})
    top.set(ylim=(0, 102), ylabel="share [%]")
    bottom.set(ylim=(0, None), xlabel=f"cycle (end of a window of {window})", ylabel="errors [% of cycles]")
    figure.suptitle(title)
    _legend(top)
    _legend(bottom)
    return figure


def _draw_curves(top: Axes, bottom: Axes, lines: dict[str, Floats], colour: str, name: str) -> None:
    x, lead = np.arange(1, len(lines["certain"]) + 1), f"{name}: " if name else ""
    top.fill_between(x, lines["certain_low"], lines["certain_high"], color=colour, alpha=0.15, linewidth=0)
    top.plot(x, lines["certain"], color=colour, label=f"{lead}certain, of all cycles")
    top.plot(x, lines["precision"], color=colour, linestyle="--", label=f"{lead}precision, of accepted parts")
    bottom.plot(x, lines["false_positive"], color=colour, label=f"{lead}FP, bad part accepted")
    bottom.plot(x, lines["false_negative"], color=colour, linestyle="--", label=f"{lead}FN, good part rejected")


def _draw_tolerance(top: Axes, bottom: Axes, lower_bounds: set[float]) -> None:
    for bound in sorted(lower_bounds):
        top.axhline(100 * bound, color="black", linestyle=":", label=f"LB = {100 * bound:g} %")
        tolerated = 100 * (1 - bound)
        bottom.axhline(tolerated, color="black", linestyle=":", label=f"tolerance 100 - LB = {tolerated:g} %")


def embedding_map(replay: Replay, last: int = WINDOW, title: str = "") -> Figure:
    """Where the newest parts of a replay lie: once by what they were, once by what was decided.

    Only the newest, since each retrain moves the map. The first two dimensions are drawn.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 5.0), layout="constrained")
    left, right = figure.subplots(1, 2, sharex=True, sharey=True)
    z = _plane(replay.position[-last:])
    _scatter(left, z, replay.truth[-last:], TRUTH_MARKS)
    _scatter(right, z, replay.action[-last:], ACTION_MARKS)
    left.set(title="what the parts were", xlabel="embedding 1 [scaled]", ylabel="embedding 2 [scaled]")
    right.set(title="what was decided", xlabel="embedding 1 [scaled]")
    figure.suptitle(title)
    return figure


def _plane(positions: Floats) -> Floats:
    """(n, d) -> (n, 2): zeros where a reducer has but one dimension."""
    return np.hstack([positions, np.zeros_like(positions[:, :1])])[:, :2]


def _scatter(axes: Axes, z: Floats, kinds: NDArray[Any], marks: Mapping[Any, tuple[str, str, str, int]]) -> None:
    known = np.isfinite(z).all(axis=1)
    for kind, (name, colour, marker, size) in marks.items():
        points = z[known & (kinds == kind)]
        look: dict[str, Any] = {"color": colour, "marker": marker, "s": size, "alpha": 0.7, "linewidths": 0}
        axes.scatter(points[:, 0], points[:, 1], label=f"{name} ({len(points)})", **look)
    if not known.any():
        axes.text(0.5, 0.5, "no trace was embedded yet", transform=axes.transAxes, ha="center", va="center")
    _plain(axes)
    axes.legend(loc="best", frameon=True, framealpha=0.9)


def run_picture(log: RunLog, title: str = "", window: int = 100) -> Figure:
    """A live run: verified share, errors so far and, with a clock, parts an hour."""
    from matplotlib.ticker import MaxNLocator

    window = min(window, max(1, len(log) // 3))
    figure, axes = _axes(2 if log.clock_s is None else 3, (9.0, 6.0 if log.clock_s is None else 8.5))
    x = np.arange(1, len(log) + 1)
    seen = sliding_sum(np.ones(len(log)), window)
    axes[0].plot(x, 100 * sliding_sum(log.verified, window) / seen, color=BLUE, label="verified")
    axes[0].set(ylim=(0, 104), ylabel=f"verified, last {window} [%]")
    axes[1].step(x, np.cumsum(log.false_positive), color=RED, where="post", label="bad part accepted (FP)")
    axes[1].step(
        x, np.cumsum(log.false_negative), color=GREEN, where="post", linestyle="--", label="good part rejected (FN)"
    )
    axes[1].set(ylabel="errors so far [parts]", ylim=(0, 1 + 1.1 * max(log.false_positive.sum(), log.false_negative.sum())))
    axes[1].yaxis.set_major_locator(MaxNLocator(nbins=6, integer=True))
    _legend(axes[1])
    if log.clock_s is not None:
        _draw_rate(axes[2], log, log.clock_s, window)
    axes[-1].set(xlabel="cycle")
    figure.suptitle(title)
    return figure


def _draw_rate(axes: Axes, log: RunLog, clock_s: Floats, window: int) -> None:
    x, took = np.arange(1, len(log) + 1), np.diff(clock_s, prepend=0.0)
    rate = 3600 * sliding_sum(log.finished, window) / sliding_sum(took, window)
    settled = x >= window  # a rate over few cycles is mostly luck
    axes.plot(x[settled], rate[settled], color=BLUE, label="this run")
    if log.verified.any():
        # The same parts, each at the time that a verified one took: every good one goes on, and nothing stops.
        seconds = float(np.median(took[log.verified])) * sliding_sum(np.ones(len(x)), window)
        always = 3600 * sliding_sum(log.truth == 1.0, window) / seconds
        axes.plot(x[settled], always[settled], color=GREY, linestyle=":", label="had every part been verified")
    axes.set(ylabel=f"good parts/h, last {window}")
    _legend(axes)


def save(figure: Figure, path: str | Path, dpi: int = 120) -> Path:
    """Write a figure as its suffix says; makes the folder."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=dpi)
    return path


def _axes(rows: int, size: tuple[float, float], heights: Sequence[float] | None = None) -> tuple[Figure, list[Axes]]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    axes = list(figure.subplots(rows, 1, sharex=True, height_ratios=heights))
    for each in axes:
        _plain(each)
    return figure, axes


def _plain(axes: Axes) -> None:
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)


def _legend(axes: Axes, columns: int = 3) -> None:
    # Above the axes: inside, it would lie on one curve or another.
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=columns, frameon=False, fontsize=9, borderaxespad=0.2)
