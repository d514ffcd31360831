"""Pictures of replays and runs, as matplotlib figures that are saved and forgotten.

    save(curves({"conv": replays}), "out/curves.png")

How they look is said in look.py, the maps of the embedding are drawn in maps.py; both are handed on from here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np

from .live import RunLog
from .look import (
    GREEN,
    LIMIT,
    RECIPES,
    VERIFIED,
    Floats,
    draw_errors,
    draw_verified,
    legend_above,
    panels,
    save,
    sliding_sum,
)
from .maps import embedding_map
from .replay import Replay

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["curves", "embedding_map", "run_picture", "save", "sliding_sum", "window_curves"]

WINDOW = 300  # cycles, the paper's
FEWEST = 20  # parts: a share of fewer jumps by more than five in a hundred with each, and is not drawn
COUNTS = ("accepted", "false_positive", "rejected", "false_negative")


def window_curves(replays: Sequence[Replay], window: int = WINDOW, fewest: int = 1) -> dict[str, Floats]:
    """What the paper plots, in percent, (n,) each, over a sliding window and all replays, which must be equally long.

    certain : of all cycles in the window.  certain_low, certain_high : 10th and 90th percentile over the replays.
    precision, false_positive : of the accepted parts in the windows of all replays together.
    false_negative : of the rejected parts, likewise.  All three NaN where these are fewer than `fewest`.
    """
    accept, reject = np.stack([r.accepted for r in replays]), np.stack([r.rejected for r in replays])
    seen = sliding_sum(np.ones(accept.shape[1]), window)
    certain = sliding_sum(accept | reject, window) / seen
    false_positive = _pooled_share(np.stack([r.false_positive for r in replays]), accept, window, fewest)
    false_negative = _pooled_share(np.stack([r.false_negative for r in replays]), reject, window, fewest)
    curves = {
        "certain": certain.mean(axis=0),
        "certain_low": np.quantile(certain, 0.1, axis=0),
        "certain_high": np.quantile(certain, 0.9, axis=0),
        "precision": 1.0 - false_positive,
        "false_positive": false_positive,
        "false_negative": false_negative,
    }
    return {name: 100.0 * values for name, values in curves.items()}


def _pooled_share(wrong: Any, decided: Any, window: int, fewest: int) -> Floats:
    """(replays, n) bool each -> (n,): share of the decided parts that were wrong, in all replays' windows together."""
    of = sliding_sum(decided.sum(axis=0), window)
    return np.where(of >= fewest, sliding_sum(wrong.sum(axis=0), window) / np.maximum(of, 1.0), np.nan)


def curves(by_recipe: Mapping[str, Sequence[Replay]], title: str = "", window: int = WINDOW) -> Figure:
    """The paper's two-part curve, a colour a recipe: certain and precision above; below the errors of what was decided.

    The tolerance 100 - LB is a share of the accepted parts, so the errors are drawn as shares of what was decided alike.
    """
    wide = max(2, min(len(by_recipe), 4))  # recipes side by side in the legends: a column each, and one for the bound
    figure, (top, bottom) = panels(2, (3.6 + 2.7 * wide, 7.4), heights=(4, 3))
    length = max(len(r) for replays in by_recipe.values() for r in replays)
    window = min(window, max(1, length // 3))
    bounds = {r.recipe.policy.lower_bound for replays in by_recipe.values() for r in replays}
    for colour, (name, replays) in zip(cycle(RECIPES), by_recipe.items(), strict=False):
        _draw_curves(top, bottom, replays, window, colour, f"{name}: " if len(by_recipe) > 1 else "")
    _draw_tolerance(top, bottom, bounds)
    top.set(ylim=(0, 102), ylabel="share [%]")
    # Above the tolerance at least half as much again: whether the errors keep to it is what the panel is there for.
    bottom.set(ylim=(0, max(bottom.get_ylim()[1], 150 * (1 - min(bounds)))), ylabel="wrong [% of accepted, rejected]")
    bottom.set(xlabel=f"cycle (end of a window of {window}; a share of fewer than {FEWEST} parts is not drawn)")
    figure.suptitle(title)
    legend_above(top, columns=wide + 1)
    legend_above(bottom, columns=wide + 1)
    return figure


def _draw_curves(top: Axes, bottom: Axes, replays: Sequence[Replay], window: int, colour: str, lead: str) -> None:
    lines = window_curves(replays, window, FEWEST)
    x = np.arange(1, len(lines["certain"]) + 1)
    top.fill_between(x, lines["certain_low"], lines["certain_high"], color=colour, alpha=0.15, linewidth=0)
    top.plot(x, lines["certain"], color=colour, label=f"{lead}certain, of all cycles")
    top.plot(x, lines["precision"], color=colour, linestyle="--", label=f"{lead}precision, of accepted")
    # The counts beside the names: where too few parts were decided alike for a curve, they still say what went wrong.
    counted = [each.stretch(slice(None)) for each in replays]
    n = {name: sum(each[name] for each in counted) for name in COUNTS}
    bad, good = "{false_positive} bad of {accepted} accepted", "{false_negative} good of {rejected} rejected"
    bottom.plot(x, lines["false_positive"], color=colour, label=lead + bad.format_map(n))
    bottom.plot(x, lines["false_negative"], color=colour, linestyle="--", label=lead + good.format_map(n))


def _draw_tolerance(top: Axes, bottom: Axes, lower_bounds: set[float]) -> None:
    for bound in sorted(lower_bounds):
        top.axhline(100 * bound, label=f"LB = {100 * bound:g} %", **LIMIT)
        tolerated = 100 * (1 - bound)
        bottom.axhline(tolerated, label=f"tolerance 100 - LB = {tolerated:g} %", **LIMIT)


def run_picture(log: RunLog, title: str = "", window: int = 100) -> Figure:
    """A live run: verified share, errors so far and, with a clock, parts an hour."""
    window = min(window, max(1, len(log) // 3))
    figure, axes = panels(2 if log.clock_s is None else 3, (9.0, 6.0 if log.clock_s is None else 8.5))
    draw_verified(axes[0], log.verified, window)
    axes[0].set(ylabel=f"verified, last {window} [%]")
    draw_errors(axes[1], log.false_positive, log.false_negative)
    axes[1].set(ylabel="errors so far [parts]", ylim=(0, 1 + 1.1 * max(log.false_positive.sum(), log.false_negative.sum())))
    legend_above(axes[1])
    if log.clock_s is not None:
        _draw_rate(axes[2], log, log.clock_s, window)
    if not len(log):
        axes[0].text(0.5, 0.5, "no cycle was finished", transform=axes[0].transAxes, ha="center", va="center")
    axes[-1].set(xlabel="cycle")
    figure.suptitle(title)
    return figure


def _draw_rate(axes: Axes, log: RunLog, clock_s: Floats, window: int) -> None:
    x, took = np.arange(1, len(log) + 1), np.diff(clock_s, prepend=0.0)
    rate = 3600 * sliding_sum(log.finished, window) / sliding_sum(took, window)
    settled = x >= window  # a rate over few cycles is mostly luck
    axes.plot(x[settled], rate[settled], color=GREEN, label="this run")
    if log.verified.any():
        # The same parts, each at the time that a verified one took: every good one goes on, and nothing stops.
        seconds = float(np.median(took[log.verified])) * sliding_sum(np.ones(len(x)), window)
        always = 3600 * sliding_sum(log.truth == 1.0, window) / seconds
        axes.plot(x[settled], always[settled], color=VERIFIED, linestyle=":", label="had every part been verified")
    axes.set(ylabel=f"good parts/h, last {window}")
    legend_above(axes)
