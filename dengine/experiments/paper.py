"""The paper's experiment, whole: its grid, its two tables in its form with its figures beside ours, and its findings.

    frame = run_grid("insertion", ["conv"], **GRID, repeats=30)
    print(paper_table(frame, "conv", "wilson"))
    for line in findings(frame): print(line)

Source: Duan, Krüger, Heredia, Iversen and Hagelskjær, section "Experiments", tables "Wilson Score" and "Binomial Interval
score": mean false positives / mean certain predictions of 30 shuffles of 1503 insertions.
"""

import math
from typing import TYPE_CHECKING

from .baselines import BASELINES

if TYPE_CHECKING:
    import pandas as pd

ALPHAS = (0.5, 0.1, 0.05)
LOWER_BOUNDS = (0.8, 0.9, 0.95)
INTERVALS = ("wilson", "binomial")
GRID = {"alphas": ALPHAS, "lower_bounds": LOWER_BOUNDS, "intervals": INTERVALS}

_ROWS = {  # (interval, alpha) -> false positives and certain predictions for each LB
    ("wilson", 0.5): ((36.1, 1317.1), (39.6, 1281.6), (39.9, 1241.4)),
    ("wilson", 0.1): ((40.4, 1217.3), (36.9, 1019.8), (16.9, 621.1)),
    ("wilson", 0.05): ((39.6, 1151.4), (30.4, 870.2), (6.5, 397.3)),
    ("binomial", 0.5): ((37.8, 1322.7), (43.5, 1325.8), (40.6, 1322.5)),
    ("binomial", 0.1): ((40.9, 1324.4), (41.7, 1325.6), (40.5, 1325.0)),
    ("binomial", 0.05): ((41.7, 1328.2), (39.7, 1324.1), (40.2, 1324.6)),
}
PUBLISHED = {(*of, bound): cell for of, cells in _ROWS.items() for bound, cell in zip(LOWER_BOUNDS, cells, strict=True)}
BUDGET_S = 0.45  # the paper's cycle budget of a retrain
ANSWERS = 0.1  # certain predictions that vary by more than this share of their mean, over the grid, answer to it


def paper_table(frame: "pd.DataFrame", recipe: str, interval: str) -> str:
    """One of the paper's two tables as Markdown: a row an alpha, a column an LB, `false positives / certain`.

    Ours with the standard deviation over the shuffles; below, in brackets, what the paper published, on other parts.
    """
    rows = frame[(frame["recipe"] == recipe) & (frame["interval"] == interval)]
    bounds = sorted(rows["lower_bound"].unique())
    lines = ["| alpha / LB | " + " | ".join(f"{100 * bound:g} %" for bound in bounds) + " |"]
    lines.append("| --- |" + " --- |" * len(bounds))
    for alpha in sorted(rows["alpha"].unique(), reverse=True):
        cells = []
        for bound in bounds:
            played = rows[(rows["alpha"] == alpha) & (rows["lower_bound"] == bound)][["false_positive", "certain"]]
            pairs = zip(played.mean(), played.std().fillna(0.0), strict=True)
            ours = " / ".join(f"{mean:.1f} ± {sd:.1f}" for mean, sd in pairs) if len(played) else "-"
            theirs = PUBLISHED.get((interval, float(alpha), float(bound))) if len(played) else None
            cells.append(ours if theirs is None else f"{ours} [{theirs[0]} / {theirs[1]}]")
        lines.append(f"| {alpha:g} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def findings(frame: "pd.DataFrame") -> list[str]:
    """Which of the paper's findings the replays of a grid bear out: a line a finding, recipe and interval.

    Those that they say nothing of are left out: of baselines, which decide by rules of their own, what the intervals do.
    frame : as `run_grid` gives it, of one feedback and one guarantee.
    """
    lines: list[str] = []

    def say(holds: bool, claim: str, measured: str) -> None:
        lines.append(f"{'holds' if holds else 'does NOT hold'}: {claim}: {measured}")

    for (recipe, interval), rows in frame.groupby(["recipe", "interval"], sort=False):
        who, ours = f"{recipe}, {interval}", str(recipe).split(" ")[0] not in BASELINES
        means = rows.groupby(["alpha", "lower_bound"], sort=False)[["certain", "false_positive"]].mean()
        certain, n = means["certain"], len(means)
        if ours and n > 1 and interval in INTERVALS and certain.any():
            answers = bool(certain.max() - certain.min() > ANSWERS * certain.mean())
            said = "Wilson answers" if interval == "wilson" else "Binomial does not answer"
            measured = f"certain from {certain.min():.1f} to {certain.max():.1f} over the cells"
            say(answers == (interval == "wilson"), f"{said} to alpha and LB; {who}", measured)
        shares = (means["false_positive"] / certain).fillna(0.0)
        kept = int((shares < 1.0 - means.index.get_level_values("lower_bound")).sum())
        worst = f"in {kept} of {n} cells, at most {100 * shares.max():.1f} % of the certain"
        say(kept == n, f"the mean share of false positives stays below 1 - LB; {who}", worst)
        for bound, column in rows.groupby("lower_bound", sort=False) if ours and interval == "wilson" else ():
            first = column.groupby("alpha")["first_certain"].mean().dropna().sort_index(ascending=False)
            if len(first) >= 2:
                later = bool(first.is_monotonic_increasing and first.iloc[0] < first.iloc[-1])
                measured = ", ".join(f"cycle {cycle:.0f} at {alpha:g}" for alpha, cycle in first.items())
                say(later, f"lower alpha delays the first certain prediction; {who}, LB {100 * bound:g} %", measured)
    for name, rows in frame.groupby("recipe", sort=False):
        if not math.isnan(slowest := float(rows["retrain_max_s"].max())):
            measured = f"median {rows['retrain_p50_s'].median():.3f} s, worst {slowest:.3f} s"
            say(slowest < BUDGET_S, f"a retrain of {name} takes less than {BUDGET_S:g} s", measured)
    return lines


def grid_lines(frame: "pd.DataFrame") -> list[str]:
    """Tables and findings as the lines of a Markdown page, for each guarantee and feedback that was played."""
    told = "false positives / certain, mean ± standard deviation over the shuffles [the paper's, on its own parts]"
    lines = []
    for (guarantee, stops, confirm), rows in frame.groupby(["guarantee", "stops", "confirm"], sort=False):
        known = "good accepted parts confirmed" if confirm else f"stops: {stops}"
        lines += [f"## Guarantee {guarantee}, {known}", ""]
        for recipe, interval in rows[["recipe", "interval"]].drop_duplicates().itertuples(index=False):
            lines += [f"**{recipe}, {interval}**: {told}", "", paper_table(rows, recipe, interval), ""]
        lines += [*(f"- {line}" for line in findings(rows)), ""]
    return lines
