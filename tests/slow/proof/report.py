"""The proof's rows as a table a part: proof.csv and proof.md."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from .replays import WHEN, broken

if TYPE_CHECKING:
    from .pieces import Piece, Row

HEADS = {
    "planted": (
        "Planted truths: replays that broke the tolerance",
        "What is claimed is of members, at every moment at which a part passes (*members, ever*): their mean true failure "
        "probability is at most 1 - LB, in all but a share alpha of the replays. Beside it, in brackets, what is not "
        "claimed: of members at the end alone, of the parts that passed, at any moment from 30 on and at the end, of the "
        "local rule, and of rejects without audits. The interval is Clopper and Pearson's, 95 %.",
    ),
    "cost": (
        "Planted truths: what the cost guarantee spent",
        "At 5 a check and 120 an escape. Account: the most that the members stood at when a part passed, in escapes beyond "
        "their checks, over all replays; the rule allows 1. Saved: by accepted parts' true failure probabilities. Bound: "
        "what the certificate said of it at the end. Broke: it ever said more.",
    ),
    "noise": ("Labels of noise", "As above. Certain: decisions per 1503 cycles."),
    "null": (
        "The null test",
        "Labels independent of the trace, four in five good: certain decisions of a replay.",
    ),
    "certificate": (
        "Certificate",
        "Streams of 2000 parts in which the bound, at any moment, was wrong; alpha 10 %.",
    ),
    "garbage": (
        "Garbage accepted",
        "Share accepted with the novelty gate, and without it; last, certain of clean parts.",
    ),
}


WHO = ("members", "passed")
NEAR = 0.04  # by which an interval may reach beyond alpha, and still say that a promise is kept


def share_row(k: int, n: int, alpha: float, claimed: bool = True) -> Row:
    """How often a promise was broken, and what its whole interval says; in brackets where nothing was promised."""
    ends = binomtest(k, n).proportion_ci(0.95)
    word = "BROKEN" if ends.low > alpha else "kept" if ends.high <= alpha + NEAR else "within error"
    return {
        "broke": k / n,
        "low": ends.low,
        "high": ends.high,
        "verdict": word if claimed else f"({word.lower()})",
    }


def replay_row(settings: Row, rows: list[Row]) -> Row:
    """One configuration of replays."""
    case, n = settings["case"], len(rows)
    certain = 1503 / case.cycles * _mean(row["certain"] for row in rows)
    out: Row = {
        "alpha": case.alpha,
        "LB": case.lower_bound,
        "replays": n,
        "certain per 1503": certain,
    }
    out |= {case.side: _mean(row["passed"] for row in rows)}
    shares = {
        name: broken(rows, name, case.tolerance)
        for name in (f"{who}, {when}" for who in WHO for when in WHEN)
    }
    out |= share_row(shares.pop("members, ever"), n, case.alpha, case.claims)
    return out | {name: f"({k / n:.0%})" for name, k in shares.items()}


def cost_row(settings: Row, rows: list[Row]) -> Row:
    """One configuration under prices."""
    out: Row = {"replays": len(rows)} | {
        name: _mean(row[name] for row in rows) for name in ("accepted", "saved", "bound")
    }
    out["account"] = float(np.nanmax([row["account"] for row in rows]))
    return out | share_row(sum(row["untrue"] for row in rows), len(rows), settings["case"].alpha)


def null_row(settings: Row, rows: list[Row]) -> Row:
    """Each replay's, and their mean."""
    certain = [r["certain"] for r in rows]
    return {
        "replays": len(rows),
        "cycles": rows[0]["cycles"],
        "certain": str(certain),
        "mean": _mean(certain),
    }


def certificate_row(settings: Row, rows: list[Row]) -> Row:
    """Share of streams in which the bound was ever wrong."""
    n = sum(r["streams"] for r in rows)
    return {"streams": n, **share_row(sum(r["wrong"] for r in rows), n, settings["alpha"])}


def garbage_rows(settings: Row, rows: list[Row]) -> list[Row]:
    """A row a kind."""
    means = pd.DataFrame(rows).groupby("kind", sort=False)[["gated", "open"]].mean()
    return [
        {"kind": kind, "with the gate": gated, "without": open_}
        for kind, gated, open_ in means.itertuples()
    ]


ROWS: dict[str, Callable[[Row, list[Row]], Any]] = {
    "planted": replay_row,
    "cost": cost_row,
    "noise": replay_row,
    "null": null_row,
    "certificate": certificate_row,
    "garbage": garbage_rows,
}


def tables(done: Iterable[tuple[Piece, list[Row]]]) -> dict[str, pd.DataFrame]:
    """Part -> a row a configuration."""
    gathered: dict[tuple[str, str], tuple[Row, list[Row]]] = {}
    for piece, rows in done:
        gathered.setdefault((piece.kind, piece.name), (piece.settings, []))[1].extend(rows)
    result: dict[str, list[Row]] = {}
    for (kind, name), (settings, rows) in gathered.items():
        created = ROWS[kind](settings, rows)
        named = [
            {"configuration": name} | row
            for row in (created if isinstance(created, list) else [created])
        ]
        result.setdefault(kind, []).extend(named)
    return {kind: pd.DataFrame(rows) for kind, rows in result.items()}


def write_report(done: Iterable[tuple[Piece, list[Row]]], docs: Path) -> str:
    """Write both files; returns what became of everything that is called a guarantee, in a few lines."""
    docs.mkdir(parents=True, exist_ok=True)
    result = tables(done)
    whole = pd.concat(
        [frame.assign(part=kind) for kind, frame in result.items()], ignore_index=True
    )
    whole.to_csv(docs / "proof.csv", index=False, float_format="%.6g")
    blocks = ["# The proof", "`make proof` writes this page."]
    for kind in (kind for kind in HEADS if kind in result):
        title, text = HEADS[kind]
        blocks += [f"## {title}", text, _table(result[kind])]
    (docs / "proof.md").write_text("\n\n".join(blocks) + "\n", encoding="utf-8")
    output = whole.get("verdict", pd.Series(dtype=str)).dropna()
    claimed = output[~output.str.startswith("(")]
    lines = [f"{title}: {', '.join(whole['configuration'][at.index]) or 'none'}." for title, at in (
        (f"Of {len(claimed)} promises, broken beyond sampling error", claimed[claimed == "BROKEN"]),
        ("Not yet known well enough", claimed[claimed == "within error"]),
    )]  # fmt: skip
    return "\n".join([*lines, f"Written to {docs}."])


def _table(frame: pd.DataFrame) -> str:
    def cell(value: Any) -> str:
        if isinstance(value, float):
            return "" if np.isnan(value) else f"{value:.3g}" if abs(value) < 100 else f"{value:.0f}"
        return str(value)

    body = [[cell(v) for v in row] for row in frame.to_numpy(dtype=object)]
    rows = [list(frame.columns), ["---"] * len(frame.columns), *body]
    return "\n".join("| " + " | ".join(map(str, row)) + " |" for row in rows)


def _mean(values: Iterable[float]) -> float:
    finite = [v for v in values if not np.isnan(v)]
    return float(np.mean(finite)) if finite else float("nan")
