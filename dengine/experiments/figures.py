"""Pictures of replays, grids, runs and costs, as matplotlib figures that are saved and forgotten; and how all of them look.

    save(curves({"conv": replays}), "out/curves.png")

No pyplot: its global state would leak figures into a user's notebook. Colours: Okabe and Ito (2008), distinct to all eyes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import OutputError
from ..files import write_output
from ..recipe import Recipe
from ..records import Action
from ..reducers import reducer_class
from .costs import CostCurve, PolicyCost
from .replay import Replay

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]

BLUE, RED, GREEN, PINK, SKY, ORANGE = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00"
GREY, BLACK = "#6E6E6E", "#000000"
GOOD, BAD, VERIFIED = BLUE, RED, GREY  # of parts, and of the decisions that call them so
RECIPES = (GREEN, PINK, ORANGE, SKY, BLUE, RED)  # first those that mean nothing else
LIMIT: dict[str, Any] = {"color": BLACK, "linestyle": ":", "linewidth": 1.2}  # a bound, or a moment, that is given
SMALL = 9  # points: legends and notes


@dataclass(frozen=True)
class Mark:
    """How one kind of part is drawn on a map."""

    name: str
    colour: str
    marker: str
    size: int


ACTION_MARKS = {  # drawn in this order, so that the few certain ones lie on top
    Action.VERIFY: Mark("verify", VERIFIED, "o", 9),
    Action.ACCEPT: Mark("accept", GOOD, "o", 26),
    Action.REJECT: Mark("reject", BAD, "X", 30),
}
TRUTH_MARKS = {True: Mark("good part", GOOD, "o", 22), False: Mark("bad part", BAD, "X", 26)}


def sliding_sum(values: NDArray[Any], window: int) -> Floats:
    """(..., n) -> (..., n): sum over the last `window` values, over all so far where there are fewer."""
    total = np.cumsum(np.asarray(values, dtype=np.float64), axis=-1)
    out = total.copy()
    out[..., window:] -= total[..., :-window]
    return out


def blank(width: float, height: float) -> Figure:
    """An empty figure, inches."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def panels(rows: int, size: tuple[float, float], heights: Sequence[float] | None = None) -> tuple[Figure, list[Axes]]:
    """A figure of panels one below the other, with one axis of cycles."""
    figure = blank(*size)
    axes = list(figure.subplots(rows, 1, sharex=True, height_ratios=heights))
    for each in axes:
        plain(each)
    return figure, axes


def plain(axes: Axes) -> None:
    """A light grid, and no box."""
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)


def note(axes: Axes, text: str, colour: str = BLACK) -> None:
    """Words in the middle, where there is nothing to draw."""
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", color=colour)


def whole_numbers(axes: Axes) -> None:
    """Ticks of counts."""
    from matplotlib.ticker import MaxNLocator

    axes.yaxis.set_major_locator(MaxNLocator(nbins=6, integer=True))


def legend_above(axes: Axes, columns: int = 3) -> None:
    """The legend above the axes: inside, it would lie on one curve or another."""
    axes.legend(
        loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=columns, frameon=False, fontsize=SMALL, borderaxespad=0.2
    )


def draw_errors(axes: Axes, false_positive: NDArray[np.bool_], false_negative: NDArray[np.bool_]) -> None:
    """Wrong decisions so far, (n,) each: bad parts accepted, good parts rejected."""
    x = np.arange(1, len(false_positive) + 1)
    axes.step(x, np.cumsum(false_positive), "-", where="post", color=BAD, label="bad part accepted (FP)")
    axes.step(x, np.cumsum(false_negative), "--", where="post", color=GOOD, label="good part rejected (FN)")
    whole_numbers(axes)


def draw_verified(
    axes: Axes, verified: NDArray[np.bool_], window: int, colour: str = VERIFIED, label: str = "verified"
) -> None:
    """Share of the parts that were checked, (n,), over the last `window` cycles."""
    x, seen = np.arange(1, len(verified) + 1), sliding_sum(np.ones(len(verified)), window)
    axes.plot(x, 100 * sliding_sum(verified, window) / seen, color=colour, label=label)
    axes.set(ylim=(0, 104))


def save(figure: Figure, path: str | Path, dpi: int = 120, force: bool = False) -> Path:
    """Write a figure as its suffix says; makes the folder. OutputError where a file is there, without `force`."""
    buffer = BytesIO()
    try:
        figure.savefig(buffer, dpi=dpi, format=Path(path).suffix.removeprefix(".") or "png")
    except ValueError as error:
        raise OutputError(f"Cannot draw {path}: {error}; name it .png, .pdf or .svg.") from error
    return write_output(path, buffer.getvalue(), force, make_folder=True)


NEWEST = 300  # parts drawn, as many as the paper's window


