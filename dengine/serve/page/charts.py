"""The picture of one trace: over the band of the good parts, and some bad ones.

Pictures as text: an element of SVG with everything in it escaped, and a scale from values to a picture's units.

Pictures of an interval: a bound against what it must reach, and the share of bad parts against the tolerance.

The picture of how it went: the verified share along the parts, the retrains, and bad accepted parts.

The map: where the known parts and the newest lie in the model's embedding, a mark and a link each.
"""

from __future__ import annotations

from dataclasses import dataclass
from hashlib import sha256
from urllib.parse import quote

import numpy as np
from markupsafe import Markup, escape
from numpy.typing import NDArray

from ...history.envelope import Envelope
from ...history.sentences import Bound
from ...history.status import Course, Judged
from ...records import TraceSpec
from .words import Words

Floats = NDArray[np.floating]


def element(name: str, *children: str, **attributes: object) -> Markup:
    """An element; text in it is escaped, markup is not. `class_` is class, `aria_label` is aria-label; None is left out."""
    told = "".join(
        f' {key.rstrip("_").replace("_", "-") if key != "viewBox" else key}="{escape(value)}"'
        for key, value in attributes.items()
        if value is not None
    )
    inside = "".join(str(escape(child)) for child in children)
    return Markup(f"<{name}{told}>{inside}</{name}>")  # all that goes in was escaped above


def picture(width: int, height: int, alt: str, *children: str, role: str = "img", class_: str = "chart") -> Markup:
    """A picture with what it shows in a sentence."""
    return element("svg", *children, viewBox=f"0 0 {width} {height}", role=role, aria_label=alt, class_=class_)


@dataclass(frozen=True, slots=True)
class Scale:
    """From values low..high to units begin..end."""

    low: float
    high: float
    begin: float
    end: float

    def at(self, value: float) -> float:
        """The place of a value, within the picture."""
        span = self.high - self.low or 1.0
        share = min(1.0, max(0.0, (value - self.low) / span))
        return round(self.begin + share * (self.end - self.begin), 1)

    def all(self, values: Floats) -> Floats:
        """The places of many values, within the picture."""
        span = self.high - self.low or 1.0
        share = np.clip((np.nan_to_num(values, nan=self.low) - self.low) / span, 0.0, 1.0)
        return self.begin + share * (self.end - self.begin)

    def ticks(self, most: int = 5) -> list[float]:
        """Round values for an axis, at most about so many."""
        span = self.high - self.low
        if not span > 0:
            return [self.low]
        rough = span / most
        power = 10.0 ** np.floor(np.log10(rough))
        step = float(next(m * power for m in (1, 2, 5, 10) if m * power >= rough))
        first = np.ceil(self.low / step - 1e-9) * step
        return [float(round(tick, 10)) for tick in np.arange(first, self.high + step * 1e-6, step)]


def line_path(x: Floats, y: Floats) -> str:
    """The path through points."""
    return "M" + "L".join(f"{a:.1f} {b:.1f}" for a, b in zip(x.tolist(), y.tolist(), strict=True))


def band_path(x: Floats, low: Floats, high: Floats) -> str:
    """The path around a band."""
    return line_path(np.concatenate([x, x[::-1]]), np.concatenate([high, low[::-1]])) + "Z"


WIDTH, HEIGHT = 480, 96
LINE = 42  # where the bar lies


def bound_chart(bound: Bound, w: Words) -> Markup:
    """The bound between 0 and 1, and the zones in which a part is rejected and accepted."""
    x = Scale(0.0, 1.0, 16, WIDTH - 16)
    reject, accept = bound.reject_at, bound.accept_at
    zones = []
    if reject is not None:
        zones.append(_zone(x, 0.0, reject, "zone reject"))
    if accept is not None:
        zones.append(_zone(x, accept, 1.0, "zone accept"))
    alt = w(
        "alt.bound",
        lower=w.percent(bound.lower, 1),
        upper=w.percent(bound.upper, 1),
        accept=w.percent(accept, 1),
        reject=w.percent(reject, 1),
    )
    marks = [(sign, value) for sign, value in (("✕ ≤", reject), ("✓ ≥", accept)) if value is not None]
    return picture(
        WIDTH, HEIGHT, alt, _axis(x), *zones, *_interval(x, bound.lower, bound.upper), *_values(x, marks, w), class_="bound"
    )


