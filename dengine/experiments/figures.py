"""Pictures as matplotlib figures: of replays, grids, costs, runs, data sets and single decisions.
Each picture is a function that returns a figure, and `save` writes it. The command line draws
them.

    save(curves({"conv": replays}), "out/curves.png")

They are made without pyplot, whose global state leaks into notebooks. The colours are those of
Okabe and Ito (2008), which colour-blind readers can tell apart.
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
from ..history.explain import Explanation
from ..history.sentences import Bound
from ..records import Action, TraceArray, TraceSpec
from ..reducers import has_own_unit
from ..traces import as_traces
from .costs import CostCurve, policy_name
from .replay import Floats, Replay
from .survey import channel_means

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Style = dict[str, Any]  # keywords of matplotlib's drawing functions

BLUE = "#0072B2"
RED = "#D55E00"
GREEN = "#009E73"
PINK = "#CC79A7"
SKY = "#56B4E9"
ORANGE = "#E69F00"
GREY = "#6E6E6E"
BLACK = "#000000"
# Of parts, and of the decisions that call them so.
GOOD = BLUE
BAD = RED
VERIFIED = GREY
RECIPES = (GREEN, PINK, ORANGE, SKY, BLUE, RED)  # first the colours that mean nothing else
LIMIT: Style = {"color": BLACK, "linestyle": ":", "linewidth": 1.2}  # a bound that is given
SMALL = 9  # points: legends and notes
RUN_WINDOW = 100  # cycles of the sliding window of a run
WINDOW = 300  # cycles of a sliding window, and parts of a map: the paper's
# Wrong decisions, what they are counted among, their name in the legend, and their line.
ERRORS = (
    ("false_positive", "accepted", "bad", "-"),
    ("false_negative", "rejected", "good", "--"),
)
GRID_LINES = (
    "certain, of all cycles",
    "precision, of accepted",
    "LB",
    "bad of accepted",
    "good of rejected",
    "100 - LB",
)
# Label, name, colour, line and marker of parts.
LABEL_STYLES = ((True, "good", GOOD, "-", "o"), (False, "bad", BAD, "--", "X"))
CLEAR = 0.1  # band widths below which leaving the band is not marked
FEWEST = 20  # a share of fewer parts jumps by more than 5 % with each part, and is not drawn
# Drawn in this order, so that the few certain ones lie on top.
ACTION_MARKS: dict[Any, tuple[str, Style]] = {
    Action.VERIFY: ("verify", {"color": VERIFIED, "marker": "o", "s": 9}),
    Action.ACCEPT: ("accept", {"color": GOOD, "marker": "o", "s": 26}),
    Action.REJECT: ("reject", {"color": BAD, "marker": "X", "s": 30}),
}
TRUTH_MARKS: dict[Any, tuple[str, Style]] = {
    label: (f"{name} part", {"color": colour, "marker": marker, "s": 24})
    for label, name, colour, _, marker in LABEL_STYLES
}


def sliding_sum(values: NDArray[Any], window: int) -> Floats:
    """Sum over a sliding window.

    Parameters
    ----------
    values : array, shape (..., n)
    window : int
        1 or more.

    Returns
    -------
    sums : array of float64, shape (..., n)
        At each position the sum of it and the `window` - 1 values before it, or of fewer at the
        beginning.
    """
    total = np.cumsum(np.asarray(values, dtype=np.float64), axis=-1)
    out = total.copy()
    out[..., window:] -= total[..., :-window]
    return out


def sliding_mean(values: NDArray[Any], window: int) -> Floats:
    """Return the mean over a sliding window as `sliding_sum` has it, shape (..., n)."""
    return sliding_sum(values, window) / sliding_sum(np.ones(values.shape[-1]), window)


def fit_window(window: int, replays: Sequence[Replay]) -> int:
    """Return the window in cycles, or a third of the longest replay if that is less; at least 1."""
    return min(window, max(1, max(map(len, replays)) // 3))


def blank(width: float, height: float, title: str = "") -> Figure:
    """Return an empty figure with a title; width and height are in inches."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    figure.suptitle(title)
    return figure


