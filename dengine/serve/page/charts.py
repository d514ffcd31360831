"""Pictures as SVG: a trace over the band of good ones, a bound, how verification went, and the map of the parts.

Everything that goes into an element is escaped; what a picture shows stands in a sentence as well.
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

Floats = NDArray[np.floating]
Traces = NDArray[np.float32]
BAR_WIDTH, BAR_HEIGHT, BAR = 480, 96, 42  # of a bound's picture, and where its bar lies
POINTS = 360  # drawn of a line at most: half the picture's units
COARSE = 3  # of the bad parts' lines only each third of these
CHANNELS = 3  # drawn, those that leave the band farthest
SIZE = 7.0  # of a mark


def number(value: float | None, digits: int = 0) -> str:
    """1,234.5; a dash where there is none."""
    if value is None or value != value:
        return "–"
    text = f"{abs(value):,.{digits}f}"
    return "\u2212" + text if value < 0 and any(digit in text for digit in "123456789") else text


def percent(share: float | None, digits: int = 0) -> str:
    """A share as per cent; a dash where there is none."""
    return "–" if share is None else f"{number(100.0 * share, digits)}\u202f%"


def element(name: str, *children: str, **attributes: object) -> Markup:
    """An element; text in it is escaped, markup is not. `class_` is class, `aria_label` is aria-label; None is left out."""
    told = "".join(
        f' {key.rstrip("_").replace("_", "-") if key != "viewBox" else key}="{escape(value)}"'
        for key, value in attributes.items()
        if value is not None
    )
    inside = "".join(str(escape(child)) for child in children)
    return Markup(f"<{name}{told}>{inside}</{name}>")  # all that goes in was escaped above


@dataclass(frozen=True, slots=True)
class Scale:
    """From values low..high to units begin..end."""

    low: float
    high: float
    begin: float
    end: float

    def at(self, value: float) -> float:
        """The place of a value, within the picture."""
        return round(float(self.all(np.array([value]))[0]), 1)

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


@dataclass(frozen=True, slots=True)
class Frame:
    """A picture's size, and the space around what is drawn."""

    width: int
    height: int
    left: int
    right: int
    top: int
    bottom: int

    def x(self, low: float, high: float, room: int = 0) -> Scale:
        """The scale from left to right."""
        return Scale(low, high, self.left + room, self.width - self.right - room)

    def y(self, low: float, high: float, room: int = 0) -> Scale:
        """The scale from below to above."""
        return Scale(low, high, self.height - self.bottom - room, self.top + room)

    def picture(self, alt: str, *children: str, role: str = "img", class_: str = "chart") -> Markup:
        """The picture, with what it shows in a sentence."""
        size = f"0 0 {self.width} {self.height}"
        return element("svg", *children, viewBox=size, role=role, aria_label=alt, class_=class_)

    def level(self, y: Scale, value: float, text: str) -> Markup:
        """A line across, and its value beside it."""
        at = y.at(value)
        line = element("line", x1=self.left, x2=self.width - self.right, y1=at, y2=at, class_="grid")
        return line + element("text", text, x=self.left - 8, y=at + 6, class_="end")

    def below(self, x: Scale, digits: int | None = None) -> list[Markup]:
        """Values under the picture."""
        at = self.height - self.bottom + 23
        return [element("text", _tick(value, digits), x=x.at(value), y=at, class_="middle") for value in x.ticks()]

    def name(self, text: str) -> Markup:
        """What is told from left to right."""
        return element("text", text, x=self.width - self.right, y=self.height - 5, class_="end name")


BOUND = Frame(BAR_WIDTH, BAR_HEIGHT, 16, 16, 0, 0)
COURSE = Frame(720, 260, 66, 12, 14, 54)
MAP = Frame(720, 520, 16, 16, 14, 56)
TRACE = Frame(720, 300, 62, 12, 10, 52)


def _tick(value: float, digits: int | None) -> str:
    whole = next((n for n in (0, 1) if round(value, n) == value), 2)
    return number(value, whole if digits is None else digits)


def line_path(x: Floats, y: Floats) -> str:
    """The path through points."""
    return "M" + "L".join(f"{a:.1f} {b:.1f}" for a, b in zip(x.tolist(), y.tolist(), strict=True))


def bound_chart(bound: Bound) -> Markup:
    """The bound between 0 and 1, and the zones in which a part is rejected and accepted."""
    x, reject, accept = BOUND.x(0.0, 1.0), bound.reject_at, bound.accept_at
    zones = [*([] if reject is None else [(0.0, reject, "reject")]), *([] if accept is None else [(accept, 1.0, "accept")])]
    marks = [(sign, value) for sign, value in (("✕ ≤", reject), ("✓ ≥", accept)) if value is not None]
    alt = (
        f"The success rate lies between {percent(bound.lower, 1)} and {percent(bound.upper, 1)}. "
        f"Accepted from {percent(accept, 1)} on, rejected up to {percent(reject, 1)}."
    )
    return _interval(x, bound.lower, bound.upper, zones, marks, alt)