def bad_chart(bad: Judged, w: Words) -> Markup:
    """The interval of the share of bad accepted parts, and the tolerance."""
    most = min(1.0, max(0.02, 2.0 * bad.tolerance, 1.1 * bad.upper))
    x = Scale(0.0, most, 16, WIDTH - 16)
    said = {"lower": w.percent(bad.lower, 1), "upper": w.percent(bad.upper, 1), "tolerance": w.percent(bad.tolerance, 1)}
    kept = _zone(x, 0.0, bad.tolerance, "zone accept")
    bar = _interval(x, bad.lower, bad.upper)
    return picture(
        WIDTH, HEIGHT, w("alt.bad", **said), _axis(x), kept, *bar, *_values(x, [("≤", bad.tolerance)], w), class_="bound"
    )


def _axis(x: Scale) -> Markup:
    return element("rect", x=x.begin, y=LINE - 20, width=x.end - x.begin, height=40, class_="axis")


def _zone(x: Scale, low: float, high: float, kind: str) -> Markup:
    return element("rect", x=x.at(low), y=LINE - 20, width=max(1.0, x.at(high) - x.at(low)), height=40, class_=kind)


def _interval(x: Scale, lower: float, upper: float) -> list[Markup]:
    begin, end = x.at(lower), x.at(upper)
    bar = element("rect", x=begin, y=LINE - 7, width=max(3.0, end - begin), height=14, rx=3, class_="interval")
    ends = [element("line", x1=at, x2=at, y1=LINE - 15, y2=LINE + 15, class_="interval-end") for at in (begin, end)]
    return [bar, *ends]


def _values(x: Scale, values: list[tuple[str, float]], w: Words) -> list[Markup]:
    """The thresholds, each with its sign, under their places; and the ends of the axis where there is room."""
    places = [min(max(x.at(value), x.begin + 44), x.end - 44) for _, value in values]
    told = [(f"{sign} {w.percent(value)}", at, "middle strong") for (sign, value), at in zip(values, places, strict=True)]
    ends = ((x.low, x.begin, "start"), (x.high, x.end, "end"))
    told += [(w.percent(end), at, kind) for end, at, kind in ends if all(abs(at - place) > 110 for place in places)]
    return [element("text", text, x=at, y=HEIGHT - 8, class_=kind, aria_hidden="true") for text, at, kind in told]


WIDTH_OF_COURSE_CHART, HEIGHT_OF_COURSE_CHART = 720, 260
LEFT, RIGHT, TOP, BOTTOM = 66, 12, 14, 54


def course_chart(course: Course, w: Words) -> Markup:
    """Steps of the verified share; a triangle a retrain, a cross where an accepted part was bad."""
    total = sum(stretch.n for stretch in course.stretches)
    x, y = Scale(0.0, total, LEFT, WIDTH_OF_COURSE_CHART - RIGHT), Scale(0.0, 1.0, HEIGHT_OF_COURSE_CHART - BOTTOM, TOP)
    path, crosses, done = "", [], 0
    for stretch in course.stretches:
        share = y.at(stretch.verified / stretch.n)
        begin, end = x.at(done), x.at(done + stretch.n)
        path += f"{'L' if path else 'M'}{begin} {share}L{end} {share}"
        if stretch.bad:
            middle = (begin + end) / 2
            crosses.append(element("path", d=f"M{middle - 6} {TOP}l12 12m0 -12l-12 12", class_="shape cross bad"))
        done += stretch.n
    return picture(
        WIDTH_OF_COURSE_CHART,
        HEIGHT_OF_COURSE_CHART,
        _alt(course, w),
        _grid(x, y, w),
        *_retrains(course, x),
        element("path", d=path, class_="course"),
        *crosses,
    )


