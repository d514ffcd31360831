"""Pictures as matplotlib figures, without pyplot, whose global state leaks into notebooks: of replays, grids and costs;
of a run, a data set, and one decision among its neighbours.

    save(curves({"conv": replays}), "out/curves.png")

Colours: Okabe and Ito (2008), distinct to all eyes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from io import BytesIO
from itertools import cycle, product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..datasets import Dataset
from ..errors import OutputError, instead
from ..files import write_output
from ..history.explain import Bound, Explanation
from ..records import Action
from ..reducers import has_own_unit
from ..traces import as_traces
from .costs import CostCurve
from .replay import Replay
from .survey import levels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]
Look = dict[str, Any]

BLUE, RED, GREEN, PINK, SKY, ORANGE = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00"
GREY, BLACK = "#6E6E6E", "#000000"
GOOD, BAD, VERIFIED = BLUE, RED, GREY  # of parts, and of the decisions that call them so
RECIPES = (GREEN, PINK, ORANGE, SKY, BLUE, RED)  # first those that mean nothing else
LIMIT: Look = {"color": BLACK, "linestyle": ":", "linewidth": 1.2}  # a bound, or a moment, that is given
SMALL = 9  # points: legends and notes
WINDOW = 300  # cycles of a sliding window, and parts of a map: the paper's
ERRORS = (("false_positive", "accepted", "bad", "-"), ("false_negative", "rejected", "good", "--"))
GRID_LINES = ("certain, of all cycles", "precision, of accepted", "LB", "bad of accepted", "good of rejected", "100 - LB")
KINDS = ((True, "good", GOOD, "-", "o"), (False, "bad", BAD, "--", "X"))
CLEAR = 0.1  # band widths below which leaving the band is not marked
FEWEST = 20  # parts: a share of fewer jumps by more than five in a hundred with each, and is not drawn
ACTION_MARKS: dict[Any, tuple[str, Look]] = {  # drawn in this order, so that the few certain ones lie on top
    Action.VERIFY: ("verify", {"color": VERIFIED, "marker": "o", "s": 9}),
    Action.ACCEPT: ("accept", {"color": GOOD, "marker": "o", "s": 26}),
    Action.REJECT: ("reject", {"color": BAD, "marker": "X", "s": 30}),
}
TRUTH_MARKS: dict[Any, tuple[str, Look]] = {
    good: (f"{name} part", {"color": colour, "marker": marker, "s": 24}) for good, name, colour, _, marker in KINDS
}


def sliding_sum(values: NDArray[Any], window: int) -> Floats:
    """(..., n) -> (..., n): sum over the last `window` values, over all so far where there are fewer."""
    total = np.cumsum(np.asarray(values, dtype=np.float64), axis=-1)
    out = total.copy()
    out[..., window:] -= total[..., :-window]
    return out


def sliding_mean(values: NDArray[Any], window: int) -> Floats:
    """(..., n) -> (..., n): mean over the last `window` values, over all so far where there are fewer."""
    return sliding_sum(values, window) / sliding_sum(np.ones(values.shape[-1]), window)


def fitting(window: int, replays: Sequence[Replay]) -> int:
    """The window, or a third of the longest replay where that is less."""
    return min(window, max(1, max(map(len, replays)) // 3))


def blank(width: float, height: float, title: str = "") -> Figure:
    """An empty figure, inches."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    figure.suptitle(title)
    return figure


def finish(axes: Axes, legend: int = 3, **settings: Any) -> None:
    """A light grid and no box; the legend above, in so many columns: inside, it would lie on one curve or another.

    legend : 0 for none.  settings : as `Axes.set` takes them.
    """
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set(**settings)
    if legend:
        look: Look = {"ncols": legend, "frameon": False, "fontsize": SMALL, "borderaxespad": 0.2}
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), **look)


def note(axes: Axes, text: str, colour: str = BLACK) -> None:
    """Words in the middle, where there is nothing to draw."""
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", color=colour)


def save(figure: Figure, path: str | Path, dpi: int = 120, force: bool = False) -> Path:
    """Write a figure as its suffix says; makes the folder. OutputError where a file is there, without `force`."""
    buffer = BytesIO()
    with instead(OutputError, f"Cannot draw {path}", ValueError, do="name it .png, .pdf or .svg"):
        figure.savefig(buffer, dpi=dpi, format=Path(path).suffix.removeprefix(".") or "png")
    return write_output(path, buffer.getvalue(), force, make_folder=True)


