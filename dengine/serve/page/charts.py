"""Pictures as SVG: a trace over the band of good ones, a bound, how verification went, and the map of the parts.

Everything that goes into an element is escaped; what a picture shows stands in a sentence as well.
"""

from __future__ import annotations

from dataclasses import dataclass
from hashlib import sha256
from typing import NamedTuple
from urllib.parse import quote

import numpy as np
from markupsafe import Markup, escape
from numpy.typing import ArrayLike, NDArray

from ...history.explain import Bound, Explanation
from ...history.status import Course, Judged

Floats = NDArray[np.floating]
POINTS = 360  # drawn of a line at most: half the picture's units
COARSE = 3  # of the bad parts' lines only each third of these
CHANNELS = 3  # drawn, those that leave the band farthest


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
    return Markup(f"<{name}{told}>{''.join(str(escape(child)) for child in children)}</{name}>")  # all of it is escaped


class Scale(NamedTuple):
    """From values low..high to units begin..end."""

    low: float
    high: float
    begin: float
    end: float

    def all(self, values: ArrayLike) -> Floats:
        """The places of values, within the picture."""
        share = (np.nan_to_num(values, nan=self.low) - self.low) / (self.high - self.low or 1.0)
        return np.asarray(self.begin + np.clip(share, 0.0, 1.0) * (self.end - self.begin))

    def at(self, value: float) -> float:
        """The place of one value."""
        return round(float(self.all(value)), 1)

    def ticks(self, most: int = 5) -> list[float]:
        """Round values for an axis, at most about so many."""
        rough = (self.high - self.low) / most
        if not rough > 0:
            return [self.low]
        power = 10.0 ** np.floor(np.log10(rough))
        step = float(next(m * power for m in (1, 2, 5, 10) if m * power >= rough))
        first = np.ceil(self.low / step - 1e-9) * step
        return [float(round(tick, 10)) for tick in np.arange(first, self.high + step * 1e-6, step)]


class Frame(NamedTuple):
    """A picture's size, and the space around what is drawn."""

    width: int
    height: int
    left: int
    right: int
    top: int
    bottom: int

    def scales(self, x: tuple[float, float], y: tuple[float, float] = (0.0, 1.0), room: int = 0) -> tuple[Scale, Scale]:
        """From left to right, and from below to above."""
        across = Scale(*x, self.left + room, self.width - self.right - room)
        return across, Scale(*y, self.height - self.bottom - room, self.top + room)

    def picture(self, alt: str, *children: str, role: str = "img", class_: str = "chart") -> Markup:
        """The picture, with what it shows in a sentence."""
        size = f"0 0 {self.width} {self.height}"
        return element("svg", *children, viewBox=size, role=role, aria_label=alt, class_=class_)

    def axes(
        self, name: str, x: Scale, digits: int | None, *more: Markup, levels: dict[float, str] | None = None
    ) -> Markup:
        """Values under the picture, what they are, and lines across it.  levels : their places and names."""
        end, below = self.width - self.right, self.height - self.bottom + 23
        lines = [element("line", x1=self.left, x2=end, y1=at, y2=at, class_="grid") for at in levels or ()]
        told = [element("text", text, x=self.left - 8, y=at + 6, class_="end") for at, text in (levels or {}).items()]
        told += [element("text", _tick(value, digits), x=x.at(value), y=below, class_="middle") for value in x.ticks()]
        told.append(element("text", name, x=end, y=self.height - 5, class_="end name"))
        return element("g", *more, *lines, *told, aria_hidden="true")


BOUND = Frame(480, 96, 16, 16, 0, 0)
COURSE = Frame(720, 260, 66, 12, 14, 54)
MAP = Frame(720, 520, 16, 16, 14, 56)
TRACE = Frame(720, 300, 62, 12, 10, 52)


def _tick(value: float, digits: int | None) -> str:
    whole = next((n for n in (0, 1) if round(value, n) == value), 2)
    return number(value, whole if digits is None else digits)


def _line(x: Floats, y: Floats, kind: str, close: str = "") -> Markup:
    points = "L".join(f"{a:.1f} {b:.1f}" for a, b in zip(x.tolist(), y.tolist(), strict=True))
    return element("path", d=f"M{points}{close}", class_=kind)


def bound_chart(bound: Bound) -> Markup:
    """The bound between 0 and 1, and the zones in which a part is rejected and accepted."""
    reject, accept = bound.reject_at, bound.accept_at
    zones = [*([] if reject is None else [(0.0, reject, "reject")]), *([] if accept is None else [(accept, 1.0, "accept")])]
    marks = [(sign, value) for sign, value in (("✕ ≤", reject), ("✓ ≥", accept)) if value is not None]
    alt = (
        f"The success rate lies between {percent(bound.lower, 1)} and {percent(bound.upper, 1)}. "
        f"Accepted from {percent(accept, 1)} on, rejected up to {percent(reject, 1)}."
    )
    return _interval(1.0, bound.lower, bound.upper, zones, marks, alt)


