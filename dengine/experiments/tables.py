"""Replays as tables: a row a replay in the CSV, a pooled row a recipe on the screen.

    frame = frame_of(replays)
    Console().print(pooled_table(pool(frame)))   # and promise_line(row) for each

Which promise is shown: the one about all parts together. Among all parts accepted in all replays the share of bad ones
should be at most 1 - LB, and likewise the share of good ones among the rejected. Each row names its guarantee: under
"pooled" the rule itself keeps the accepted parts to it, under "local" it is only measured.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..records import RetrainReport
from .replay import Replay

if TYPE_CHECKING:
    import pandas as pd
    from rich.table import Table

CONDITION = ["recipe", "interval", "alpha", "lower_bound", "guarantee", "stops"]
COUNTS = ["certain", "accepted", "rejected", "false_positive", "false_negative", "novel", "safe_mode"]
ENOUGH = 200  # accepted parts; with 30, each better than LB, the realised rate breaks 1 - LB in every fifth run
PROMISE = (
    "certain: cycles decided without a check, and their share of all cycles. accept, reject: such decisions; below them "
    "the wrong ones, FP (bad parts accepted) and FN (good parts rejected). precision: the share of accepted parts that "
    "were good; NPV, below it: the share of rejected parts that were bad. retrain: median and worst; decide: median and "
    "99th percentile. saved: checks left out, at 5 s each, before what stops and wrong rejects cost. Counts and saved "
    "are means a replay; shares are pooled, that is, counted over the parts of all replays together. The pooled "
    "precision is compared with LB. {} Rejected parts get no feedback but audits."
)
SHOWN = {  # by guarantee
    "local": "Guarantee local: the rule speaks of the ball around each part; the pooled precision is only measured.",
    "pooled": "Guarantee pooled: the rule itself keeps all accepted parts together to LB, at level alpha.",
}
KNOWN = {  # by what is known of stops
    "some": "Beside it, some: of accepted parts only stops are known.",
    "all": "Beside it, all: an accepted part that no stop follows counts as good, and is learned from.",
}


def frame_of(replays: Sequence[Replay], names: Sequence[str] | None = None) -> pd.DataFrame:
    """A row a replay, as in `Replay.summary`; `names` tells recipes of one reducer apart."""
    import pandas as pd

    rows = [replay.summary() for replay in replays]
    if names is not None:
        rows = [row | {"recipe": name} for row, name in zip(rows, names, strict=True)]
    return pd.DataFrame(rows)


def pool(frame: pd.DataFrame) -> list[dict[str, Any]]:
    """A row for each recipe, interval, alpha and LB, in the frame's order.

    precision, npv : over the sums of all replays, not the mean of their ratios, which would weigh a replay that accepted
        three parts as much as one that accepted 300.  COUNTS, saved_s : means a replay; `total_*` are the sums.
    retrain_p50_s, decide_p50_us : median over replays.  retrain_max_s, decide_p99_us : the worst replay's.
    """
    return [_pooled(dict(zip(CONDITION, key, strict=True)), part) for key, part in frame.groupby(CONDITION, sort=False)]


def _pooled(condition: dict[str, Any], part: pd.DataFrame) -> dict[str, Any]:
    total = {name: int(part[name].sum()) for name in COUNTS}
    return (
        condition
        | {"replays": len(part), "cycles": int(part["cycles"].sum())}
        | {name: float(part[name].mean()) for name in COUNTS}
        | {f"total_{name}": n for name, n in total.items()}
        | {
            "precision": _share_right(total["false_positive"], total["accepted"]),
            "npv": _share_right(total["false_negative"], total["rejected"]),
            "retrain_p50_s": float(part["retrain_p50_s"].median()),
            "retrain_max_s": float(part["retrain_max_s"].max()),
            "decide_p50_us": float(part["decide_p50_us"].median()),
            "decide_p99_us": float(part["decide_p99_us"].max()),
            "saved_s": float(part["saved_s"].mean()),
        }
    )


def _share_right(wrong: int, n: int) -> float:
    return 1.0 - wrong / n if n else math.nan


def promise_kept(row: Mapping[str, Any]) -> bool | None:
    """Whether the pooled precision is at least LB; None where too few parts were accepted to say."""
    if row["total_accepted"] < ENOUGH:
        return None
    return bool(row["precision"] >= row["lower_bound"])


def promise_line(row: Mapping[str, Any]) -> str:
    """The promise of one row in words."""
    if not row["total_accepted"]:
        return f"{row['recipe']} ({row['guarantee']}): no part was accepted."
    verdict = {True: "kept", False: "broken", None: f"fewer than {ENOUGH} accepted parts, too few to say"}[
        promise_kept(row)
    ]
    good, bound = _percent(row["precision"]), 100 * row["lower_bound"]
    who = f"{row['recipe']} ({row['guarantee']})"
    return f"{who}: {good} of {row['total_accepted']} accepted parts were good, LB {bound:g} %: {verdict}."


def guarantee_line(rows: Sequence[Mapping[str, Any]]) -> str:
    """What the rows' guarantees say, and what is known of stops; one that a user wrote is not explained."""
    asked = dict.fromkeys(str(row["guarantee"]) for row in rows)
    known = dict.fromkeys(str(row["stops"]) for row in rows)
    return " ".join([*(SHOWN[name] for name in asked if name in SHOWN), *(KNOWN[name] for name in known)])


