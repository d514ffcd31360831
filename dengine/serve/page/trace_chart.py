"""The picture of one trace: over the band of the good parts, and some bad ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from ...envelope import Envelope
from ...records import TraceSpec
from .svg import Scale, band_path, element, line_path, picture
from .words import Words

WIDTH, HEIGHT = 720, 300
LEFT, RIGHT, TOP, BOTTOM = 62, 12, 10, 52
POINTS = 360  # drawn of a line at most: half the picture's units
COARSE = 3  # of the bad parts' lines only each third of these
CHANNELS = 3  # drawn, those that leave the band farthest

Traces = NDArray[np.float32]


@dataclass(frozen=True)
class TraceView:
    """What a picture of a trace is drawn from.

    trace : (C, T).  bads : (n, C, T), some bad parts.  band : of the good ones, None while they are too few.
    """

    trace: Traces
    spec: TraceSpec
    band: Envelope | None
    bads: Traces


def trace_charts(view: TraceView, w: Words) -> list[Markup]:
    """A picture a channel."""
    widest = np.zeros(len(view.trace))
    for each in () if view.band is None else view.band.excesses:
        widest[each.channel] = max(widest[each.channel], each.widths)
    drawn = sorted(np.argsort(-widest, kind="stable")[:CHANNELS].tolist())
    return [_chart(view, channel, w) for channel in drawn]


def _chart(view: TraceView, channel: int, w: Words) -> Markup:
    trace, band = view.trace[channel], view.band
    step = max(1, len(trace) // POINTS)
    seconds = len(trace) / view.spec.rate_hz
    bads = view.bads[:, channel, :: COARSE * step] if len(view.bads) else np.zeros((0, 0), np.float32)
    edges = [] if band is None else [band.low[channel], band.high[channel]]
    x = Scale(0.0, seconds, LEFT, WIDTH - RIGHT)
    y = _range([trace, *edges, *bads])
    times = x.all(np.arange(0, len(trace), step) / view.spec.rate_hz)
    layers = [_grid(x, y, view.spec.unit, w)]
    if band is not None:
        low, high, median = (y.all(each[channel][::step]) for each in (band.low, band.high, band.median))
        layers.append(element("path", d=band_path(times, low, high), class_="band"))
        layers.append(element("path", d=line_path(times, median), class_="median"))
    layers += [element("path", d=line_path(times[::COARSE], y.all(bad)), class_="bad-trace") for bad in bads]
    layers.append(element("path", d=line_path(times, y.all(trace[::step])), class_="trace"))
    return picture(WIDTH, HEIGHT, _alt(view, channel, seconds, w), *layers)


def _range(lines: list[Traces]) -> Scale:
    finite = [line[np.isfinite(line)] for line in lines]
    low = min((float(each.min()) for each in finite if len(each)), default=0.0)
    high = max((float(each.max()) for each in finite if len(each)), default=1.0)
    room = 0.04 * (high - low or 1.0)
    return Scale(low - room, high + room, HEIGHT - BOTTOM, TOP)


def _grid(x: Scale, y: Scale, unit: str, w: Words) -> Markup:
    parts = []
    for value in y.ticks(4):
        at = y.at(value)
        parts.append(element("line", x1=LEFT, x2=WIDTH - RIGHT, y1=at, y2=at, class_="grid"))
        parts.append(
            element("text", w.number(value, 0 if value == round(value) else 2), x=LEFT - 8, y=at + 6, class_="end")
        )
    for value in x.ticks(5):
        digits = 0 if value == round(value) else 1 if value * 10 == round(value * 10) else 2
        parts.append(element("text", w.number(value, digits), x=x.at(value), y=HEIGHT - BOTTOM + 24, class_="middle"))
    parts.append(element("text", w("chart.time"), x=WIDTH - RIGHT, y=HEIGHT - 5, class_="end name"))
    parts.append(element("text", unit, x=6, y=TOP + 12, class_="name"))
    return element("g", *parts, aria_hidden="true")


def _alt(view: TraceView, channel: int, seconds: float, w: Words) -> str:
    finite = view.trace[channel][np.isfinite(view.trace[channel])]
    low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 0.0)
    return w(
        "alt.trace",
        seconds=w.number(seconds, 1),
        low=w.number(low, 1),
        high=w.number(high, 1),
        unit=view.spec.unit,
        band=_against(view.band, channel, w),
    )


def _against(band: Envelope | None, channel: int, w: Words) -> str:
    if band is None:
        return w("alt.noband")
    said = w("alt.inside", share=w.percent(band.outside, 1), usual=w.percent(band.usual, 1))
    here = [each for each in band.excesses if each.channel == channel]
    if not here:
        return said
    most = max(here, key=lambda each: each.widths)
    side = w("alt.above" if most.above else "alt.below")
    return f"{said} {w('alt.leaves', side=side, start=w.number(most.from_s, 2), end=w.number(most.to_s, 2))}"
