"""The picture of one decision: the trace among its neighbours and the band of the successes, the ball, and the bound."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..explaining import Explanation
from ..verdict import Bound
from .look import BAD, BLACK, GOOD, GREEN, GREY, LIMIT, ORANGE, SMALL, legend_above, plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

MOST = 4  # channels drawn: those that leave the band farthest
CLEAR = 0.1  # band widths below which leaving the band is not marked


def explained_picture(found: Explanation) -> Figure:
    """Above, a panel a channel: the trace, its nearest references and the band. Below: their distances, and the bound."""
    from matplotlib.figure import Figure

    channels = _channels(found)
    below = bool(found.neighbours or found.bound)
    heights = [1.5 + 2.3 * len(channels), 2.6]
    figure = Figure(figsize=(10.0, heights[0] + (heights[1] if below else 0.0)), layout="constrained")
    past = found.decision
    version = f"version {past.model_version}" if past.model_version else "no model yet"
    figure.suptitle(
        f"{past.id}: {past.action.value}, {past.reason.value} ({version}); label: {past.label}", fontweight="bold"
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
    for success, name, colour, line in ((True, "good", GOOD, "-"), (False, "bad", BAD, "--")):
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
        axes.text(0.5, 0.5, "no neighbours", transform=axes.transAxes, ha="center", va="center", color=GREY)
        axes.set(xticks=[], yticks=[])
        return
    spaces = sorted({each.space for each in near})
    for success, name, colour, marker in ((True, "good", GOOD, "o"), (False, "bad", BAD, "X")):
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
        axes.text(0.5, 0.0, "no bound was asked for", ha="center", va="center", color=GREY)
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
