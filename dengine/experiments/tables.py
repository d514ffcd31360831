"""Replays as tables: a row for each replay in the CSV, a pooled row for each recipe and policy on
the screen, and sentences about them. `dengine replay` and `dengine compare` print them.

    frame = frame_of(replays)
    rows = pool(frame, replays)
    Console().print(pooled_table(rows, "Replays", LEGEND), *promise_lines(rows))
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import counted, percent
from ..files import write_output
from ..records import RetrainReport
from .metrics import CYCLE_SECONDS, STOP_SECONDS, VERIFY_SECONDS, pooled_error, share_right
from .replay import POLICY_COLUMNS, Replay, Row

if TYPE_CHECKING:
    import pandas as pd
    from rich.table import Table

# Columns by which replays are pooled, and those that are counts.
CONDITION = ["recipe", *POLICY_COLUMNS]
COUNTS = [
    "certain",
    "accepted",
    "rejected",
    "false_positive",
    "false_negative",
    "novel",
    "safe_mode",
]
# Column -> how the values of the replays are combined in a pooled row.
AGGREGATED = {
    "retrain_p50_s": "median",
    "retrain_max_s": "max",
    "decide_p50_us": "median",
    "decide_p99_us": "max",
    "first_certain": "mean",
    "saved_s": "mean",
    "net_s": "mean",
}
# Accepted parts from which on a verdict is given. With 30 parts, each better than LB, the realised
# rate breaks 1 - LB in every fifth run.
ENOUGH = 200
LEGEND = (
    "Means per replay ± the standard deviation over the replays; shares are of the parts of all "
    "replays. FP: bad parts accepted, FN: good ones rejected; NPV: share of the rejected parts "
    "that were bad. retrain: median and worst; decide: median and 99th percentile. saved: "
    f"--check-seconds for each check left out; net: less {STOP_SECONDS:g} s for each FP and "
    f"{CYCLE_SECONDS:g} s for each FN."
)


def frame_of(replays: Sequence[Replay], check_seconds: float = VERIFY_SECONDS) -> pd.DataFrame:
    """Return a table with a row for each replay, as `Replay.summary` gives it.

    `check_seconds` is how long a verification takes, for the time saved. Raises SettingError if it
    is not finite or not above 0. Without replays the table has no rows and no columns.
    """
    import pandas as pd

    return pd.DataFrame([replay.summary(check_seconds) for replay in replays])


def pool(frame: pd.DataFrame, replays: Sequence[Replay]) -> list[Row]:
    """Pool the replays that have the same settings, and return a row for each of these settings.

    The settings are the columns in `CONDITION`: recipe (name of the engine's settings, or of the
    method that decides in its place) and, of the `Policy`, interval (method of the confidence
    interval), alpha (its error level), lower_bound, guarantee (name of the decision rule) and stops
    (whether all line stops are reported). There is a row for each combination of their values that
    the frame has, in the frame's order.

    Parameters
    ----------
    frame : DataFrame
        As `frame_of` gives it for one replay or more.
    replays : sequence of Replay
        The replays of the frame's rows, in their order, all of one data set and none of a live run.

    Returns
    -------
    rows : list of dict
        Beside `CONDITION`, `replays` (how many) and `cycles` (of all of them; a cycle is a decision
        on a part):

        - certain (accepted or rejected by the model), accepted, rejected, false_positive,
          false_negative, novel (verified as unlike all learned traces) and safe_mode (after which
          every part is verified, because of an alarm): mean number of cycles per replay. `total_*`:
          their sums. `certain_sd` and `false_positive_sd`: standard deviations over the replays,
          NaN for one replay.
        - precision, npv : computed from the sums over all replays; NaN without such decisions. A
          mean over the replays would weigh a replay that accepted three parts as much as one that
          accepted 300.
        - Times of retrains and decisions, the first cycle without a check (`first_certain`), and
          the seconds of checks saved (`saved_s`; `net_s`: less what wrong decisions cost): median,
          largest or mean, as `AGGREGATED` says. Replays without such a value (NaN) are left out.
        - error_lower, error_upper : 95 % interval of the share of bad parts among the accepted
          parts; 0 and 1 if none was accepted.
        - promise_kept : whether the pooled precision is at least `lower_bound`; None if fewer than
          200 parts were accepted.
        - retrains_dropped : number of retrains whose model was not put in use.
    """
    rows = []
    for key, part in frame.reset_index(drop=True).groupby(CONDITION, sort=False):
        totals = part[COUNTS].sum().to_dict()
        row = dict(zip(CONDITION, key, strict=True))
        row |= {"replays": len(part), "cycles": int(part["cycles"].sum())}
        row |= part[COUNTS].mean().to_dict()
        row |= {f"total_{name}": total for name, total in totals.items()}
        row |= {f"{name}_sd": float(part[name].std()) for name in ("certain", "false_positive")}
        row["precision"] = share_right(totals["false_positive"], totals["accepted"])
        row["npv"] = share_right(totals["false_negative"], totals["rejected"])
        row |= part.agg(AGGREGATED).to_dict()
        row["retrains_dropped"] = int(part["retrains_dropped"].sum())
        error = pooled_error([replays[i] for i in part.index])
        row |= {"error_lower": error.lower, "error_upper": error.upper}
        row["promise_kept"] = None
        if totals["accepted"] >= ENOUGH:
            row["promise_kept"] = bool(row["precision"] >= row["lower_bound"])
        rows.append(row)
    return rows


def promise_lines(rows: Sequence[Row]) -> list[str]:
    """Return a sentence for each row of `pool`: were at least LB of its accepted parts good?

    `pool` counts replays with the same settings together in one row. LB is the `lower_bound` of its
    policy, the success probability that accepted parts must have. The sentence ends with "kept" or
    "broken", or says that no part, or too few parts, were accepted. It always names the recipe (all
    settings) and the guarantee (the rule that decided). It names the interval and alpha only if the
    rows differ in it. Unless no part was accepted, it has the share of good parts among the
    accepted parts, the interval of the share of bad parts, and LB.
    """
    varying = [name for name in ("interval", "alpha") if len({row[name] for row in rows}) > 1]
    lines = []
    for row in rows:
        words = {"interval": row["interval"], "alpha": f"alpha {row['alpha']:g}"}
        settings = ", ".join([row["guarantee"], *(words[name] for name in varying)])
        subject = f"{row['recipe']} ({settings})"
        if not row["total_accepted"]:
            lines.append(f"{subject}: no part was accepted.")
            continue
        too_few = f"fewer than {ENOUGH} accepted parts, too few to say"
        verdict = {True: "kept", False: "broken", None: too_few}[row["promise_kept"]]
        good = f"{percent(row['precision'])} of {row['total_accepted']} accepted parts were good"
        bad = f"{100 * row['error_lower']:.1f} to {percent(row['error_upper'])} at 95 %"
        lines.append(
            f"{subject}: {good}; bad: {bad}, LB {100 * row['lower_bound']:g} %: {verdict}."
        )
    return lines


def pooled_table(rows: Sequence[Row], title: str, legend: str) -> Table:
    """Return the rows that `pool` returned as a rich Table for the screen, with a legend below.

    There must be at least one row. The first column has the recipe (all settings of an engine), the
    guarantee (the rule that decided), the policy's `stops` (which bad accepted parts stop the
    line), and the interval if the rows differ in it. The others are those of `CELLS`: alpha (the
    error level) and lower bound (the success probability that accepted parts must have), counts and
    shares of decisions and errors, times of retrains and decisions, and the seconds of checks
    saved, alone and less the cost of errors.
    """
    several_intervals = len({row["interval"] for row in rows}) > 1
    shown = []
    for row in rows:
        name = f"{row['recipe']}\n{row['guarantee']}, {row['stops']}"
        if several_intervals:
            name += f"\n{row['interval']}"
        shown.append(
            {"recipe\nguarantee": name}
            | {column: format_cell(row) for column, format_cell in CELLS.items()}
        )
    return table_of_numbers(title, shown, legend)


def table_of_numbers(
    title: str, rows: Sequence[Mapping[str, str]], caption: str, total: bool = False
) -> Table:
    """Return a rich Table: the names of the rows at the left, right-aligned numbers beside them.

    Parameters
    ----------
    title, caption : str
        Texts above and below the table.
    rows : sequence of mappings
        A mapping for each row, at least one: column title -> text of the table's cell, with the
        same titles in the same order in all. The first column has the names of the rows.
    total : bool, default False
        Draw a line above the last row.
    """
    from rich.box import SIMPLE_HEAD
    from rich.markup import escape
    from rich.table import Table

    table = Table(
        title=f"\n{escape(title)}\n",
        caption=f"\n{escape(caption)}\n",
        box=SIMPLE_HEAD,
        title_justify="left",
        caption_justify="left",
        pad_edge=False,
        show_edge=False,
        collapse_padding=True,
    )
    # The first column may wrap: 80 columns are enough for every number.
    for i, name in enumerate(rows[0]):
        table.add_column(name, justify="right" if i else "left", no_wrap=i > 0, overflow="fold")
    for i, row in enumerate(rows):
        table.add_row(*map(escape, row.values()), end_section=total and i == len(rows) - 2)
    return table


def _whole(value: float) -> str:
    """Return a number as text, rounded to an integer; "-" for NaN."""
    return "-" if math.isnan(value) else f"{value:.0f}"


def _certain_with_sd(row: Row) -> str:
    """Return the mean `certain` of a pooled row as text, ± its standard deviation over the replays.

    Both are rounded to integers. For one replay it is the mean alone, with one decimal.
    """
    mean = row["certain"]
    deviation = row["certain_sd"]
    return f"{mean:.1f}" if math.isnan(deviation) else f"{mean:.0f}±{deviation:.0f}"


# Column of the screen's table -> its cell for a pooled row.
CELLS: dict[str, Any] = {
    "alpha\nLB": lambda row: f"{row['alpha']:g}\n{100 * row['lower_bound']:g} %",
    "certain\nshare": lambda row: (
        f"{_certain_with_sd(row)}\n{percent(row['total_certain'] / row['cycles'])}"
    ),
    "accept\nFP": lambda row: f"{row['accepted']:.1f}\n{row['false_positive']:.2f}",
    "reject\nFN": lambda row: f"{row['rejected']:.1f}\n{row['false_negative']:.2f}",
    "precision\nNPV": lambda row: f"{percent(row['precision'])}\n{percent(row['npv'])}",
    "retrain\nms": lambda row: (
        f"{_whole(1e3 * row['retrain_p50_s'])}\n{_whole(1e3 * row['retrain_max_s'])}"
    ),
    "decide\nµs": lambda row: f"{_whole(row['decide_p50_us'])}\n{_whole(row['decide_p99_us'])}",
    "saved\nnet, s": lambda row: f"{row['saved_s']:.0f}\n{row['net_s']:.0f}",
}


def retrain_line(retrains: Sequence[RetrainReport]) -> str:
    """Return a sentence on retrains: how many, how many seconds at most, how many were dropped.

    A retrain is dropped if its new model is not put in use; the sentence gives the reason of the
    last such retrain. If there was no retrain, it is "No retrain."
    """
    if not retrains:
        return "No retrain."
    slowest = max(retrain.seconds for retrain in retrains)
    reasons = [retrain.reason for retrain in retrains if not retrain.accepted]
    dropped = ""
    if reasons:
        last_reason = reasons[-1].removeprefix("dropped: ")
        dropped = f"; {len(reasons)} dropped, the last for: {last_reason}"
    return f"{counted(len(retrains), 'retrain')}, the worst in {slowest:.3f} s{dropped}."


def write_csv(frame: pd.DataFrame, path: str | Path, force: bool = False) -> Path:
    """Write a frame as CSV without its index, creating the folder; return the file's path.

    The text is UTF-8, with a header and line feeds. The file is written as a whole or not at all.

    Raises
    ------
    OutputError
        The file exists and `force` is not set, it is a database or a link, or it cannot be
        written.
    """
    return write_output(
        path,
        frame.to_csv(index=False, lineterminator="\n").encode(),
        force,
        make_folder=True,
    )
