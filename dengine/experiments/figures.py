"""Pictures as matplotlib figures: of replays and runs, costs, data sets and single decisions.
Each picture is a function that returns a figure, and `save` writes it. The command line draws
them.

    save(curves({"conv": replays}), "out/curves.png")

They are made without pyplot, whose global state leaks into notebooks. The colours are those of
Okabe and Ito (2008), which colour-blind readers can tell apart.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from io import BytesIO
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..datasets import Dataset
from ..errors import OutputError, amount, counted, instead
from ..files import write_output
from ..history.explain import Explanation
from ..records import Action, Floats, TraceSpec
from ..reducers import has_own_unit
from .costs import CostCurve, policy_name
from .replay import Bools, Replay

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Style = dict[str, Any]  # keywords of matplotlib's drawing functions
Marks = dict[Any, tuple[str, Style]]  # label or action -> its name in the legend, its style

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
WINDOW = 300  # cycles of a sliding window, and parts of a map: the paper's
# Wrong decisions, what they are counted among, their name in the legend, and their line.
ERRORS = (
    ("false_positive", "accepted", "bad", "-"),
    ("false_negative", "rejected", "good", "--"),
)
# Label, name, colour, line and marker of parts.
LABEL_STYLES = ((True, "good", GOOD, "-", "o"), (False, "bad", BAD, "--", "X"))
CLEAR = 0.1  # band widths below which leaving the band is not marked
FEWEST = 20  # a share of fewer parts jumps by more than 5 % with each part, and is not drawn
# Drawn in this order, so that the few certain ones lie on top.
ACTION_MARKS: Marks = {
    Action.VERIFY: ("verify", {"color": VERIFIED, "marker": "o", "s": 9}),
    Action.ACCEPT: ("accept", {"color": GOOD, "marker": "o", "s": 26}),
    Action.REJECT: ("reject", {"color": BAD, "marker": "X", "s": 30}),
}
TRUTH_MARKS: Marks = {
    label: (f"{name} part", {"color": colour, "marker": marker, "s": 24})
    for label, name, colour, _, marker in LABEL_STYLES
}


def blank(width: float, height: float, title: str = "") -> Figure:
    """Return an empty matplotlib figure with a title; width and height are in inches.

    It is made without pyplot, so that no global state keeps it. It has no axes yet, and a
    constrained layout.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    figure.suptitle(title)
    return figure


def finish(axes: Axes, legend: int = 3, **settings: Any) -> None:
    """Give axes a light grid, no lines at the top and the right, and a legend above them.

    The legend hides no curve there. Returns nothing; the axes are changed.

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


def save(figure: Figure, path: str | Path, dpi: int = 120, force: bool = False) -> Path:
    """Write a figure in the format that the file's suffix names; create the folder if needed.

    Parameters
    ----------
    figure : Figure
    path : path
        Written as it is: without a suffix the format is PNG, and none is appended.
    dpi : int, default 120
        Dots per inch.
    force : bool, default False
        Whether a file that exists is replaced; a database or a link never is.

    Returns
    -------
    path : Path
        The file, as given.

    Raises
    ------
    OutputError
        The file exists and `force` is not set, it cannot or must not be written, or the suffix
        names no format.
    """
    path = Path(path)
    buffer = BytesIO()
    with instead(OutputError, f"Cannot draw {path}", ValueError, do="name it .png, .pdf or .svg"):
        figure.savefig(buffer, dpi=dpi, format=path.suffix.removeprefix(".") or "png")
    return write_output(path, buffer.getvalue(), force, make_folder=True)


def embedding_map(replay: Replay, title: str = "") -> Figure:
    """Draw the embeddings of a replay's newest 300 parts, and return the figure.

    A replay is a recorded run of a robot cell. The left panel shows which parts were good and bad,
    the right one what was decided. A point is the mean over the embedding spaces (one for each fold
    of the cross-fitting), in its first two dimensions (0 for a second one that is missing), as it
    was at the decision; later retrains do not move it. Parts that no model embedded, or whose
    embedding has another number of dimensions than the replay's newest, are left out, on the left
    also parts of unknown truth. A circle with the recipe's radius, within which labels are counted,
    surrounds the newest point. Without any point a text says so. If the recipe's reducer gives an
    embedding that is never scaled (`has_own_unit`), its first dimension is taken for a probability,
    and the second says little: the vertical axis is then the cycle, and two vertical lines take the
    place of the circle. Raises SettingError if the reducer's class cannot be imported.

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
            axes.scatter(
                *points.T, label=f"{word} ({len(points)})", alpha=0.7, linewidths=0, **style
            )
        if not embedded.any():
            axes.text(0.5, 0.5, "no trace was embedded yet", ha="center", transform=axes.transAxes)
        finish(axes, xlabel=x_label)
        axes.set_title(name, pad=24)
    left.set(ylabel=y_label)
    if is_probability:
        left.set_xlim(-0.06, 1.06)
    else:
        left.set_aspect("equal")
        right.set_aspect("equal")
        if embedded.any():
            low = z[embedded].min(axis=0)
            high = z[embedded].max(axis=0)
            half = 0.56 * (high - low).max() + 1e-9  # the panel is a square in data units
            x, y = (low + high) / 2
            left.set(xlim=(x - half, x + half), ylim=(y - half, y + half))
    if embedded.any():
        _draw_neighbourhood(figure, z[embedded][-1], replay.recipe.radius, is_probability)
    return figure