def bad_chart(bad: Judged) -> Markup:
    """The interval of the share of bad accepted parts, and the tolerance."""
    x = BOUND.x(0.0, min(1.0, max(0.02, 2.0 * bad.tolerance, 1.1 * bad.upper)))
    alt = (
        f"The share of bad accepted parts lies between {percent(bad.lower, 1)} and {percent(bad.upper, 1)}; "
        f"the tolerance is {percent(bad.tolerance, 1)}."
    )
    return _interval(x, bad.lower, bad.upper, [(0.0, bad.tolerance, "accept")], [("≤", bad.tolerance)], alt)


def _interval(
    x: Scale, lower: float, upper: float, zones: list[tuple[float, float, str]], marks: list[tuple[str, float]], alt: str
) -> Markup:
    """A bar over zones; the thresholds under their places, and the ends of the axis where there is room."""

    def bar(low: float, high: float, half: int, least: float, kind: str, **more: object) -> Markup:
        width = max(least, x.at(high) - x.at(low))
        return element("rect", x=x.at(low), y=BAR - half, width=width, height=2 * half, class_=kind, **more)

    drawn = [bar(x.low, x.high, 20, 0.0, "axis")]
    drawn += [bar(low, high, 20, 1.0, f"zone {kind}") for low, high, kind in zones]
    drawn.append(bar(lower, upper, 7, 3.0, "interval", rx=3))
    for at in (x.at(lower), x.at(upper)):
        drawn.append(element("line", x1=at, x2=at, y1=BAR - 15, y2=BAR + 15, class_="interval-end"))
    places = [min(max(x.at(value), x.begin + 44), x.end - 44) for _, value in marks]
    told = [(f"{sign} {percent(value)}", at, "middle strong") for (sign, value), at in zip(marks, places, strict=True)]
    ends = ((x.low, x.begin, "start"), (x.high, x.end, "end"))
    told += [(percent(end), at, kind) for end, at, kind in ends if all(abs(at - place) > 110 for place in places)]
    drawn += [element("text", text, x=at, y=BAR_HEIGHT - 8, class_=kind, aria_hidden="true") for text, at, kind in told]
    return BOUND.picture(alt, *drawn, class_="bound")


def course_chart(course: Course) -> Markup:
    """Steps of the verified share; a triangle a retrain, a cross where an accepted part was bad."""
    counts = [stretch.n for stretch in course.stretches]
    ends = np.cumsum([0, *counts]).tolist()
    x, y, bottom = COURSE.x(0.0, ends[-1]), COURSE.y(0.0, 1.0), COURSE.height - COURSE.bottom
    shares = [stretch.verified / stretch.n for stretch in course.stretches]
    path, crosses = "", []
    for stretch, share, begin, end in zip(course.stretches, shares, ends[:-1], ends[1:], strict=True):
        path += f"{'L' if path else 'M'}{x.at(begin)} {y.at(share)}L{x.at(end)} {y.at(share)}"
        if stretch.bad:
            middle = (x.at(begin) + x.at(end)) / 2
            crosses.append(element("path", d=f"M{middle - 6} {COURSE.top}l12 12m0 -12l-12 12", class_="shape cross bad"))
    retrained = {x.at(ends[sum(each.last <= retrain.time for each in course.stretches)]) for retrain in course.retrains}
    retrains = [element("path", d=f"M{at - 5} {bottom}l5 -9l5 9Z", class_="retrain") for at in sorted(retrained)]
    grid = [
        *(COURSE.level(y, value, percent(value)) for value in (0.0, 0.5, 1.0)),
        *COURSE.below(x, 0),
        COURSE.name("parts"),
    ]
    alt = (
        "Share of verified parts from the first to the newest: "
        f"it began at {percent(shares[0])} and is now at {percent(shares[-1])}."
    )
    line = element("path", d=path, class_="course")
    return COURSE.picture(alt, element("g", *grid, aria_hidden="true"), *retrains, line, *crosses)


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


def map_chart(found: PartMap, chosen: str, root: str) -> Markup:
    """The picture; every mark is a link to its part, and one of them is reached by the tab key."""
    xs, ys = np.array([mark.x for mark in found.marks]), np.array([mark.y for mark in found.marks])
    low, high = (0.0, 1.0) if found.probability else (float(xs.min()), float(xs.max()))
    bottom, top = np.quantile(ys, (0.005, 0.995)).tolist()
    x, y = MAP.x(low, high, 18), MAP.y(bottom, top, 18)
    spoken = next((mark for mark in found.marks if mark.id == chosen), found.marks[-1])
    links = [_link(mark, x, y, mark is spoken, mark.id == chosen, root) for mark in found.marks]
    good, bad = (sum(mark.label == label and not mark.action for mark in found.marks) for label in ("good", "bad"))
    alt = (
        f"Map of {good + bad} known parts, {good} good and {bad} bad, and the newest {len(found.marks) - good - bad}. "
        "Arrow keys go from part to part."
    )
    inside = {
        "x": MAP.left,
        "y": MAP.top,
        "width": MAP.width - MAP.left - MAP.right,
        "height": MAP.height - MAP.top - MAP.bottom,
    }
    name = MAP.name("model's probability of a good part" if found.probability else "first axis")
    text = element("g", element("rect", **inside, class_="axis"), name, *MAP.below(x, 1), aria_hidden="true")
    ball = []
    if found.radius is not None:
        newest = found.marks[-1]
        radii = [found.radius * abs(s.end - s.begin) / (s.high - s.low or 1.0) for s in (x, y)]
        rx, ry = (round(each, 1) for each in radii)
        around = element("ellipse", cx=x.at(newest.x), cy=y.at(newest.y), rx=rx, ry=ry, class_="ball")
        ball = [element("svg", around, **inside, viewBox=" ".join(map(str, inside.values())), aria_hidden="true")]
    return MAP.picture(alt, text, *ball, *links, role="group", class_="chart map")