def finish(axes: Axes, legend: int = 3, **settings: Any) -> None:
    """Give axes a light grid, no box, and a legend above them, where it hides no curve.

    Parameters
    ----------
    axes : Axes
    legend : int, default 3
        Columns of the legend; 0 draws none.
    **settings
        As `Axes.set` takes them.
    """
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set(**settings)
    if legend:
        axes.legend(
            loc="lower left",
            bbox_to_anchor=(0.0, 1.0),
            ncols=legend,
            frameon=False,
            fontsize=SMALL,
            borderaxespad=0.2,
        )


def note(axes: Axes, text: str, colour: str = BLACK) -> None:
    """Write a text into the middle of axes that have nothing to show."""
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", color=colour)


def save(figure: Figure, path: str | Path, dpi: int = 120, force: bool = False) -> Path:
    """Write a figure in the format that the file's suffix names, creating the folder.

    Parameters
    ----------
    figure : Figure
    path : path
        Written as it is: without a suffix the format is PNG, and none is appended.
    dpi : int, default 120
    force : bool, default False
        Whether a file that exists is replaced.

    Returns
    -------
    path : Path
        The file, as given.

    Raises
    ------
    OutputError
        The file exists and `force` is not set, it cannot be written, or the suffix names no format.
    """
    path = Path(path)
    buffer = BytesIO()
    with instead(OutputError, f"Cannot draw {path}", ValueError, do="name it .png, .pdf or .svg"):
        figure.savefig(buffer, dpi=dpi, format=path.suffix.removeprefix(".") or "png")
    return write_output(path, buffer.getvalue(), force, make_folder=True)


def embedding_map(replay: Replay, title: str = "") -> Figure:
    """Draw where the newest 300 parts of a replay lie, left by truth and right by decision.

    Each part is drawn where it lay when it was decided, though each retrain moves the map; those
    that no model embedded are left out, on the left also those of unknown truth. The first two
    dimensions are drawn, the mean over the spaces, in equal units; a circle is the neighbourhood of
    the newest part drawn, with the recipe's radius. If the first dimension is a probability, the
    second is small against the radius: then the cycle stands in its place, and two lines bound the
    neighbourhood.

    Parameters
    ----------
    replay : Replay
    title : str, default ""

    Returns
    -------
    figure : Figure
    """
    figure = blank(10.0, 6.2, title)
    left, right = figure.subplots(1, 2, sharex=True, sharey=True)
    positions = replay.position[-WINDOW:]
    # Zeros where a reducer has but one dimension.
    z = np.hstack([positions, np.zeros_like(positions[:, :1])])[:, :2]
    embedded = np.isfinite(z).all(axis=1)
    is_probability = has_own_unit(replay.recipe.reducer)
    x_label = "embedding 1 [root mean square radius = 1]"
    y_label = "embedding 2 [root mean square radius = 1]"
    if is_probability:
        z[:, 1] = np.arange(len(z)) + len(replay) - len(z) + 1
        x_label = "predicted probability of success"
        y_label = "cycle"
    panels = (
        (left, "what the parts were", replay.truth, TRUTH_MARKS),
        (right, "what was decided", replay.action, ACTION_MARKS),
    )
    for axes, name, values, marks in panels:
        for value, (word, style) in marks.items():
            points = z[embedded & (values[-WINDOW:] == value)]
            label = f"{word} ({len(points)})"
            axes.scatter(*points.T, label=label, alpha=0.7, linewidths=0, **style)
        if not embedded.any():
            note(axes, "no trace was embedded yet")
        finish(axes, xlabel=x_label)
        axes.set_title(name, pad=24)
    left.set(ylabel=y_label)
    if is_probability:
        left.set_xlim(-0.06, 1.06)
    elif embedded.any():
        low = z[embedded].min(axis=0)
        high = z[embedded].max(axis=0)
        half = 0.56 * (high - low).max() + 1e-9  # the panel is a square in data units
        x, y = (low + high) / 2
        left.set(xlim=(x - half, x + half), ylim=(y - half, y + half))
    if embedded.any():
        _draw_neighbourhood(figure, z[embedded][-1], replay.recipe.radius, is_probability)
    if not is_probability:
        left.set_aspect("equal")
        right.set_aspect("equal")
    return figure


