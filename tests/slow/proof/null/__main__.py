"""The null test: 200 shuffles of labels, and 20 of each planted leak.

    python -m tests.slow.proof.null --out out/null

Each finished shuffle is a line of a file in --out, so that an interrupted run continues; other
source begins another file. Writes null_proof.csv, one row for the honest engine and one for each
leak, into the folder that --docs names, by default --out.
"""

import argparse
import hashlib
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

import dengine

from .shuffles import LEAKS, N_TRACES, play

FOLDERS = ("decision", "engine", "model", "reducers")  # of dengine, whose source matters


def digest_of_source() -> str:
    """Return the beginning of the SHA-256 of the source that influences a result."""
    package = Path(dengine.__file__).parent
    files = [Path(__file__).with_name("shuffles.py"), package / "folds.py"]
    for folder in FOLDERS:
        files += sorted((package / folder).rglob("*.py"))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:12]


def read_finished(path: Path) -> list[dict[str, Any]]:
    """Return the rows of a file of finished shuffles; none if it is not there."""
    if not path.exists():
        return []
    rows: list[dict[str, Any]] = pd.read_csv(path, keep_default_na=False).to_dict("records")
    return rows


def append(path: Path, row: dict[str, Any]) -> None:
    """Add a row to a file of finished shuffles."""
    pd.DataFrame([row]).to_csv(path, mode="a", header=not path.exists(), index=False)


def summarize(rows: Sequence[dict[str, Any]], leak: str) -> dict[str, Any]:
    """Return one row of the table, of the finished shuffles of one leak.

    A shuffle finds a leak if anything moved. "z, error" is the standard error of the mean z over
    the shuffles.
    """
    table = pd.DataFrame([row for row in rows if row["leak"] == leak])
    n = len(table)
    found = int(((table["moved"] > 0) | (table["traces"] > 0)).sum())
    return {
        "leak": leak or "none",
        "shuffles": n,
        "found": found,
        "labels": int(table["labels"].sum()),
        "moved": int(table["moved"].sum()),
        "z": table["z"].mean(),
        "z, error": table["z"].std() / math.sqrt(n) if n > 1 else math.nan,
        "certain of 1,000": 1000.0 * table["certain"].mean() / N_TRACES,
        "most certain": int(table["certain"].max()),
    }


def main() -> None:
    """Play what is not finished, write the table and print it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("out/null"), help="finished shuffles")
    parser.add_argument("--docs", type=Path, help="folder for null_proof.csv; by default --out")
    parser.add_argument("--shuffles", type=int, default=200)
    parser.add_argument("--leaking", type=int, default=20, help="shuffles of each leak")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    path = arguments.out / f"shuffles-{digest_of_source()}.csv"
    rows = read_finished(path)
    finished = {(int(row["seed"]), row["leak"]) for row in rows}
    for seed in range(arguments.shuffles):
        for leak in LEAKS:
            if (seed, leak) in finished or (leak and seed >= arguments.leaking):
                continue
            rows.append(play(seed, leak))
            append(path, rows[-1])
            print(*rows[-1].values(), flush=True)
    played = [leak for leak in LEAKS if any(row["leak"] == leak for row in rows)]
    table = pd.DataFrame([summarize(rows, leak) for leak in played])
    docs = arguments.docs or arguments.out
    docs.mkdir(parents=True, exist_ok=True)
    table.to_csv(docs / "null_proof.csv", index=False, float_format="%.4g")
    print(table.to_string(index=False))


if __name__ == "__main__":
    main()
