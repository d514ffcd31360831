"""The proof of the engine: 1,000 random histories, each recounted from its store.

    python -m tests.slow.proof.engine --out out/engine

Each finished history is a line of a file in --out, so that an interrupted run continues; other
source begins another file. Writes engine_proof.csv, one row for each case, into the folder that
--docs names, by default --out.
"""

import argparse
import hashlib
from pathlib import Path

import pandas as pd
from joblib import Parallel, delayed

import dengine

from .checking import ORDER, check_history


def digest_of_source() -> str:
    """Return the beginning of the SHA-256 of the source that influences a result."""
    here = Path(__file__).parent
    package = Path(dengine.__file__).parent
    digest = hashlib.sha256()
    files = [path for path in sorted(here.glob("*.py")) if path.name != "__main__.py"]
    for folder in ("decision", "engine", "model", "reducers", "store"):
        files += sorted((package / folder).rglob("*.py"))
    for path in files:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def summarize(rows: pd.DataFrame) -> pd.DataFrame:
    """Return one row for each case, with sums over its histories, and one for all."""
    rows = rows.drop(columns=["seed", "fault"]).assign(histories=1)
    table = rows.groupby("case", sort=False).sum()
    table.loc["all"] = table.sum()
    first = table.pop("histories")
    table.insert(0, "histories", first)
    return table.reset_index()


def main() -> None:
    """Check what is not finished, write the table and print it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("out/engine"), help="finished histories")
    parser.add_argument("--docs", type=Path, help="folder for engine_proof.csv; by default --out")
    parser.add_argument("--histories", type=int, default=1000)
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    path = arguments.out / f"histories-{digest_of_source()}.csv"
    n_finished = len(pd.read_csv(path)) if path.exists() else 0
    print(f"{n_finished} of {arguments.histories} histories are there already.")
    parallel = Parallel(n_jobs=arguments.jobs, return_as="generator", batch_size=1)
    missing = range(n_finished, arguments.histories)
    for row in parallel(delayed(check_history)(ORDER[i % len(ORDER)], i) for i in missing):
        pd.DataFrame([row]).to_csv(path, mode="a", header=not path.exists(), index=False)
        if row["faults"]:
            print(row["case"], row["seed"], row["faults"], row["fault"], flush=True)
    rows = pd.read_csv(path).head(arguments.histories)
    table = summarize(rows)
    docs = arguments.docs or arguments.out
    docs.mkdir(parents=True, exist_ok=True)
    table.to_csv(docs / "engine_proof.csv", index=False)
    print(table.T.to_string(header=False))


if __name__ == "__main__":
    main()