def _draw_neighbourhood(figure: Figure, centre: Floats, radius: float, is_strip: bool) -> None:
    """Draw the neighbourhood of a point (2,), a cross, into all axes, and a legend below.

    It is a circle, or a strip between two lines.
    """
    from matplotlib.patches import Circle

    style: Style = {"edgecolor": BLACK, "linewidth": 1.4}
    x, y = centre
    for axes in figure.axes:
        if is_strip:
            for end in (x - radius, x + radius):
                axes.axvline(end, color=BLACK, linewidth=1.4)
        else:
            axes.add_patch(Circle((x, y), radius, fill=False, **style))
        label = f"newest part; its neighbourhood ends at the black line, radius {radius:g}"
        (mark,) = axes.plot(x, y, "+", color=BLACK, markersize=9, label=label)
    figure.legend(handles=[mark], loc="outside lower center", frameon=False, fontsize=SMALL)


def window_curves(
    replays: Sequence[Replay], window: int = WINDOW, fewest: int = 1
) -> dict[str, Floats]:
    """Compute the paper's curves over a sliding window of cycles.

    Parameters
    ----------
    replays : sequence of Replay
        All equally long.
    window : int, default 300
    fewest : int, default 1
        Shares of fewer decisions are NaN.

    Returns
    -------
    curves : dict of str to array, shape (n,)
        In percent. certain : parts that the model accepted or rejected, of all cycles in the
        window, the mean over the replays. certain_low, certain_high : its 10th and 90th percentile
        over the replays. precision, false_positive : good and bad ones of the accepted parts in the
        windows of all replays together. false_negative : good ones of the rejected parts.
    """
    certain = sliding_mean(np.stack([r.accepted | r.rejected for r in replays]), window)

    def sum_in_window(name: str) -> Floats:
        """Return how many cycles a field marks in each window, over all replays."""
        return sliding_sum(sum(getattr(r, name).astype(int) for r in replays), window)

    def share(wrong: str, decided: str) -> Floats:
        """Return the share of wrong ones of those decided, (n,), in the windows of all replays."""
        n_decided = sum_in_window(decided)
        shares = sum_in_window(wrong) / np.maximum(n_decided, 1.0)
        return np.where(n_decided >= fewest, shares, np.nan)

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


def curves(by_recipe: Mapping[str, Sequence[Replay]], title: str = "") -> Figure:
    """Draw the paper's curve, with a colour for each recipe.

    From the top: the share of certain decisions, those without a check; the precision of the
    accepted ones, and LB; the errors, bad parts as a share of the accepted ones (solid) and good
    parts as a share of the rejected ones (dashed), and the tolerance 100 - LB. The legend below has
    the counts. Shares of fewer than `FEWEST` parts are not drawn. The window is `WINDOW` cycles, or
    a third of the longest replay.

    Parameters
    ----------
    by_recipe : mapping of str to sequence of Replay
        Those of one recipe are equally long.
    title : str, default ""

    Returns
    -------
    figure : Figure
    """
    from matplotlib import colormaps

    n = len(by_recipe)
    figure = blank(9.0, 8.2 + 0.22 * n, title)
    certain, precision, errors = figure.subplots(3, 1, sharex=True, height_ratios=(4, 3, 3))
    all_replays = [replay for replays in by_recipe.values() for replay in replays]
    window = fit_window(WINDOW, all_replays)
    colours = RECIPES if n <= len(RECIPES) else colormaps["tab20"].colors  # type: ignore[attr-defined]
    handles = []
    for colour, (name, replays) in zip(cycle(colours), by_recipe.items(), strict=False):
        _draw_replays(certain, precision, errors, replays, window, colour)
        counts = [replay.stretch() for replay in replays]
        wrong = [
            f"{sum(count[kind] for count in counts)} {word} of "
            f"{sum(count[decided] for count in counts)} {decided}"
            for kind, decided, word, _ in ERRORS
        ]
        handles += certain.plot([], color=colour, label=f"{name}: {', '.join(wrong)}")
    bounds = sorted({replay.recipe.policy.lower_bound for replay in all_replays})
    for bound in bounds:
        _draw_bounds(precision, errors, bound)
    finish(certain, 0, ylim=(0, 102), ylabel="certain\n[% of cycles]")
    finish(precision, min(len(bounds), 4), ylabel="precision\n[% of accepted]")
    precision.set_ylim(max(0.0, min(precision.get_ylim()[0], 100 * bounds[0] - 1)), 100.5)
    # At least half as much again above the tolerance: the panel shows whether errors keep to it.
    highest = max(errors.get_ylim()[1], 150 * (1 - bounds[0]))
    y_label = "bad of accepted, good of\nrejected (dashed) [%]"
    finish(errors, min(len(bounds), 4), ylim=(0, highest), ylabel=y_label)
    windows = f"end of a window of {window}; a share of fewer than {FEWEST} parts is not drawn"
    errors.set(xlabel=f"cycle ({windows})")
    figure.legend(handles=handles, loc="outside lower center", frameon=False, fontsize=SMALL)
    return figure


