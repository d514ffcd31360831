"""The paper's experiment, whole: its grid, its two tables in its form with its figures beside ours, and its findings.

    frame = run_grid("insertion", ["conv"], **GRID, repeats=30)
    print(paper_table(frame, "conv", "wilson"))
    for finding in findings(frame): print(finding.sentence)

Source: Duan, Krüger, Heredia, Iversen and Hagelskjær, section "Experiments", tables "Wilson Score" and "Binomial Interval
score": mean false positives / mean certain predictions of 30 shuffles of 1503 insertions.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from .rivals import RIVALS

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


def paper_table(frame: pd.DataFrame, recipe: str, interval: str) -> str:
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


@dataclass(frozen=True, slots=True)
class Finding:
    """One of the paper's findings in one cell of the grid, or over it, and whether it holds here.

    claim : the paper's.  who : recipe and interval.  cell : alpha and LB, or "" for the grid.  measured : in words.
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
    found: list[Finding] = []
    for (recipe, interval), rows in frame.groupby(["recipe", "interval"], sort=False):
        who, ours = f"{recipe}, {interval}", str(recipe).split(" ")[0] not in RIVALS
        means = rows.groupby(["alpha", "lower_bound"], sort=False)[["certain", "false_positive"]].mean()
        found += _answers(means["certain"], who, str(interval)) if ours else []
        for (alpha, bound), (certain, wrong) in zip(means.index, means.to_numpy(), strict=True):
            said = f"{100 * wrong / certain:.1f} % of {certain:.1f} certain" if certain else "nothing was certain"
            cell, claim = f"alpha {alpha:g}, LB {100 * bound:g} %", "the mean share of false positives stays below 1 - LB"
            found.append(Finding(claim, who, cell, said, bool(wrong < (1.0 - bound) * certain or not certain)))
        found += _delays(rows, who) if ours and interval == "wilson" else []
    for name, rows in frame.groupby("recipe", sort=False):
        worst = float(rows["retrain_max_s"].max())
        if not math.isnan(worst):
            said = f"median {rows['retrain_p50_s'].median():.3f} s, worst {worst:.3f} s"
            claim = f"a retrain of {name} takes less than {BUDGET_S:g} s"
            found.append(Finding(claim, str(name), "", said, worst < BUDGET_S))
    return found


def _answers(certain: pd.Series[float], who: str, interval: str) -> Iterator[Finding]:
    if len(certain) > 1 and interval in INTERVALS and certain.any():
        spread = float((certain.max() - certain.min()) / certain.mean())
        said = f"certain from {certain.min():.1f} to {certain.max():.1f} over the cells, {100 * spread:.0f} % of the mean"
        claim = "Wilson answers" if interval == "wilson" else "Binomial does not answer"
        yield Finding(f"{claim} to alpha and LB", who, "", said, (spread > ANSWERS) == (interval == "wilson"))


def _delays(rows: pd.DataFrame, who: str) -> Iterator[Finding]:
    for bound, column in rows.groupby("lower_bound", sort=False):
        first = column.groupby("alpha")["first_certain"].mean().dropna().sort_index(ascending=False)
        if len(first) >= 2:
            said = ", ".join(f"cycle {cycle:.0f} at {alpha:g}" for alpha, cycle in first.items())
            later = bool(first.is_monotonic_increasing and first.iloc[0] < first.iloc[-1])
            yield Finding("lower alpha delays the first certain prediction", who, f"LB {100 * bound:g} %", said, later)


def finding_lines(found: Sequence[Finding]) -> list[str]:
    """A line a claim and recipe: what was measured, or in how many cells it holds and where it does not."""
    lines = []
    for claim, who in dict.fromkeys((each.claim, each.who) for each in found):
        some = [each for each in found if (each.claim, each.who) == (claim, who)]
        against = [f"{each.cell}: {each.measured}" for each in some if not each.holds]
        many = f"holds in {len(some) - len(against)} of {len(some)} cells: {claim}; {who}"
        many += f"; not at {'; '.join(against)}" if against else ""
        lines.append(some[0].sentence if len(some) == 1 else many)
    return lines


def grid_lines(frame: pd.DataFrame) -> list[str]:
    """Tables and findings as the lines of a Markdown page, for each guarantee and feedback that was played."""
    told = "false positives / certain, mean ± standard deviation over the shuffles [the paper's, on its own parts]"
    lines = []
    for (guarantee, stops, confirm), rows in frame.groupby(["guarantee", "stops", "confirm"], sort=False):
        known = "good accepted parts confirmed" if confirm else f"stops: {stops}"
        lines += [f"## Guarantee {guarantee}, {known}", ""]
        for recipe, interval in rows[["recipe", "interval"]].drop_duplicates().itertuples(index=False):
            lines += [f"**{recipe}, {interval}**: {told}", "", paper_table(rows, recipe, interval), ""]
        lines += [*(f"- {finding.sentence}" for finding in findings(rows)), ""]
    return lines