def embedding_map(replay: Replay, last: int = WINDOW, title: str = "") -> Figure:
    """Where the newest parts of a replay lie, by what they were and by what was decided; each retrain moves the map.

    The first two dimensions are drawn, the mean over the spaces. The circle is the ball around the newest part, where the
    recipe fixes its radius. Units are equal on both axes, unless the first is a probability: then the second is for the
    eye, and the ball is cut off above and below.
    """
    figure, recipe = blank(10.0, 6.2, title), replay.recipe
    left, right = figure.subplots(1, 2, sharex=True, sharey=True)
    positions = replay.position[-last:]
    z = np.hstack([positions, np.zeros_like(positions[:, :1])])[:, :2]  # zeros where a reducer has but one dimension
    known, probability = np.isfinite(z).all(axis=1), has_own_unit(recipe.reducer)
    first, second = (f"embedding {i} [root mean square radius = 1]" for i in (1, 2))
    if probability:
        first, second = "predicted probability of success", "embedding 2 [for the eye, small against the radius]"
    truth, action = (left, "what the parts were", replay.truth), (right, "what was decided", replay.action)
    for (axes, name, kinds), marks in ((truth, TRUTH_MARKS), (action, ACTION_MARKS)):
        for kind, (word, look) in marks.items():
            points = z[known & (kinds[-last:] == kind)]
            axes.scatter(*points.T, label=f"{word} ({len(points)})", alpha=0.7, linewidths=0, **look)
        if not known.any():
            note(axes, "no trace was embedded yet")
        finish(axes, xlabel=first)
        axes.set_title(name, pad=24)
    left.set(ylabel=second)
    if known.any():
        low, high = z[known].min(axis=0), z[known].max(axis=0)
        half = 0.56 * (high - low) + 1e-9
        half = half if probability else np.full(2, half.max())
        (x0, y0), (x1, y1) = (low + high) / 2 - half, (low + high) / 2 + half
        left.set(xlim=(-0.06, 1.06) if probability else (x0, x1), ylim=(y0, y1))
        cut = ", cut off above and below" if probability else ""
        _draw_balls(figure, z[known][-1], recipe.radius, f"ball around the newest part, radius {recipe.radius:g}{cut}")
    for axes in () if probability else (left, right):
        axes.set_aspect("equal")
    return figure


def _draw_balls(figure: Figure, centre: Floats, radius: float, label: str) -> None:
    from matplotlib.patches import Circle

    for axes in figure.axes:
        axes.add_patch(Circle((centre[0], centre[1]), radius, fill=False, edgecolor=BLACK, linewidth=1.4))
        (mark,) = axes.plot(*centre, "+", color=BLACK, markersize=9, label=label)
    figure.legend(handles=[mark], loc="outside lower center", frameon=False, fontsize=SMALL)


def window_curves(replays: Sequence[Replay], window: int = WINDOW, fewest: int = 1) -> dict[str, Floats]:
    """What the paper plots, in percent, (n,) each, over a sliding window and all replays, which must be equally long.

    certain : of all cycles in the window.  certain_low, certain_high : 10th and 90th percentile over the replays.
    precision, false_positive : of the accepted parts in the windows of all replays together.
    false_negative : of the rejected parts, likewise.  All three NaN where these are fewer than `fewest`.
    """
    certain = sliding_mean(np.stack([r.accepted | r.rejected for r in replays]), window)

    def share(wrong: str, decided: str) -> Floats:
        bad, of = (sliding_sum(sum(getattr(r, name).astype(int) for r in replays), window) for name in (wrong, decided))
        return np.where(of >= fewest, bad / np.maximum(of, 1.0), np.nan)

    false_positive = share("false_positive", "accepted")
    curves = {
        "certain": certain.mean(axis=0),
        "certain_low": np.quantile(certain, 0.1, axis=0),
        "certain_high": np.quantile(certain, 0.9, axis=0),
        "precision": 1.0 - false_positive,
        "false_positive": false_positive,
        "false_negative": share("false_negative", "rejected"),
    }
    return {name: 100.0 * values for name, values in curves.items()}