def _draw_neighbourhood(figure: Figure, centre: Floats, radius: float, is_strip: bool) -> None:
    """Draw a point as a cross, with its neighbourhood, into all axes of a figure; add a legend.

    `centre` (2,) is the point, which the legend calls the newest part, and `radius` the distance
    within which labels are counted. The neighbourhood is a circle, or a strip between two vertical
    lines if `is_strip`.
    """
    from matplotlib.patches import Circle

    x, y = centre
    for axes in figure.axes:
        if is_strip:
            for end in (x - radius, x + radius):
                axes.axvline(end, color=BLACK, linewidth=1.4)
        else:
            axes.add_patch(Circle((x, y), radius, fill=False, edgecolor=BLACK, linewidth=1.4))
        (mark,) = axes.plot(
            x,
            y,
            "+",
            color=BLACK,
            markersize=9,
            label=f"newest part; its neighbourhood ends at the black line, radius {radius:g}",
        )
    figure.legend(handles=[mark], loc="outside lower center", frameon=False, fontsize=SMALL)


def window_curves(replays: Sequence[Replay], window: int = WINDOW, fewest: int = 1) -> pd.DataFrame:
    """Compute the paper's curves, shares of decisions and of errors, over a window of cycles.

    Parameters
    ----------
    replays : sequence of Replay
        At least one; all equally long.
    window : int, default 300
        Cycles, one part each, in the sliding window. At the first cycles, before there are so many,
        a window has all cycles so far.
    fewest : int, default 1
        precision and false_positive are NaN if the windows of all replays together have fewer
        accepted parts than this, or none; false_negative likewise for rejected parts.

    Returns
    -------
    curves : DataFrame
        A row for each cycle, indexed from 0. Each column is a share in percent, over the window
        that ends with the cycle. A part of unknown truth counts as rightly decided.
        certain : the share of parts that the model accepted or rejected, the mean over the
        replays. certain_low, certain_high : its 10th and 90th percentile over the replays.
        precision, false_positive : the shares of good and of bad parts among the accepted parts,
        counted in the windows of all replays together. false_negative : likewise, the share of
        good parts among the rejected parts.
    """
    import pandas as pd

    is_certain = pd.DataFrame({i: r.accepted | r.rejected for i, r in enumerate(replays)})
    certain = is_certain.astype(float).rolling(window, min_periods=1).mean()

    def count(name: str) -> pd.Series[float]:
        """Return how many cycles a field marks in each window, summed over all replays."""
        marks = np.sum([getattr(replay, name) for replay in replays], axis=0)
        return pd.Series(marks).rolling(window, min_periods=1).sum()

    def share(wrong: str, decided: str) -> pd.Series[float]:
        """Return the share of wrong ones of those decided, in the windows of all replays.

        It is NaN in a window with fewer than `fewest` of them, or none.
        """
        n_decided = count(decided)
        return (count(wrong) / n_decided).where(n_decided >= fewest)

    false_positive = share("false_positive", "accepted")
    return 100.0 * pd.DataFrame(
        {
            "certain": certain.mean(axis=1),
            "certain_low": certain.quantile(0.1, axis=1),
            "certain_high": certain.quantile(0.9, axis=1),
            "precision": 1.0 - false_positive,
            "false_positive": false_positive,
            "false_negative": share("false_negative", "rejected"),
        }
    )


