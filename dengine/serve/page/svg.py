"""Pictures as text: an element of SVG with everything in it escaped, and a scale from values to a picture's units."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from markupsafe import Markup, escape
from numpy.typing import NDArray

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
