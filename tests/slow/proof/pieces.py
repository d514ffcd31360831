"""Work in pieces that are kept on disk: what is done is not done again.

    >>> done = finish(pieces, Path("out/proof"), jobs=2)

A piece is a function's name in `FUNCTIONS`, its settings and a seed. It is kept under these and a hash of the sources of
dengine and of this folder: other code, other pieces.
"""

import hashlib
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from joblib import Memory, Parallel, delayed

import dengine

from .certificate import ever_wrong
from .garbage import garbage
from .replays import judge, spend

Row = dict[str, Any]
BESIDE = ("cli", "export", "store", "figures", "tables")  # sources that decide nothing here
STREAMS = 100  # of the certificate, a seed


def null(seed: int, reducer: str, data: str) -> Row:
    """Labels that are independent of the trace, four in five good, through the whole loop: how many came out certain."""
    X, recipe = (
        dengine.load_dataset(data).X,
        dengine.Recipe.load(reducer).with_policy(alpha=0.1, lower_bound=0.9),
    )
    y = (
        np.random.default_rng(100 + seed)
        .permutation(np.arange(len(X)) < 0.8 * len(X))
        .astype(np.int8)
    )
    return {
        "cycles": len(X),
        "certain": int((dengine.replay((X, y), recipe, 100 + seed).action != "verify").sum()),
    }


def certified(seed: int, stream: str, propensity: float, alpha: float) -> Row:
    """In how many of `STREAMS` the bound was ever wrong."""
    share = ever_wrong(stream, propensity, alpha, STREAMS, 2000, seed)
    return {"streams": STREAMS, "wrong": round(STREAMS * share)}


FUNCTIONS: dict[str, Callable[..., Row | list[Row]]] = {
    "null": null,
    "noise": judge,
    "planted": judge,
    "cost": spend,
    "certificate": certified,
    "garbage": garbage,
}


@dataclass(frozen=True)
class Piece:
    """A seed of one configuration. kind : in `FUNCTIONS`.  settings : of its function."""

    kind: str
    settings: Row = field(hash=False)
    seed: int = 0

    @property
    def name(self) -> str:
        """Its configuration's."""
        return ", ".join(str(getattr(value, "name", value)) for value in self.settings.values())


def sources_digest() -> str:
    """SHA-256 of every source that decides a result."""
    parent, theirs = Path(__file__).parent, Path(dengine.__file__).parent
    files = [*sorted(parent.glob("*.py")), *sorted(theirs.rglob("*.py"))]
    files = [f for f in files if not {f.stem, f.parent.name} & {*BESIDE, "report"}]
    return hashlib.sha256(b"".join(f.read_bytes() for f in files)).hexdigest()


def run_piece(piece: Piece, sources: str) -> list[Row]:
    """Every row of a piece, with its seed; sources : part of what it is kept under."""
    result = FUNCTIONS[piece.kind](seed=piece.seed, **piece.settings)
    return [
        {"seed": piece.seed} | row for row in (result if isinstance(result, list) else [result])
    ]


def finish(
    pieces: list[Piece], out: Path, jobs: int, tell: Callable[[str], None] = print
) -> list[tuple[Piece, list[Row]]]:
    """Every piece with its rows, in order; those missing on the disk are done, `jobs` at a time."""
    run, sources, begin = (
        Memory(out, verbose=0).cache(run_piece),
        sources_digest(),
        time.perf_counter(),
    )
    there = sum(run.check_call_in_cache(piece, sources) for piece in pieces)
    tell(f"{there} of {len(pieces)} pieces are there already.")
    every = Parallel(n_jobs=jobs, return_as="generator", batch_size=1)(
        delayed(run)(piece, sources) for piece in pieces
    )
    done: list[tuple[Piece, list[Row]]] = []
    for piece, rows in zip(pieces, every, strict=True):
        done.append((piece, rows))
        if len(done) == len(pieces) or pieces[len(done)].name != piece.name:
            minutes = (time.perf_counter() - begin) / 60
            tell(f"[{len(done)}/{len(pieces)}] {piece.kind}: {piece.name}; {minutes:.1f} min")
    return done
