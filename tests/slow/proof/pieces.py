"""Work in pieces that are kept on disk: what is done is not done again.

    >>> done = finish(pieces, Path("out/proof"), jobs=2)

A piece is a function's name in `FUNCTIONS`, plain settings and a range of seeds. It is kept under these and a hash of the
sources of dengine and of this folder: other code, other pieces.
"""

import hashlib
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from joblib import Memory, Parallel, delayed

import dengine

from .certificate import ever_wrong
from .collapse import collapse
from .counts import count_noise, relabelled, white_noise
from .garbage import garbage
from .replays import Case, judge

Row = dict[str, Any]
BESIDE = ("cli", "export", "store", "figures", "look", "maps", "tables")  # sources that decide nothing here


def _judged(seed: int, **case: Any) -> list[Row]:
    return [judge(Case(**case), seed)]


def _counted(seed: int, reducer: str, data: str, p: float) -> list[Row]:
    if data == "insertion":
        noise = relabelled(dengine.load_dataset("insertion").X[:, ::10], 500, p, seed)
    else:
        noise = white_noise(500, p, seed)
    z2 = count_noise(dengine.Recipe.load(reducer), noise, seed)
    return [{"seed": seed, "balls": len(z2), "sum_z2": float(z2.sum())}]


def _certified(seed: int, stream: str, propensity: float, alpha: float) -> list[Row]:
    streams = 100  # a seed
    share = ever_wrong(stream, propensity, alpha, streams, 2000, seed)
    return [{"seed": seed, "streams": streams, "wrong": round(streams * share)}]


FUNCTIONS: dict[str, Callable[..., list[Row]]] = {
    "noise": _judged,
    "planted": _judged,
    "counts": _counted,
    "certificate": _certified,
    "garbage": lambda seed, reducer: garbage(reducer, seed),
    "collapse": lambda seed, **about: [collapse(seed=seed, **about)],
}


@dataclass(frozen=True)
class Piece:
    """Some seeds of one configuration. kind : in `FUNCTIONS`.  settings : plain, of its function."""

    kind: str
    settings: Row = field(hash=False)
    seeds: tuple[int, ...] = ()

    @property
    def name(self) -> str:
        """Its configuration's, for the progress line."""
        return f"{self.kind}: {self.settings.get('name') or ', '.join(map(str, self.settings.values()))}"


def sources_digest() -> str:
    """SHA-256 of every source that decides a result."""
    own, theirs = Path(__file__).parent, Path(dengine.__file__).parent
    files = [*sorted(own.glob("*.py")), *sorted(theirs.rglob("*.py"))]
    files = [f for f in files if not {f.stem, f.parent.name} & {*BESIDE, "report"}]
    return hashlib.sha256(b"".join(f.read_bytes() for f in files)).hexdigest()


def run_piece(piece: Piece, sources: str) -> list[Row]:
    """Every row of a piece; sources : part of what it is kept under."""
    return [row for seed in piece.seeds for row in FUNCTIONS[piece.kind](seed=seed, **piece.settings)]


def finish(pieces: list[Piece], out: Path, jobs: int, tell: Callable[[str], None] = print) -> list[tuple[Piece, list[Row]]]:
    """Every piece with its rows, in order; those missing on the disk are done, `jobs` at a time."""
    run, sources, begin = Memory(out, verbose=0).cache(run_piece), sources_digest(), time.perf_counter()
    there = sum(run.check_call_in_cache(piece, sources) for piece in pieces)
    tell(f"{there} of {len(pieces)} pieces are there already.")
    every = Parallel(n_jobs=jobs, return_as="generator", batch_size=1)(delayed(run)(piece, sources) for piece in pieces)
    done: list[tuple[Piece, list[Row]]] = []
    for piece, rows in zip(pieces, every, strict=True):
        done.append((piece, rows))
        tell(f"[{len(done)}/{len(pieces)}] {piece.name}; {(time.perf_counter() - begin) / 60:.1f} min")
    return done