def _draw_replays(
    certain: Axes,
    precision: Axes,
    errors: Axes,
    replays: Sequence[Replay],
    window: int,
    colour: Any,
) -> None:
    """Draw the curves of replays: share of certain decisions, precision, and errors.

    A band shows the spread of the certain share over the replays.
    """
    lines = window_curves(replays, window, FEWEST)
    x = np.arange(1, len(lines["certain"]) + 1)  # cycles are counted from 1
    low = lines["certain_low"]
    high = lines["certain_high"]
    certain.fill_between(x, low, high, color=colour, alpha=0.15, linewidth=0)
    certain.plot(x, lines["certain"], color=colour)
    precision.plot(x, lines["precision"], "--" if precision is certain else "-", color=colour)
    for wrong, _, _, line in ERRORS:
        errors.plot(x, lines[wrong], line, color=colour)


def _draw_bounds(top: Axes, bottom: Axes, bound: float) -> None:
    """Draw dotted lines: LB into the upper axes, the tolerance 100 - LB into the lower ones."""
    top.axhline(100 * bound, label=f"LB = {100 * bound:g} %", **LIMIT)
    tolerance = 100 * (1 - bound)
    bottom.axhline(tolerance, label=f"tolerance 100 - LB = {tolerance:g} %", **LIMIT)


def grid_figure(replays: Sequence[Replay], title: str = "") -> Figure:
    """Draw the paper's figure of its grid.

    It has a row for each alpha, from the largest, a column for each LB, and in each cell the two
    panels that `curves` draws; a cell without replays stays empty.

    Parameters
    ----------
    replays : sequence of Replay
        Of one contender and interval, all equally long.
    title : str, default ""

    Returns
    -------
    figure : Figure

    References
    ----------
    The paper's figure "Results obtained with varying values of the parameters alpha and LB"; there
    the errors are shares of all cycles.
    """
    cells: dict[tuple[float, float], list[Replay]] = {}
    for replay in replays:
        policy = replay.recipe.policy
        cells.setdefault((policy.alpha, policy.lower_bound), []).append(replay)
    alphas = sorted({alpha for alpha, _ in cells}, reverse=True)
    bounds = sorted({bound for _, bound in cells})
    window = fit_window(WINDOW, replays)
    figure = blank(1.0 + 3.6 * len(bounds), 1.0 + 3.1 * len(alphas), title)
    axes = figure.subplots(
        2 * len(alphas),
        len(bounds),
        sharex=True,
        sharey="row",
        height_ratios=[3, 1.6] * len(alphas),
        squeeze=False,
    )
    for (i, alpha), (j, bound) in product(enumerate(alphas), enumerate(bounds)):
        top, bottom = axes[2 * i : 2 * i + 2, j]
        top.set_title(f"alpha {alpha:g}, LB {100 * bound:g} %", fontsize=SMALL + 1)
        if (alpha, bound) in cells:
            _draw_replays(top, top, bottom, cells[alpha, bound], window, GREEN)
            _draw_bounds(top, bottom, bound)
    for i, row in enumerate(axes):
        if i % 2:
            row[0].set(ylabel="wrong [%]", ylim=(0, None))
        else:
            row[0].set(ylabel="share [%]", ylim=(0, 102))
        for panel in row:
            finish(panel, legend=0)
    for panel in axes[-1]:
        panel.set_xlabel(f"cycle (end of a window of {window})")
    pairs = zip(axes[0::2].flat, axes[1::2].flat, strict=True)
    drawn = next(pair for pair in pairs if pair[0].lines)
    handles = [line for panel in drawn for line in panel.lines]
    style: Style = {"loc": "outside lower center", "frameon": False, "fontsize": SMALL}
    figure.legend(handles, GRID_LINES, ncols=3, **style)
    return figure


