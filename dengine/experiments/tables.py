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
    f"median and 99th percentile. saved: {VERIFY_SECONDS:g} s a check left out; net: less {STOP_SECONDS:g} s an FP and "
    f"{CYCLE_SECONDS:g} s an FN."
)


def frame_of(replays: Sequence[Replay]) -> pd.DataFrame:
    """A row a replay, as in `Replay.summary`."""
    import pandas as pd

    return pd.DataFrame([replay.summary() for replay in replays])


def pool(frame: pd.DataFrame, replays: Sequence[Replay] = ()) -> list[dict[str, Any]]:
    """A row for each recipe, interval, alpha, LB, guarantee and feedback, in the frame's order.

    replays : of the frame's rows; with them a row has the interval of the pooled error, and retrains that were dropped.

    precision, npv : over the sums of all replays, not the mean of their ratios, which would weigh a replay that accepted
        three parts as much as one that accepted 300.  COUNTS, saved_s, net_s : means a replay; `total_*` are the sums,
        `certain_sd` and `false_positive_sd` the standard deviations over the replays (NaN of one).
    error_lower, error_upper : 95 % interval of the share of bad ones among the accepted parts; NaN without replays.
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
        rows.append(row | {"error_lower": ends[0], "error_upper": ends[1], "promise_kept": promise_kept(row)})
    return rows


def promise_kept(row: Mapping[str, Any]) -> bool | None:
    """Whether the pooled precision is at least LB; None where too few parts were accepted to say."""
    if row["total_accepted"] < ENOUGH:
        return None
    return bool(row["precision"] >= row["lower_bound"])


def promise_lines(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """The promise of each row in words, with those of its settings in which the rows differ."""
    telling = [name for name in ("interval", "alpha", "confirm") if len({row[name] for row in rows}) > 1]
    return [promise_line(row, telling) for row in rows]


def promise_line(row: Mapping[str, Any], telling: Sequence[str] = ()) -> str:
    """The promise of one row in words. telling : settings that are named beside the guarantee."""
    said = {"interval": row["interval"], "alpha": f"alpha {row['alpha']:g}"}
    said["confirm"] = "good ones confirmed" if row["confirm"] else "stops alone"
    who = f"{row['recipe']} ({', '.join([row['guarantee'], *(said[name] for name in telling)])})"
    if not row["total_accepted"]:
        return f"{who}: no part was accepted."
    few = f"fewer than {ENOUGH} accepted parts, too few to say"
    verdict = {True: "kept", False: "broken", None: few}[promise_kept(row)]
    bad = f"; bad: {100 * row['error_lower']:.1f} to {percent(row['error_upper'])} at 95 %"
    good = f"{percent(row['precision'])} of {row['total_accepted']} accepted parts were good"
    good += "" if math.isnan(row["error_lower"]) else bad
    return f"{who}: {good}, LB {100 * row['lower_bound']:g} %: {verdict}."


def pooled_table(rows: Sequence[Mapping[str, Any]], title: str = "Replays") -> Table:
    """The pooled rows for a screen, each with its guarantee, and what is known of stops."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    known = ["confirmed" if row["confirm"] else str(row["stops"]) for row in rows]
    look: dict[str, Any] = {"box": SIMPLE_HEAD, "title_justify": "left", "caption_justify": "left"}
    look |= {"pad_edge": False, "show_edge": False, "collapse_padding": True}
    table = Table(title=f"\n{title}\n", caption=f"\n{LEGEND}\n", **look)
    # The one that gives way: 80 columns are enough for every number.
    table.add_column("recipe\nguarantee", overflow="fold")
    for name in CELLS:
        table.add_column(name, justify="right", no_wrap=True)
    several = len({row["interval"] for row in rows}) > 1
    for row, stops in zip(rows, known, strict=True):
        name = f"{row['recipe']}\n{row['guarantee']}, {stops}" + (f"\n{row['interval']}" if several else "")
        table.add_row(name, *(show(row) for show in CELLS.values()))
    return table


def _number(value: float, digits: int) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


def _with_sd(row: Mapping[str, Any], name: str) -> str:
    deviation = row[f"{name}_sd"]
    return f"{row[name]:.1f}" if math.isnan(deviation) else f"{row[name]:.0f}±{deviation:.0f}"


CELLS: dict[str, Any] = {
    "alpha\nLB": lambda r: f"{r['alpha']:g}\n{100 * r['lower_bound']:g} %",
    "certain\nshare": lambda r: f"{_with_sd(r, 'certain')}\n{percent(r['total_certain'] / r['cycles'])}",
    "accept\nFP": lambda r: f"{r['accepted']:.1f}\n{r['false_positive']:.2f}",
    "reject\nFN": lambda r: f"{r['rejected']:.1f}\n{r['false_negative']:.2f}",
    "precision\nNPV": lambda r: f"{percent(r['precision'])}\n{percent(r['npv'])}",
    "retrain\nms": lambda r: f"{_number(1e3 * r['retrain_p50_s'], 0)}\n{_number(1e3 * r['retrain_max_s'], 0)}",
    "decide\nµs": lambda r: f"{_number(r['decide_p50_us'], 0)}\n{_number(r['decide_p99_us'], 0)}",
    "saved\nnet, s": lambda r: f"{r['saved_s']:.0f}\n{r['net_s']:.0f}",
}


def retrain_line(retrains: Sequence[RetrainReport]) -> str:
    """How many retrains there were, the worst of them, and why candidates were dropped."""
    if not retrains:
        return "No retrain."
    worst, dropped = max(r.seconds for r in retrains), [r for r in retrains if not r.accepted]
    last = f"; {len(dropped)} dropped, the last for: {dropped[-1].reason.removeprefix('dropped: ')}" if dropped else ""
    many = "" if len(retrains) == 1 else "s"
    return f"{len(retrains)} retrain{many}, the worst in {worst:.3f} s{last}."


def write_csv(frame: pd.DataFrame, path: str | Path, force: bool = False) -> Path:
    """The frame as CSV; makes the folder. OutputError where a file is there, without `force`."""
    text = frame.to_csv(index=False, lineterminator="\n")
    return write_output(path, text.encode("utf-8"), force, make_folder=True)
