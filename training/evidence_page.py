"""The page of results: tables and figures from the replays that `evidence.py` has played.

`write_results` takes the table of replays (`replays.csv`, one row per replay) and writes

    differences.csv    means per set, policy and method, and paired differences from conv
    curves.png         how the certain share grows with the labels
    net_seconds.png    the seconds saved beside conv
    index.md           the page: three tables per policy, both figures, where conv loses

Nothing is played here, so the page can be written again from a table of an earlier run:
`python training/evidence.py --tables-only --out OUT`.
"""

import math
import os
import platform
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch
from evidence_sets import SETS
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from paper import INTERVALS, findings, paper_table
from published import METHODS as PUBLISHED_METHODS
from scipy.stats import t as student_t

from dengine.experiments.baselines import BASELINES
from dengine.experiments.figures import LIMIT, RECIPES, blank, finish, save
from dengine.experiments.metrics import CYCLE_SECONDS, STOP_SECONDS, VERIFY_SECONDS
from dengine.experiments.tables import write_csv
from dengine.files import write_output

# Methods in the order of the page's columns: first the reducers, then the published baselines.
REDUCERS = ("conv", "rocket", "umap", "umap-learn", "pca")
METHODS = (*REDUCERS, "knn", "wskde", "gp", "minirocket")
REFERENCE = "conv"  # differences are from this method
POLICIES = ((0.1, 0.9), (0.05, 0.95))  # alpha and LB; the figures show the first
CONDITION = ["set", "recipe", "interval", "alpha", "lower_bound"]  # columns of replays.csv
POLICY_COLUMNS = ["set", "interval", "alpha", "lower_bound"]
TOO_FEW = "Too few replays to compare."
LABELS_PER_POINT = 50  # labels between two points of a learning curve
PAPER_REDUCERS = ("umap", "conv")
# Policies of `evidence_guarantees.py`, and the limits that it computes. At LB 95.8 % an accepted
# part costs as much as its check, by the default prices.
GUARANTEES: dict[str, dict[str, Any]] = {
    "local, LB 90 %": {"alpha": 0.1, "lower_bound": 0.9},
    "local, LB 95 %": {"alpha": 0.1, "lower_bound": 0.95},
    "local, LB 95.8 %": {"alpha": 0.1, "lower_bound": 1.0 - VERIFY_SECONDS / STOP_SECONDS},
    "pooled, LB 90 %": {"alpha": 0.1, "lower_bound": 0.9, "guarantee": "pooled"},
    "cost": {"alpha": 0.1, "guarantee": "cost"},
}
HINDSIGHT = ("hindsight, scores of each moment", "hindsight, final scores")
# Variants of conv, each with something that the paper's rule does not promise or need.
VARIANTS = {
    "conv, no novelty": (
        "without the novelty gate, so it also decides on a trace that is unlike all labelled traces"
    ),
    "conv, every stop known": (
        'with `stops="all"`: the engine counts an accepted part as good if the line did not stop'
    ),
    "conv, every stop known, dishonest": (
        'also with `stops="all"`, but each copy of the network learns from all labels, and the '
        "same labels are then counted in its space; it shows what honest counting costs, and must "
        "not be used"
    ),
    "conv, pooled": 'with `guarantee="pooled"` and `stops="all"`',
    "conv, pooled, 2 % audits": (
        "like *conv, pooled*, but 2 % of the parts that the model is certain of are checked all "
        "the same"
    ),
    "conv, pooled, 10 % audits": (
        "like *conv, pooled*, but 10 % of the parts that the model is certain of are checked all "
        "the same"
    ),
}


@dataclass(frozen=True)
class Measure:
    """A column of the table of replays that methods are compared by.

    Parameters
    ----------
    title : str
        Of its table.
    decimals : int
        Of its means and differences.
    text : str
        Sentences that explain it to a reader of the page.
    is_ranked : bool
        Whether the page ranks the methods by it; the largest value is best.
    """

    title: str
    decimals: int
    text: str
    is_ranked: bool