def _retrains(course: Course, x: Scale) -> list[Markup]:
    places = sorted({x.at(place) for place in _retrain_places(course)})
    bottom = HEIGHT_OF_COURSE_CHART - BOTTOM
    return [element("path", d=f"M{at - 5} {bottom}l5 -9l5 9Z", class_="retrain") for at in places]


def _retrain_places(course: Course) -> list[float]:
    """After how many parts each retrain came, as far as the stretches tell."""
    places = []
    for retrain in course.retrains:
        done = 0
        for stretch in course.stretches:
            if stretch.last > retrain.time:
                break
            done += stretch.n
        places.append(float(done))
    return places


def _grid(x: Scale, y: Scale, w: Words) -> Markup:
    parts = []
    for value in (0.0, 0.5, 1.0):
        at = y.at(value)
        parts.append(element("line", x1=LEFT, x2=WIDTH_OF_COURSE_CHART - RIGHT, y1=at, y2=at, class_="grid"))
        parts.append(element("text", w.percent(value), x=LEFT - 8, y=at + 6, class_="end"))
    below = HEIGHT_OF_COURSE_CHART - BOTTOM + 22
    parts += [element("text", w.number(value), x=x.at(value), y=below, class_="middle") for value in x.ticks(5)]
    parts.append(
        element(
            "text", w("how.course.parts"), x=WIDTH_OF_COURSE_CHART - RIGHT, y=HEIGHT_OF_COURSE_CHART - 5, class_="end name"
        )
    )
    return element("g", *parts, aria_hidden="true")


def _alt(course: Course, w: Words) -> str:
    first, last = (course.stretches[i].verified / course.stretches[i].n for i in (0, -1))
    return w("alt.course", first=w.percent(first), last=w.percent(last))


WIDTH_OF_MAP_CHART, HEIGHT_OF_MAP_CHART = 720, 520
LEFT_OF_MAP_CHART, RIGHT_OF_MAP_CHART, TOP_OF_MAP_CHART, BOTTOM_OF_MAP_CHART = 16, 16, 14, 56
SIZE = 7.0


@dataclass(frozen=True, slots=True)
class Mark:
    """A part on the map.

    id : of its decision.  name : what it is called.  x, y : its place.  label : good, bad or none.
    action : what was decided, of a newest part; "" of a known one.  newest : whether it is the very newest.
    """

    id: str
    name: str
    x: float
    y: float
    label: str
    action: str = ""
    newest: bool = False


@dataclass(frozen=True, slots=True)
class PartMap:
    """The known parts and the newest of one model version.

    version : of the model.  marks : the known ones first, oldest first.
    radius : of the ball around the newest, None where it is not fixed.  probability : whether x is one.
    """

    version: int
    marks: tuple[Mark, ...]
    radius: float | None
    probability: bool

    def count(self, label: str) -> int:
        """Known parts with a label."""
        return sum(mark.label == label and not mark.action for mark in self.marks)


def map_chart(found: PartMap, chosen: str, root: str, w: Words) -> Markup:
    """The picture; every mark is a link to its part, and one of them is reached by the tab key."""
    x, y = _scales(found)
    spoken = [mark for mark in found.marks if mark.id == chosen] or list(found.marks[-1:])
    known = found.count("good") + found.count("bad")
    alt = w("alt.map", n=known, good=found.count("good"), bad=found.count("bad"), new=len(found.marks) - known)
    ball = [_ball(found, x, y)] if found.radius is not None and found.marks else []
    links = [_link(mark, x, y, mark is spoken[0], mark.id == chosen, root, w) for mark in found.marks]
    names = [
        element(
            "text",
            w("map.probability" if found.probability else "map.first"),
            x=WIDTH_OF_MAP_CHART - RIGHT_OF_MAP_CHART,
            y=HEIGHT_OF_MAP_CHART - 6,
            class_="end",
        ),
        *(
            element(
                "text", w.number(tick, 1), x=x.at(tick), y=HEIGHT_OF_MAP_CHART - BOTTOM_OF_MAP_CHART + 20, class_="middle"
            )
            for tick in x.ticks(5)
        ),
    ]
    frame = element(
        "rect",
        x=LEFT_OF_MAP_CHART,
        y=TOP_OF_MAP_CHART,
        width=WIDTH_OF_MAP_CHART - LEFT_OF_MAP_CHART - RIGHT_OF_MAP_CHART,
        height=HEIGHT_OF_MAP_CHART - TOP_OF_MAP_CHART - BOTTOM_OF_MAP_CHART,
        class_="axis",
    )
    text = element("g", frame, *names, aria_hidden="true")
    return picture(WIDTH_OF_MAP_CHART, HEIGHT_OF_MAP_CHART, alt, text, *ball, *links, role="group", class_="chart map")