def curves(by_recipe: Mapping[str, Sequence[Replay]], title: str = "", window: int = WINDOW) -> Figure:
    """The paper's two-part curve, a colour a recipe: certain and precision above; below the errors of what was decided.

    The tolerance 100 - LB is a share of the accepted parts, so the errors are drawn as shares of what was decided alike.
    """
    wide = max(2, min(len(by_recipe), 4))  # recipes side by side in the legends: a column each, and one for the bound
    figure = blank(3.6 + 2.7 * wide, 7.4, title)
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(4, 3))
    all_replays = [r for replays in by_recipe.values() for r in replays]
    window, bounds = fitting(window, all_replays), sorted({r.recipe.policy.lower_bound for r in all_replays})
    for colour, (name, replays) in zip(cycle(RECIPES), by_recipe.items(), strict=False):
        _draw_replays(top, bottom, replays, window, colour, f"{name}: " if len(by_recipe) > 1 else "")
    for bound in bounds:
        _draw_bounds(top, bottom, bound)
    finish(top, wide + 1, ylim=(0, 102), ylabel="share [%]")
    # Above the tolerance at least half as much again: whether the errors keep to it is what the panel is there for.
    highest = max(bottom.get_ylim()[1], 150 * (1 - bounds[0]))
    finish(bottom, wide + 1, ylim=(0, highest), ylabel="wrong [% of accepted, rejected]")
    bottom.set(xlabel=f"cycle (end of a window of {window}; a share of fewer than {FEWEST} parts is not drawn)")
    return figure


def _draw_replays(top: Axes, bottom: Axes, replays: Sequence[Replay], window: int, colour: str, lead: str = "") -> None:
    """Above the certain share with its spread, and the precision; below the errors, with their counts in the legend."""
    lines, counts = window_curves(replays, window, FEWEST), [each.stretch() for each in replays]
    x = np.arange(1, len(lines["certain"]) + 1)  # cycles are counted from 1
    top.fill_between(x, lines["certain_low"], lines["certain_high"], color=colour, alpha=0.15, linewidth=0)
    top.plot(x, lines["certain"], color=colour, label=f"{lead}certain, of all cycles")
    top.plot(x, lines["precision"], color=colour, linestyle="--", label=f"{lead}precision, of accepted")
    # Where too few parts were decided alike for a curve, the counts still say what went wrong.
    for wrong, decided, kind, style in ERRORS:
        label = f"{lead}{sum(n[wrong] for n in counts)} {kind} of {sum(n[decided] for n in counts)} {decided}"
        bottom.plot(x, lines[wrong], style, color=colour, label=label)


def _draw_bounds(top: Axes, bottom: Axes, bound: float) -> None:
    top.axhline(100 * bound, label=f"LB = {100 * bound:g} %", **LIMIT)
    bottom.axhline(100 * (1 - bound), label=f"tolerance 100 - LB = {100 * (1 - bound):g} %", **LIMIT)


def grid_figure(replays: Sequence[Replay], title: str = "", window: int = WINDOW) -> Figure:
    """The paper's figure of its grid: a row an alpha, from the largest; a column an LB; in each cell what `curves` draws.

    replays : of one contender and interval, all equally long.
    Source: the paper's figure "Results obtained with varying values of the parameters alpha and LB"; there the errors are
    shares of all cycles.
    """
    cells: dict[tuple[float, float], list[Replay]] = {}
    for r in replays:
        cells.setdefault((r.recipe.policy.alpha, r.recipe.policy.lower_bound), []).append(r)
    alphas, bounds = sorted({alpha for alpha, _ in cells}, reverse=True), sorted({bound for _, bound in cells})
    figure = blank(1.0 + 3.6 * len(bounds), 1.0 + 3.1 * len(alphas), title)
    heights, window = [3, 1.6] * len(alphas), fitting(window, replays)
    axes = figure.subplots(2 * len(alphas), len(bounds), sharex=True, sharey="row", height_ratios=heights, squeeze=False)
    for (i, alpha), (j, bound) in product(enumerate(alphas), enumerate(bounds)):
        top, bottom = axes[2 * i : 2 * i + 2, j]
        top.set_title(f"alpha {alpha:g}, LB {100 * bound:g} %", fontsize=SMALL + 1)
        if (alpha, bound) in cells:
            _draw_replays(top, bottom, cells[alpha, bound], window, GREEN)
            _draw_bounds(top, bottom, bound)
    for i, row in enumerate(axes):
        row[0].set(ylabel="wrong [%]" if i % 2 else "share [%]", ylim=(0, None) if i % 2 else (0, 102))
        for each in row:
            finish(each, legend=0)
    for each in axes[-1]:
        each.set_xlabel(f"cycle (end of a window of {window})")
    drawn = next(pair for pair in zip(axes[0::2].flat, axes[1::2].flat, strict=True) if pair[0].lines)
    handles = [line for each in drawn for line in each.lines]
    figure.legend(handles, GRID_LINES, loc="outside lower center", ncols=3, frameon=False, fontsize=SMALL)
    return figure


