"""Work in pieces that are kept on disk, each under the hash of all that decides its result: what is done is not done again.

    >>> done = finish(pieces, Path("out/proof"), jobs=2)

A piece is a function's name in `FUNCTIONS`, plain settings and a range of seeds. Its file is named by a hash of these, and
of the sources of dengine and of this folder: other code, other pieces.
"""

import hashlib
import json
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from joblib import Parallel, delayed

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

    def key(self, sources: str) -> str:
        """Of its file."""
        return hashlib.sha256(json.dumps([asdict(self), sources], sort_keys=True).encode()).hexdigest()[:24]


def sources_digest() -> str:
    """SHA-256 of every source that decides a result."""
    own, theirs = Path(__file__).parent, Path(dengine.__file__).parent
    files = [*sorted(own.glob("*.py")), *sorted(theirs.rglob("*.py"))]
    files = [f for f in files if not {f.stem, f.parent.name} & {*BESIDE, "report"}]
    return hashlib.sha256(b"".join(f.read_bytes() for f in files)).hexdigest()


def run_piece(piece: Piece, path: Path) -> Piece:
    """Do a piece and write its file."""
    rows = [row for seed in piece.seeds for row in FUNCTIONS[piece.kind](seed=seed, **piece.settings)]
    half = path.with_suffix(".tmp")
    half.write_text(json.dumps({"piece": asdict(piece), "rows": rows}))
    half.replace(path)  # a file is there as a whole or not at all
    return piece


def finish(pieces: list[Piece], out: Path, jobs: int, tell: Callable[[str], None] = print) -> list[tuple[Piece, list[Row]]]:
    """Every piece with its rows, in order; those missing on the disk are done, `jobs` at a time."""
    out.mkdir(parents=True, exist_ok=True)
    sources = sources_digest()
    paths = {piece: out / f"{piece.key(sources)}.json" for piece in pieces}
    todo = [piece for piece in pieces if not paths[piece].is_file()]
    tell(f"{len(pieces) - len(todo)} of {len(pieces)} pieces are there already.")
    begin = time.perf_counter()
    results: Iterable[Piece] = Parallel(n_jobs=jobs, return_as="generator_unordered", batch_size=1)(
        delayed(run_piece)(piece, paths[piece]) for piece in todo
    )
    for done, piece in enumerate(results, len(pieces) - len(todo) + 1):
        tell(f"[{done}/{len(pieces)}] {piece.name}; {(time.perf_counter() - begin) / 60:.1f} min")
    return [(piece, json.loads(paths[piece].read_text())["rows"]) for piece in pieces]