def _scales(found: PartMap) -> tuple[Scale, Scale]:
    xs, ys = np.array([mark.x for mark in found.marks] or [0.0]), np.array([mark.y for mark in found.marks] or [0.0])
    low, high = (0.0, 1.0) if found.probability else (float(xs.min()), float(xs.max()))
    bottom, top = np.quantile(ys, (0.005, 0.995)).tolist()
    return Scale(low, high, LEFT_OF_MAP_CHART + 18, WIDTH_OF_MAP_CHART - RIGHT_OF_MAP_CHART - 18), Scale(
        bottom, top, HEIGHT_OF_MAP_CHART - BOTTOM_OF_MAP_CHART - 18, TOP_OF_MAP_CHART + 18
    )


def _ball(found: PartMap, x: Scale, y: Scale) -> Markup:
    newest, radius = found.marks[-1], found.radius or 0.0
    width = radius * (x.end - x.begin) / (x.high - x.low or 1.0)
    height = radius * (y.begin - y.end) / (y.high - y.low or 1.0)
    center = {"cx": x.at(newest.x), "cy": y.at(newest.y)}
    ball = element("ellipse", **center, rx=round(width, 1), ry=round(height, 1), class_="ball")
    inside = {
        "x": LEFT_OF_MAP_CHART,
        "y": TOP_OF_MAP_CHART,
        "width": WIDTH_OF_MAP_CHART - LEFT_OF_MAP_CHART - RIGHT_OF_MAP_CHART,
        "height": HEIGHT_OF_MAP_CHART - TOP_OF_MAP_CHART - BOTTOM_OF_MAP_CHART,
    }  # of the frame
    return element("svg", ball, **inside, viewBox=" ".join(map(str, inside.values())), aria_hidden="true")


def _link(mark: Mark, x: Scale, y: Scale, reached: bool, chosen: bool, root: str, w: Words) -> Markup:
    label = w(f"label.{mark.label}")
    if mark.action:
        name = w("map.mark.new", part=mark.name, action=w(f"action.{mark.action}"), label=label)
    else:
        name = w("map.mark", part=mark.name, label=label)
    kinds = [f"mark {mark.label}", *(["recent"] if mark.action else []), *(["newest"] if mark.newest else [])]
    return element(
        "a",
        element("title", name),
        *_shape(mark, x.at(mark.x), y.at(mark.y)),
        href=f"{root}/map?id={quote(mark.id, safe='')}",
        id=f"m{sha256(mark.id.encode()).hexdigest()[:12]}",
        class_=" ".join(kinds + (["chosen"] if chosen else [])),
        tabindex=0 if reached else -1,
        aria_label=name,
        aria_current="true" if chosen else None,
        data_x=x.at(mark.x),
        data_y=y.at(mark.y),
    )