def curves(by_recipe: Mapping[str, Sequence[Replay]], title: str = "") -> Figure:
    """Draw the paper's curves over a sliding window of cycles, in a colour for each key.

    A key is a recipe (all settings of an engine) with its replays, or a live run. Up to six keys
    have the colours in `RECIPES`. More keys have 20 others, which the 21st key and those after it
    use again.

    The panels show, from the top: the share of certain decisions, those without a check, with its
    10th to 90th percentile over the replays; the share of good parts among the accepted parts, and
    the lower bound LB of each policy (the success probability that accepted parts must have); bad
    parts among the accepted parts (solid), good parts among the rejected parts (dashed), and the
    tolerated shares, 100 - LB, all in percent. The legend below has the counts of wrong decisions.
    A part of unknown truth counts as rightly decided. Shares of fewer than 20 accepted or rejected
    parts are not drawn; the share of certain decisions is drawn from the first cycle. The window is
    300 cycles, or a third of the longest replay if that is less.

    Parameters
    ----------
    by_recipe : mapping of str to sequence of Replay
        At least one replay; those of one recipe are equally long.
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
    # Of a short replay a third.
    window = min(WINDOW, max(1, max(map(len, all_replays)) // 3))
    colours = RECIPES if n <= len(RECIPES) else colormaps["tab20"].colors  # type: ignore[attr-defined]
    handles = []
    for colour, (name, replays) in zip(cycle(colours), by_recipe.items(), strict=False):
        shares = window_curves(replays, window, FEWEST)
        x = shares.index + 1  # cycles are counted from 1
        certain.fill_between(
            x,
            shares["certain_low"],
            shares["certain_high"],
            color=colour,
            alpha=0.15,
            linewidth=0,
        )
        certain.plot(x, shares["certain"], color=colour)
        precision.plot(x, shares["precision"], color=colour)
        wrong = []
        for kind, decided, word, line in ERRORS:
            errors.plot(x, shares[kind], line, color=colour)
            n_wrong, n_decided = (
                sum(getattr(replay, field).sum() for replay in replays) for field in (kind, decided)
            )
            wrong.append(f"{n_wrong} {word} of {n_decided} {decided}")
        handles += certain.plot([], color=colour, label=f"{name}: {', '.join(wrong)}")
    bounds = sorted({100 * replay.recipe.policy.lower_bound for replay in all_replays})
    tolerances = [100 - bound for bound in bounds]
    for axes, levels, name in (
        (precision, bounds, "LB"),
        (errors, tolerances, "tolerance 100 - LB"),
    ):
        text = ", ".join(f"{level:g}" for level in levels)
        for i, level in enumerate(levels):
            axes.axhline(level, label="_" if i else f"{name} = {text} %", **LIMIT)
    finish(certain, 0, ylim=(0, 102), ylabel="certain\n[% of cycles]")
    lowest = max(0.0, min(precision.get_ylim()[0], bounds[0] - 1))
    finish(precision, ylim=(lowest, 100.5), ylabel="precision\n[% of accepted]")
    # At least half as much again above the tolerance: the panel shows whether errors keep to it.
    finish(
        errors,
        ylim=(0, max(errors.get_ylim()[1], 1.5 * tolerances[0])),
        ylabel="bad of accepted, good of\nrejected (dashed) [%]",
        xlabel=f"cycle (end of a window of {window}; a share of fewer than {FEWEST} parts is not "
        "drawn)",
    )
    figure.legend(handles=handles, loc="outside lower center", frameon=False, fontsize=SMALL)
    return figure


def cost_picture(curve: CostCurve, unit: str = "s") -> Figure:
    """Draw what a part costs under each policy, with 95 % intervals.

    On top are the policies that played the reported shuffles (random orders of the recordings), the
    cheapest first. Below them, hollow, are those that the search left behind: their costs are of
    earlier shuffles, and cannot be compared with the others. A line marks the cost of checking
    everything, and a ring the chosen policy, unless its verdict (`CostCurve.verdict`) is "does not
    pay". The axis begins at 0 and ends at 1.3 times the largest of these costs and the price of a
    check; an interval that goes beyond its end ends in an arrow with its value. The right panel
    shows the share of parts that were decided without a check.

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
        f"{unit}, false reject {costs.false_reject:g} {unit}\n{counted(curve.shuffles, 'shuffle')} "
        f"of {curve.cycles} parts, with 95 % intervals"
    )
    n_last = len(curve.rows)
    rows = [*curve.rows, *curve.left_behind]
    labels = {0: "played last", n_last: "left behind"}  # of the first row of each kind
    figure = blank(9.0, 2.2 + 0.34 * len(rows), title)
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=(3, 1))
    end = 1.3 * max(costs.check, *(row.cost for row in rows))
    left.axvline(costs.check, label="check everything", **LIMIT)
    for y, row in enumerate(rows):
        is_last = y < n_last
        left.errorbar(
            row.cost,
            y,
            xerr=[[row.cost - max(row.lower, 0.0)], [min(row.upper, end) - row.cost]],
            label=labels.get(y, "_"),
            color=BLUE,
            markerfacecolor=BLUE if is_last else "none",
            capsize=3,
            fmt="o",
        )
        if row.upper > end:
            left.text(end, y, f"to {amount(row.upper)} \u2192", ha="right", va="bottom", size=SMALL)
        right.barh(y, 100 * (row.accepted + row.rejected), color=BLUE, fill=is_last)
    if curve.policy is not None:
        left.scatter(
            curve.marked.cost,
            curve.rows.index(curve.marked),
            s=200,
            label=f"choice: {curve.verdict}",
            facecolors="none",
            edgecolors=BLACK,
            linewidths=1.6,
            zorder=5,
        )
    left.set_yticks(range(len(rows)), [policy_name(row.policy) for row in rows])
    left.invert_yaxis()
    finish(left, 4, xlim=(0.0, end), xlabel=f"cost a part [{unit}]")
    finish(right, 0, xlim=(0, 100), xlabel="decided without\na check [% of parts]")
    return figure