def run_picture(log: Replay, title: str = "", window: int = 100) -> Figure:
    """A live run: verified share, errors so far and, with a clock, parts an hour."""
    window, x, timed = fitting(window, [log]), np.arange(1, len(log) + 1), log.clock_s is not None
    figure = blank(9.0, 8.5 if timed else 6.0, title)
    axes = figure.subplots(3 if timed else 2, 1, sharex=True)
    axes[0].plot(x, 100 * sliding_mean(log.verified, window), color=VERIFIED)
    finish(axes[0], legend=0, ylim=(0, 104), ylabel=f"verified, last {window} [%]")
    wrong = np.cumsum([log.false_positive, log.false_negative], axis=1)
    axes[1].step(x, wrong[0], "-", where="post", color=BAD, label="bad part accepted (FP)")
    axes[1].step(x, wrong[1], "--", where="post", color=GOOD, label="good part rejected (FN)")
    axes[1].locator_params(axis="y", nbins=6, integer=True)
    finish(axes[1], ylabel="errors so far [parts]", ylim=(0, 1 + 1.1 * wrong.max(initial=0)))
    if log.clock_s is not None:
        took, settled = np.diff(log.clock_s, prepend=0.0), x >= window  # a rate over few cycles is mostly luck
        rate = 3600 * sliding_sum(log.finished, window) / sliding_sum(took, window)
        axes[2].plot(x[settled], rate[settled], color=GREEN, label="this run")
        if log.verified.any():
            # The same parts, each at the time that a verified one took: every good one goes on, and nothing stops.
            always = 3600 * sliding_mean(log.truth == 1.0, window) / float(np.median(took[log.verified]))
            axes[2].plot(x[settled], always[settled], color=VERIFIED, linestyle=":", label="had every part been verified")
        finish(axes[2], ylabel=f"good parts/h, last {window}")
    if not len(log):
        note(axes[0], "no cycle was finished")
    axes[-1].set(xlabel="cycle")
    return figure


def cost_picture(curve: CostCurve, title: str = "", unit: str = "s") -> Figure:
    """Above: cost a part with its interval, and what verifying everything costs; the choice has a ring.

    Below: shares of parts that were decided without a check. unit : of the costs.
    """
    prices = {"check": curve.costs.check, "escape": curve.costs.escape, "false reject": curve.costs.false_reject}
    what = ", ".join(f"{name} {price:g} {unit}" for name, price in prices.items())
    how = f"{curve.reporting} shuffles of {curve.cycles} parts; bars: errors at the ends of their 95 % intervals"
    figure = blank(9.0, 7.2, title or f"{curve.dataset}, {curve.recipe}: {what}\n{how}")
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    asked = [row for row in curve.rows if row.policy.guarantee != "cost"]
    priced = [row for row in curve.rows if row.policy.guarantee == "cost"]
    bounds = sorted({row.policy.lower_bound for row in asked})
    alphas = dict.fromkeys(row.policy.alpha for row in asked)
    groups = {f"alpha {alpha:g}": [row for row in asked if row.policy.alpha == alpha] for alpha in alphas}
    if priced:
        groups["by cost"] = priced
    top.axhline(curve.costs.check, label="verify everything", **LIMIT)
    for i, (label, rows) in enumerate(groups.items()):
        # The alphas' whiskers side by side.
        places = [len(bounds) if rows is priced else bounds.index(row.policy.lower_bound) for row in rows]
        x = np.array(places) + 0.08 * (i - (len(groups) - 1) / 2)
        cost, lower, upper = np.array([(row.cost, row.lower, row.upper) for row in rows]).T
        look: Look = {"color": RECIPES[i % len(RECIPES)], "marker": "osD^vP"[i % 6], "markersize": 6}
        look["label"] = label
        # A replay's mean lies within what its errors' intervals allow, but for rounding.
        top.errorbar(x, cost, yerr=np.maximum([cost - lower, upper - cost], 0.0), capsize=3, elinewidth=1.0, **look)
        bottom.plot(x, [100 * row.certain for row in rows], **look)
        for at, row in zip(x, rows, strict=True):
            if row.policy == curve.policy:
                ring: Look = {"facecolors": "none", "edgecolors": BLACK, "linewidths": 1.6, "zorder": 5}
                top.scatter(at, row.cost, s=260, label=f"the choice: {curve.verdict}", **ring)
    means, wide = [row.cost for row in curve.rows], len(groups) + 2
    lowest, highest = min(0.0, *means), 1.25 * max(curve.costs.check, *means)
    finish(top, wide, ylim=(lowest, highest), ylabel=f"cost a part [{unit}]")
    highest = max(10.0, 110 * max(row.certain for row in curve.rows))
    finish(bottom, wide, ylim=(0, highest), ylabel="decided without a check\n[% of parts]")
    ticks = [f"{100 * bound:g}" for bound in bounds] + ["by cost"] * len(priced)
    bottom.set_xticks(range(len(ticks)), ticks)
    bottom.set_xlabel("LB [% of accepted parts that are to be good]")
    return figure


