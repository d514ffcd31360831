"""Reducers and rival methods against each other, as many tries for each: chosen on some seeds, reported on others.

    python training/compare_reducers.py choose --data insertion --reducers conv,umap,knn,gp --out out/
    python training/compare_reducers.py report --data insertion --reducers conv,umap,knn,gp --out out/

`choose` replays every try (TRIES for reducers, `RIVALS[name].tries` for rivals, four each) on seeds 0 to 4 at alpha 0.1,
LB 90 %, and names the one with the most certain decisions among those whose pooled precision and NPV meet LB. `report`
replays all with the settings they have, on seeds 100 to 129, and writes one table: certain decisions, errors pooled over
the replays with the interval for other parts of this kind, seconds saved net of stops and good parts done again, retrain
and decision times.

The rivals play in the same loop, on the same streams, with the same feedback. Those without a bound have a threshold that
was swept: the column "bound" says so. Finished replays are kept in --keep, so that a long run can be done in parts; every
run writes the table of all that it asked for.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import options
from rich.progress import track

from dengine import Replay, load_dataset
from dengine.experiments.grid import Task, contenders, iterate_replays
from dengine.experiments.metrics import pooled_error
from dengine.experiments.replay import Contender
from dengine.experiments.rivals import RIVALS
from dengine.experiments.tables import frame_of, pool, write_csv

# The same number of tries for each reducer: its radius, the one setting that every reducer has.
TRIES: dict[str, tuple[float, ...]] = {
    "conv": (0.03, 0.05, 0.07, 0.1),
    "umap": (0.2, 0.3, 0.4, 0.6),
    "pca": (0.1, 0.2, 0.3, 0.4),
    "rocket": (0.03, 0.05, 0.07, 0.1),
}
OURS = "Wilson, at one look"
SWEPT = "none: threshold swept"


def tries(name: str) -> list[Contender]:
    """Every try of a reducer or a rival, named by what is tried."""
    base = Contender.load(name)
    if name in RIVALS:
        known = RIVALS[name].tries
        different = [params for i, params in enumerate(known) if params not in known[:i]]
        return [
            replace(base, name=f"{name} {' '.join(f'{k}={v}' for k, v in params.items())}".strip(), params=params)
            for params in different
        ]
    return [replace(base, name=f"{name} radius={r:g}", recipe=replace(base.recipe, radius=r)) for r in TRIES[name]]


def row_of(name: str, replays: Sequence[Replay]) -> dict[str, str]:
    """A row of the table: means a replay ± their deviation, pooled shares with their interval."""
    (row,) = pool(frame_of(replays))
    kind = RIVALS.get(name.split(" ")[0])
    return {
        "who": name if kind is None else f"{name}: {kind.title}",
        "bound": OURS if kind is None else kind.bound or (SWEPT if any(kind.tries) else "none"),
        "certain": f"{row['certain']:.0f} ± {np.nan_to_num(row['certain_sd']):.0f}",
        "accepted": f"{row['accepted']:.0f}",
        "FP": f"{row['false_positive']:.1f}",
        "rejected": f"{row['rejected']:.0f}",
        "FN": f"{row['false_negative']:.1f}",
        "bad of accepted (95 %)": _error(replays, "accepted"),
        "good of rejected (95 %)": _error(replays, "rejected"),
        "net s": f"{row['net_s']:.0f}",
        "retrain s, median / worst": f"{row['retrain_p50_s']:.3f} / {row['retrain_max_s']:.3f}",
        "decide µs, median": f"{row['decide_p50_us']:.0f}",
    }


def _error(replays: Sequence[Replay], side: str) -> str:
    error = pooled_error(replays, side)
    return f"{100 * error.rate:.1f} % ({100 * error.lower:.1f} to {100 * error.upper:.1f})" if error.decided else "-"


def chosen(by_name: dict[str, list[Replay]], lower_bound: float) -> str | None:
    """The try with the most certain decisions among those that keep to LB on both sides; None where none does."""
    kept = {}
    for name, replays in by_name.items():
        (row,) = pool(frame_of(replays))
        sides = [share for share in (row["precision"], row["npv"]) if not np.isnan(share)]
        if row["certain"] and min(sides) >= lower_bound:
            kept[name] = row["certain"]
    return max(kept, key=kept.__getitem__) if kept else None


def markdown(rows: Sequence[dict[str, str]]) -> str:
    """Rows as a Markdown table."""
    return "\n".join(
        f"| {' | '.join(line)} |" for line in (rows[0], ["---"] * len(rows[0]), *(row.values() for row in rows))
    )


def policies(text: str) -> list[tuple[float, float]]:
    """'0.1:0.9,0.05:0.95' -> (alpha, LB) of each."""
    return [(float(alpha), float(bound)) for alpha, bound in (pair.split(":") for pair in text.split(","))]


def main() -> None:
    """Parse, replay, show."""
    parser = options(
        __doc__, data="insertion", samples=None, cycles=1503, seeds=None, n_jobs=-1, keep=None, out=Path("out")
    )
    parser.add_argument("do", choices=["choose", "report"], help="try settings, or report all as they are")
    parser.add_argument("--reducers", default="conv,umap,pca", help="and rivals and TOML files, with commas between")
    parser.add_argument("--policies", type=policies, help="alpha:LB with commas between; 0.1:0.9, to report 0.05:0.95 too")
    parser.add_argument("--confirm", action="store_true", help="good accepted parts are confirmed, not stops alone known")
    args = parser.parse_args()
    choosing, asked = args.do == "choose", args.reducers.split(",")
    unknown = [name for name in asked if name not in TRIES and name not in RIVALS]
    if choosing and unknown:
        parser.error(f"choose has tries of {', '.join([*TRIES, *RIVALS])}, none of {', '.join(unknown)}; add them to TRIES")
    seeds = args.seeds or (range(5) if choosing else range(100, 130))
    if len(set(asked)) < len(asked):
        parser.error(f"expected each of --reducers once, got {args.reducers}")
    sys.path.append(str(Path.cwd()))  # module:Class of the current folder, as in `dengine compare`
    data = load_dataset(args.data, args.samples)
    args.cycles = min(args.cycles, len(data))
    who = contenders([one for name in asked for one in (tries(name) if choosing else [name])])
    replays, pages = [], []
    for alpha, bound in args.policies or ([(0.1, 0.9)] if choosing else [(0.1, 0.9), (0.05, 0.95)]):
        them = [one.with_policy(alpha=alpha, lower_bound=bound) for one in who]
        tasks = [Task(one, seed, args.cycles, True, args.confirm) for one in them for seed in seeds]
        found = iterate_replays(data, tasks, n_jobs=args.n_jobs, keep=args.keep)
        ended = {each.position: each.replay for each in track(found, "replaying", len(tasks))}
        played = [ended[i] for i in range(len(tasks))]
        by_name = {one.name: [each for each in played if each.name == one.name] for one in who}
        which = f"({alpha:g}, {100 * bound:g} %), seeds {seeds[0]} to {seeds[-1]}, {args.cycles} cycles"
        rows = markdown([row_of(name, some) for name, some in by_name.items()])
        pages.append(f"{args.do}: {data.name}, {which}\n\n{rows}\n")
        print(f"\n{pages[-1]}")
        replays += played
        for name in asked if choosing else ():
            some = {one: each for one, each in by_name.items() if one.split(" ")[0] == name}
            print(f"Chosen of {name}: {chosen(some, bound) or 'none; no try was certain of anything and kept to LB'}")
    path = write_csv(frame_of(replays), args.out / f"{args.do}_{data.name}.csv", force=True)
    path.with_suffix(".md").write_text("\n".join(pages), encoding="utf-8")
    print(f"Wrote {path} and {path.with_suffix('.md')}")


if __name__ == "__main__":
    main()
