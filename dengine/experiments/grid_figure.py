"""The paper's figure of its grid: a cell for each alpha and LB, each in two parts.

    save(grid_figure(replays, "conv, wilson"), "out/grid.png")

Above: share of certain decisions and precision in a sliding window; below: the shares of all decisions in the window that
were false positives and false negatives, as the paper draws them. Source: the paper's figure "Results obtained with varying
values of the parameters alpha and LB".
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from .figures import FEWEST, WINDOW, window_curves
from .look import BAD, GOOD, GREEN, LIMIT, SMALL, plain, sliding_sum
from .replay import Replay

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def grid_figure(replays: Sequence[Replay], title: str = "", window: int = WINDOW) -> Figure:
    """A row an alpha, from the largest; a column an LB. replays : of one contender and interval, all equally long."""
    from matplotlib.figure import Figure

    alphas = sorted({r.recipe.policy.alpha for r in replays}, reverse=True)
    bounds = sorted({r.recipe.policy.lower_bound for r in replays})
    figure = Figure(figsize=(1.0 + 3.6 * len(bounds), 1.0 + 3.1 * len(alphas)), layout="constrained")
    heights = [3, 1.6] * len(alphas)
    axes = figure.subplots(2 * len(alphas), len(bounds), sharex=True, sharey="row", height_ratios=heights, squeeze=False)
    window = min(window, max(1, len(replays[0]) // 3))
    for i, alpha in enumerate(alphas):
        for j, bound in enumerate(bounds):
            cell = [r for r in replays if (r.recipe.policy.alpha, r.recipe.policy.lower_bound) == (alpha, bound)]
            top, bottom = axes[2 * i, j], axes[2 * i + 1, j]
            top.set_title(f"alpha {alpha:g}, LB {100 * bound:g} %", fontsize=SMALL + 1)
            if cell:
                _draw_cell(top, bottom, cell, bound, window)
    _label(figure, axes, window)
    figure.suptitle(title)
    return figure


def _draw_cell(top: Axes, bottom: Axes, replays: Sequence[Replay], bound: float, window: int) -> None:
    lines = window_curves(replays, window, FEWEST)
    x = np.arange(1, len(lines["certain"]) + 1)
    top.fill_between(x, lines["certain_low"], lines["certain_high"], color=GREEN, alpha=0.15, linewidth=0)
    top.plot(x, lines["certain"], color=GREEN, label="certain, of all cycles")
    top.plot(x, lines["precision"], color=GOOD, linestyle="--", linewidth=1.2, label="precision, of accepted")
    top.axhline(100 * bound, label="LB", **LIMIT)
    for name, colour, style, label in (
        ("false_positive", BAD, "-", "false positives, of all cycles"),
        ("false_negative", GOOD, "-.", "false negatives, of all cycles"),
    ):
        bottom.plot(x, 100 * _share_of_cycles(replays, name, window), style, color=colour, linewidth=1.2, label=label)
    bottom.axhline(100 * (1 - bound), label="100 - LB", **LIMIT)


def _share_of_cycles(replays: Sequence[Replay], name: str, window: int) -> np.ndarray:
    wrong = np.stack([getattr(r, name) for r in replays]).mean(axis=0)
    return sliding_sum(wrong, window) / sliding_sum(np.ones(len(wrong)), window)


def _label(figure: Figure, axes: np.ndarray, window: int) -> None:
    for each in axes.flat:
        plain(each)
    for i, row in enumerate(axes):
        row[0].set(ylabel="wrong [%]" if i % 2 else "share [%]", ylim=(0, None) if i % 2 else (0, 102))
    for each in axes[-1]:
        each.set_xlabel(f"cycle (end of a window of {window})")
    drawn = next((pair for pair in zip(axes[0::2].flat, axes[1::2].flat, strict=True) if pair[0].lines), None)
    if drawn is not None:
        handles = [line for each in drawn for line in each.lines]
        figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False, fontsize=SMALL)