def explained_picture(found: Explanation) -> Figure:
    """Above, a panel a channel: the trace, its nearest references and the band. Below: their distances, and the bound."""
    past, made, spec = found.decision, found.decision.decision, found.spec
    widest = np.zeros(len(found.trace))
    for each in () if found.envelope is None else found.envelope.excesses:
        widest[each.channel] = max(widest[each.channel], each.widths)
    channels = sorted(np.argsort(-widest, kind="stable")[:4].tolist())  # those that leave the band farthest
    version = f"version {made.model_version}" if made.model_version else "no model yet"
    words = f"{made.id}: {made.action.value}, {made.reason.value} ({version}); label: {past.label}"
    figure = blank(10.0, 4.1 + 2.3 * len(channels), words)
    above, below = figure.subfigures(2, 1, squeeze=False, height_ratios=(1.5 + 2.3 * len(channels), 2.6))[:, 0]
    panels = above.subplots(len(channels), 1, sharex=True, squeeze=False)[:, 0]
    for i, (axes, channel) in enumerate(zip(panels, channels, strict=True)):
        _draw_trace(axes, found, channel)
        name = spec.columns[channel] if spec.columns else "trace" if spec.channels == 1 else f"channel {channel + 1}"
        finish(axes, legend=0 if i else 3, ylabel=f"{name} [{spec.units[channel]}]")
    panels[-1].set(xlabel="time [s]")
    left, right = below.subplots(1, 2, width_ratios=(1.15, 1.0))
    _draw_distances(left, found)
    _draw_bound(right, found.bound)
    return figure


def _draw_trace(axes: Axes, found: Explanation, channel: int) -> None:
    x, band = np.arange(found.trace.shape[1]) / found.spec.rate_hz, found.envelope
    if band is not None:
        label = f"95 % of {band.n:,} successes"
        axes.fill_between(x, band.low[channel], band.high[channel], color=GREEN, alpha=0.22, linewidth=0, label=label)
        axes.plot(x, band.median[channel], color=GREEN, linewidth=1.0, label="their median")
    for success, name, colour, line, _ in KINDS:
        near = [each.trace for each in found.neighbours if each.trace is not None and each.success is success]
        for i, trace in enumerate(near):
            label = f"neighbours that were {name} ({len(near)})" if i == 0 else "_"
            axes.plot(x, trace[channel], line, color=colour, linewidth=0.7, alpha=0.55, label=label)
    axes.plot(x, found.trace[channel], color=BLACK, linewidth=1.6, label="this trace")
    outside = [each for each in band.excesses if each.channel == channel and each.widths >= CLEAR] if band else []
    for i, each in enumerate(outside):
        half, label = 0.5 / found.spec.rate_hz, "outside the band" if i == 0 else "_"
        axes.axvspan(each.from_s - half, each.to_s + half, color=ORANGE, alpha=0.3, linewidth=0, label=label, zorder=0)