def run_picture(run: Replay, title: str = "") -> Figure:
    """Draw a live run: the verified share, the errors so far and, with a clock, parts per hour.

    Parameters
    ----------
    run : Replay
    title : str, default ""

    Returns
    -------
    figure : Figure
    """
    window = fit_window(RUN_WINDOW, [run])
    x = np.arange(1, len(run) + 1)
    has_clock = run.clock_s is not None
    figure = blank(9.0, 8.5 if has_clock else 6.0, title)
    axes = figure.subplots(3 if has_clock else 2, 1, sharex=True)
    axes[0].plot(x, 100 * sliding_mean(run.verified, window), color=VERIFIED)
    finish(axes[0], legend=0, ylim=(0, 104), ylabel=f"verified, last {window} [%]")
    false_positives = np.cumsum(run.false_positive)
    false_negatives = np.cumsum(run.false_negative)
    label = "bad part accepted (FP)"
    axes[1].step(x, false_positives, "-", where="post", color=BAD, label=label)
    label = "good part rejected (FN)"
    axes[1].step(x, false_negatives, "--", where="post", color=GOOD, label=label)
    axes[1].locator_params(axis="y", nbins=6, integer=True)
    highest = max(false_positives.max(initial=0), false_negatives.max(initial=0))
    finish(axes[1], ylabel="errors so far [parts]", ylim=(0, 1 + 1.1 * highest))
    if run.clock_s is not None:
        _draw_rate(axes[2], run, run.clock_s, window)
    if not len(run):
        note(axes[0], "no cycle was finished")
    axes[-1].set(xlabel="cycle")
    return figure


def _draw_rate(axes: Axes, run: Replay, clock_s: Floats, window: int) -> None:
    """Draw the good parts per hour of a run, and what they would be if all were verified.

    Nothing is drawn before the first full window; the second line needs a verified part. `clock_s`
    (n,) is the time at each cycle's end, in seconds of production.
    """
    x = np.arange(1, len(run) + 1)
    seconds = np.diff(clock_s, prepend=0.0)
    shown = x >= window  # a rate over few cycles is mostly luck
    rate = 3600 * sliding_sum(run.finished, window) / sliding_sum(seconds, window)
    axes.plot(x[shown], rate[shown], color=GREEN, label="this run")
    if run.verified.any():
        # The same parts, each in the time that a verified one took: every good one goes on, and
        # nothing stops.
        verify_seconds = float(np.median(seconds[run.verified]))
        always = 3600 * sliding_mean(run.truth == 1.0, window) / verify_seconds
        label = "had every part been verified"
        axes.plot(x[shown], always[shown], color=VERIFIED, linestyle=":", label=label)
    finish(axes, ylabel=f"good parts/h, last {window}")


