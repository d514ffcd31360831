"""The proof: does what is called a guarantee hold, where the truth is known? Resumable: finished pieces are kept.

    python -m tests.slow.proof --out out/proof --repeats 200
    python -m tests.slow.proof --out out/proof --repeats 4 --only planted,noise --jobs 2 --docs out/proof

Writes proof.csv (a row a configuration) and proof.md (the tables) into the folder that `--docs` names.
"""

from __future__ import annotations

import argparse
import functools
import itertools
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from .certificate import PROPENSITIES, STREAMS
from .pieces import Piece, finish
from .replays import noise_cases, planted_cases
from .report import write_report

CHUNK = 10  # seeds a piece
QUICK = ("conv", "pca", "rocket")
CASES = {"planted": planted_cases, "noise": noise_cases}
PARTS = ("null", "counts", "certificate", "planted", "noise", "collapse", "garbage")


def in_pieces(kind: str, settings: dict[str, Any], repeats: int, chunk: int = CHUNK) -> list[Piece]:
    """The seeds 0 .. repeats - 1 of one configuration."""
    return [Piece(kind, settings, tuple(range(a, min(a + chunk, repeats)))) for a in range(0, repeats, chunk)]


def pieces_of(part: str, repeats: int) -> list[Piece]:
    """All pieces of one part."""
    if part in CASES:
        return [
            piece
            for case in CASES[part]()
            for piece in in_pieces(
                part, {"case": case}, max(2, round(case.share * repeats)), {"umap": 1, "rocket": 2}.get(case.reducer, CHUNK)
            )
        ]
    count, chunk, settings = {
        "null": (max(2, repeats // 20), 1, [{"reducer": "conv", "data": "insertion"}]),
        "counts": (max(2, repeats // 5), CHUNK, _product(reducer=QUICK, data=("white noise", "insertion"), p=(0.8,))),
        "certificate": (max(2, repeats // 10), CHUNK, _product(stream=STREAMS, propensity=PROPENSITIES, alpha=(0.1,))),
        "garbage": (max(1, repeats // 40), 1, _product(reducer=QUICK)),
        "collapse": (min(30, max(2, repeats // 4)), 5, _product(guarantee=("local", "pooled"), stops=("some", "all"))),
    }[part]
    pieces = [piece for each in settings for piece in in_pieces(part, each, count, chunk)]
    return pieces + (in_pieces(part, {"reducer": "umap"}, 1) if part == "garbage" else [])


def _product(**axes: Iterable[Any]) -> list[dict[str, Any]]:
    """Every combination of settings, the last axis quickest."""
    return [dict(zip(axes, values, strict=True)) for values in itertools.product(*axes.values())]


def main() -> None:
    """Parse, finish every piece, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/proof"), help="folder for the finished pieces")
    parser.add_argument("--docs", type=Path, help="folder for proof.csv and proof.md; by default that of the pieces")
    parser.add_argument("--repeats", type=int, default=200, help="replays of a main configuration; others have a share")
    parser.add_argument("--only", default=",".join(PARTS), help=f"parts to do, of {', '.join(PARTS)}")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    args = parser.parse_args()
    pieces = [piece for part in args.only.split(",") for piece in pieces_of(part, args.repeats)]
    done = finish(pieces, args.out, args.jobs, functools.partial(print, flush=True))
    print(write_report(done, args.docs or args.out))


if __name__ == "__main__":
    main()