def embedding_map(replay: Replay, last: int = NEWEST, title: str = "") -> Figure:
    """Where the newest parts of a replay lie: once by what they were, once by what was decided.

    Only the newest, since each retrain moves the map. The first two dimensions are drawn, the mean over the spaces. The
    circle is the ball around the newest part, where the recipe fixes its radius. Units are equal on both axes, but where
    the first is a probability: there the second is for the eye, and the ball is cut off above and below.
    """
    figure = blank(10.0, 5.4)
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
        note(axes, "no trace was embedded yet")


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


WINDOW = 300  # cycles, the paper's
FEWEST = 20  # parts: a share of fewer jumps by more than five in a hundred with each, and is not drawn
COUNTS = ("accepted", "false_positive", "rejected", "false_negative")


def window_curves(replays: Sequence[Replay], window: int = WINDOW, fewest: int = 1) -> dict[str, Floats]:
    """What the paper plots, in percent, (n,) each, over a sliding window and all replays, which must be equally long.

    certain : of all cycles in the window.  certain_low, certain_high : 10th and 90th percentile over the replays.
    precision, false_positive : of the accepted parts in the windows of all replays together.
    false_negative : of the rejected parts, likewise.  All three NaN where these are fewer than `fewest`.
    """
    accept, reject = np.stack([r.accepted for r in replays]), np.stack([r.rejected for r in replays])
    seen = sliding_sum(np.ones(accept.shape[1]), window)
    certain = sliding_sum(accept | reject, window) / seen
    false_positive = _pooled_share(np.stack([r.false_positive for r in replays]), accept, window, fewest)
    false_negative = _pooled_share(np.stack([r.false_negative for r in replays]), reject, window, fewest)
    curves = {
        "certain": certain.mean(axis=0),
        "certain_low": np.quantile(certain, 0.1, axis=0),
        "certain_high": np.quantile(certain, 0.9, axis=0),
        "precision": 1.0 - false_positive,
        "false_positive": false_positive,
        "false_negative": false_negative,
    }
    return {name: 100.0 * values for name, values in curves.items()}


def _pooled_share(wrong: Any, decided: Any, window: int, fewest: int) -> Floats:
    """(replays, n) bool each -> (n,): share of the decided parts that were wrong, in all replays' windows together."""
    of = sliding_sum(decided.sum(axis=0), window)
    return np.where(of >= fewest, sliding_sum(wrong.sum(axis=0), window) / np.maximum(of, 1.0), np.nan)