def cost_picture(curve: CostCurve, unit: str = "s") -> Figure:
    """Draw what a part costs under each policy, the cheapest at the top.

    A line marks the cost of checking everything, and a ring the chosen policy. Policies that were
    left behind are hollow: their costs are of other shuffles. An interval that leaves the axes ends
    in an arrow with its value. On the right stands the share of parts decided without a check.

    Parameters
    ----------
    curve : CostCurve
    unit : str, default "s"
        Of the costs.

    Returns
    -------
    figure : Figure
    """
    costs = curve.costs
    title = (
        f"{curve.dataset}, {curve.recipe}: check {costs.check:g} {unit}, escape {costs.escape:g} "
        f"{unit}, false reject {costs.false_reject:g} {unit}\n{curve.shuffles} shuffles of "
        f"{curve.cycles} parts, with 95 % intervals"
    )
    rows = [*curve.rows, *curve.left_behind]
    figure = blank(9.0, 2.2 + 0.34 * len(rows), title)
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=(3, 1))
    end = 1.3 * max(costs.check, *(row.cost for row in rows))
    left.axvline(costs.check, label="check everything", **LIMIT)
    groups = ((curve.rows, BLUE, "played last"), (curve.left_behind, "none", "left behind"))
    y = 0
    for group, colour, label in groups:
        style: Style = {"color": BLUE, "markerfacecolor": colour, "capsize": 3, "fmt": "o"}
        for i, row in enumerate(group):
            upper = min(row.upper, end)
            errors = [[row.cost - max(row.lower, 0.0)], [upper - row.cost]]
            left.errorbar(row.cost, y, xerr=errors, label="_" if i else label, **style)
            if row.upper > end:
                left.text(end, y, f"to {row.upper:.3g} \u2192", ha="right", va="bottom", size=SMALL)
            right.barh(y, 100 * (row.accepted + row.rejected), color=BLUE, fill=group is curve.rows)
            y += 1
    if curve.policy is not None:
        ring: Style = {"facecolors": "none", "edgecolors": BLACK, "linewidths": 1.6, "zorder": 5}
        where = curve.rows.index(curve.marked)
        left.scatter(curve.marked.cost, where, s=200, label=f"choice: {curve.verdict}", **ring)
    left.set_yticks(range(len(rows)), [policy_name(row.policy) for row in rows])
    left.invert_yaxis()
    finish(left, 4, xlim=(0.0, end), xlabel=f"cost a part [{unit}]")
    finish(right, 0, xlim=(0, 100), xlabel="decided without\na check [% of parts]")
    return figure


def _axis_labels(spec: TraceSpec) -> list[str]:
    """Return the label of each channel's axis: its name, and its unit in brackets if known."""
    numbered = [f"channel {i + 1}" for i in range(spec.channels)]
    names = spec.columns or (numbered if spec.channels > 1 else ["trace"])
    return [
        f"{name} [{unit}]" if unit else name for name, unit in zip(names, spec.units, strict=True)
    ]


def explained_picture(explanation: Explanation) -> Figure:
    """Draw why a decision came out as it did; return the figure.

    Above, a panel for each channel, of at most four, those that leave the envelope farthest: the
    trace, its nearest references and the envelope of known successes. Below: the distances of the
    references, and the bound.
    """
    stored = explanation.decision
    decision = stored.decision
    spec = explanation.spec
    widest = np.zeros(len(explanation.trace))
    if explanation.envelope is not None:
        for excess in explanation.envelope.excesses:
            widest[excess.channel] = max(widest[excess.channel], excess.widths)
    # The channels that leave the band farthest.
    channels = sorted(np.argsort(-widest, kind="stable")[:4].tolist())
    version = f"version {decision.model_version}" if decision.model_version else "no model yet"
    title = (
        f"{decision.id}: {decision.action.value}, {decision.reason.value} ({version}); label: "
        f"{stored.label}"
    )
    figure = blank(10.0, 4.1 + 2.3 * len(channels), title)
    heights = (1.5 + 2.3 * len(channels), 2.6)
    above, below = figure.subfigures(2, 1, squeeze=False, height_ratios=heights)[:, 0]
    panels = above.subplots(len(channels), 1, sharex=True, squeeze=False)[:, 0]
    labels = _axis_labels(spec)
    for i, (axes, channel) in enumerate(zip(panels, channels, strict=True)):
        _draw_trace(axes, explanation, channel)
        finish(axes, legend=0 if i else 3, ylabel=labels[channel])
    panels[-1].set(xlabel="time [s]" if spec.rate_hz else "sample")
    left, right = below.subplots(1, 2, width_ratios=(1.15, 1.0))
    _draw_distances(left, explanation)
    _draw_bound(right, explanation.bound)
    return figure