MEASURES = {
    "certain": Measure(
        "Certain decisions",
        0,
        "Parts that were accepted or rejected without a check, per replay. More is better.",
        True,
    ),
    "false_positive": Measure(
        "Bad parts accepted",
        1,
        "Parts per replay that were accepted and were bad. Fewer is better. A method that decides "
        "little also accepts few bad parts, so read this table beside the table of certain "
        "decisions.",
        False,
    ),
    "net_s": Measure(
        "Net seconds saved",
        0,
        f"Each check that was left out saves {VERIFY_SECONDS:g} s. Each bad part that was accepted "
        f"costs {STOP_SECONDS:g} s, and each good part that was rejected costs {CYCLE_SECONDS:g} "
        "s. The entry is the sum per replay. More is better; below zero the method cost more than "
        "it saved.",
        True,
    ),
}


def write_results(replays: pd.DataFrame, folder: Path) -> None:
    """Write `differences.csv`, both figures and the page `index.md` into a folder.

    Parameters
    ----------
    replays : DataFrame
        A row for each replay, as `evidence.py` writes them to `replays.csv`.
    folder : Path
        Created if it is missing; files in it are replaced. The page also shows `guarantees.csv`, if
        `evidence_guarantees.py` has written it there.
    """
    differences = compare_with_reference(replays)
    write_csv(differences.round(3), folder / "differences.csv", force=True)
    save(draw_learning_curves(replays), folder / "curves.png", dpi=80, force=True)
    save(draw_net_seconds(differences), folder / "net_seconds.png", dpi=80, force=True)
    lines = page_lines(replays, differences)
    guarantees = folder / "guarantees.csv"
    if guarantees.exists():
        i = lines.index("## What was played")
        lines[i:i] = guarantee_lines(pd.read_csv(guarantees, dtype={"commit": str}))
    page = "\n".join(lines) + "\n"
    write_output(folder / "index.md", page.encode(), force=True)


class Difference(NamedTuple):
    """Mean of paired differences, and its 95 % interval; NaN where there are too few pairs."""

    mean: float
    low: float
    high: float


def mean_difference(values: pd.Series) -> Difference:
    """Return the mean of paired differences with Student's 95 % interval.

    All are NaN without pairs, and the interval is NaN for a single pair.
    """
    n_pairs = len(values)
    if n_pairs == 0:
        return Difference(math.nan, math.nan, math.nan)
    mean = values.mean()
    if n_pairs == 1:
        return Difference(mean, math.nan, math.nan)
    half = student_t.ppf(0.975, n_pairs - 1) * values.std() / np.sqrt(n_pairs)
    return Difference(mean, mean - half, mean + half)


def compare_with_reference(replays: pd.DataFrame) -> pd.DataFrame:
    """Compare each method with conv on the same parts in the same order.

    Returns
    -------
    differences : DataFrame
        A row for each set, policy and method. For each name in `MEASURES` it has the mean over the
        replays, and `NAME_more`, `NAME_low` and `NAME_high`: how much more the method has than
        conv's replay of the same seed, and the ends of the 95 % interval. NaN without pairs.
    """
    rows = []
    for policy, played in replays.groupby(POLICY_COLUMNS, sort=False):
        reference = played[played["recipe"] == REFERENCE]
        for method, group in played.groupby("recipe", sort=False):
            row: dict[str, Any] = dict(zip(POLICY_COLUMNS, policy, strict=True))
            row |= {"recipe": method, "commit": group["commit"].iloc[0], "replays": len(group)}
            row |= {"cycles": group["cycles"].mean(), "accepted": group["accepted"].mean()}
            pairs = group.merge(reference, on="seed", suffixes=("", "_conv"))
            for name in MEASURES:
                difference = mean_difference(pairs[name] - pairs[f"{name}_conv"])
                row[name] = group[name].mean()
                row[f"{name}_more"] = difference.mean
                row[f"{name}_low"] = difference.low
                row[f"{name}_high"] = difference.high
            rows.append(row)
    return pd.DataFrame(rows)


