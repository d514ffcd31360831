"""The proof of the engine: 1,000 random histories, each recounted from its store.

    python -m tests.slow.proof.engine --out out/engine

Finished histories are kept in --out, so that an interrupted run continues. Writes engine_proof.csv,
one row for each case, into the folder that --docs names, by default --out.
"""

from collections.abc import Sequence

import pandas as pd

from ..keeping import (
    PACKAGE,
    PROOF,
    digest_of,
    make_parser,
    play_kept,
    source_files,
    write_table,
)
from .checking import ORDER, Row, check_history


def summarize(rows: Sequence[Row]) -> pd.DataFrame:
    """Return one row for each case, with sums over its histories, and one for all."""
    histories = pd.DataFrame(rows).drop(columns=["seed", "fault"])
    histories.insert(1, "histories", 1)
    table = histories.groupby("case", sort=False).sum()
    table.loc["all"] = table.sum()
    return table.reset_index()


def main() -> None:
    """Check what is not kept yet, write the table and print it."""
    parser = make_parser(__doc__, "out/engine", "finished histories")
    parser.add_argument("--histories", type=int, default=1000)
    arguments = parser.parse_args()
    source = digest_of([*source_files(PROOF), *source_files(PACKAGE)])
    calls = [(ORDER[i % len(ORDER)], i) for i in range(arguments.histories)]
    rows = []
    for row in play_kept(check_history, calls, source, arguments.out, arguments.jobs):
        rows.append(row)
        if row["faults"]:
            print(row["case"], row["seed"], row["faults"], row["fault"], flush=True)
    table = summarize(rows)
    write_table(table, arguments.docs or arguments.out, "engine_proof.csv")
    print(table.T.to_string(header=False))


if __name__ == "__main__":
    main()