def _draw_trace(axes: Axes, explanation: Explanation, channel: int) -> None:
    """Draw one channel of the explained trace over the traces of its neighbours and the envelope.

    Stretches in which it clearly leaves the envelope are shaded. Without an envelope only the
    traces are drawn.
    """
    rate = explanation.spec.rate_hz or 1.0  # the axis is in samples if it is unknown
    x = np.arange(explanation.trace.shape[1]) / rate
    envelope = explanation.envelope
    if envelope is not None:
        low = envelope.low[channel]
        high = envelope.high[channel]
        label = f"95 % of {envelope.n:,} successes"
        axes.fill_between(x, low, high, color=GREEN, alpha=0.22, linewidth=0, label=label)
        median = envelope.median[channel]
        axes.plot(x, median, color=GREEN, linewidth=1.0, label="their median")
    for success, name, colour, line, _ in LABEL_STYLES:
        traces = [
            neighbour.trace
            for neighbour in explanation.neighbours
            if neighbour.trace is not None and neighbour.success is success
        ]
        style: Style = {"color": colour, "linewidth": 0.7, "alpha": 0.55}
        for i, trace in enumerate(traces):
            # matplotlib leaves labels that begin with _ out of the legend.
            label = f"neighbours that were {name} ({len(traces)})" if i == 0 else "_"
            axes.plot(x, trace[channel], line, label=label, **style)
    axes.plot(x, explanation.trace[channel], color=BLACK, linewidth=1.6, label="this trace")
    if envelope is None:
        return
    excesses = [
        excess
        for excess in envelope.excesses
        if excess.channel == channel and excess.widths >= CLEAR
    ]
    mark: Style = {"color": ORANGE, "alpha": 0.3, "linewidth": 0, "zorder": 0}
    for i, excess in enumerate(excesses):
        label = "outside the band" if i == 0 else "_"
        axes.axvspan((excess.first - 0.5) / rate, (excess.last + 0.5) / rate, label=label, **mark)


def _draw_distances(axes: Axes, explanation: Explanation) -> None:
    """Draw the nearest references by distance, with a row for each fold, and the radius.

    The references of one fold live in one space of the embedding. Without neighbours a note says
    so.
    """
    neighbours = explanation.neighbours
    radius = explanation.radius
    if not neighbours or radius is None:
        note(axes, "no neighbours", GREY)
        finish(axes, legend=0, xticks=[], yticks=[])
        return
    spaces = sorted({neighbour.space for neighbour in neighbours})
    farthest = max(neighbour.distance for neighbour in neighbours)
    for success, name, colour, _, marker in LABEL_STYLES:
        group = [neighbour for neighbour in neighbours if neighbour.success is success]
        x = [neighbour.distance for neighbour in group]
        y = [spaces.index(neighbour.space) for neighbour in group]
        axes.scatter(x, y, s=34, color=colour, marker=marker, alpha=0.8, label=name)
    axes.axvline(radius, label=f"radius {radius:.3g}", **LIMIT)
    end = farthest
    if radius <= 3.0 * farthest:
        end = max(farthest, radius)  # a larger radius has all references inside, and is not shown
    axes.set(yticks=range(len(spaces)), yticklabels=[f"fold {space}" for space in spaces])
    version = explanation.decision.decision.model_version
    x_label = f"distance of the nearest references of version {version} [scaled]"
    limits = (0.0, 1.08 * max(end, 1e-9))
    finish(axes, ylim=(-0.7, len(spaces) - 0.3), xlim=limits, xlabel=x_label)