def select_policy(frame: pd.DataFrame, alpha: float, lower_bound: float) -> pd.DataFrame:
    """Return the rows of one policy with the Wilson interval."""
    is_chosen = (
        (frame["interval"] == "wilson")
        & (frame["alpha"] == alpha)
        & (frame["lower_bound"] == lower_bound)
    )
    return frame[is_chosen]


def policy_name(alpha: float, lower_bound: float) -> str:
    """Return "alpha 0.1, LB 90 %"."""
    return f"alpha {alpha:g}, LB {100 * lower_bound:g} %"


# Figures


def learning_curve(replays: pd.DataFrame) -> pd.Series:
    """Return the certain share of the parts by the number of labels.

    Each value is the share from that number of labels to the next one, `LABELS_PER_POINT` later.
    The curve ends where the first of the replays has no more labels.
    """
    labelled_cycles = [list(map(int, text.split())) for text in replays["bought"].fillna("")]
    durations = pd.DataFrame([np.diff([0, *cycles]) for cycles in labelled_cycles])
    mean_durations = durations.mean(skipna=False)  # cycles per LABELS_PER_POINT labels
    certain_shares = (1.0 - LABELS_PER_POINT / mean_durations).to_numpy()
    return pd.Series(certain_shares, index=LABELS_PER_POINT * mean_durations.index).dropna()


class SetPanels(NamedTuple):
    """A figure with axes for each set in three columns, and one place for the legend."""

    figure: Figure
    axes: dict[str, Axes]
    legend: Axes


def set_panels(title: str, **subplots: Any) -> SetPanels:
    """Return an empty figure of three by three axes."""
    figure = blank(11.0, 8.0, title)
    all_axes = figure.subplots(3, 3, **subplots).ravel()
    return SetPanels(figure, dict(zip(SETS, all_axes, strict=False)), all_axes[-1])


def draw_learning_curves(replays: pd.DataFrame) -> Figure:
    """Draw the learning curve of each method on each set, at the first of `POLICIES`."""
    name = policy_name(*POLICIES[0])
    panels = set_panels(f"Certain share of the parts by labels bought; {name}", sharey=True)
    styles = dict(zip(METHODS, product(("-", "--"), RECIPES), strict=False))
    rows = select_policy(replays, *POLICIES[0])
    rows = rows[rows["recipe"].isin(METHODS)]
    for (set_name, method), group in rows.groupby(["set", "recipe"], sort=False):
        curve = 100.0 * learning_curve(group)
        line, colour = styles[method]
        axes = panels.axes[set_name]
        axes.plot(curve.index, curve, line, marker=".", color=colour, label=method)
    for set_name, axes in panels.axes.items():
        finish(axes, legend=0, ylim=(0, 100), title=set_name)
    panels.figure.supxlabel("labels bought")
    panels.figure.supylabel("certain [%]")
    panels.legend.set_axis_off()
    handles, labels = panels.axes["insertion"].get_legend_handles_labels()
    panels.legend.legend(handles, labels, loc="center", frameon=False)
    return panels.figure


def draw_net_seconds(differences: pd.DataFrame) -> Figure:
    """Draw the net seconds of each method beyond conv's on each set, at the first of `POLICIES`."""
    name = policy_name(*POLICIES[0])
    title = f"Net seconds per replay beyond those of {REFERENCE}, with 95 % intervals; {name}"
    panels = set_panels(title, sharex=True, sharey=True)
    rows = select_policy(differences, *POLICIES[0])
    played = set(rows["recipe"])
    others = [method for method in METHODS if method in played and method != REFERENCE]
    heights = {method: -i for i, method in enumerate(others)}  # from top to bottom
    colours = dict(zip(METHODS, [*RECIPES, *RECIPES], strict=False))
    for _, row in rows[rows["recipe"].isin(others)].iterrows():
        half = row["net_s_high"] - row["net_s_more"]
        axes = panels.axes[row["set"]]
        style: dict[str, Any] = {
            "fmt": "o",
            "markersize": 4,
            "capsize": 3,
            "color": colours[row["recipe"]],
        }
        axes.errorbar(row["net_s_more"], heights[row["recipe"]], xerr=half, **style)
    for set_name, axes in panels.axes.items():
        axes.axvline(0.0, **LIMIT)
        finish(axes, legend=0, title=set_name)
        axes.set(yticks=list(heights.values()), yticklabels=list(heights))
        axes.tick_params(labelbottom=True)
    panels.figure.supxlabel(f"left of the line: {REFERENCE} saves more [s]")
    panels.legend.set_axis_off()
    return panels.figure


