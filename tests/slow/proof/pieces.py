"""The proof in pieces that are kept on disk, so that no piece is done twice.

    >>> finished = finish(pieces, Path("out/proof"), jobs=2)

A piece is the name of a function in `FUNCTIONS`, its settings and a seed. Its rows are kept under
these and a hash of the source of dengine and of this folder: if the code changes, pieces are done
again.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from joblib import Memory, Parallel, delayed

import dengine

from .certificate import share_ever_wrong
from .garbage import garbage
from .keeping import PACKAGE, PROOF, digest_of, source_files
from .replays import judge, spend

Row = dict[str, Any]
FinishedPiece = tuple["Piece", list[Row]]
# Files and folders whose source does not influence a result.
UNRELATED = ("cli", "export", "store", "figures", "tables")
N_STREAMS = 100  # of the certificate, for each seed
N_STREAM_PARTS = 2000


def null(seed: int, reducer: str, data: str) -> Row:
    """Play labels that are independent of the traces, four in five good, through an engine.

    Returns
    -------
    row : dict
        cycles, and how many decisions were certain.
    """
    X = dengine.load_dataset(data).X
    recipe = dengine.Recipe.load(reducer).with_policy(alpha=0.1, lower_bound=0.9)
    labels = np.arange(len(X)) < 0.8 * len(X)
    y = np.random.default_rng(100 + seed).permutation(labels).astype(np.int8)
    played = dengine.replay((X, y), recipe, 100 + seed)
    return {"cycles": len(X), "certain": int((played.action != "verify").sum())}


def certify(seed: int, stream: str, propensity: float, alpha: float) -> Row:
    """Return in how many of `N_STREAMS` the certificate's bound was ever wrong."""
    share = share_ever_wrong(stream, propensity, alpha, N_STREAMS, N_STREAM_PARTS, seed)
    return {"streams": N_STREAMS, "wrong": round(N_STREAMS * share)}


FUNCTIONS: dict[str, Callable[..., Row | list[Row]]] = {
    "null": null,
    "noise": judge,
    "planted": judge,
    "cost": spend,
    "certificate": certify,
    "garbage": garbage,
}


@dataclass(frozen=True)
class Piece:
    """One seed of one configuration.

    Parameters
    ----------
    kind : str
        A name in `FUNCTIONS`.
    settings : dict
        Arguments of the function.
    seed : int, default 0
    """

    kind: str
    settings: Row = field(hash=False)
    seed: int = 0

    @property
    def name(self) -> str:
        """Name of the configuration."""
        return ", ".join(str(getattr(value, "name", value)) for value in self.settings.values())


def run_piece(piece: Piece, source: str) -> list[Row]:
    """Return the rows of a piece, with its seed; they are kept under both arguments."""
    result = FUNCTIONS[piece.kind](seed=piece.seed, **piece.settings)
    rows = result if isinstance(result, list) else [result]
    return [{"seed": piece.seed} | row for row in rows]


def finish(
    pieces: list[Piece], out: Path, jobs: int, print_line: Callable[[str], None] = print
) -> list[FinishedPiece]:
    """Return every piece with its rows, in order; do those that are not kept.

    Parameters
    ----------
    pieces : list of Piece
    out : Path
        Folder of the kept pieces.
    jobs : int
        Pieces at a time.
    print_line : callable, default print
        Called with lines on the progress: how many pieces are kept, and each finished
        configuration.
    """
    run = Memory(out, verbose=0).cache(run_piece)
    source = digest_of([*PROOF.glob("*.py"), *source_files(PACKAGE, UNRELATED)])
    begin = time.perf_counter()
    n_kept = sum(run.check_call_in_cache(piece, source) for piece in pieces)
    print_line(f"{n_kept} of {len(pieces)} pieces are there already.")
    parallel = Parallel(n_jobs=jobs, return_as="generator", batch_size=1)
    all_rows = parallel(delayed(run)(piece, source) for piece in pieces)
    finished: list[FinishedPiece] = []
    for piece, rows in zip(pieces, all_rows, strict=True):
        finished.append((piece, rows))
        n = len(finished)
        is_last_seed = n == len(pieces) or pieces[n].name != piece.name
        if is_last_seed:
            minutes = (time.perf_counter() - begin) / 60
            print_line(f"[{n}/{len(pieces)}] {piece.kind}: {piece.name}; {minutes:.1f} min")
    return finished
