"""Maps of the embedding: where the parts of a replay lie, and how far the ball reaches that labels are counted in."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..recipe import Recipe
from ..reducers import reducer_class
from .look import ACTION_MARKS, BLACK, SMALL, TRUTH_MARKS, Floats, Mark, legend_above, plain
from .replay import Replay

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

NEWEST = 300  # parts drawn, as many as the paper's window


def embedding_map(replay: Replay, last: int = NEWEST, title: str = "") -> Figure:
    """Where the newest parts of a replay lie: once by what they were, once by what was decided.

    Only the newest, since each retrain moves the map. The first two dimensions are drawn, the mean over the spaces. The
    circle is the ball around the newest part, where the recipe fixes its radius. Units are equal on both axes, but where
    the first is a probability: there the second is for the eye, and the ball is cut off above and below.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 5.4), layout="constrained")
    left, right = figure.subplots(1, 2, sharex=True, sharey=True)
    z = _plane(replay.position[-last:])
    for axes, kinds, marks in ((left, replay.truth, TRUTH_MARKS), (right, replay.action, ACTION_MARKS)):
        _scatter(axes, z, kinds[-last:], marks)
        plain(axes)
        legend_above(axes)
    left.set_title("what the parts were", pad=24)
    right.set_title("what was decided", pad=24)
    _label_axes(left, right, z, replay.recipe)
    _draw_balls(figure, z, replay.recipe)
    figure.suptitle(title)
    return figure


def is_probability(recipe: Recipe) -> bool:
    """Whether the recipe's first axis is a predicted probability of success, which is never scaled."""
    kind = reducer_class(recipe.reducer) if isinstance(recipe.reducer, str) else recipe.reducer
    return bool(getattr(kind, "own_unit", False))  # scikit-learn's transformers say nothing of a unit


def _plane(positions: Floats) -> Floats:
    """(n, d) -> (n, 2): zeros where a reducer has but one dimension."""
    return np.hstack([positions, np.zeros_like(positions[:, :1])])[:, :2]


def _known(z: Floats) -> NDArray[np.bool_]:
    return np.asarray(np.isfinite(z).all(axis=1))


def _scatter(axes: Axes, z: Floats, kinds: NDArray[Any], marks: Mapping[Any, Mark]) -> None:
    for kind, mark in marks.items():
        points = z[_known(z) & (kinds == kind)]
        look: dict[str, Any] = {"color": mark.colour, "marker": mark.marker, "s": mark.size, "alpha": 0.7, "linewidths": 0}
        axes.scatter(points[:, 0], points[:, 1], label=f"{mark.name} ({len(points)})", **look)
    if not _known(z).any():
        axes.text(0.5, 0.5, "no trace was embedded yet", transform=axes.transAxes, ha="center", va="center")


def _draw_balls(figure: Figure, z: Floats, recipe: Recipe) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Circle

    if recipe.fraction is not None or not _known(z).any():
        return  # a ball that grows until it holds a share of the references has no radius of its own
    x, y = z[_known(z)][-1]
    for axes in figure.axes:
        axes.add_patch(Circle((x, y), recipe.radius, fill=False, edgecolor=BLACK, linewidth=1.4))
        axes.plot([x], [y], "+", color=BLACK, markersize=9)
    label = f"the ball around the newest part, radius {recipe.radius:g}"
    label += ", cut off above and below" if is_probability(recipe) else ""
    ring = Line2D([], [], color=BLACK, marker="o", markersize=11, fillstyle="none", linestyle="none", label=label)
    figure.legend(handles=[ring], loc="outside lower center", frameon=False, fontsize=SMALL)


def _label_axes(left: Axes, right: Axes, z: Floats, recipe: Recipe) -> None:
    if is_probability(recipe):
        first, second = "predicted probability of success", "embedding 2 [for the eye, small against the radius]"
        left.set(xlim=(-0.06, 1.06), ylim=_around(z[:, 1]))
    else:
        first, second = (f"embedding {i} [root mean square radius = 1]" for i in (1, 2))
        span = max(np.ptp(_around(z[:, 0])), np.ptp(_around(z[:, 1])))
        left.set(xlim=_around(z[:, 0], span), ylim=_around(z[:, 1], span))
        for axes in (left, right):
            axes.set_aspect("equal")
    left.set(xlabel=first, ylabel=second)
    right.set(xlabel=first)


def _around(values: Floats, span: float = 0.0) -> tuple[float, float]:
    """Limits of an axis: the known values with a margin, or as wide as `span` where that is more."""
    known = values[np.isfinite(values)]
    if not len(known):
        return -1.0, 1.0
    low, high = float(known.min()), float(known.max())
    half = max(0.56 * (high - low), span / 2) or 1.0
    return (low + high) / 2 - half, (low + high) / 2 + half
