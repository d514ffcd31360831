"""The picture of a store: verified share and bad accepts over all of its cycles, retrains and safe mode as marks."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from ..standing import Course
from .look import BAD, BLACK, GREEN, ORANGE, PINK, SKY, VERIFIED, Floats, legend_above, panels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


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
        top.text(0.5, 0.5, "no decision yet", transform=top.transAxes, ha="center", va="center")
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
    from matplotlib.ticker import MaxNLocator

    accepted, bad = (np.cumsum([getattr(each, name) for each in course.stretches]) for name in ("accepted", "bad"))
    x = np.concatenate([[0.0], ends])
    total = f"{int(bad[-1])} bad of {int(accepted[-1]):,}" if len(bad) else "none"
    axes.plot(x, np.concatenate([[0], bad]), color=BAD, label=f"known bad ({total} accepted)")
    tolerated = course.tolerance * np.concatenate([[0], accepted])
    axes.plot(x, tolerated, ":", color=BLACK, label=f"tolerated, {100 * course.tolerance:g} % of the accepted")
    axes.yaxis.set_major_locator(MaxNLocator(nbins=6, integer=True))
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
        if event.text.startswith("ended"):
            if began is not None:
                yield began, float(cycle)
            began = None
        elif began is None:
            began = float(cycle)
    if began is not None:
        yield began, float(ends[-1])
