"""Replays as tables: a row a replay in the CSV, a pooled row a recipe on the screen.

frame = frame_of(replays)
Console().print(pooled_table(pool(frame, replays)))   # and promise_lines(rows)
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import percent
from ..files import write_output
from ..records import RetrainReport
from .metrics import CYCLE_SECONDS, STOP_SECONDS, VERIFY_SECONDS, pooled_error
from .replay import Replay

if TYPE_CHECKING:
    import pandas as pd
    from rich.table import Table

CONDITION = ["recipe", "interval", "alpha", "lower_bound", "guarantee", "stops", "confirm"]
COUNTS = ["certain", "accepted", "rejected", "false_positive", "false_negative", "novel", "safe_mode"]
TIMES = {  # of a pooled row, and how the replays' are put together
    "retrain_p50_s": "median",
    "retrain_max_s": "max",
    "decide_p50_us": "median",
    "decide_p99_us": "max",
    "first_certain": "mean",
    "saved_s": "mean",
    "net_s": "mean",
}
ENOUGH = 200  # accepted parts; with 30, each better than LB, the realised rate breaks 1 - LB in every fifth run
LEGEND = (
    "Means a replay ± the standard deviation over the replays; shares are of the parts of all replays. FP: bad parts "
    "accepted, FN: good ones rejected; NPV: of the rejected the share that was bad. retrain: median and worst; decide: "
    f"median and 99th percentile. saved: --check-seconds a check left out; net: less {STOP_SECONDS:g} s an FP and "
    f"{CYCLE_SECONDS:g} s an FN."
)


def frame_of(replays: Sequence[Replay], check_seconds: float = VERIFY_SECONDS) -> pd.DataFrame:
    """A row a replay, as in `Replay.summary`."""
    import pandas as pd

    return pd.DataFrame([replay.summary(check_seconds) for replay in replays])


def pool(frame: pd.DataFrame, replays: Sequence[Replay] = ()) -> list[dict[str, Any]]:
    """A row for each recipe, interval, alpha, LB, guarantee and feedback, in the frame's order.

    replays : of the frame's rows; with them a row has the interval of the pooled error, and retrains that were dropped.

    precision, npv : over the sums of all replays, not the mean of their ratios, which would weigh a replay that accepted
        three parts as much as one that accepted 300.  COUNTS, saved_s, net_s : means a replay; `total_*` are the sums,
        `certain_sd` and `false_positive_sd` the standard deviations over the replays (NaN of one).
    error_lower, error_upper : 95 % interval of the share of bad ones among the accepted parts; NaN without replays.
    promise_kept : whether the pooled precision is at least LB; None where too few parts were accepted to say.
    retrain_p50_s, decide_p50_us : median over replays.  retrain_max_s, decide_p99_us : the worst replay's.
    """
    rows = []
    for key, part in frame.reset_index(drop=True).groupby(CONDITION, sort=False):
        total = {name: int(part[name].sum()) for name in COUNTS}
        row = dict(zip(CONDITION, key, strict=True)) | {"replays": len(part), "cycles": int(part["cycles"].sum())}
        row |= {name: float(part[name].mean()) for name in COUNTS} | {f"total_{name}": n for name, n in total.items()}
        row |= {f"{name}_sd": float(part[name].std()) for name in ("certain", "false_positive")}
        for name, wrong, decided in (("precision", "false_positive", "accepted"), ("npv", "false_negative", "rejected")):
            row[name] = 1.0 - total[wrong] / total[decided] if total[decided] else math.nan
        row |= {name: float(part[name].agg(how)) for name, how in TIMES.items()}
        own = [replays[i] for i in part.index] if replays else []
        error = pooled_error(own)
        ends = (error.lower, error.upper) if error.decided else (math.nan, math.nan)
        row |= {"retrains_dropped": sum(not each.accepted for one in own for each in one.retrains)}
        kept = bool(row["precision"] >= row["lower_bound"]) if total["accepted"] >= ENOUGH else None
        rows.append(row | {"error_lower": ends[0], "error_upper": ends[1], "promise_kept": kept})
    return rows


def promise_lines(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """The promise of each row in words, with those of its settings in which the rows differ."""
    telling = [name for name in ("interval", "alpha", "confirm") if len({row[name] for row in rows}) > 1]
    lines = []
    for row in rows:
        said = {"interval": row["interval"], "alpha": f"alpha {row['alpha']:g}"}
        said["confirm"] = "good ones confirmed" if row["confirm"] else "stops alone"
        who = f"{row['recipe']} ({', '.join([row['guarantee'], *(said[name] for name in telling)])})"
        if not row["total_accepted"]:
            lines.append(f"{who}: no part was accepted.")
            continue
        few = f"fewer than {ENOUGH} accepted parts, too few to say"
        verdict = {True: "kept", False: "broken", None: few}[row["promise_kept"]]
        bad = f"; bad: {100 * row['error_lower']:.1f} to {percent(row['error_upper'])} at 95 %"
        good = f"{percent(row['precision'])} of {row['total_accepted']} accepted parts were good"
        good += "" if math.isnan(row["error_lower"]) else bad
        lines.append(f"{who}: {good}, LB {100 * row['lower_bound']:g} %: {verdict}.")
    return lines


def pooled_table(rows: Sequence[Mapping[str, Any]], title: str = "Replays", legend: str = LEGEND) -> Table:
    """The pooled rows for a screen, each with its guarantee, and what is known of stops."""
    shown, several = [], len({row["interval"] for row in rows}) > 1
    for row in rows:
        known = "confirmed" if row["confirm"] else row["stops"]
        name = f"{row['recipe']}\n{row['guarantee']}, {known}" + (f"\n{row['interval']}" if several else "")
        shown.append({"recipe\nguarantee": name} | {title: show(row) for title, show in CELLS.items()})
    return figures(title, shown, legend)


def figures(title: str, rows: Sequence[Mapping[str, str]], caption: str, total: bool = False) -> Table:
    """A table of numbers, to the right, under the rows' names. total : whether a line sets the last row apart."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    look: dict[str, Any] = {"box": SIMPLE_HEAD, "title_justify": "left", "caption_justify": "left"}
    look |= {"pad_edge": False, "show_edge": False, "collapse_padding": True}
    table = Table(title=f"\n{title}\n", caption=f"\n{caption}\n", **look)
    for i, name in enumerate(rows[0]):  # the first gives way: 80 columns are enough for every number
        table.add_column(name, justify="right" if i else "left", no_wrap=i > 0, overflow="fold")
    for i, row in enumerate(rows):
        if total and i == len(rows) - 1:
            table.add_section()
        table.add_row(*row.values())
    return table