def _axis_labels(spec: TraceSpec) -> list[str]:
    """Return a label for the axis of each channel: its name, and its unit in brackets if known.

    `spec` says what the traces look like. A single channel without a name is called "trace",
    several are "channel 0" and so on.
    """
    names = spec.names if spec.columns or spec.channels > 1 else ["trace"]
    return [
        f"{name} [{unit}]" if unit else name for name, unit in zip(names, spec.units, strict=True)
    ]


def _times(spec: TraceSpec, samples: int) -> tuple[Floats, str]:
    """Return the time of each of so many samples, in seconds from 0, and the label of that axis.

    If the rate is unknown, they are the indices of the samples.
    """
    label = "time [s]" if spec.rate_hz else "sample"
    return np.arange(samples) / (spec.rate_hz or 1.0), label


def explained_picture(explanation: Explanation) -> Figure:
    """Draw the trace of a decision with its neighbours and the envelope; return the figure.

    The neighbours are the labelled traces nearest to it in the embedding. The envelope is the band
    in which 95 % of the traces of good parts lie at each sample. Samples that are outside by more
    than a tenth of its width are shaded, but not one that stands alone. The picture has a panel for
    each of at most four channels, in their order: those with the most samples so far outside (those
    that stand alone count, too), of equal ones the first. Without an envelope only the traces are
    drawn, of the first four channels. The title has the decision's id, action and reason, the
    model's version and the label.
    """
    stored = explanation.decision
    decision = stored.decision
    envelope = explanation.envelope
    trace = explanation.trace
    is_outside = np.zeros(trace.shape, dtype=bool)
    if envelope is not None:
        margin = CLEAR * (envelope.high - envelope.low)
        is_outside = (trace < envelope.low - margin) | (trace > envelope.high + margin)
    channels = sorted(np.argsort(-is_outside.sum(axis=1), kind="stable")[:4].tolist())
    version = f"version {decision.model_version}" if decision.model_version else "no model yet"
    title = (
        f"{decision.id}: {decision.action.value}, {decision.reason.value} ({version}); label: "
        f"{stored.label}"
    )
    figure = blank(10.0, 1.5 + 2.3 * len(channels), title)
    panels = figure.subplots(len(channels), 1, sharex=True, squeeze=False)[:, 0]
    labels = _axis_labels(explanation.spec)
    x, x_label = _times(explanation.spec, trace.shape[1])
    for i, (axes, channel) in enumerate(zip(panels, channels, strict=True)):
        if envelope is not None:
            band = (envelope.low[channel], envelope.median[channel], envelope.high[channel])
            _draw_band(axes, x, band, GREEN, "-", f"95 % of {envelope.n:,} successes, median")
        _draw_neighbours(axes, x, explanation, channel)
        axes.plot(x, trace[channel], color=BLACK, linewidth=1.6, label="this trace")
        if is_outside[channel].any():
            axes.fill_between(
                x,
                0.0,
                1.0,
                where=is_outside[channel],
                transform=axes.get_xaxis_transform(),
                zorder=0,
                color=ORANGE,
                alpha=0.3,
                label="outside the band",
            )
        finish(axes, legend=0 if i else 3, ylabel=labels[channel])
    panels[-1].set(xlabel=x_label)
    return figure