def _shape(mark: Mark, x: float, y: float) -> list[Markup]:
    """A circle is good, a cross is bad, a square is not known; a ring around it: it is among the newest."""
    s = SIZE
    ring = [element("circle", cx=x, cy=y, r=s * (2.2 if mark.newest else 1.6), class_="ring")] if mark.action else []
    shapes = {
        "good": element("circle", cx=x, cy=y, r=s * 0.8, class_="shape"),
        "bad": element("path", d=f"M{x - s} {y - s}L{x + s} {y + s}M{x - s} {y + s}L{x + s} {y - s}", class_="shape cross"),
        "none": element("rect", x=x - s * 0.7, y=y - s * 0.7, width=s * 1.4, height=s * 1.4, class_="shape"),
    }
    hit = element("circle", cx=x, cy=y, r=s * 1.5, class_="hit")
    return [hit, *ring, shapes[mark.label]]


WIDTH_OF_TRACE_CHART, HEIGHT_OF_TRACE_CHART = 720, 300
LEFT_OF_TRACE_CHART, RIGHT_OF_TRACE_CHART, TOP_OF_TRACE_CHART, BOTTOM_OF_TRACE_CHART = 62, 12, 10, 52
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
    x = Scale(0.0, seconds, LEFT_OF_TRACE_CHART, WIDTH_OF_TRACE_CHART - RIGHT_OF_TRACE_CHART)
    y = _range([trace, *edges, *bads])
    times = x.all(np.arange(0, len(trace), step) / view.spec.rate_hz)
    layers = [_grid_of_trace_chart(x, y, view.spec.unit, w)]
    if band is not None:
        low, high, median = (y.all(each[channel][::step]) for each in (band.low, band.high, band.median))
        layers.append(element("path", d=band_path(times, low, high), class_="band"))
        layers.append(element("path", d=line_path(times, median), class_="median"))
    layers += [element("path", d=line_path(times[::COARSE], y.all(bad)), class_="bad-trace") for bad in bads]
    layers.append(element("path", d=line_path(times, y.all(trace[::step])), class_="trace"))
    return picture(WIDTH_OF_TRACE_CHART, HEIGHT_OF_TRACE_CHART, _alt_of_trace_chart(view, channel, seconds, w), *layers)


def _range(lines: list[Traces]) -> Scale:
    finite = [line[np.isfinite(line)] for line in lines]
    low = min((float(each.min()) for each in finite if len(each)), default=0.0)
    high = max((float(each.max()) for each in finite if len(each)), default=1.0)
    room = 0.04 * (high - low or 1.0)
    return Scale(low - room, high + room, HEIGHT_OF_TRACE_CHART - BOTTOM_OF_TRACE_CHART, TOP_OF_TRACE_CHART)


def _grid_of_trace_chart(x: Scale, y: Scale, unit: str, w: Words) -> Markup:
    parts = []
    for value in y.ticks(4):
        at = y.at(value)
        parts.append(
            element(
                "line", x1=LEFT_OF_TRACE_CHART, x2=WIDTH_OF_TRACE_CHART - RIGHT_OF_TRACE_CHART, y1=at, y2=at, class_="grid"
            )
        )
        parts.append(
            element(
                "text",
                w.number(value, 0 if value == round(value) else 2),
                x=LEFT_OF_TRACE_CHART - 8,
                y=at + 6,
                class_="end",
            )
        )
    for value in x.ticks(5):
        digits = 0 if value == round(value) else 1 if value * 10 == round(value * 10) else 2
        parts.append(
            element(
                "text",
                w.number(value, digits),
                x=x.at(value),
                y=HEIGHT_OF_TRACE_CHART - BOTTOM_OF_TRACE_CHART + 24,
                class_="middle",
            )
        )
    parts.append(
        element(
            "text",
            w("chart.time"),
            x=WIDTH_OF_TRACE_CHART - RIGHT_OF_TRACE_CHART,
            y=HEIGHT_OF_TRACE_CHART - 5,
            class_="end name",
        )
    )
    parts.append(element("text", unit, x=6, y=TOP_OF_TRACE_CHART + 12, class_="name"))
    return element("g", *parts, aria_hidden="true")


def _alt_of_trace_chart(view: TraceView, channel: int, seconds: float, w: Words) -> str:
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