# The page


def page_lines(replays: pd.DataFrame, differences: pd.DataFrame) -> list[str]:
    """Return the lines of the page, from how to read it to what was played."""
    lines = ["# Results: how much each method decides, and what it costs", ""]
    lines += introduction_lines()
    for policy in POLICIES:
        rows = select_policy(differences, *policy)
        if not known_methods(rows):
            continue
        name = policy_name(*policy)
        lines += [f"## The answer in short, at {name}", "", *verdict_lines(rows)]
        lines += [f"## Every method on every set, at {name}", "", *measure_lines(rows)]
        if policy == POLICIES[0]:
            lines += figure_lines()
        lines += [f"### Where {REFERENCE} loses, at {name}", "", *loss_lines(rows)]
    lines += paper_lines(replays)
    lines += variant_lines(differences)
    return lines + provenance_lines(replays, differences)


def introduction_lines() -> list[str]:
    """Return the paragraphs that say what a replay is and how to read an entry."""
    kinds = BASELINES | PUBLISHED_METHODS
    titles = [(method, kinds[method].title) for method in METHODS if method in kinds]
    baselines = ", ".join(f"`{method}` ({title})" for method, title in titles)
    return [
        "`python training/evidence.py` played the replays and wrote this page from them. "
        "[replays.csv](replays.csv) has one row per replay, and [differences.csv](differences.csv) "
        "has the means and the paired differences.",
        "",
        "**A replay** sends the parts of one "
        "[set](../explanation/reducers.md#what-each-reducer-gives) through an engine, one after "
        "the other. The "
        "engine starts without a label. It decides a part itself, which is a *certain* decision, "
        "or it has the part checked and learns from the result. From an accepted part it learns "
        "only if the part stopped the line. The seed shuffles the parts of a set, or generates "
        "them.",
        "",
        "**The methods.** " + ", ".join(f"`{method}`" for method in REDUCERS) + " are reducers of "
        "dengine. The other names are published methods, which decide and learn in the same "
        f"engine: {baselines}. The published methods have rules of their own. SGR (selection with "
        "guaranteed risk) chooses a threshold of the predicted probability. `knn` decides if all k "
        "nearest labelled parts have the same "
        "label. It has no bound at all: alpha and LB do not change its decisions.",
        "",
        "**The policies.** alpha is the error level of the interval around the success rate of "
        "similar parts. LB is the success rate that the lower end of this interval must reach "
        "before a part is accepted.",
        "",
        "**An entry** is a mean over the replays. Below the mean is its difference from "
        f"`{REFERENCE}` on the same parts in the same order (the same seed). In brackets is the "
        "95 % interval of this difference (Student's t over the seeds). The difference is **bold** "
        "if the interval does not contain zero. Each interval holds by itself: of 100 methods that "
        f"are exactly as good as `{REFERENCE}`, about five would have a bold difference. A method "
        f"with fewer seeds is compared only with the replays of `{REFERENCE}` that have these "
        "seeds. So this difference may not be the difference of the two means in the table.",
        "",
    ]


def known_methods(differences: pd.DataFrame) -> list[str]:
    """Return the `METHODS` that were played, in the order of the page."""
    played = set(differences["recipe"])
    return [method for method in METHODS if method in played]


