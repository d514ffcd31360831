"""Pictures of a data set, of one decision among its neighbours, and of a store over all of its cycles."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..datasets import Dataset
from ..history.explain import Explanation
from ..history.sentences import Bound
from ..history.status import Course
from ..store.records import SAFE_MODE_ENDED
from ..traces import as_traces
from .figures import (
    BAD,
    BLACK,
    GOOD,
    GREEN,
    GREY,
    LIMIT,
    ORANGE,
    PINK,
    SKY,
    SMALL,
    VERIFIED,
    Floats,
    blank,
    legend_above,
    note,
    panels,
    plain,
    sliding_sum,
    whole_numbers,
)
from .survey import levels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

MOST = 4  # channels drawn: those that leave the band farthest
MOST_OF_DATA = 3  # channels of a data set drawn
WINDOW = 10  # of a data set: one in so many
KINDS = ((True, "good", GOOD, "-", "o"), (False, "bad", BAD, "--", "X"))
CLEAR = 0.1  # band widths below which leaving the band is not marked


def explained_picture(found: Explanation) -> Figure:
    """Above, a panel a channel: the trace, its nearest references and the band. Below: their distances, and the bound."""
    channels = _channels(found)
    below = bool(found.neighbours or found.bound)
    heights = [1.5 + 2.3 * len(channels), 2.6]
    figure = blank(10.0, heights[0] + (heights[1] if below else 0.0))
    past, made = found.decision, found.decision.decision
    version = f"version {made.model_version}" if made.model_version else "no model yet"
    figure.suptitle(
        f"{made.id}: {made.action.value}, {made.reason.value} ({version}); label: {past.label}",
        fontweight="bold",
    )
    rows = figure.subfigures(2 if below else 1, 1, squeeze=False, height_ratios=heights if below else None)[:, 0]
    _draw_channels(rows[0], found, channels)
    if not below:
        return figure
    left, right = rows[1].subplots(1, 2, width_ratios=(1.15, 1.0))
    _draw_distances(left, found)
    _draw_bound(right, found.bound)
    return figure


def _channels(found: Explanation) -> list[int]:
    """Which channels are drawn, in their order."""
    n, band = len(found.trace), found.envelope
    widest = np.zeros(n)
    for each in () if band is None else band.excesses:
        widest[each.channel] = max(widest[each.channel], each.widths)
    return sorted(np.argsort(-widest, kind="stable")[:MOST].tolist())


def _draw_channels(figure: SubFigure, found: Explanation, channels: list[int]) -> None:
    panels = figure.subplots(len(channels), 1, sharex=True, squeeze=False)[:, 0]
    for i, (axes, channel) in enumerate(zip(panels, channels, strict=True)):
        _draw_trace(axes, found, channel)
        axes.set(ylabel=_name(found, channel))
        if i == 0:
            legend_above(axes, columns=3)
    panels[-1].set(xlabel="time [s]")


def _name(found: Explanation, channel: int) -> str:
    spec = found.spec
    if spec.columns:
        return f"{spec.columns[channel]} [{spec.unit}]"
    return f"trace [{spec.unit}]" if spec.channels == 1 else f"channel {channel + 1} [{spec.unit}]"


def _draw_trace(axes: Axes, found: Explanation, channel: int) -> None:
    plain(axes)
    x, band = np.arange(found.trace.shape[1]) / found.spec.rate_hz, found.envelope
    if band is not None:
        label = f"95 % of {band.n:,} successes"
        axes.fill_between(x, band.low[channel], band.high[channel], color=GREEN, alpha=0.22, linewidth=0, label=label)
        axes.plot(x, band.median[channel], color=GREEN, linewidth=1.0, label="their median")
    for success, name, colour, line, _ in KINDS:
        near = [each.trace for each in found.neighbours if each.trace is not None and each.success is success]
        for i, trace in enumerate(near):
            label = f"neighbours that were {name} ({len(near)})" if i == 0 else "_"
            axes.plot(x, trace[channel], line, color=colour, linewidth=0.7, alpha=0.55, label=label)
    axes.plot(x, found.trace[channel], color=BLACK, linewidth=1.6, label="this trace")
    _mark_excesses(axes, found, channel)


def _mark_excesses(axes: Axes, found: Explanation, channel: int) -> None:
    if found.envelope is None:
        return
    first = True
    for each in found.envelope.excesses:
        if each.channel == channel and each.widths >= CLEAR:
            half = 0.5 / found.spec.rate_hz
            label = "outside the band" if first else "_"
            axes.axvspan(each.from_s - half, each.to_s + half, color=ORANGE, alpha=0.3, linewidth=0, label=label, zorder=0)
            first = False


def _draw_distances(axes: Axes, found: Explanation) -> None:
    """Nearest references by distance, a row a fold: those of one fold live in one space."""
    plain(axes)
    near = found.neighbours
    if not near or found.radius is None:
        note(axes, "no neighbours", GREY)
        axes.set(xticks=[], yticks=[])
        return
    spaces = sorted({each.space for each in near})
    for success, name, colour, _, marker in KINDS:
        some = [each for each in near if each.success is success]
        if some:
            rows = [spaces.index(each.space) for each in some]
            axes.scatter([each.distance for each in some], rows, s=34, color=colour, marker=marker, alpha=0.8, label=name)
    end = max(each.distance for each in near)
    if found.radius <= 3.0 * end:
        axes.axvline(found.radius, label=f"ball, radius {found.radius:.3g}", **LIMIT)
        end = max(end, found.radius)
    else:
        axes.plot([], [], " ", label=f"all inside the ball, radius {found.radius:.3g}")
    axes.set(yticks=range(len(spaces)), yticklabels=[f"fold {space}" for space in spaces])
    axes.set(ylim=(-0.7, len(spaces) - 0.3), xlim=(0.0, 1.08 * max(end, 1e-9)))
    version = f"references of version {found.neighbours_version}"
    axes.set(xlabel=f"distance of the nearest {version} [scaled]")
    legend_above(axes, columns=3)


def _draw_bound(axes: Axes, bound: Bound | None) -> None:
    """The interval of the success rate, and what it was held against."""
    plain(axes)
    axes.set(yticks=[], xlim=(-0.02, 1.02), ylim=(-1.0, 1.0), xlabel="success rate in the ball")
    if bound is None:
        note(axes, "no bound was asked for", GREY)
        return
    n = bound.n_success + bound.n_failure
    if n:
        axes.plot([bound.n_success / n], [0.0], "o", color=BLACK, label=f"{bound.n_success} of {n}")
    axes.plot([bound.lower, bound.upper], [0.0, 0.0], color=BLACK, linewidth=3.0, alpha=0.7, label="bound")
    for at, colour, name in ((bound.accept_at, GOOD, "accept from"), (bound.reject_at, BAD, "reject up to")):
        if at is not None:
            axes.axvline(at, color=colour, linestyle=":", linewidth=1.5, label=f"{name} {at:.3g}")
    text, middle = f"{bound.lower:.3f} to {bound.upper:.3f}", 0.5 * (bound.lower + bound.upper)
    side = "left" if middle < 0.2 else "right" if middle > 0.8 else "center"
    at = {"left": bound.lower, "right": bound.upper, "center": middle}[side]
    axes.annotate(text, (at, 0.0), xytext=(0, 9), textcoords="offset points", ha=side, fontsize=SMALL)
    legend_above(axes, columns=2)


def status_picture(course: Course, title: str = "") -> Figure:
    """Above, the verified and the novel share of each stretch; below, bad accepted parts so far and what is tolerated."""
    figure, (top, bottom) = panels(2, (10.0, 6.4))
    stretches = course.stretches
    ends = np.cumsum([each.n for each in stretches], dtype=np.float64)
    length = stretches[0].n if stretches else 0
    _draw_shares(top, course, ends)
    _draw_bad(bottom, course, ends)
    _mark_retrains(top, course, ends)
    for axes in (top, bottom):
        _shade(axes, course, ends)
        legend_above(axes, columns=4)
    top.set(ylim=(0, 104), ylabel="share of the parts [%]")
    every = f", {length} a point" if length > 1 else ""
    bottom.set(xlabel=f"cycle{every}", ylabel="bad accepted parts so far")
    if not stretches:
        note(top, "no decision yet")
    else:
        bottom.set(xlim=(0, ends[-1] * 1.01))
    figure.suptitle(title)
    return figure


def _draw_shares(axes: Axes, course: Course, ends: Floats) -> None:
    n = np.array([each.n for each in course.stretches])
    verified, novel = (np.array([getattr(each, name) for each in course.stretches]) for name in ("verified", "novel"))
    middle = ends - n / 2
    axes.plot(middle, 100 * verified / np.maximum(n, 1), color=VERIFIED, label="verified")
    if novel.any():
        axes.plot(middle, 100 * novel / np.maximum(n, 1), "--", color=PINK, label="novel")


def _draw_bad(axes: Axes, course: Course, ends: Floats) -> None:
    accepted, bad = (np.cumsum([getattr(each, name) for each in course.stretches]) for name in ("accepted", "bad"))
    x = np.concatenate([[0.0], ends])
    total = f"{int(bad[-1])} bad of {int(accepted[-1]):,}" if len(bad) else "none"
    axes.plot(x, np.concatenate([[0], bad]), color=BAD, label=f"known bad ({total} accepted)")
    tolerated = course.tolerance * np.concatenate([[0], accepted])
    axes.plot(x, tolerated, ":", color=BLACK, label=f"tolerated, {100 * course.tolerance:g} % of the accepted")
    whole_numbers(axes)
    axes.set(ylim=(0, max(1.0, 1.1 * tolerated[-1], 1.1 * float(bad[-1]) if len(bad) else 0.0)))


def _cycle(course: Course, ends: Floats, times: list[float]) -> Floats:
    """At which cycle something happened, to within a stretch."""
    return np.interp(times, [each.last for each in course.stretches], ends)


def _mark_retrains(axes: Axes, course: Course, ends: Floats) -> None:
    if not len(ends):
        return
    for accepted, marker, colour, name in ((True, "^", GREEN, "retrained"), (False, "x", BAD, "retrain dropped")):
        times = [each.time for each in course.retrains if each.report.accepted is accepted]
        if times:
            at = _cycle(course, ends, times)
            label = f"{name} ({len(times)})"
            axes.scatter(at, np.full(len(at), 2.5), s=26, marker=marker, color=colour, label=label, zorder=3, clip_on=False)


def _shade(axes: Axes, course: Course, ends: Floats) -> None:
    if not len(ends):
        return
    for i, (begin, end) in enumerate(_modes(course, ends)):
        axes.axvspan(begin, end, color=ORANGE, alpha=0.25, linewidth=0, label="safe mode" if i == 0 else None)
    if course.last < ends[-1]:
        name = f"the last {course.last:,}"
        axes.axvspan(ends[-1] - course.last, ends[-1], color=SKY, alpha=0.15, linewidth=0, label=name, zorder=0)


def _modes(course: Course, ends: Floats) -> Iterator[tuple[float, float]]:
    """From which cycle to which everything was verified; a safe mode that lasts ends with the newest cycle."""
    began: float | None = None
    for event, cycle in zip(course.modes, _cycle(course, ends, [each.time for each in course.modes]), strict=True):
        if event.kind == SAFE_MODE_ENDED:
            if began is not None:
                yield began, float(cycle)
            began = None
        elif began is None:
            began = float(cycle)
    if began is not None:
        yield began, float(ends[-1])


def data_picture(data: Dataset, title: str = "") -> Figure:
    """Above, a channel a panel: the median trace of good and bad parts, and where the middle 80 % lie. Below: the share of
    good parts and each trace's mean, in the order in which they were recorded. Traces that are not finite are not drawn.
    """
    X = as_traces(data.X)
    shown = np.isfinite(X).all(axis=(1, 2))
    n_channels = min(X.shape[1], MOST_OF_DATA)
    figure = blank(9.0, 7.6)
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
    for label, name, colour, line, _ in KINDS:
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
    for label, name, colour, _, _ in KINDS:
        some = y == label
        axes.scatter(x[some], level[some], s=8, color=colour, alpha=0.5, linewidths=0, label=name)
    window = max(1, len(level) // WINDOW)
    if len(level) >= window:
        middle = np.median(np.lib.stride_tricks.sliding_window_view(level, window), axis=1)
        axes.plot(x[window - 1 :], middle, color=BLACK, linewidth=1.2, label=f"median of the last {window}")
    legend_above(axes)
