"""The null test: 200 shuffles of labels, and 20 of each planted leak.

    python -m tests.slow.proof.null --out out/null

Finished shuffles are kept in --out, so that an interrupted run continues. Writes null_proof.csv,
one row for the honest engine and one for each leak, into the folder that --docs names, by default
--out.
"""

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
from .shuffles import LEAKS, N_TRACES, play


def summarize(rows: pd.DataFrame) -> pd.DataFrame:
    """Return one row for each leak; a shuffle finds it if anything moved or was misplaced."""
    is_found = rows[["moved", "traces", "misplaced"]].any(axis=1)
    groups = rows.assign(found=is_found).groupby("leak", sort=False)
    table = groups[["found", "labels", "moved"]].sum()
    table.insert(0, "shuffles", groups.size())
    table["certain of 1,000"] = 1000.0 * groups["certain"].mean() / N_TRACES
    table["most certain"] = groups["certain"].max()
    return table.rename(index={"": "none"}).reset_index()


def main() -> None:
    """Play what is not kept yet, write the table and print it."""
    parser = make_parser(__doc__, "out/null", "finished shuffles")
    parser.add_argument("--shuffles", type=int, default=200)
    parser.add_argument("--leaking", type=int, default=20, help="shuffles of each leak")
    arguments = parser.parse_args()
    source = digest_of([*source_files(PROOF), *source_files(PACKAGE)])
    calls = [
        (seed, leak)
        for leak in LEAKS
        for seed in range(arguments.leaking if leak else arguments.shuffles)
    ]
    rows = []
    for row in play_kept(play, calls, source, arguments.out, arguments.jobs):
        rows.append(row)
        print(*row.values(), flush=True)
    table = summarize(pd.DataFrame(rows))
    write_table(table, arguments.docs or arguments.out, "null_proof.csv", "%.4g")
    print(table.to_string(index=False))


if __name__ == "__main__":
    main()
