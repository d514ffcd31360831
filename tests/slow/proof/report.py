"""The proof's tables, proof.csv and proof.md, from the rows of its pieces."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from .replays import MOMENTS, count_broken

if TYPE_CHECKING:
    from .pieces import FinishedPiece, Row

# Kind of pieces -> title and text of its section.
SECTIONS = {
    "planted": (
        "Planted truths: replays that broke the tolerance",
        "The promise is about members, at every moment at which a part passes (*members, ever*): "
        "their mean true failure probability is at most 1 - LB, in all but a share alpha of the "
        "replays. In brackets stands what is not promised: the members at the end alone; the parts "
        "that passed, at any moment from 30 parts on and at the end; the local rule; and rejects "
        "without audits. The interval is that of Clopper and Pearson, 95 %.",
    ),
    "cost": (
        "Planted truths: what the cost guarantee spent",
        "At 5 for a check and 120 for a false accept. Account: the members' cost beyond their "
        "checks, in false accepts, at the worst moment of all replays at which a part passed; the "
        "rule allows 2. Saved: by the accepted parts' true failure probabilities. Bound: what the "
        "certificate said of it at the end. Broke: it said more at any moment.",
    ),
    "noise": ("Labels of noise", "As above. Certain: decisions per 1503 cycles."),
    "null": (
        "The null test",
        "Labels independent of the trace, four in five good: certain decisions of each replay.",
    ),
    "certificate": (
        "Certificate",
        "Streams of 2000 parts in which the bound was wrong at any moment; alpha 10 %.",
    ),
    "garbage": (
        "Garbage accepted",
        "Share accepted with the novelty gate and without it; *clean, certain*: share of certain "
        "decisions on insertions.",
    ),
}
# What an interval may exceed alpha by, while the promise still counts as kept.
MARGIN = 0.04
CYCLES = 1503  # that certain decisions are scaled to


def verdict_row(n_broken: int, n: int, alpha: float, is_promise: bool = True) -> Row:
    """Return how often a promise was broken, and what the whole interval of this share says.

    Returns
    -------
    row : dict
        broke, the share; low and high, its 95 % interval; verdict: "BROKEN", "within error" or
        "kept", in brackets and lower case if nothing was promised.
    """
    interval = binomtest(n_broken, n).proportion_ci(0.95)
    verdict = "within error"
    if interval.low > alpha:
        verdict = "BROKEN"
    elif interval.high <= alpha + MARGIN:
        verdict = "kept"
    return {
        "broke": n_broken / n,
        "low": interval.low,
        "high": interval.high,
        "verdict": verdict if is_promise else f"({verdict.lower()})",
    }


def replay_row(settings: Row, rows: list[Row]) -> Row:
    """Return the row of a configuration of replays."""
    case = settings["case"]
    n = len(rows)
    row: Row = {
        "alpha": case.alpha,
        "LB": case.lower_bound,
        "replays": n,
        "certain per 1503": CYCLES / case.cycles * _mean(row["certain"] for row in rows),
        case.side: _mean(row["passed"] for row in rows),
    }
    n_broken = count_broken(rows, "members, ever", case.tolerance)
    row |= verdict_row(n_broken, n, case.alpha, case.is_promise)
    means = [f"{who}, {moment}" for who in ("members", "passed") for moment in MOMENTS]
    for mean in means[1:]:  # the first is the promise
        row[mean] = f"({count_broken(rows, mean, case.tolerance) / n:.0%})"
    return row


def cost_row(settings: Row, rows: list[Row]) -> Row:
    """Return the row of a configuration with prices."""
    row: Row = {"replays": len(rows)}
    for name in ("accepted", "saved", "bound"):
        row[name] = _mean(replay[name] for replay in rows)
    row["account"] = float(np.nanmax([replay["account"] for replay in rows]))
    n_untrue = sum(replay["untrue"] for replay in rows)
    return row | verdict_row(n_untrue, len(rows), settings["case"].alpha)


def null_row(settings: Row, rows: list[Row]) -> Row:
    """Return the certain decisions of each replay of the null test, and their mean."""
    certain = [row["certain"] for row in rows]
    return {
        "replays": len(rows),
        "cycles": rows[0]["cycles"],
        "certain": str(certain),
        "mean": _mean(certain),
    }


def certificate_row(settings: Row, rows: list[Row]) -> Row:
    """Return the share of streams in which the bound was ever wrong."""
    n_streams = sum(row["streams"] for row in rows)
    n_wrong = sum(row["wrong"] for row in rows)
    return {"streams": n_streams, **verdict_row(n_wrong, n_streams, settings["alpha"])}


def garbage_rows(settings: Row, rows: list[Row]) -> list[Row]:
    """Return a row for each kind of garbage, with the means over the seeds."""
    means = pd.DataFrame(rows).groupby("kind", sort=False)[["gated", "ungated"]].mean()
    return [
        {"kind": kind, "with the gate": gated, "without": ungated}
        for kind, gated, ungated in means.itertuples()
    ]


# Kind of pieces -> a function that returns the rows of a configuration.
SUMMARIES: dict[str, Callable[[Row, list[Row]], Row | list[Row]]] = {
    "planted": replay_row,
    "cost": cost_row,
    "noise": replay_row,
    "null": null_row,
    "certificate": certificate_row,
    "garbage": garbage_rows,
}


def make_tables(finished: Iterable[FinishedPiece]) -> dict[str, pd.DataFrame]:
    """Return a table for each kind of pieces, with a row for each configuration."""
    settings: dict[tuple[str, str], Row] = {}
    rows: dict[tuple[str, str], list[Row]] = {}
    for piece, piece_rows in finished:
        configuration = (piece.kind, piece.name)
        settings.setdefault(configuration, piece.settings)
        rows.setdefault(configuration, []).extend(piece_rows)
    tables: dict[str, list[Row]] = {}
    for (kind, name), all_rows in rows.items():
        summary = SUMMARIES[kind](settings[kind, name], all_rows)
        summaries = summary if isinstance(summary, list) else [summary]
        tables.setdefault(kind, []).extend({"configuration": name} | row for row in summaries)
    return {kind: pd.DataFrame(kind_rows) for kind, kind_rows in tables.items()}


def write_report(finished: Iterable[FinishedPiece], docs: Path) -> str:
    """Write proof.csv and proof.md into a folder, which is created.

    Returns
    -------
    conclusion : str
        Lines that name the promises that were broken and those that are not sure yet.
    """
    docs.mkdir(parents=True, exist_ok=True)
    tables = make_tables(finished)
    whole = pd.concat(
        [table.assign(part=kind) for kind, table in tables.items()], ignore_index=True
    )
    whole.to_csv(docs / "proof.csv", index=False, float_format="%.6g")
    blocks = ["# The proof", "`make proof` writes this page."]
    for kind, (title, text) in SECTIONS.items():
        if kind in tables:
            blocks += [f"## {title}", text, _markdown_table(tables[kind])]
    (docs / "proof.md").write_text("\n\n".join(blocks) + "\n", encoding="utf-8")
    return f"{_conclusion(whole)}\nWritten to {docs}."


def _conclusion(whole: pd.DataFrame) -> str:
    """Return two lines: which promises were broken, and which are not known well enough."""
    verdicts = whole.get("verdict", pd.Series(dtype=str)).dropna()
    promises = verdicts[~verdicts.str.startswith("(")]
    lines = []
    for title, verdict in (
        (f"Of {len(promises)} promises, broken beyond sampling error", "BROKEN"),
        ("Not yet known well enough", "within error"),
    ):
        names = whole["configuration"][promises[promises == verdict].index]
        lines.append(f"{title}: {', '.join(names) or 'none'}.")
    return "\n".join(lines)


def _markdown_table(table: pd.DataFrame) -> str:
    """Return a table as Markdown; numbers have three digits, and NaN is an empty cell."""
    body = [[_format(value) for value in row] for row in table.to_numpy(dtype=object)]
    rows = [list(table.columns), ["---"] * len(table.columns), *body]
    return "\n".join("| " + " | ".join(map(str, row)) + " |" for row in rows)


def _format(value: Any) -> str:
    """Return the text of a cell."""
    if not isinstance(value, float):
        return str(value)
    if np.isnan(value):
        return ""
    return f"{value:.3g}" if abs(value) < 100 else f"{value:.0f}"


def _mean(values: Iterable[float]) -> float:
    """Return the mean of the values that are not NaN; NaN without any."""
    finite = [value for value in values if not np.isnan(value)]
    return float(np.mean(finite)) if finite else float("nan")