def _link(mark: Mark, x: Scale, y: Scale, reached: bool, chosen: bool, root: str) -> Markup:
    label = "not known" if mark.label == "none" else mark.label
    name = ", ".join([mark.name, *([mark.action.capitalize()] if mark.action else []), label])
    told = {mark.label: True, "recent": mark.action, "newest": mark.newest, "chosen": chosen}
    return element(
        "a",
        element("title", name),
        *_shape(mark, x.at(mark.x), y.at(mark.y)),
        href=f"{root}/map?id={quote(mark.id, safe='')}",
        id=f"m{sha256(mark.id.encode()).hexdigest()[:12]}",
        class_=" ".join(["mark", *(kind for kind, so in told.items() if so)]),
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
    return [element("circle", cx=x, cy=y, r=s * 1.5, class_="hit"), *ring, shapes[mark.label]]


@dataclass(frozen=True)
class TraceView:
    """What a picture of a trace is drawn from.

    trace : (C, T).  bads : (n, C, T), some bad parts.  band : of the good ones, None while they are too few.
    """

    trace: Traces
    spec: TraceSpec
    band: Envelope | None
    bads: Traces


def trace_charts(view: TraceView) -> list[Markup]:
    """A picture a channel."""
    widest = np.zeros(len(view.trace))
    for each in () if view.band is None else view.band.excesses:
        widest[each.channel] = max(widest[each.channel], each.widths)
    return [_trace_chart(view, channel) for channel in sorted(np.argsort(-widest, kind="stable")[:CHANNELS].tolist())]


def _trace_chart(view: TraceView, channel: int) -> Markup:
    trace, band, rate = view.trace[channel], view.band, view.spec.rate_hz
    step = max(1, len(trace) // POINTS)
    bads = view.bads[:, channel, :: COARSE * step] if len(view.bads) else np.zeros((0, 0), np.float32)
    edges = [] if band is None else [band.low[channel], band.high[channel]]
    values = np.concatenate([trace, *edges, *bads])
    finite = values[np.isfinite(values)] if np.isfinite(values).any() else np.array([0.0, 1.0])
    room = 0.04 * float(np.ptp(finite) or 1.0)
    x, y = TRACE.x(0.0, len(trace) / rate), TRACE.y(float(finite.min()) - room, float(finite.max()) + room)
    times = x.all(np.arange(0, len(trace), step) / rate)
    unit = element("text", view.spec.unit, x=6, y=TRACE.top + 12, class_="name")
    levels = [TRACE.level(y, value, _tick(value, 0 if value == round(value) else 2)) for value in y.ticks(4)]
    layers = [element("g", *levels, *TRACE.below(x), TRACE.name("time in s"), unit, aria_hidden="true")]
    if band is not None:
        low, high, median = (y.all(each[channel][::step]) for each in (band.low, band.high, band.median))
        around = line_path(np.concatenate([times, times[::-1]]), np.concatenate([high, low[::-1]])) + "Z"
        layers.append(element("path", d=around, class_="band"))
        layers.append(element("path", d=line_path(times, median), class_="median"))
    layers += [element("path", d=line_path(times[::COARSE], y.all(bad)), class_="bad-trace") for bad in bads]
    layers.append(element("path", d=line_path(times, y.all(trace[::step])), class_="trace"))
    return TRACE.picture(_trace_alt(view, channel), *layers)


def _trace_alt(view: TraceView, channel: int) -> str:
    trace, band = view.trace[channel], view.band
    finite = trace[np.isfinite(trace)] if np.isfinite(trace).any() else np.zeros(1)
    seconds, low, high = (number(each, 1) for each in (len(trace) / view.spec.rate_hz, finite.min(), finite.max()))
    said = f"Force over {seconds} s, from {low} to {high} {view.spec.unit}. "
    if band is None:
        return said + "No band of good parts is drawn yet."
    said += (
        f"{percent(band.outside, 1)} of it lies outside the band of good parts; "
        f"for most good parts it is less than {percent(band.usual, 1)}."
    )
    here = [each for each in band.excesses if each.channel == channel]
    if not here:
        return said
    most = max(here, key=lambda each: each.widths)
    side, start, end = "upwards" if most.above else "downwards", number(most.from_s, 2), number(most.to_s, 2)
    return f"{said} It leaves the band farthest {side} between {start} s and {end} s."