def _draw_bound(axes: Axes, bound: Bound | None) -> None:
    """Draw the interval of the success rate, its point estimate and the two thresholds.

    The estimate needs a label, and a threshold that is None is not drawn. If `bound` is None, a
    note says that no bound was asked for.
    """
    x_label = "success rate in the neighbourhood"
    axes.set(yticks=[], xlim=(-0.02, 1.02), ylim=(-1.0, 1.0), xlabel=x_label)
    if bound is None:
        note(axes, "no bound was asked for", GREY)
        finish(axes, legend=0)
        return
    n = bound.n_success + bound.n_failure
    if n:
        label = f"{bound.n_success} of {n}"
        axes.plot([bound.n_success / n], [0.0], "o", color=BLACK, label=label)
    ends = [bound.lower, bound.upper]
    label = f"bound: {bound.lower:.3f} to {bound.upper:.3f}"
    axes.plot(ends, [0.0, 0.0], color=BLACK, linewidth=3.0, alpha=0.7, label=label)
    thresholds = (
        (bound.accept_threshold, GOOD, "accept from"),
        (bound.reject_threshold, BAD, "reject up to"),
    )
    for threshold, colour, name in thresholds:
        if threshold is not None:
            label = f"{name} {threshold:.3g}"
            axes.axvline(threshold, color=colour, linestyle=":", linewidth=1.5, label=label)
    finish(axes, legend=2)


def data_picture(data: Dataset, title: str = "") -> Figure:
    """Draw a data set's traces, and how it changes in its order; return the figure.

    Above, a panel for each channel, of at most three: the median trace of good and of bad parts,
    and where the middle 80 % lie. Below: the share of good parts, and the mean of each trace's
    first channel, in recorded order. Traces that are not finite are not drawn.
    """
    X = as_traces(data.X)
    y = data.y
    finite = np.asarray(np.isfinite(X).all(axis=(1, 2)))
    figure = blank(9.0, 7.6)
    above, below = figure.subfigures(2, 1, squeeze=False, height_ratios=(1, 1.1))[:, 0]
    n_channels = X.shape[1]
    labels = _axis_labels(data.spec)
    above.suptitle(f"{title}: median trace, and where 10 to 90 % of them lie")
    time = np.arange(X.shape[2]) / (data.rate_hz or 1.0)
    x_label = "time [s]" if data.rate_hz else "sample"
    for i, axes in enumerate(above.subplots(1, min(n_channels, 3), squeeze=False)[0]):
        for success, name, colour, line, _ in LABEL_STYLES:
            traces = X[finite & (y == success), i]  # (n, T)
            if len(traces):
                low, median, high = np.quantile(traces, (0.1, 0.5, 0.9), axis=0)
                axes.fill_between(time, low, high, color=colour, alpha=0.18, linewidth=0)
                label = f"{name} ({len(traces)})"
                axes.plot(time, median, line, color=colour, linewidth=1.2, label=label)
        n_columns = 3 if finite.any() and not i else 0
        finish(axes, legend=n_columns, xlabel=x_label, ylabel=labels[i])
    _draw_drift(below, X, y, finite, labels[0])
    return figure


def _draw_drift(
    figure: Any, X: TraceArray, y: NDArray[Any], finite: NDArray[np.bool_], label: str
) -> None:
    """Draw the share of good parts in a sliding tenth of the set, and each finite trace's mean.

    The mean is that of the first channel, over the trace.

    Parameters
    ----------
    figure : SubFigure
    X : array, shape (n, C, T)
    y : array, shape (n,)
    finite : array of bool, shape (n,)
    label : str
        Name and unit of the first channel.
    """
    top, bottom = figure.subplots(2, 1, sharex=True)
    window = max(1, len(y) // 10)
    x = np.arange(1, len(y) + 1)
    full = x >= window  # a share of the first few jumps
    share = 100 * sliding_mean(y, window)
    top.plot(x[full], share[full], color=VERIFIED, label=f"good, of the last {window}")
    top.axhline(100 * y.mean(), label="good, of all", **LIMIT)
    finish(top, ylim=(0, 104), ylabel="share [%]")
    for success, name, colour, _, _ in LABEL_STYLES:
        rows = finite & (y == success)
        means = channel_means(X[rows, :1])[:, 0]
        bottom.scatter(x[rows], means, s=8, color=colour, alpha=0.5, linewidths=0, label=name)
    x_label = "recording, in the order in which they were made"
    finish(bottom, xlabel=x_label, ylabel=f"mean {label}")