def _draw_distances(axes: Axes, found: Explanation) -> None:
    """Nearest references by distance, a row a fold: those of one fold live in one space."""
    near = found.neighbours
    if not near or found.radius is None:
        note(axes, "no neighbours", GREY)
        finish(axes, legend=0, xticks=[], yticks=[])
        return
    spaces, end = sorted({each.space for each in near}), max(each.distance for each in near)
    for success, name, colour, _, marker in KINDS:
        some = [each for each in near if each.success is success]
        x, y = [each.distance for each in some], [spaces.index(each.space) for each in some]
        axes.scatter(x, y, s=34, color=colour, marker=marker, alpha=0.8, label=name)
    axes.axvline(found.radius, label=f"ball, radius {found.radius:.3g}", **LIMIT)
    end = max(end, found.radius) if found.radius <= 3.0 * end else end  # else all are inside, and it is not in view
    axes.set(yticks=range(len(spaces)), yticklabels=[f"fold {space}" for space in spaces])
    name = f"distance of the nearest references of version {found.decision.decision.model_version} [scaled]"
    finish(axes, ylim=(-0.7, len(spaces) - 0.3), xlim=(0.0, 1.08 * max(end, 1e-9)), xlabel=name)


def _draw_bound(axes: Axes, bound: Bound | None) -> None:
    axes.set(yticks=[], xlim=(-0.02, 1.02), ylim=(-1.0, 1.0), xlabel="success rate in the ball")
    if bound is None:
        note(axes, "no bound was asked for", GREY)
        finish(axes, legend=0)
        return
    if n := bound.n_success + bound.n_failure:
        axes.plot([bound.n_success / n], [0.0], "o", color=BLACK, label=f"{bound.n_success} of {n}")
    text = f"bound: {bound.lower:.3f} to {bound.upper:.3f}"
    axes.plot([bound.lower, bound.upper], [0.0, 0.0], color=BLACK, linewidth=3.0, alpha=0.7, label=text)
    for at, colour, name in ((bound.accept_threshold, GOOD, "accept from"), (bound.reject_threshold, BAD, "reject up to")):
        if at is not None:
            axes.axvline(at, color=colour, linestyle=":", linewidth=1.5, label=f"{name} {at:.3g}")
    finish(axes, legend=2)


def data_picture(data: Dataset, title: str = "") -> Figure:
    """Above, a channel a panel: the median trace of good and bad parts, and where the middle 80 % lie.

    Below: the share of good parts and each trace's mean, as recorded. Traces that are not finite are not drawn.
    """
    X, y = as_traces(data.X), data.y
    shown = np.isfinite(X).all(axis=(1, 2))
    figure = blank(9.0, 7.6)
    above, below = figure.subfigures(2, 1, squeeze=False, height_ratios=(1, 1.1))[:, 0]
    names = data.channels or tuple(f"channel {i + 1}" if X.shape[1] > 1 else "trace" for i in range(X.shape[1]))
    time, axis = np.arange(X.shape[2]) / (data.rate_hz or 1.0), "time [s]" if data.rate_hz else "sample"
    labels = [f"{name} [{unit}]" for name, unit in zip(names, data.spec.units, strict=True)]
    above.suptitle(f"{title}: median trace, and where 10 to 90 % of them lie")
    for i, axes in enumerate(above.subplots(1, min(X.shape[1], 3), squeeze=False)[0]):
        for label, name, colour, line, _ in KINDS:
            some = X[shown & (y == label), i]  # (n, T)
            if len(some):
                low, median, high = np.quantile(some, (0.1, 0.5, 0.9), axis=0)
                axes.fill_between(time, low, high, color=colour, alpha=0.18, linewidth=0)
                axes.plot(time, median, line, color=colour, linewidth=1.2, label=f"{name} ({len(some)})")
        finish(axes, legend=3 if shown.any() and not i else 0, xlabel=axis, ylabel=labels[i])
    share, level = below.subplots(2, 1, sharex=True)
    window, x = max(1, len(y) // 10), np.arange(1, len(y) + 1)
    full = x >= window  # a share of the first few jumps
    share.plot(x[full], 100 * sliding_mean(y, window)[full], color=VERIFIED, label=f"good, of the last {window}")
    share.axhline(100 * y.mean(), label="good, of all", **LIMIT)
    finish(share, ylim=(0, 104), ylabel="share [%]")
    for label, name, colour, _, _ in KINDS:
        some = shown & (y == label)
        level.scatter(x[some], levels(X[some, :1])[:, 0], s=8, color=colour, alpha=0.5, linewidths=0, label=name)
    finish(level, xlabel="recording, in the order in which they were made", ylabel=f"mean {labels[0]}")
    return figure
