"""Malformed inputs of every kind: each must be refused by an error of dengine's own, or its part be verified.

    python -m tests.slow.fuzzing.inputs --n 1000 --seed 0

Prints a table by kind: what was tried, refused (a `DengineError`; exit code 1 or 2 and one line that begins with "Error:"),
verified, and taken, since what was damaged can still be a good input. Any other exception is raw and is shown; so is what
was taken and must not be. Exit code 1 if there is any.
"""

from __future__ import annotations

import argparse
import logging
import os
import random
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from dengine import DengineError

from .attempts import Fuzz

SHOWN = 5  # raw exceptions of a kind whose traceback is printed
OUTCOMES = ("refused", "verified", "taken", "raw")
SHARES = {  # of all attempts; those on files and commands take the longest
    "traces": 0.31,
    "labels": 0.25,
    "ids": 0.18,
    "toml": 0.10,
    "data": 0.10,
    "imports": 0.03,
    "journals": 0.01,
    "arguments": 0.01,
    "stores": 0.01,
}


def attempt(run: Callable[[random.Random], str], rng: random.Random) -> tuple[str, str]:
    """An outcome, and the traceback of a raw exception."""
    try:
        return run(rng), ""
    except DengineError:
        return "refused", ""
    except Exception:
        return "raw", traceback.format_exc(limit=-6)


def fuzz(n: int, seed: int, folder: Path, kinds: list[str] | None = None) -> dict[str, Counter[str]]:
    """Try n inputs; outcomes by kind. Raw exceptions are printed, the first few of each kind."""
    subject, found = Fuzz(folder), dict[str, Counter[str]]()
    for kind, share in SHARES.items():
        if kinds and kind not in kinds:
            continue
        counts, begin = found.setdefault(kind, Counter()), time.perf_counter()
        for i in range(max(1, round(share * n))):
            outcome, said = attempt(getattr(subject, kind), random.Random(f"{seed} {kind} {i}"))
            counts[outcome] += 1
            if said and counts["raw"] <= SHOWN:
                print(f"{kind} {i}: {said}", file=sys.stderr)
        print(f"{kind}: {time.perf_counter() - begin:.0f} s", file=sys.stderr)
    subject.close()
    return found


@contextmanager
def quiet_folder() -> Iterator[Path]:
    """A folder to work in, without logs and warnings of what is expected."""
    here = Path.cwd()
    logging.disable(logging.CRITICAL)
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        os.chdir(folder)
        try:
            yield Path(folder)
        finally:
            os.chdir(here)
            logging.disable(logging.NOTSET)


def main() -> None:
    """Parse, try, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, default=100_000, help="inputs to try")
    parser.add_argument("--seed", type=int, default=0, help="the same seed, the same inputs")
    parser.add_argument("--kinds", nargs="+", choices=SHARES, help="only these; all by default")
    args = parser.parse_args()
    with quiet_folder() as folder:
        found = fuzz(args.n, args.seed, folder, args.kinds)
    total = sum(found.values(), Counter[str]())
    print(f"{'kind':10} {'tried':>8} " + " ".join(f"{name:>9}" for name in OUTCOMES))
    for kind, counts in (*found.items(), ("all", total)):
        print(f"{kind:10} {sum(counts.values()):8} " + " ".join(f"{counts[name]:9}" for name in OUTCOMES))
    raise SystemExit(1 if total["raw"] else 0)


if __name__ == "__main__":
    main()