def verdict_lines(rows: pd.DataFrame) -> list[str]:
    """Return the lines of a table that counts the sets on which conv is ahead of each method.

    It counts those where conv is behind as well. A sentence says it if nothing can be compared.
    """
    table = []
    for method in known_methods(rows):
        compared = rows[(rows["recipe"] == method) & rows["certain_low"].notna()]
        if method != REFERENCE and len(compared):
            counts = [count_verdicts(compared, name) for name in ("certain", "net_s")]
            table.append([method, str(len(compared)), *counts])
    if not table:
        return [TOO_FEW, ""]
    return [
        f"The three numbers count the sets on which `{REFERENCE}` is ahead, on which the interval "
        f"of the difference contains zero, and on which `{REFERENCE}` is behind.",
        "",
        *table_lines(["method", "sets", "certain decisions", "net seconds"], table),
    ]


def count_verdicts(rows: pd.DataFrame, measure: str) -> str:
    """Return as text on how many sets conv has more, on how many nothing is sure, and has less."""
    n_ahead = int((rows[f"{measure}_high"] < 0).sum())
    n_behind = int((rows[f"{measure}_low"] > 0).sum())
    return f"{n_ahead} / {len(rows) - n_ahead - n_behind} / {n_behind}"


def measure_lines(rows: pd.DataFrame) -> list[str]:
    """Return the lines of a section for each of the `MEASURES`: its title, its text and a table.

    The table has a row for each set and a column for each method, and for some measures a last row
    with mean ranks.
    """
    methods = known_methods(rows)
    lines = []
    for name, measure in MEASURES.items():
        lines += [f"### {measure.title}", "", measure.text, ""]
        table = []
        for set_name, group in rows.groupby("set", sort=False):
            cells = {row["recipe"]: measure_cell(row, name) for _, row in group.iterrows()}
            n_parts = f"{group['cycles'].max():.0f}"
            table.append([set_name, n_parts, *(cells.get(method, "-") for method in methods)])
        if measure.is_ranked:
            table += rank_row(rows, name, methods)
        lines += table_lines(["set", "parts", *methods], table)
    return lines


def measure_cell(row: pd.Series, measure: str) -> str:
    """Return the mean of a method and, below it, the difference from conv, if there is one."""
    mean = f"{row[measure]:.{MEASURES[measure].decimals}f}"
    if row["recipe"] == REFERENCE or math.isnan(row[f"{measure}_more"]):
        return mean
    return f"{mean}<br>{difference_cell(row, measure)}"


def difference_cell(row: pd.Series, measure: str) -> str:
    """Return the difference from conv with its interval, bold if that does not contain zero.

    It is "-" where there is no difference, and stands alone where there is no interval.
    """
    digits = f".{MEASURES[measure].decimals}f"
    difference = Difference(*(row[f"{measure}_{end}"] for end in ("more", "low", "high")))
    if math.isnan(difference.mean):
        return "-"
    mean = f"{difference.mean:+{digits}}"
    if math.isnan(difference.low):
        return mean
    if difference.low > 0 or difference.high < 0:
        mean = f"**{mean}**"
    return f"{mean} ({difference.low:{digits}} to {difference.high:{digits}})"


def rank_row(rows: pd.DataFrame, measure: str, methods: Sequence[str]) -> list[list[str]]:
    """Return a list of one row: the mean ranks over the sets that all methods have played.

    The list is empty if there is no such set, or fewer than two methods.
    """
    rows = rows[rows["recipe"].isin(methods)]
    is_complete = rows.groupby("set")["recipe"].transform("nunique") == len(methods)
    complete = rows[is_complete]
    if complete.empty or len(methods) < 2:
        return []
    ranks = complete.groupby("set")[measure].rank(ascending=False)
    means = ranks.groupby(complete["recipe"]).mean()
    title = f"mean rank over {complete['set'].nunique()} sets"
    return [[title, "", *(f"{means[method]:.1f}" for method in methods)]]


