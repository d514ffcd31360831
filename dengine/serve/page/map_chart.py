"""The map: where the known parts and the newest lie in the model's embedding, a mark and a link each."""

from __future__ import annotations

from dataclasses import dataclass
from hashlib import sha256
from urllib.parse import quote

import numpy as np
from markupsafe import Markup

from .svg import Scale, element, picture
from .words import Words

WIDTH, HEIGHT = 720, 520
LEFT, RIGHT, TOP, BOTTOM = 16, 16, 14, 56
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
            "text", w("map.probability" if found.probability else "map.first"), x=WIDTH - RIGHT, y=HEIGHT - 6, class_="end"
        ),
        *(element("text", w.number(tick, 1), x=x.at(tick), y=HEIGHT - BOTTOM + 20, class_="middle") for tick in x.ticks(5)),
    ]
    frame = element("rect", x=LEFT, y=TOP, width=WIDTH - LEFT - RIGHT, height=HEIGHT - TOP - BOTTOM, class_="axis")
    text = element("g", frame, *names, aria_hidden="true")
    return picture(WIDTH, HEIGHT, alt, text, *ball, *links, role="group", class_="chart map")


def _scales(found: PartMap) -> tuple[Scale, Scale]:
    xs, ys = np.array([mark.x for mark in found.marks] or [0.0]), np.array([mark.y for mark in found.marks] or [0.0])
    low, high = (0.0, 1.0) if found.probability else (float(xs.min()), float(xs.max()))
    bottom, top = np.quantile(ys, (0.005, 0.995)).tolist()
    return Scale(low, high, LEFT + 18, WIDTH - RIGHT - 18), Scale(bottom, top, HEIGHT - BOTTOM - 18, TOP + 18)


def _ball(found: PartMap, x: Scale, y: Scale) -> Markup:
    newest, radius = found.marks[-1], found.radius or 0.0
    width = radius * (x.end - x.begin) / (x.high - x.low or 1.0)
    height = radius * (y.begin - y.end) / (y.high - y.low or 1.0)
    center = {"cx": x.at(newest.x), "cy": y.at(newest.y)}
    ball = element("ellipse", **center, rx=round(width, 1), ry=round(height, 1), class_="ball")
    inside = {"x": LEFT, "y": TOP, "width": WIDTH - LEFT - RIGHT, "height": HEIGHT - TOP - BOTTOM}  # of the frame
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
