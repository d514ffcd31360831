"""The paper's experiment, whole: its grid, its two tables in its form with its figures beside ours, and its findings.

    frame = run_grid("insertion", ["conv"], **GRID, repeats=30)
    print(paper_table(frame, "conv", "wilson"))
    for finding in findings(frame): print(finding.sentence)

Source: Duan, Krüger, Heredia, Iversen and Hagelskjær, section "Experiments", tables "Wilson Score" and "Binomial Interval
score": mean false positives / mean certain predictions of 30 shuffles of 1503 insertions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from .rivals import RIVALS

if TYPE_CHECKING:
    import pandas as pd

ALPHAS = (0.5, 0.1, 0.05)
LOWER_BOUNDS = (0.8, 0.9, 0.95)
INTERVALS = ("wilson", "binomial")
GRID = {"alphas": ALPHAS, "lower_bounds": LOWER_BOUNDS, "intervals": INTERVALS}

PUBLISHED = {  # (interval, alpha, LB) -> (false positives, certain predictions)
    ("wilson", 0.5, 0.8): (36.1, 1317.1),
    ("wilson", 0.5, 0.9): (39.6, 1281.6),
    ("wilson", 0.5, 0.95): (39.9, 1241.4),
    ("wilson", 0.1, 0.8): (40.4, 1217.3),
    ("wilson", 0.1, 0.9): (36.9, 1019.8),
    ("wilson", 0.1, 0.95): (16.9, 621.1),
    ("wilson", 0.05, 0.8): (39.6, 1151.4),
    ("wilson", 0.05, 0.9): (30.4, 870.2),
    ("wilson", 0.05, 0.95): (6.5, 397.3),
    ("binomial", 0.5, 0.8): (37.8, 1322.7),
    ("binomial", 0.5, 0.9): (43.5, 1325.8),
    ("binomial", 0.5, 0.95): (40.6, 1322.5),
    ("binomial", 0.1, 0.8): (40.9, 1324.4),
    ("binomial", 0.1, 0.9): (41.7, 1325.6),
    ("binomial", 0.1, 0.95): (40.5, 1325.0),
    ("binomial", 0.05, 0.8): (41.7, 1328.2),
    ("binomial", 0.05, 0.9): (39.7, 1324.1),
    ("binomial", 0.05, 0.95): (40.2, 1324.6),
}
BUDGET_S = 0.45  # the paper's cycle budget of a retrain
ANSWERS = 0.1  # certain predictions that vary by more than this share of their mean, over the grid, answer to it


def paper_table(frame: pd.DataFrame, recipe: str, interval: str) -> str:
    """One of the paper's two tables as Markdown: a row an alpha, a column an LB, `false positives / certain`.

    Ours with the standard deviation over the shuffles; below, in brackets, what the paper published, on other parts.
    """
    rows = frame[(frame["recipe"] == recipe) & (frame["interval"] == interval)]
    alphas, bounds = sorted(rows["alpha"].unique(), reverse=True), sorted(rows["lower_bound"].unique())
    lines = ["| alpha / LB | " + " | ".join(f"{100 * bound:g} %" for bound in bounds) + " |"]
    lines.append("| --- |" + " --- |" * len(bounds))
    for alpha in alphas:
        cells = [_cell(_of(rows, alpha, bound), interval, alpha, bound) for bound in bounds]
        lines.append(f"| {alpha:g} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _of(rows: pd.DataFrame, alpha: float, bound: float) -> pd.DataFrame:
    return rows[(rows["alpha"] == alpha) & (rows["lower_bound"] == bound)]


def _cell(rows: pd.DataFrame, interval: str, alpha: float, bound: float) -> str:
    if not len(rows):
        return "-"
    mean, sd = (
        getattr(rows[["false_positive", "certain"]], what)().fillna(0.0).to_numpy(dtype=np.float64)
        for what in ("mean", "std")
    )
    ours = f"{mean[0]:.1f} ± {sd[0]:.1f} / {mean[1]:.1f} ± {sd[1]:.1f}"
    published = PUBLISHED.get((interval, float(alpha), float(bound)))
    return ours if published is None else f"{ours} [{published[0]} / {published[1]}]"


@dataclass(frozen=True, slots=True)
class Finding:
    """One of the paper's findings in one cell of the grid, or over it.

    claim : the paper's.  who : recipe and interval.  cell : alpha and LB, or "" for the grid as a whole.
    measured : in words.  holds : here.
    """

    claim: str
    who: str
    cell: str
    measured: str
    holds: bool

    @property
    def sentence(self) -> str:
        """All of it as one line."""
        where = ", ".join(part for part in (self.who, self.cell) if part)
        return f"{'holds' if self.holds else 'does NOT hold'}: {self.claim}; {where}: {self.measured}"


def findings(frame: pd.DataFrame) -> list[Finding]:
    """Which of the paper's findings the replays of a grid bear out, cell by cell.

    Those that they say nothing of are left out: of rivals, which decide by rules of their own, what the intervals do.
    frame : as `run_grid` gives it, of one feedback and one guarantee.
    """
    found = []
    for (recipe, interval), rows in frame.groupby(["recipe", "interval"], sort=False):
        ours = str(recipe).split(" ")[0] not in RIVALS
        found += _answers(rows, f"{recipe}, {interval}", str(interval)) if ours else []
        found += _tolerances(rows, f"{recipe}, {interval}")
        found += _delays(rows, f"{recipe}, {interval}") if ours and interval == "wilson" else []
    return found + _budgets(frame)


def _answers(rows: pd.DataFrame, where: str, interval: str) -> list[Finding]:
    certain = rows.groupby(["alpha", "lower_bound"])["certain"].mean()
    if len(certain) < 2 or interval not in INTERVALS or not certain.any():
        return []
    spread = float((certain.max() - certain.min()) / certain.mean())
    said = f"certain from {certain.min():.1f} to {certain.max():.1f} over the cells, {100 * spread:.0f} % of the mean"
    if interval == "wilson":
        return [Finding("Wilson answers to alpha and LB", where, "", said, spread > ANSWERS)]
    return [Finding("Binomial does not answer to alpha and LB", where, "", said, spread <= ANSWERS)]


def _tolerances(rows: pd.DataFrame, where: str) -> list[Finding]:
    found = []
    for (alpha, bound), cell in rows.groupby(["alpha", "lower_bound"], sort=False):
        certain = float(cell["certain"].mean())
        share = float(cell["false_positive"].mean()) / certain if certain else math.nan
        said = "nothing was certain" if math.isnan(share) else f"{100 * share:.1f} % of {certain:.1f} certain"
        claim = "the mean share of false positives stays below 1 - LB"
        cell_of = f"alpha {alpha:g}, LB {100 * bound:g} %"
        found.append(Finding(claim, where, cell_of, said, math.isnan(share) or share < 1.0 - bound))
    return found


def _delays(rows: pd.DataFrame, where: str) -> list[Finding]:
    found = []
    for bound, column in rows.groupby("lower_bound", sort=False):
        first = column.groupby("alpha")["first_certain"].mean().dropna().sort_index(ascending=False)
        if len(first) < 2:
            continue
        said = ", ".join(f"cycle {cycle:.0f} at {alpha:g}" for alpha, cycle in first.items())
        later = bool(first.is_monotonic_increasing and first.iloc[0] < first.iloc[-1])
        claim = "lower alpha delays the first certain prediction"
        found.append(Finding(claim, where, f"LB {100 * bound:g} %", said, later))
    return found


def _budgets(frame: pd.DataFrame) -> list[Finding]:
    found = []
    for recipe, rows in frame.groupby("recipe", sort=False):
        worst = float(rows["retrain_max_s"].max())
        if not math.isnan(worst):
            said = f"median {rows['retrain_p50_s'].median():.3f} s, worst {worst:.3f} s"
            claim = f"a retrain of {recipe} takes less than {BUDGET_S:g} s"
            found.append(Finding(claim, str(recipe), "", said, worst < BUDGET_S))
    return found


def finding_lines(found: Sequence[Finding]) -> list[str]:
    """A line a claim and recipe: what was measured, or in how many cells it holds and where it does not."""
    groups: dict[tuple[str, str], list[Finding]] = {}
    for each in found:
        groups.setdefault((each.claim, each.who), []).append(each)
    return [_line_of(some) for some in groups.values()]


def _line_of(found: Sequence[Finding]) -> str:
    first, against = found[0], [f"{each.cell}: {each.measured}" for each in found if not each.holds]
    if len(found) == 1:
        return first.sentence
    but = f"; not at {'; '.join(against)}" if against else ""
    return f"holds in {len(found) - len(against)} of {len(found)} cells: {first.claim}; {first.who}{but}"


def grid_lines(frame: pd.DataFrame) -> list[str]:
    """Tables and findings as the lines of a Markdown page, for each guarantee and feedback that was played."""
    lines = []
    for (guarantee, stops, confirm), rows in frame.groupby(["guarantee", "stops", "confirm"], sort=False):
        known = "good accepted parts confirmed" if confirm else f"stops: {stops}"
        lines += [f"## Guarantee {guarantee}, {known}", ""]
        for recipe, interval in rows[["recipe", "interval"]].drop_duplicates().itertuples(index=False):
            lines += [f"**{recipe}, {interval}**: false positives / certain, mean ± standard deviation over the shuffles"]
            lines[-1] += " [the paper's, on its own parts]"
            lines += ["", paper_table(rows, recipe, interval), ""]
        lines += [*(f"- {finding.sentence}" for finding in findings(rows)), ""]
    return lines