def _draw_neighbours(axes: Axes, x: Floats, explanation: Explanation, channel: int) -> None:
    """Draw one channel of the traces of a decision's neighbours, good and bad ones in two styles.

    The neighbours are the labelled traces nearest to the decision's trace in the embedding. `x`
    (T,) are the times of the samples. Neighbours whose trace is not stored are left out. The legend
    counts those that are drawn, of each label.
    """
    for success, name, colour, line, _ in LABEL_STYLES:
        traces = [
            neighbour.trace[channel]
            for neighbour in explanation.neighbours
            if neighbour.trace is not None and neighbour.success is success
        ]
        for i, trace in enumerate(traces):
            # matplotlib leaves labels that begin with _ out of the legend.
            axes.plot(
                x,
                trace,
                line,
                label="_" if i else f"neighbours that were {name} ({len(traces)})",
                color=colour,
                linewidth=0.7,
                alpha=0.55,
            )


def _draw_band(
    axes: Axes, x: Floats, band: Sequence[NDArray[Any]], colour: str, line: str, label: str
) -> None:
    """Draw a band of traces, given by three curves (T,): its lower end, its median, its upper end.

    `x` (T,) are the times of the samples, `line` is the style of the median, and `label` names it
    in the legend.
    """
    low, median, high = band
    axes.fill_between(x, low, high, color=colour, alpha=0.2, linewidth=0)
    axes.plot(x, median, line, color=colour, linewidth=1.2, label=label)


def data_picture(data: Dataset, title: str = "") -> Figure:
    """Draw a data set's traces, and how they change in their order; return the figure.

    Above, a panel for each of the first three channels shows the median trace of good and of bad
    parts, and where the middle 80 % lie. Below are the share of good parts in a sliding tenth of
    the set, and among all, and the mean of each trace's first channel, in the order of the set.
    Traces with a sample that is not finite are not drawn; their labels count in the share. The
    title is `title`, a colon and what is drawn. Raises SettingError as `data.spec` does, for
    example if two channels have the same name.
    """
    X = data.cube
    finite: Bools = np.asarray(np.isfinite(X).all(axis=(1, 2)))
    figure = blank(9.0, 7.6)
    above, below = figure.subfigures(2, 1, squeeze=False, height_ratios=(1, 1.1))[:, 0]
    labels = _axis_labels(data.spec)
    above.suptitle(f"{title}: median trace, and where 10 to 90 % of them lie".removeprefix(": "))
    x, x_label = _times(data.spec, X.shape[2])
    for i, axes in enumerate(above.subplots(1, min(X.shape[1], 3), squeeze=False)[0]):
        for success, name, colour, line, _ in LABEL_STYLES:
            traces = X[finite & (data.y == success), i]  # (n, T)
            if len(traces):
                band = np.quantile(traces, (0.1, 0.5, 0.9), axis=0)
                _draw_band(axes, x, band, colour, line, f"{name} ({len(traces)})")
        n_columns = 3 if finite.any() and not i else 0
        finish(axes, legend=n_columns, xlabel=x_label, ylabel=labels[i])
    _draw_drift(below, data, finite, labels[0])
    return figure


def _draw_drift(figure: Any, data: Dataset, finite: Bools, label: str) -> None:
    """Draw how a data set changes in its order: the share of good parts, the mean of each trace.

    `figure` is a Figure or SubFigure, which gets two axes. The upper one shows the share of good
    parts in a sliding tenth of the data set (at least one part); it begins at the end of the first
    tenth, and a dotted line is the share in the whole set. The lower one has a dot for each of the
    n traces that has only finite samples, as `finite` (n,) says: the mean over the samples of the
    first channel, in the colour of the part's label. `label` names this channel and its unit.
    """
    import pandas as pd

    y = data.y
    top, bottom = figure.subplots(2, 1, sharex=True)
    window = max(1, len(y) // 10)
    x = np.arange(1, len(y) + 1)
    top.plot(
        x,
        100 * pd.Series(y).rolling(window).mean(),
        color=VERIFIED,
        label=f"good, of the last {window}",
    )
    top.axhline(100 * y.mean(), label="good, of all", **LIMIT)
    finish(top, ylim=(0, 104), ylabel="share [%]")
    for success, name, colour, _, _ in LABEL_STYLES:
        rows = finite & (y == success)
        bottom.scatter(
            x[rows],
            data.cube[rows, 0].mean(axis=1, dtype=np.float64),
            s=8,
            color=colour,
            alpha=0.5,
            linewidths=0,
            label=name,
        )
    finish(bottom, xlabel="recording, in the order in which they were made", ylabel=f"mean {label}")