def figure_lines() -> list[str]:
    """Return both figures with a sentence on how to read each."""
    policy = policy_name(*POLICIES[0])
    return [
        "### How fast they learn",
        "",
        "![Learning curves of each method on each set](curves.png)",
        "",
        f"Each point covers a stretch of parts in which the engine got {LABELS_PER_POINT} labels, "
        f"at {policy}. It shows the share of these parts that were decided without a check. If a "
        "curve ends further left, the method needed fewer labels for all parts of the set.",
        "",
        f"### Net seconds beside {REFERENCE}",
        "",
        f"![Net seconds of each method beyond those of {REFERENCE}](net_seconds.png)",
        "",
        f"The figure shows the differences in net seconds saved, at {policy}. The dotted line is "
        f"`{REFERENCE}`. If the bar of a method crosses this line, these replays show no "
        f"difference from `{REFERENCE}`.",
        "",
    ]


def loss_lines(rows: pd.DataFrame) -> list[str]:
    """Return the lines of a table: where a method beats conv beyond chance, and by how much.

    It beats conv by certain decisions or by net seconds. A sentence says it if none does, or if
    nothing can be compared.
    """
    rows = rows[rows["recipe"].isin(METHODS)]
    losses = rows[(rows["certain_low"] > 0) | (rows["net_s_low"] > 0)]
    if not (rows["recipe"] != REFERENCE).any() or rows["certain_low"].isna().all():
        return [TOO_FEW, ""]
    if losses.empty:
        return ["Nowhere in certain decisions or net seconds, beyond chance.", ""]
    table = []
    for _, row in losses.iterrows():
        cells = [difference_cell(row, name) for name in MEASURES]
        table.append([row["set"], row["recipe"], *cells])
    return [
        f"These methods have more certain decisions or net seconds than `{REFERENCE}`, by more "
        "than chance explains. The entries say how much more.",
        "",
        *table_lines(["set", "method", *(measure.title for measure in MEASURES.values())], table),
    ]


def paper_lines(replays: pd.DataFrame) -> list[str]:
    """Return the paper's tables and findings; [] if its combinations were not played."""
    rows = replays[(replays["set"] == "insertion") & replays["recipe"].isin(PAPER_REDUCERS)]
    if rows[["alpha", "lower_bound"]].drop_duplicates().shape[0] <= len(POLICIES):
        return []
    lines = [
        "## The paper's table",
        "",
        "The tables have the paper's 18 combinations of interval, alpha and LB on `insertion`. An "
        "entry is: bad parts accepted / certain decisions, each a mean ± the standard deviation "
        "over the seeds. In brackets are the numbers that the paper published for UMAP on its own "
        "parts.",
        "",
    ]
    for reducer, interval in product(PAPER_REDUCERS, INTERVALS):
        played = rows[(rows["recipe"] == reducer) & (rows["interval"] == interval)]
        if len(played):
            lines += [f"**{reducer}, {interval} interval**", ""]
            lines += [paper_table(played, reducer, interval), ""]
    lines += [
        "Each line says whether these replays confirm a finding of the paper. Then come the "
        "finding, the method and what was measured. Here a *cell* is a cell of the tables: a "
        "combination of alpha and LB.",
        "",
    ]
    return [*lines, *(f"- {line}" for line in findings(rows)), ""]


def variant_lines(differences: pd.DataFrame) -> list[str]:
    """Return the table of conv's variants on the sets that they were played on; [] without any."""
    rows = select_policy(differences, *POLICIES[0])
    sets = set(rows.loc[rows["recipe"].isin(VARIANTS), "set"])
    if not sets:
        return []
    rows = rows[rows["recipe"].isin([REFERENCE, *VARIANTS]) & rows["set"].isin(sets)]
    table = []
    for _, row in rows.iterrows():
        bad_share = "-"
        if row["accepted"]:
            bad_share = f"{100.0 * row['false_positive'] / row['accepted']:.1f} %"
        cells = [measure_cell(row, "certain"), bad_share, measure_cell(row, "net_s")]
        table.append([row["set"], row["recipe"], *cells])
    return [
        f"## What each promise costs, at {policy_name(*POLICIES[0])}",
        "",
        f"The table compares `{REFERENCE}` under the paper's rule with variants of it:",
        "",
        *(f"- *{name}*: {text}." for name, text in VARIANTS.items()),
        "",
        *table_lines(["set", "variant", "certain", "bad of the accepted", "net seconds"], table),
    ]


