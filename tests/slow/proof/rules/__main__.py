"""The proof of the rules: 10,000 replays of each stream, without a network.

    python -m tests.slow.proof.rules --out out/rules

Finished pieces are kept in --out, so that an interrupted run continues. Writes rules_proof.csv, one
row for each case, into the folder that --docs names, by default --out.
"""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd

from ..keeping import digest_of, make_parser, play_kept, source_files, write_table
from .implementation import ENDINGS
from .replays import ALPHA, OUTCOMES, Case, play

PLAYED = (
    "informative",
    "useless",
    "overconfident",
    "drifting",
    "alternating",
    "snooped",
    "adversary",
    "sly",
    "tied",
    "constant",
    "constant, good",
)
MAIN_OUTCOMES = ("all", "audited, late, missing")
EVERY_OUTCOME = ("informative", "snooped", "adversary", "constant")  # the others have the main ones
FAULTS = (
    Case("pooled", "peeking", fault="peeks"),
    Case("pooled", "overconfident", fault="moves"),
    Case("pooled", "sly", "audited", fault="unweighted"),
)
N_REPLAYS = 2500  # of a piece
# Streams without a perfect bet: their parts depend on the rule, or are no better than the tolerance.
WITHOUT_BET = ("adversary", "sly", "at the tolerance")
MARGIN = 0.01  # of the upper end of the interval
Z = 1.959964


def all_cases() -> Iterator[Case]:
    """Return every row: the promises, the faults, and the ends of a safe mode."""
    for rule in ("pooled", "cost", "local"):
        for stream in PLAYED:
            for outcomes, (is_audited, _, _) in OUTCOMES.items():
                is_played = stream in EVERY_OUTCOME or outcomes in MAIN_OUTCOMES
                if is_played and (rule != "local" or not is_audited):
                    yield Case(rule, stream, outcomes)
    yield from FAULTS
    for rule in ("local", "cost", "pooled"):
        endings = {ENDINGS[rule], "bet"} if rule != "local" else set(ENDINGS.values())
        for ending in sorted(endings):
            for stream in ("constant, good", "at the tolerance", "doubling"):
                yield Case(rule, stream, ending=ending, n_parts=1500)


def wilson(k: float, n: float) -> tuple[float, float]:
    """Return the 95 % interval of a share."""
    p = k / n
    middle = (p + Z**2 / (2 * n)) / (1 + Z**2 / n)
    half = Z / (1 + Z**2 / n) * math.sqrt(p * (1 - p) / n + Z**2 / (4 * n**2))
    return round(max(0.0, middle - half), 6), round(min(1.0, middle + half), 6)


def verdict(k: float, n: float, allowed: float) -> str:
    """Return "kept", "BROKEN" or "open", by the whole interval of the share that broke."""
    low, high = wilson(k, n)
    if low > allowed and k:
        return "BROKEN"
    return "kept" if high <= allowed + MARGIN else "open"


def summarize(case: Case, pieces: list[dict[str, float]]) -> dict[str, Any]:
    """Return the row of a case."""
    total = {name: sum(piece[name] for piece in pieces) for name in pieces[0]}
    n = total["replays"]
    row: dict[str, Any] = {
        "rule": case.rule,
        "stream": case.stream,
        "outcomes": case.outcomes,
        "fault": case.fault,
        "safe mode ends by": case.ending or ENDINGS[case.rule],
        "replays": int(n),
        "parts": case.n_parts,
    }
    if case.allowed is not None:
        low, high = wilson(total["broke"], n)
        row |= {
            "broke": total["broke"] / n,
            "low": low,
            "high": high,
            "allowed": case.allowed,
            "verdict": verdict(total["broke"], n, case.allowed),
        }
    _, high = wilson(total["certificate_broke"], n)
    row |= {
        "accepted": total["accepted"] / n,
        "a perfect bet": None if case.stream in WITHOUT_BET else total["perfect"] / n,
        "account above 2": total["over_account"] / n if case.rule == "cost" else None,
        "certificate broke": total["certificate_broke"] / n,
        "certificate, high": high,
        "certificate": verdict(total["certificate_broke"], n, ALPHA),
        "safe modes per 1,000 parts": 1000 * total["safe_modes"] / total["parts"],
        "parts of a safe mode": total["safe_parts"] / max(1.0, total["safe_modes"]),
        "replays with more than 300": total["long_safe_modes"] / n,
    }
    return row


def main() -> None:
    """Play what is not kept yet, write the table, print its conclusion."""
    parser = make_parser(__doc__, "out/rules", "finished pieces")
    parser.add_argument("--pieces", type=int, default=4, help=f"of {N_REPLAYS:,} replays, per row")
    arguments = parser.parse_args()
    cases = list(all_cases())
    seeds = range(arguments.pieces)
    source = digest_of(source_files(Path(__file__).parent))
    calls = [(case, N_REPLAYS, seed) for case in cases for seed in seeds]
    played = play_kept(play, calls, source, arguments.out, arguments.jobs)
    rows = []
    for case in cases:
        rows.append(summarize(case, [next(played) for _ in seeds]))
        print(f"[{len(rows)}/{len(cases)}]", *rows[-1].values(), flush=True)
    table = pd.DataFrame(rows)
    write_table(table, arguments.docs or arguments.out, "rules_proof.csv", "%.4g")
    honest = table[(table["fault"] == "") & table["verdict"].notna()]
    certificates = table[table["fault"] == ""]
    print(f"{(honest['verdict'] == 'kept').sum()} of {len(honest)} promises kept;")
    print(f"{(certificates['certificate'] == 'kept').sum()} of {len(certificates)} certificates.")
    print("Planted faults:", *table["verdict"][table["fault"] != ""])


if __name__ == "__main__":
    main()