def bad_chart(bad: Judged) -> Markup:
    """The interval of the share of bad accepted parts, and the tolerance."""
    alt = (
        f"The share of bad accepted parts lies between {percent(bad.lower, 1)} and {percent(bad.upper, 1)}; "
        f"the tolerance is {percent(bad.tolerance, 1)}."
    )
    most, zones = min(1.0, max(0.02, 2.0 * bad.tolerance, 1.1 * bad.upper)), [(0.0, bad.tolerance, "accept")]
    return _interval(most, bad.lower, bad.upper, zones, [("≤", bad.tolerance)], alt)


def _interval(
    most: float, lower: float, upper: float, zones: list[tuple[float, float, str]], marks: list[tuple[str, float]], alt: str
) -> Markup:
    """A bar over zones of 0..most; thresholds under their places, and the ends of the axis where there is room."""
    x, middle = BOUND.scales((0.0, most))[0], 42  # where the bar lies
    drawn = []
    for low, high, half, least, kind in (
        (0.0, most, 20, 0.0, "axis"),
        *((low, high, 20, 1.0, f"zone {kind}") for low, high, kind in zones),
        (lower, upper, 7, 3.0, "interval"),
    ):
        width, round_ = max(least, x.at(high) - x.at(low)), 3 if kind == "interval" else None
        drawn.append(element("rect", x=x.at(low), y=middle - half, width=width, height=2 * half, class_=kind, rx=round_))
    high, low = middle - 15, middle + 15
    drawn += [element("line", x1=x.at(end), x2=x.at(end), y1=high, y2=low, class_="interval-end") for end in (lower, upper)]
    places = [min(max(x.at(value), x.begin + 44), x.end - 44) for _, value in marks]
    told = [(f"{sign} {percent(value)}", at, "middle strong") for (sign, value), at in zip(marks, places, strict=True)]
    ends = ((x.low, x.begin, "start"), (x.high, x.end, "end"))
    told += [(percent(end), at, kind) for end, at, kind in ends if all(abs(at - place) > 110 for place in places)]
    drawn += [element("text", text, x=at, y=BOUND.height - 8, class_=kind, aria_hidden="true") for text, at, kind in told]
    return BOUND.picture(alt, *drawn, class_="bound")


def course_chart(course: Course) -> Markup:
    """Steps of the verified share; a triangle a retrain, a cross where an accepted part was bad."""
    ends = np.cumsum([0, *(stretch.n for stretch in course.stretches)]).tolist()
    x, y = COURSE.scales((0.0, ends[-1]))
    shares = [stretch.verified / stretch.n for stretch in course.stretches]
    path, crosses = "", []
    for stretch, share, begin, end in zip(course.stretches, shares, ends[:-1], ends[1:], strict=True):
        path += f"{'L' if path else 'M'}{x.at(begin)} {y.at(share)}L{x.at(end)} {y.at(share)}"
        if stretch.bad:
            left = (x.at(begin) + x.at(end)) / 2 - 6
            crosses.append(element("path", d=f"M{left} {COURSE.top}l12 12m0 -12l-12 12", class_="shape cross bad"))
    retrained = {x.at(ends[sum(each.last <= retrain.time for each in course.stretches)]) for retrain in course.retrains}
    retrains = [element("path", d=f"M{at - 5} {y.begin}l5 -9l5 9Z", class_="retrain") for at in sorted(retrained)]
    grid = COURSE.axes("parts", x, 0, levels={y.at(value): percent(value) for value in (0.0, 0.5, 1.0)})
    alt = (
        "Share of verified parts from the first to the newest: "
        f"it began at {percent(shares[0])} and is now at {percent(shares[-1])}."
    )
    return COURSE.picture(alt, grid, *retrains, element("path", d=path, class_="course"), *crosses)


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


class PartMap(NamedTuple):
    """The known parts and the newest.

    marks : the known ones first, oldest first.  probability : whether x is one.
    radius : of the ball around the newest, None where it is not fixed.
    """

    marks: tuple[Mark, ...]
    radius: float | None
    probability: bool


def map_chart(found: PartMap, chosen: str, root: str) -> Markup:
    """The picture; every mark is a link to its part, and one of them is reached by the tab key."""
    xs, ys = np.array([(mark.x, mark.y) for mark in found.marks]).T
    bottom, top = np.quantile(ys, (0.005, 0.995)).tolist()
    ends = (0.0, 1.0) if found.probability else (float(xs.min()), float(xs.max()))
    x, y = MAP.scales(ends, (bottom, top), 18)
    newest = found.marks[-1]
    reached = next((mark for mark in found.marks if mark.id == chosen), newest)
    links = [_link(mark, x.at(mark.x), y.at(mark.y), mark is reached, mark.id == chosen, root) for mark in found.marks]
    good, bad = (sum(mark.label == label and not mark.action for mark in found.marks) for label in ("good", "bad"))
    alt = (
        f"Map of {good + bad} known parts, {good} good and {bad} bad, and the newest {len(found.marks) - good - bad}. "
        "Arrow keys go from part to part."
    )
    wide, high = MAP.width - MAP.left - MAP.right, MAP.height - MAP.top - MAP.bottom
    inside = {"x": MAP.left, "y": MAP.top, "width": wide, "height": high}
    name = "model's probability of a good part" if found.probability else "first axis"
    drawn = [MAP.axes(name, x, 1, element("rect", **inside, class_="axis"))]
    if found.radius is not None:
        rx, ry = (round(found.radius * abs(each.end - each.begin) / (each.high - each.low or 1.0), 1) for each in (x, y))
        ball = element("ellipse", cx=x.at(newest.x), cy=y.at(newest.y), rx=rx, ry=ry, class_="ball")
        drawn.append(element("svg", ball, **inside, viewBox=" ".join(map(str, inside.values())), aria_hidden="true"))
    return MAP.picture(alt, *drawn, *links, role="group", class_="chart map")


