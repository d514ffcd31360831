"""The paper's experiment: its two tables with its numbers beside ours, and its findings.
`evidence_page.py` writes them.

    frame = run_grid("insertion", ["conv"], **PAPER_GRID, repeats=30)
    print(paper_table(frame, "conv", "wilson"))
    for line in findings(frame): print(line)

Source: Duan, Krüger, Heredia, Iversen and Hagelskjær, section "Experiments", tables "Wilson Score"
and "Binomial Interval score": mean false positives / mean certain predictions of 30 shuffles of
1503 insertions.
"""

from collections.abc import Iterator
from typing import Any

import pandas as pd

from dengine.experiments.baselines import BASELINES
from dengine.experiments.grid import PAPER_GRID

LOWER_BOUNDS = PAPER_GRID["lower_bounds"]
INTERVALS = PAPER_GRID["intervals"]

_ROWS = {  # (interval, alpha) -> false positives and certain predictions for each LB
    ("wilson", 0.5): ((36.1, 1317.1), (39.6, 1281.6), (39.9, 1241.4)),
    ("wilson", 0.1): ((40.4, 1217.3), (36.9, 1019.8), (16.9, 621.1)),
    ("wilson", 0.05): ((39.6, 1151.4), (30.4, 870.2), (6.5, 397.3)),
    ("binomial", 0.5): ((37.8, 1322.7), (43.5, 1325.8), (40.6, 1322.5)),
    ("binomial", 0.1): ((40.9, 1324.4), (41.7, 1325.6), (40.5, 1325.0)),
    ("binomial", 0.05): ((41.7, 1328.2), (39.7, 1324.1), (40.2, 1324.6)),
}
# (interval, alpha, LB) -> false positives and certain predictions, as the paper published them.
PUBLISHED = {
    (*row, bound): cell
    for row, cells in _ROWS.items()
    for bound, cell in zip(LOWER_BOUNDS, cells, strict=True)
}
# The certain predictions react to alpha and LB if they vary by more than this share of their mean.
ANSWERS = 0.1


def paper_table(frame: pd.DataFrame, recipe: str, interval: str) -> str:
    """Return one of the paper's two tables as Markdown.

    It has a row for each alpha, a column for each LB, and cells `false positives / certain`. Our
    numbers have the standard deviation over the shuffles. In brackets stands what the paper
    published, for other parts.

    Parameters
    ----------
    frame : DataFrame
        As `run_grid` gives it.
    recipe, interval : str
        Which of its rows are shown.
    """
    rows = frame[(frame["recipe"] == recipe) & (frame["interval"] == interval)]
    bounds = sorted(rows["lower_bound"].unique())
    lines = ["| alpha / LB | " + " | ".join(f"{100 * bound:g} %" for bound in bounds) + " |"]
    lines.append("| --- |" + " --- |" * len(bounds))
    for alpha in sorted(rows["alpha"].unique(), reverse=True):
        cells = []
        for bound in bounds:
            played = rows[(rows["alpha"] == alpha) & (rows["lower_bound"] == bound)]
            counts = played[["false_positive", "certain"]]
            cells.append(_paper_cell(counts, PUBLISHED.get((interval, float(alpha), float(bound)))))
        lines.append(f"| {alpha:g} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _paper_cell(counts: pd.DataFrame, published: tuple[float, float] | None) -> str:
    """Return a cell of `paper_table`, means ± deviations, as text; "-" where nothing was played.

    `counts` has a row for each replay, with false positives and certain predictions; `published` is
    the paper's pair.
    """
    if not len(counts):
        return "-"
    pairs = zip(counts.mean(), counts.std().fillna(0.0), strict=True)
    cell = " / ".join(f"{mean:.1f} ± {deviation:.1f}" for mean, deviation in pairs)
    return cell if published is None else f"{cell} [{published[0]} / {published[1]}]"


def findings(frame: pd.DataFrame) -> list[str]:
    """Check which of the paper's findings the replays of a grid confirm, and say it in lines.

    They are about how certain predictions, false positives and the first certain prediction depend
    on alpha and LB. A finding is left out if the replays say nothing about it, for want of settings
    or certain predictions to compare. Of a baseline, which has its own rule, only the finding about
    false positives is checked.

    Parameters
    ----------
    frame : DataFrame
        As `run_grid` gives it, of one guarantee and one value of `stops` and `confirm`.

    Returns
    -------
    lines : list of str
        "confirmed: ..." or "not confirmed: ..." for each finding, recipe and interval.
    """
    lines: list[str] = []
    for (recipe, interval), rows in frame.groupby(["recipe", "interval"], sort=False):
        lines += _interval_findings(str(recipe), str(interval), rows)
    return lines


def _finding(holds: bool, claim: str, measured: str) -> str:
    """Return the line of a finding: whether it holds, the claim, and what was measured."""
    return f"{'confirmed' if holds else 'not confirmed'}: {claim}: {measured}"


def _interval_findings(recipe: str, interval: str, rows: Any) -> Iterator[str]:
    """Yield the lines of the findings about one recipe and interval, from the rows of its grid.

    The findings: whether the number of certain predictions varies with alpha and LB, as the paper
    says of Wilson and denies of the binomial interval; whether the mean share of false positives
    among the certain predictions stays below 1 - LB; and, for Wilson, whether a lower alpha delays
    the first certain prediction. The first and the third are left out for baselines, and where too
    few settings or no certain predictions are there to compare.
    """
    condition = f"{recipe}, {interval}"
    is_ours = recipe.split(" ")[0] not in BASELINES
    cells = rows.groupby(["alpha", "lower_bound"], sort=False)
    means = cells[["certain", "false_positive"]].mean()
    certain = means["certain"]
    n_cells = len(means)
    if is_ours and n_cells > 1 and interval in INTERVALS and certain.any():
        answers = bool(certain.max() - certain.min() > ANSWERS * certain.mean())
        claim = (
            "Wilson interval reacts" if interval == "wilson" else "binomial interval does not react"
        )
        measured = f"{certain.min():.1f} to {certain.max():.1f} certain decisions over the cells"
        holds = answers == (interval == "wilson")
        yield _finding(holds, f"the {claim} to alpha and LB; {condition}", measured)
    shares = (means["false_positive"] / certain).fillna(0.0)
    n_kept = int((shares < 1.0 - means.index.get_level_values("lower_bound")).sum())
    most = f"at most {100 * shares.max():.1f} % of the certain decisions"
    claim = f"the mean share of false positives stays below 1 - LB; {condition}"
    yield _finding(n_kept == n_cells, claim, f"in {n_kept} of {n_cells} cells, {most}")
    if not is_ours or interval != "wilson":
        return
    for bound, column in rows.groupby("lower_bound", sort=False):
        first = column.groupby("alpha")["first_certain"].mean().dropna()
        first = first.sort_index(ascending=False)
        if len(first) >= 2:
            is_later = bool(first.is_monotonic_increasing and first.iloc[0] < first.iloc[-1])
            measured = ", ".join(
                f"cycle {cycle:.0f} at {alpha:g}" for alpha, cycle in first.items()
            )
            claim = "lower alpha delays the first certain prediction"
            yield _finding(is_later, f"{claim}; {condition}, LB {100 * bound:g} %", measured)