def _whole(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.0f}"


def _with_sd(row: Mapping[str, Any], name: str) -> str:
    deviation = row[f"{name}_sd"]
    return f"{row[name]:.1f}" if math.isnan(deviation) else f"{row[name]:.0f}±{deviation:.0f}"


CELLS: dict[str, Any] = {
    "alpha\nLB": lambda r: f"{r['alpha']:g}\n{100 * r['lower_bound']:g} %",
    "certain\nshare": lambda r: f"{_with_sd(r, 'certain')}\n{percent(r['total_certain'] / r['cycles'])}",
    "accept\nFP": lambda r: f"{r['accepted']:.1f}\n{r['false_positive']:.2f}",
    "reject\nFN": lambda r: f"{r['rejected']:.1f}\n{r['false_negative']:.2f}",
    "precision\nNPV": lambda r: f"{percent(r['precision'])}\n{percent(r['npv'])}",
    "retrain\nms": lambda r: f"{_whole(1e3 * r['retrain_p50_s'])}\n{_whole(1e3 * r['retrain_max_s'])}",
    "decide\nµs": lambda r: f"{_whole(r['decide_p50_us'])}\n{_whole(r['decide_p99_us'])}",
    "saved\nnet, s": lambda r: f"{r['saved_s']:.0f}\n{r['net_s']:.0f}",
}


def retrain_line(retrains: Sequence[RetrainReport]) -> str:
    """How many retrains there were, the worst of them, and why candidates were dropped."""
    if not retrains:
        return "No retrain."
    worst, dropped = max(r.seconds for r in retrains), [r for r in retrains if not r.accepted]
    last = f"; {len(dropped)} dropped, the last for: {dropped[-1].reason.removeprefix('dropped: ')}" if dropped else ""
    return f"{len(retrains)} retrain{'s' * (len(retrains) > 1)}, the worst in {worst:.3f} s{last}."


def write_csv(frame: pd.DataFrame, path: str | Path, force: bool = False) -> Path:
    """The frame as CSV; makes the folder. OutputError where a file is there, without `force`."""
    text = frame.to_csv(index=False, lineterminator="\n")
    return write_output(path, text.encode("utf-8"), force, make_folder=True)
