"""The proof: is every promise kept on streams whose true probabilities are known?

    python -m tests.slow.proof --out out/proof --repeats 200
    python -m tests.slow.proof --out out/proof --repeats 4 --only planted,noise --jobs 2

Finished pieces are kept in --out, so that an interrupted run continues. Writes proof.csv (one row
per configuration) and proof.md (the tables) into the folder that --docs names, by default --out.
"""

import argparse
import functools
import itertools
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

from dengine.recipe import RECIPES

from .certificate import PROPENSITIES, STREAMS
from .pieces import Piece, finish
from .replays import noise_cases, planted_cases, priced_cases
from .report import write_report

FEWEST_SEEDS = 10  # of any configuration, if as many repeats are asked for
GARBAGE_REDUCERS = ("conv", "pca", "rocket")  # umap is slow, and has one seed
CASES = {"planted": planted_cases, "cost": priced_cases, "noise": noise_cases}
PARTS = ("null", "certificate", "planted", "cost", "noise", "garbage")


def make_pieces(part: str, repeats: int, reducer: str = "conv") -> list[Piece]:
    """Return all pieces of one part: for each configuration the seeds from 0 on.

    Parameters
    ----------
    part : str
        A name in `PARTS`.
    repeats : int
        Replays of a main configuration; others have a share of them, see `count_seeds`.
    reducer : str, default "conv"
        Takes the place of "conv". "garbage" has its own reducers, "certificate" has none.
    """
    if part in CASES:
        cases = [
            replace(case, reducer=reducer) if case.reducer == "conv" else case
            for case in CASES[part]()
        ]
        return [
            Piece(part, {"case": case}, seed)
            for case in cases
            for seed in range(count_seeds(case.share, repeats))
        ]
    if part == "null":
        n_seeds = count_seeds(0.05, repeats)
        settings = [{"reducer": reducer, "data": "insertion"}]
    elif part == "certificate":
        n_seeds = count_seeds(0.1, repeats)
        settings = _combine(stream=STREAMS, propensity=PROPENSITIES, alpha=(0.1,))
    elif part == "garbage":
        n_seeds = count_seeds(0.025, repeats)
        settings = _combine(reducer=GARBAGE_REDUCERS)
    else:
        raise SystemExit(f"Expected parts of {', '.join(PARTS)}, got {part}.")
    pieces = [Piece(part, setting, seed) for setting in settings for seed in range(n_seeds)]
    if part == "garbage":
        pieces.append(Piece(part, {"reducer": "umap"}))
    return pieces


def count_seeds(share: float, repeats: int) -> int:
    """Return with how many seeds a configuration is played: a share of `repeats`, or more.

    It is at least `FEWEST_SEEDS`, but never more than `repeats`.
    """
    return min(repeats, max(FEWEST_SEEDS, round(share * repeats)))


def _combine(**axes: Iterable[Any]) -> list[dict[str, Any]]:
    """Return every combination of the axes' values, the last axis varying fastest."""
    return [dict(zip(axes, values, strict=True)) for values in itertools.product(*axes.values())]


def main() -> None:
    """Finish every piece, write the report, print its conclusion."""
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
        help="replays of a main configuration; others have a share, or ten",
    )
    parser.add_argument(
        "--only", default=",".join(PARTS), help=f"parts to do, of {', '.join(PARTS)}"
    )
    parser.add_argument(
        "--reducer",
        default="conv",
        choices=sorted(RECIPES),
        help="takes the place of conv, but not in garbage",
    )
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    arguments = parser.parse_args()
    parts = arguments.only.split(",")
    pieces = [
        piece for part in parts for piece in make_pieces(part, arguments.repeats, arguments.reducer)
    ]
    print_now = functools.partial(print, flush=True)
    finished = finish(pieces, arguments.out, arguments.jobs, print_now)
    print(write_report(finished, arguments.docs or arguments.out))


if __name__ == "__main__":
    main()
