"""The picture of a data set: what good and bad traces look like, and what changes over the recorded order."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..datasets import Dataset
from ..traces import as_traces
from .look import BAD, BLACK, GOOD, VERIFIED, legend_above, plain, sliding_sum
from .survey import levels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST = 3  # channels drawn
KINDS = ((1, "good", GOOD, "-"), (0, "bad", BAD, "--"))
WINDOW = 10  # of the stream: one in so many


def data_picture(data: Dataset, title: str = "") -> Figure:
    """Above, a channel a panel: the median trace of good and bad parts, and where the middle 80 % lie. Below: the share of
    good parts and each trace's mean, in the order in which they were recorded. Traces that are not finite are not drawn.
    """
    from matplotlib.figure import Figure

    X = as_traces(data.X)
    shown = np.isfinite(X).all(axis=(1, 2))
    n_channels = min(X.shape[1], MOST)
    figure = Figure(figsize=(9.0, 7.6), layout="constrained")
    top, bottom = figure.subfigures(2, 1, squeeze=False, height_ratios=(1, 1.1))[:, 0]
    names = data.channels or tuple(f"channel {i + 1}" if X.shape[1] > 1 else "trace" for i in range(X.shape[1]))
    time_s, unit = np.arange(X.shape[2]) / data.rate_hz, f" [{data.unit}]" if X.shape[1] == 1 else ""
    top.suptitle(f"{title}: median trace, and where 10 to 90 % of them lie")
    for i, axes in enumerate(top.subplots(1, n_channels, squeeze=False)[0]):
        _draw_traces(axes, time_s, X[shown, i], data.y[shown])
        if i == 0 and shown.any():
            legend_above(axes)
        axes.set(xlabel="time [s]", ylabel=f"{names[i]}{unit}")
    share, level = bottom.subplots(2, 1, sharex=True)
    _draw_share(share, data.y)
    _draw_levels(level, np.flatnonzero(shown) + 1, levels(X[shown, :1])[:, 0], data.y[shown])
    level.set(xlabel="recording, in the order in which they were made", ylabel=f"mean {names[0]}{unit}")
    return figure


def _draw_traces(axes: Axes, time_s: NDArray[np.float64], X: NDArray[np.float32], y: NDArray[np.int8]) -> None:
    """(n, T) of one channel."""
    plain(axes)
    for label, name, colour, line in KINDS:
        some = X[y == label]
        if len(some):
            low, median, high = np.quantile(some, (0.1, 0.5, 0.9), axis=0)
            axes.fill_between(time_s, low, high, color=colour, alpha=0.18, linewidth=0)
            axes.plot(time_s, median, line, color=colour, linewidth=1.2, label=f"{name} ({len(some)})")


def _draw_share(axes: Axes, y: NDArray[np.int8]) -> None:
    plain(axes)
    window = max(1, len(y) // WINDOW)
    seen = sliding_sum(np.ones(len(y)), window)
    full = seen >= window  # a share of the first few jumps
    x = np.arange(1, len(y) + 1)
    axes.plot(x[full], 100 * (sliding_sum(y, window) / seen)[full], color=VERIFIED, label=f"good, of the last {window}")
    axes.axhline(100 * y.mean(), color=BLACK, linestyle=":", linewidth=1.2, label="good, of all")
    axes.set(ylim=(0, 104), ylabel="share [%]")
    legend_above(axes)


def _draw_levels(axes: Axes, x: NDArray[Any], level: NDArray[np.float64], y: NDArray[np.int8]) -> None:
    plain(axes)
    for label, name, colour, _ in KINDS:
        some = y == label
        axes.scatter(x[some], level[some], s=8, color=colour, alpha=0.5, linewidths=0, label=name)
    window = max(1, len(level) // WINDOW)
    if len(level) >= window:
        middle = np.median(np.lib.stride_tricks.sliding_window_view(level, window), axis=1)
        axes.plot(x[window - 1 :], middle, color=BLACK, linewidth=1.2, label=f"median of the last {window}")
    legend_above(axes)