def pooled_table(rows: Sequence[Mapping[str, Any]], title: str = "Replays") -> Table:
    """The pooled rows for a screen; the caption says which promise they show."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    look: dict[str, Any] = {"box": SIMPLE_HEAD, "title_justify": "left", "caption_justify": "left"}
    look |= {"pad_edge": False, "show_edge": False, "collapse_padding": True}
    table = Table(title=f"\n{title}\n", caption=f"\n{PROMISE.format(guarantee_line(rows))}\n", **look)
    # The one that gives way: 80 columns are enough for every number.
    table.add_column("recipe\nguarantee", overflow="fold")
    for name in _CELLS_OF:
        table.add_column(name, justify="right", no_wrap=True)
    for row in rows:
        table.add_row(f"{row['recipe']}\n{row['guarantee']}, {row['stops']}", *(show(row) for show in _CELLS_OF.values()))
    return table


def _percent(value: float) -> str:
    return "-" if math.isnan(value) else f"{100 * value:.1f} %"


def _number(value: float, digits: int) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


_CELLS_OF: dict[str, Any] = {
    "alpha\nLB": lambda r: f"{r['alpha']:g}\n{100 * r['lower_bound']:g} %",
    "certain\n ": lambda r: f"{r['certain']:.1f}\n{_percent(r['total_certain'] / r['cycles'])}",
    "accept\nFP": lambda r: f"{r['accepted']:.1f}\n{r['false_positive']:.2f}",
    "reject\nFN": lambda r: f"{r['rejected']:.1f}\n{r['false_negative']:.2f}",
    "precision\nNPV": lambda r: f"{_percent(r['precision'])}\n{_percent(r['npv'])}",
    "retrain\nms": lambda r: f"{_number(1e3 * r['retrain_p50_s'], 0)}\n{_number(1e3 * r['retrain_max_s'], 0)}",
    "decide\nµs": lambda r: f"{_number(r['decide_p50_us'], 0)}\n{_number(r['decide_p99_us'], 0)}",
    "saved\ns": lambda r: f"{r['saved_s']:.0f}\n",
}


def retrain_line(retrains: Sequence[RetrainReport]) -> str:
    """How many retrains there were, the worst of them, and why candidates were dropped."""
    if not retrains:
        return "No retrain."
    worst, dropped = max(r.seconds for r in retrains), [r for r in retrains if not r.accepted]
    last = f"; {len(dropped)} dropped, the last for: {dropped[-1].reason.removeprefix('dropped: ')}" if dropped else ""
    many = "" if len(retrains) == 1 else "s"
    return f"{len(retrains)} retrain{many}, the worst in {worst:.3f} s{last}."


def write_csv(frame: pd.DataFrame, path: str | Path) -> Path:
    """The frame as CSV; makes the folder."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    frame.to_csv(path, index=False)
    return path
