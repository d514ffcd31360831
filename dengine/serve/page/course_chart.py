"""The picture of how it went: the verified share along the parts, the retrains, and bad accepted parts."""

from __future__ import annotations

from markupsafe import Markup

from ...standing import Course
from .svg import Scale, element, picture
from .words import Words

WIDTH, HEIGHT = 720, 260
LEFT, RIGHT, TOP, BOTTOM = 66, 12, 14, 54


def course_chart(course: Course, w: Words) -> Markup:
    """Steps of the verified share; a triangle a retrain, a cross where an accepted part was bad."""
    total = sum(stretch.n for stretch in course.stretches)
    x, y = Scale(0.0, total, LEFT, WIDTH - RIGHT), Scale(0.0, 1.0, HEIGHT - BOTTOM, TOP)
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
        WIDTH,
        HEIGHT,
        _alt(course, w),
        _grid(x, y, w),
        *_retrains(course, x),
        element("path", d=path, class_="course"),
        *crosses,
    )


def _retrains(course: Course, x: Scale) -> list[Markup]:
    places = sorted({x.at(place) for place in _retrain_places(course)})
    bottom = HEIGHT - BOTTOM
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
        parts.append(element("line", x1=LEFT, x2=WIDTH - RIGHT, y1=at, y2=at, class_="grid"))
        parts.append(element("text", w.percent(value), x=LEFT - 8, y=at + 6, class_="end"))
    below = HEIGHT - BOTTOM + 22
    parts += [element("text", w.number(value), x=x.at(value), y=below, class_="middle") for value in x.ticks(5)]
    parts.append(element("text", w("how.course.parts"), x=WIDTH - RIGHT, y=HEIGHT - 5, class_="end name"))
    return element("g", *parts, aria_hidden="true")


def _alt(course: Course, w: Words) -> str:
    first, last = (course.stretches[i].verified / course.stretches[i].n for i in (0, -1))
    return w("alt.course", first=w.percent(first), last=w.percent(last))
