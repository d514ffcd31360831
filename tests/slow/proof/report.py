"""The proof's rows as a table a part: proof.csv and proof.md."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from scipy import stats

from .replays import Case, broken

if TYPE_CHECKING:
    from .pieces import Piece, Row

HEADS = {
    "planted": (
        "Planted truths: replays that broke the tolerance",
        "A replay broke it where the true failure probability of what it accepted (the true success probability of what "
        "it rejected), on average, exceeds 1 - LB. A guarantee may be broken in a share alpha of replays; the interval "
        "is Clopper and Pearson's, 95 %, of that share. Rows whose truth moves (drifting, jumping) are not called a "
        "guarantee: they were taken out of the claim after they were seen to break it, since members from before then pay "
        "for parts after.",
    ),
    "noise": ("Labels of noise", "As above. Certain: decisions per 1503 cycles."),
    "counts": ("Count-only statistic", "Mean z^2 of the balls' counts under labels of noise; honest counting: 0.8 to 1.3."),
    "certificate": ("Certificate", "Streams of 2000 parts in which the bound, at any moment, was wrong; alpha 10 %."),
    "garbage": ("Garbage accepted", "Share accepted with the novelty gate, and without it; last, certain of clean parts."),
    "collapse": (
        "Collapse at cycle 800, over at 1100",
        "Bad parts accepted in it; cycles until nothing was; cycles after it until half as much was accepted as before.",
    ),
}


def clopper_pearson(k: int, n: int) -> tuple[float, float]:
    """95 % interval of a share."""
    low = float(stats.beta.ppf(0.025, k, n - k + 1)) if k else 0.0
    return low, float(stats.beta.ppf(0.975, k + 1, n - k)) if k < n else 1.0


def verdict(k: int, n: int, alpha: float, claimed: bool = True) -> str:
    """Kept or BROKEN by the whole interval, or within error; in brackets where nothing was promised."""
    low, high = clopper_pearson(k, n)
    word = "BROKEN" if low > alpha else "kept" if high <= alpha else "within error"
    return word if claimed else f"({word.lower()})"


def replay_row(settings: Row, rows: list[Row]) -> Row:
    """One configuration of replays."""
    case = Case(**settings)
    out: Row = {"configuration": case.name, "alpha": case.alpha, "LB": case.lower_bound, "replays": len(rows)}
    out |= {
        "cycles": case.cycles,
        "certain per 1503": 1503 / case.cycles * _mean(r["accepted"] + r["rejected"] for r in rows),
    }
    for verb, wrong, claimed in (
        ("accepted", "accepted_failure", case.claims_accepts),
        ("rejected", "rejected_success", case.claims_rejects),
    ):
        k, n = broken(rows, wrong, case.tolerance), len(rows)
        low, high = clopper_pearson(k, n)
        out |= {verb: _mean(r[verb] for r in rows), f"{verb}, mean wrong": _mean(r[wrong] for r in rows)}
        out |= {f"{verb}, broke": k / n, f"{verb}, low": low, f"{verb}, high": high}
        out |= {f"{verb}, guarantee": claimed, f"{verb}, verdict": verdict(k, n, case.alpha, claimed)}
    return out


def counts_row(settings: Row, rows: list[Row]) -> Row:
    """Mean z^2 over all balls."""
    balls, about = sum(r["balls"] for r in rows), f"{settings['reducer']}, {settings['data']}"
    z2 = sum(r["sum_z2"] for r in rows) / max(1, balls)
    return {"configuration": about, "runs": len(rows), "balls": balls, "mean z^2": z2}


def certificate_row(settings: Row, rows: list[Row]) -> Row:
    """Share of streams in which the bound was ever wrong."""
    n, k = sum(r["streams"] for r in rows), sum(r["wrong"] for r in rows)
    low, high = clopper_pearson(k, n)
    name = f"{settings['stream']}, propensity {settings['propensity']:g}"
    said = verdict(k, n, settings["alpha"])
    return {"configuration": name, "streams": n, "ever wrong": k / n, "low": low, "high": high, "verdict": said}


def collapse_row(settings: Row, rows: list[Row]) -> Row:
    """Means, and in how many runs either never happened."""
    out: Row = {"configuration": f"{settings['guarantee']}, stops {settings['stops']}", "runs": len(rows)}
    out |= {key: _mean(r[key] for r in rows) for key in ("usual", "bad_accepts", "quiet_after", "back_after")}
    out |= {"worst bad_accepts": max(r["bad_accepts"] for r in rows)}
    return out | {f"never {key}": sum(np.isnan(r[f"{key}_after"]) for r in rows) for key in ("quiet", "back")}


def garbage_rows(settings: Row, rows: list[Row]) -> list[Row]:
    """A row a kind."""
    means = pd.DataFrame(rows).groupby("kind", sort=False)[["gated", "open"]].mean()
    return [
        {"configuration": f"{settings['reducer']}, {kind}", "with the gate": gated, "without": open_}
        for kind, gated, open_ in means.itertuples()
    ]


ROWS: dict[str, Callable[[Row, list[Row]], Any]] = {
    "planted": replay_row,
    "noise": replay_row,
    "counts": counts_row,
    "certificate": certificate_row,
    "collapse": collapse_row,
    "garbage": garbage_rows,
}


def tables(done: Iterable[tuple[Piece, list[Row]]]) -> dict[str, pd.DataFrame]:
    """Part -> a row a configuration."""
    gathered: dict[tuple[str, str], tuple[Row, list[Row]]] = {}
    for piece, rows in done:
        gathered.setdefault((piece.kind, piece.name), (piece.settings, []))[1].extend(rows)
    found: dict[str, list[Row]] = {}
    for (kind, _), (settings, rows) in gathered.items():
        made = ROWS[kind](settings, rows)
        found.setdefault(kind, []).extend(made if isinstance(made, list) else [made])
    return {kind: pd.DataFrame(rows) for kind, rows in found.items()}


def write_report(done: Iterable[tuple[Piece, list[Row]]], docs: Path) -> str:
    """Write both files; returns what they come to, in a few lines."""
    docs.mkdir(parents=True, exist_ok=True)
    found = tables(done)
    whole = pd.concat([frame.assign(part=kind) for kind, frame in found.items()], ignore_index=True)
    whole.to_csv(docs / "proof.csv", index=False, float_format="%.6g")
    (docs / "proof.md").write_text(markdown(found), encoding="utf-8")
    replays = [found[kind] for kind in ("planted", "noise") if kind in found]
    if not replays:
        return f"Written to {docs}."
    return f"{summary(pd.concat(replays, ignore_index=True))}\nWritten to {docs}."


def summary(frame: pd.DataFrame) -> str:
    """What became of everything that is called a guarantee."""
    lines = []
    for verb in ("accepted", "rejected"):
        claimed = frame[frame[f"{verb}, guarantee"]]
        bad = claimed[claimed[f"{verb}, verdict"] == "BROKEN"]
        names = "; ".join(f"{r['configuration']} {r[f'{verb}, broke']:.0%}" for _, r in bad.iterrows()) or "none"
        lines.append(f"Guarantees on {verb} parts: {len(claimed)}, broken beyond sampling error: {names}.")
    return "\n".join(lines)


def markdown(found: dict[str, pd.DataFrame]) -> str:
    """The tables, each under its heading."""
    blocks = ["# The proof", "`make proof` writes this page. Verdicts in brackets are of rows that promise nothing."]
    for kind in (k for k in HEADS if k in found):
        title, text = HEADS[kind]
        blocks += [f"## {title}", text, _table(_short(found[kind]) if kind in ("planted", "noise") else found[kind])]
    return "\n\n".join(blocks) + "\n"


def _short(frame: pd.DataFrame) -> pd.DataFrame:
    short = frame[["configuration", "alpha", "LB", "replays", "certain per 1503"]].copy()
    for verb in ("accepted", "rejected"):
        short[verb] = frame[verb]
        short[f"{verb}: mean wrong"] = frame[f"{verb}, mean wrong"]
        limits = zip(frame[f"{verb}, broke"], frame[f"{verb}, low"], frame[f"{verb}, high"], strict=True)
        short[f"{verb}: broke"] = [f"{b:.1%} ({low:.1%} to {high:.1%})" for b, low, high in limits]
        short[f"{verb}: verdict"] = frame[f"{verb}, verdict"]
    return short


def _table(frame: pd.DataFrame) -> str:
    def cell(value: Any) -> str:
        if isinstance(value, float):
            return "" if np.isnan(value) else f"{value:.3g}" if abs(value) < 100 else f"{value:.0f}"
        return str(value)

    body = [[cell(v) for v in row] for row in frame.to_numpy(dtype=object)]
    rows = [list(frame.columns), ["---"] * len(frame.columns), *body]
    return "\n".join("| " + " | ".join(map(str, row)) + " |" for row in rows)


def _mean(values: Iterable[float]) -> float:
    known = [v for v in values if not np.isnan(v)]
    return float(np.mean(known)) if known else float("nan")