def _link(mark: Mark, x: float, y: float, reached: bool, chosen: bool, root: str) -> Markup:
    """A circle is good, a cross is bad, a square is not known; a ring around it: it is among the newest."""
    label = "not known" if mark.label == "none" else mark.label
    name = ", ".join([mark.name, *([mark.action.capitalize()] if mark.action else []), label])
    told = {mark.label: True, "recent": mark.action, "newest": mark.newest, "chosen": chosen}
    size = 7.0
    drawn = [element("title", name), element("circle", cx=x, cy=y, r=size * 1.5, class_="hit")]
    if mark.action:
        drawn.append(element("circle", cx=x, cy=y, r=size * (2.2 if mark.newest else 1.6), class_="ring"))
    left, top, right, below = x - size, y - size, x + size, y + size
    if mark.label == "good":
        drawn.append(element("circle", cx=x, cy=y, r=size * 0.8, class_="shape"))
    elif mark.label == "bad":
        drawn.append(element("path", d=f"M{left} {top}L{right} {below}M{left} {below}L{right} {top}", class_="shape cross"))
    else:
        half, side = size * 0.7, size * 1.4
        drawn.append(element("rect", x=x - half, y=y - half, width=side, height=side, class_="shape"))
    return element(
        "a",
        *drawn,
        href=f"{root}/map?id={quote(mark.id, safe='')}",
        id=f"m{sha256(mark.id.encode()).hexdigest()[:12]}",
        class_=" ".join(["mark", *(kind for kind, so in told.items() if so)]),
        tabindex=0 if reached else -1,
        aria_label=name,
        aria_current="true" if chosen else None,
        data_x=x,
        data_y=y,
    )


def trace_charts(found: Explanation, bads: NDArray[np.float32]) -> list[Markup]:
    """A picture a channel, of those that leave the band farthest.  bads : (n, C, T), some bad parts."""
    widest = np.zeros(len(found.trace))
    for each in () if found.envelope is None else found.envelope.excesses:
        widest[each.channel] = max(widest[each.channel], each.widths)
    drawn = sorted(np.argsort(-widest, kind="stable")[:CHANNELS].tolist())
    return [_trace_chart(found, bads, channel) for channel in drawn]


def _trace_chart(found: Explanation, bads: NDArray[np.float32], channel: int) -> Markup:
    trace, band, rate = found.trace[channel], found.envelope, found.spec.rate_hz
    step = max(1, len(trace) // POINTS)
    others = bads[:, channel, :: COARSE * step] if len(bads) else np.zeros((0, 0), np.float32)
    values = np.concatenate([trace, *([] if band is None else [band.low[channel], band.high[channel]]), *others])
    finite = values[np.isfinite(values)] if np.isfinite(values).any() else np.array([0.0, 1.0])
    room = 0.04 * float(np.ptp(finite) or 1.0)
    x, y = TRACE.scales((0.0, len(trace) / rate), (float(finite.min()) - room, float(finite.max()) + room))
    times = x.all(np.arange(0, len(trace), step) / rate)
    levels = {y.at(value): _tick(value, 0 if value == round(value) else 2) for value in y.ticks(4)}
    unit = element("text", found.spec.unit, x=6, y=TRACE.top + 12, class_="name")
    layers = [TRACE.axes("time in s", x, None, unit, levels=levels)]
    if band is not None:
        low, high, median = (y.all(each[channel][::step]) for each in (band.low, band.high, band.median))
        layers.append(_line(np.concatenate([times, times[::-1]]), np.concatenate([high, low[::-1]]), "band", "Z"))
        layers.append(_line(times, median, "median"))
    layers += [_line(times[::COARSE], y.all(bad), "bad-trace") for bad in others]
    return TRACE.picture(_trace_alt(found, channel), *layers, _line(times, y.all(trace[::step]), "trace"))


def _trace_alt(found: Explanation, channel: int) -> str:
    trace, band = found.trace[channel], found.envelope
    finite = trace[np.isfinite(trace)] if np.isfinite(trace).any() else np.zeros(1)
    seconds, low, high = (number(each, 1) for each in (len(trace) / found.spec.rate_hz, finite.min(), finite.max()))
    said = f"Force over {seconds} s, from {low} to {high} {found.spec.unit}. "
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