def curves(by_recipe: Mapping[str, Sequence[Replay]], title: str = "", window: int = WINDOW) -> Figure:
    """The paper's two-part curve, a colour a recipe: certain and precision above; below the errors of what was decided.

    The tolerance 100 - LB is a share of the accepted parts, so the errors are drawn as shares of what was decided alike.
    """
    wide = max(2, min(len(by_recipe), 4))  # recipes side by side in the legends: a column each, and one for the bound
    figure, (top, bottom) = panels(2, (3.6 + 2.7 * wide, 7.4), heights=(4, 3))
    length = max(len(r) for replays in by_recipe.values() for r in replays)
    window = min(window, max(1, length // 3))
    bounds = {r.recipe.policy.lower_bound for replays in by_recipe.values() for r in replays}
    for colour, (name, replays) in zip(cycle(RECIPES), by_recipe.items(), strict=False):
        _draw_curves(top, bottom, replays, window, colour, f"{name}: " if len(by_recipe) > 1 else "")
    _draw_tolerance(top, bottom, bounds)
    top.set(ylim=(0, 102), ylabel="share [%]")
    # Above the tolerance at least half as much again: whether the errors keep to it is what the panel is there for.
    bottom.set(ylim=(0, max(bottom.get_ylim()[1], 150 * (1 - min(bounds)))), ylabel="wrong [% of accepted, rejected]")
    bottom.set(xlabel=f"cycle (end of a window of {window}; a share of fewer than {FEWEST} parts is not drawn)")
    figure.suptitle(title)
    legend_above(top, columns=wide + 1)
    legend_above(bottom, columns=wide + 1)
    return figure


def _draw_certain(
    axes: Axes, replays: Sequence[Replay], window: int, colour: str, precision: str, lead: str = ""
) -> dict[str, Floats]:
    """The certain share with its spread, and the precision, in these colours; returns all of `window_curves`."""
    lines = window_curves(replays, window, FEWEST)
    x = np.arange(1, len(lines["certain"]) + 1)
    axes.fill_between(x, lines["certain_low"], lines["certain_high"], color=colour, alpha=0.15, linewidth=0)
    axes.plot(x, lines["certain"], color=colour, label=f"{lead}certain, of all cycles")
    axes.plot(x, lines["precision"], color=precision, linestyle="--", label=f"{lead}precision, of accepted")
    return lines


def _draw_curves(top: Axes, bottom: Axes, replays: Sequence[Replay], window: int, colour: str, lead: str) -> None:
    lines = _draw_certain(top, replays, window, colour, colour, lead)
    x = np.arange(1, len(lines["certain"]) + 1)
    # The counts beside the names: where too few parts were decided alike for a curve, they still say what went wrong.
    counted = [each.stretch() for each in replays]
    n = {name: sum(each[name] for each in counted) for name in COUNTS}
    bad, good = "{false_positive} bad of {accepted} accepted", "{false_negative} good of {rejected} rejected"
    bottom.plot(x, lines["false_positive"], color=colour, label=lead + bad.format_map(n))
    bottom.plot(x, lines["false_negative"], color=colour, linestyle="--", label=lead + good.format_map(n))


def _draw_tolerance(top: Axes, bottom: Axes, lower_bounds: set[float]) -> None:
    for bound in sorted(lower_bounds):
        top.axhline(100 * bound, label=f"LB = {100 * bound:g} %", **LIMIT)
        tolerated = 100 * (1 - bound)
        bottom.axhline(tolerated, label=f"tolerance 100 - LB = {tolerated:g} %", **LIMIT)


def run_picture(log: Replay, title: str = "", window: int = 100) -> Figure:
    """A live run: verified share, errors so far and, with a clock, parts an hour."""
    window = min(window, max(1, len(log) // 3))
    figure, axes = panels(2 if log.clock_s is None else 3, (9.0, 6.0 if log.clock_s is None else 8.5))
    draw_verified(axes[0], log.verified, window)
    axes[0].set(ylabel=f"verified, last {window} [%]")
    draw_errors(axes[1], log.false_positive, log.false_negative)
    axes[1].set(ylabel="errors so far [parts]", ylim=(0, 1 + 1.1 * max(log.false_positive.sum(), log.false_negative.sum())))
    legend_above(axes[1])
    if log.clock_s is not None:
        _draw_rate(axes[2], log, log.clock_s, window)
    if not len(log):
        note(axes[0], "no cycle was finished")
    axes[-1].set(xlabel="cycle")
    figure.suptitle(title)
    return figure


def _draw_rate(axes: Axes, log: Replay, clock_s: Floats, window: int) -> None:
    x, took = np.arange(1, len(log) + 1), np.diff(clock_s, prepend=0.0)
    rate = 3600 * sliding_sum(log.finished, window) / sliding_sum(took, window)
    settled = x >= window  # a rate over few cycles is mostly luck
    axes.plot(x[settled], rate[settled], color=GREEN, label="this run")
    if log.verified.any():
        # The same parts, each at the time that a verified one took: every good one goes on, and nothing stops.
        seconds = float(np.median(took[log.verified])) * sliding_sum(np.ones(len(x)), window)
        always = 3600 * sliding_sum(log.truth == 1.0, window) / seconds
        axes.plot(x[settled], always[settled], color=VERIFIED, linestyle=":", label="had every part been verified")
    axes.set(ylabel=f"good parts/h, last {window}")
    legend_above(axes)


def grid_figure(replays: Sequence[Replay], title: str = "", window: int = WINDOW) -> Figure:
    """The paper's figure of its grid: a row an alpha, from the largest; a column an LB, each cell in two parts.

    Above: share of certain decisions and precision in a sliding window; below: the shares of all decisions in the window
    that were false positives and false negatives. replays : of one contender and interval, all equally long.
    Source: the paper's figure "Results obtained with varying values of the parameters alpha and LB".
    """
    alphas = sorted({r.recipe.policy.alpha for r in replays}, reverse=True)
    bounds = sorted({r.recipe.policy.lower_bound for r in replays})
    figure = blank(1.0 + 3.6 * len(bounds), 1.0 + 3.1 * len(alphas))
    heights = [3, 1.6] * len(alphas)
    axes = figure.subplots(2 * len(alphas), len(bounds), sharex=True, sharey="row", height_ratios=heights, squeeze=False)
    window = min(window, max(1, len(replays[0]) // 3))
    for i, alpha in enumerate(alphas):
        for j, bound in enumerate(bounds):
            cell = [r for r in replays if (r.recipe.policy.alpha, r.recipe.policy.lower_bound) == (alpha, bound)]
            top, bottom = axes[2 * i, j], axes[2 * i + 1, j]
            top.set_title(f"alpha {alpha:g}, LB {100 * bound:g} %", fontsize=SMALL + 1)
            if cell:
                _draw_cell(top, bottom, cell, bound, window)
    _label(figure, axes, window)
    figure.suptitle(title)
    return figure


def _draw_cell(top: Axes, bottom: Axes, replays: Sequence[Replay], bound: float, window: int) -> None:
    _draw_certain(top, replays, window, GREEN, GOOD)
    x = np.arange(1, len(replays[0]) + 1)
    top.axhline(100 * bound, label="LB", **LIMIT)
    for name, colour, style, label in (
        ("false_positive", BAD, "-", "false positives, of all cycles"),
        ("false_negative", GOOD, "-.", "false negatives, of all cycles"),
    ):
        bottom.plot(x, 100 * _share_of_cycles(replays, name, window), style, color=colour, linewidth=1.2, label=label)
    bottom.axhline(100 * (1 - bound), label="100 - LB", **LIMIT)


def _share_of_cycles(replays: Sequence[Replay], name: str, window: int) -> np.ndarray:
    wrong = np.stack([getattr(r, name) for r in replays]).mean(axis=0)
    return sliding_sum(wrong, window) / sliding_sum(np.ones(len(wrong)), window)


def _label(figure: Figure, axes: np.ndarray, window: int) -> None:
    for each in axes.flat:
        plain(each)
    for i, row in enumerate(axes):
        row[0].set(ylabel="wrong [%]" if i % 2 else "share [%]", ylim=(0, None) if i % 2 else (0, 102))
    for each in axes[-1]:
        each.set_xlabel(f"cycle (end of a window of {window})")
    drawn = next((pair for pair in zip(axes[0::2].flat, axes[1::2].flat, strict=True) if pair[0].lines), None)
    if drawn is not None:
        handles = [line for each in drawn for line in each.lines]
        figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False, fontsize=SMALL)


MARKERS = "osD^vP"
APART = 0.08  # of the distance between two LBs: the alphas' whiskers side by side
ROOM = 1.25  # above the highest mean


def cost_picture(curve: CostCurve, title: str = "", unit: str = "s") -> Figure:
    """Above: cost a part with its interval, and what verifying everything costs; the choice has a ring. Below: shares of
    parts that were decided without a check. unit : of the costs.
    """
    figure, (top, bottom) = panels(2, (9.0, 7.2), heights=(3, 2))
    bounds = sorted({row.policy.lower_bound for row in curve.rows})
    alphas = sorted({row.policy.alpha for row in curve.rows}, reverse=True)
    top.axhline(curve.baseline, label="verify everything", **LIMIT)
    for i, alpha in enumerate(alphas):
        rows = [row for row in curve.rows if row.policy.alpha == alpha]
        x = np.array([bounds.index(row.policy.lower_bound) for row in rows]) + APART * (i - (len(alphas) - 1) / 2)
        _draw(top, bottom, x, rows, RECIPES[i % len(RECIPES)], MARKERS[i % len(MARKERS)])
        if curve.policy is not None and curve.policy.alpha == alpha:
            at = next(j for j, row in enumerate(rows) if row.policy == curve.policy)
            ring: dict[str, Any] = {"s": 260, "facecolors": "none", "edgecolors": BLACK, "linewidths": 1.6, "zorder": 5}
            top.scatter(x[at], rows[at].cost, label=f"the choice: {curve.verdict}", **ring)
    means = [row.cost for row in curve.rows]
    top.set(ylim=(min(0.0, *means), ROOM * max(curve.baseline, *means)), ylabel=f"cost a part [{unit}]")
    bottom.set(
        ylim=(0, max(10.0, 110 * max(row.certain for row in curve.rows))), ylabel="decided without a check\n[% of parts]"
    )
    bottom.set_xticks(range(len(bounds)), [f"{100 * bound:g}" for bound in bounds])
    bottom.set_xlabel("LB [% of accepted parts that are to be good]")
    for axes in (top, bottom):
        legend_above(axes, columns=len(alphas) + 2)
    figure.suptitle(title or _title(curve, unit))
    return figure


def _title(curve: CostCurve, unit: str) -> str:
    costs = curve.costs
    what = f"check {costs.check:g} {unit}, escape {costs.escape:g} {unit}, false reject {costs.false_reject:g} {unit}"
    how = "bars: errors at the ends of their 95 % intervals"
    return f"{curve.dataset}, {curve.recipe}: {what}\n{curve.reporting} shuffles of {curve.cycles} parts; {how}"


def _draw(top: Axes, bottom: Axes, x: np.ndarray, rows: Sequence[PolicyCost], colour: str, marker: str) -> None:
    cost = np.array([row.cost for row in rows])
    ends = np.array([[row.cost - row.lower for row in rows], [row.upper - row.cost for row in rows]])
    label = f"alpha {rows[0].policy.alpha:g}"
    look: dict[str, Any] = {"color": colour, "marker": marker, "markersize": 6}
    # A replay's mean lies within what its errors' intervals allow, but for rounding.
    top.errorbar(x, cost, yerr=np.maximum(ends, 0.0), capsize=3, elinewidth=1.0, label=label, **look)
    bottom.plot(x, [100 * row.certain for row in rows], label=label, **look)
