"""The proof: does what is called a guarantee hold, where the truth is known? Resumable: finished pieces are kept.

    python -m tests.slow.proof --out out/proof --repeats 200
    python -m tests.slow.proof --out out/proof --repeats 4 --only planted,noise --jobs 2 --docs out/proof

Writes proof.csv (a row a configuration) and proof.md (the tables) into the folder that `--docs` names.
"""

import argparse
import functools
import itertools
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from .certificate import PROPENSITIES, STREAMS
from .pieces import Piece, finish
from .replays import noise_cases, planted_cases, priced_cases
from .report import write_report

QUICK = ("conv", "pca", "rocket")
CASES = {"planted": planted_cases, "cost": priced_cases, "noise": noise_cases}
PARTS = ("null", "certificate", "planted", "cost", "noise", "garbage")


def pieces_of(part: str, repeats: int) -> list[Piece]:
    """All pieces of one part: of each configuration the seeds from 0 on."""
    if part in CASES:
        cases = [(case, max(2, round(case.share * repeats))) for case in CASES[part]()]
        return [Piece(part, {"case": case}, seed) for case, n in cases for seed in range(n)]
    n, settings = {
        "null": (max(2, repeats // 20), [{"reducer": "conv", "data": "insertion"}]),
        "certificate": (
            max(2, repeats // 10),
            _product(stream=STREAMS, propensity=PROPENSITIES, alpha=(0.1,)),
        ),
        "garbage": (max(1, repeats // 40), _product(reducer=QUICK)),
    }[part]
    pieces = [Piece(part, setting, seed) for setting in settings for seed in range(n)]
    return [*pieces, Piece(part, {"reducer": "umap"})] if part == "garbage" else pieces


def _product(**axes: Iterable[Any]) -> list[dict[str, Any]]:
    """Every combination of settings, the last axis quickest."""
    return [dict(zip(axes, values, strict=True)) for values in itertools.product(*axes.values())]


def main() -> None:
    """Parse, finish every piece, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--out", type=Path, default=Path("out/proof"), help="folder for the finished pieces"
    )
    parser.add_argument(
        "--docs", type=Path, help="folder for proof.csv and proof.md; by default that of the pieces"
    )
    parser.add_argument(
        "--repeats",
        type=int,
        default=200,
        help="replays of a main configuration; others have a share",
    )
    parser.add_argument(
        "--only", default=",".join(PARTS), help=f"parts to do, of {', '.join(PARTS)}"
    )
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    args = parser.parse_args()
    pieces = [piece for part in args.only.split(",") for piece in pieces_of(part, args.repeats)]
    done = finish(pieces, args.out, args.jobs, functools.partial(print, flush=True))
    print(write_report(done, args.docs or args.out))


if __name__ == "__main__":
    main()
