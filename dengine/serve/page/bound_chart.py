"""Pictures of an interval: a bound against what it must reach, and the share of bad parts against the tolerance."""

from __future__ import annotations

from markupsafe import Markup

from ...standing import BadAccepts
from ...verdict import Bound
from .svg import Scale, element, picture
from .words import Words

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


def bad_chart(bad: BadAccepts, w: Words) -> Markup:
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