def guarantee_lines(played: pd.DataFrame) -> list[str]:
    """Return the table of all guarantees on all sets, from the rows of guarantees.csv."""
    names = [*GUARANTEES, *HINDSIGHT]
    columns = ["certain", "accepted", "false_positive", "net_s"]
    table = []
    for set_name, group in played.groupby("set", sort=False):
        means = group.groupby("guarantee")[columns].mean()
        cells = [guarantee_cell(means.loc[name]) for name in names]
        table.append([set_name, f"{group['cycles'].max():.0f}", *cells])
    commits = ", ".join(sorted(played["commit"].unique()))
    n_shuffles = played["seed"].nunique()
    origin = f"The numbers are means over {n_shuffles} shuffles."
    if n_shuffles == 1:
        origin = "The numbers come from one shuffle, so differences between them may be chance."
    return [
        "## What each guarantee saves",
        "",
        "The table compares guarantees for `conv`. Every bad accepted part stops the line and is "
        'known (`stops="all"`). `python training/evidence_guarantees.py` played these replays at '
        f"commit {commits}. {origin} An entry is: **net seconds** / certain decisions / share of "
        "the accepted parts that were bad. LB 95.8 % is 1 - 5 / 120: if 5 of 120 accepted parts "
        "are bad, accepting costs as much as checking. The two columns on the right need "
        "hindsight: the accept threshold and the reject threshold that save most were chosen "
        "afterwards, with "
        "all labels known. The first of the two columns applies the thresholds to the score that "
        "each part had when the guarantee `cost` decided on it. The second column "
        "applies them to the scores of a model that was trained beforehand on the whole set, with "
        "cross-fitting: each part is scored by a copy of the model that was trained without its "
        "label. [guarantees.csv](guarantees.csv) has a row for each replay.",
        "",
        *table_lines(["set", "parts", *names], table),
    ]


def guarantee_cell(means: pd.Series) -> str:
    """Return net seconds, certain decisions and the bad share of the accepted parts."""
    share = 100.0 * means["false_positive"] / max(means["accepted"], 1.0)
    return f"**{means['net_s']:.0f}** / {means['certain']:.0f} / {share:.1f} %"


def provenance_lines(replays: pd.DataFrame, differences: pd.DataFrame) -> list[str]:
    """Return what was played by which commit, the seeds, the machine and the date."""
    table = []
    for (method, commit), group in differences.groupby(["recipe", "commit"], sort=False):
        fewest = group["replays"].min()
        most = group["replays"].max()
        n_seeds = f"{most}" if fewest == most else f"{fewest} to {most}"
        table.append([method, commit, n_seeds])
    return [
        "## What was played",
        "",
        f"Seeds {replays['seed'].min()} to {replays['seed'].max()}. Slow methods have fewer seeds. "
        "Retrain times are not on this page, because the replays shared the cores: "
        "`training/benchmark_cycle.py` measures them.",
        "",
        *table_lines(["method", "commit", "seeds per set and policy"], table),
        f"Written on {datetime.now(UTC):%d %B %Y} on this machine:",
        "",
        *machine_lines(),
    ]


def machine_lines() -> list[str]:
    """Return the processor, the number of cores, and the versions of Python and PyTorch."""
    processor = platform.processor()
    cpu_info = Path("/proc/cpuinfo")
    if cpu_info.exists():
        for line in cpu_info.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                processor = line.split(": ")[1]
                break
    return [
        f"    {processor}, {os.cpu_count()} cores",
        f"    Python {platform.python_version()}, torch {torch.__version__}",
    ]


def table_lines(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return the lines of a Markdown table, and an empty line."""
    lines = [head, ["---"] * len(head), *rows]
    return [*(f"| {' | '.join(cells)} |" for cells in lines), ""]
