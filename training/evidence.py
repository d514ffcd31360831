"""The paper's 18 cells, every reducer and baseline on eight sets, what each promise costs: `make evidence`.

    make evidence SCREW=screw_driving.npz            # as training/make_screw_driving.py writes it; left out without
    python training/evidence.py --only conv --n-jobs 2      # what is not asked for stays as it was

Shuffle by shuffle, so that what is finished can be compared; finished replays are kept in --keep, so that a killed run goes
on. After each shuffle it writes into OUT/evidence: replays.csv (one row per replay, with the commit of the dengine
that played it), differences.csv, curves.png, and tables.md. The rows of a condition that another commit plays again are
replaced.

Recorded sets are shuffled by the seed; of a made one each seed draws new parts, which come in their order. Everybody sees
the same parts in the same order: differences are paired, to conv's replay of the same seed, with Student's interval.
"""

import os
import platform
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from common import options
from matplotlib.figure import Figure
from scipy.signal import lfilter
from scipy.stats import t as student

import dengine
from dengine import Dataset, Replay, load_dataset
from dengine.experiments.figures import RECIPES, blank, finish, save
from dengine.experiments.grid import KeptReplays, Task, iterate_replays
from dengine.experiments.paper import ALPHAS, LOWER_BOUNDS, findings, paper_table
from dengine.experiments.replay import Contender
from dengine.experiments.tables import write_csv
from dengine.files import write_output
from dengine.reducers import ConvReducer
from dengine.reducers.base import StopRule

CELLS = ((0.1, 0.9), (0.05, 0.95))  # alpha, LB
# Seconds of a core that a replay takes.
SECONDS = {
    "conv": 10,
    "rocket": 2,
    "umap": 4,
    "umap-learn": 60,
    "pca": 2,
    "knn": 1,
    "wskde": 2,
    "gp": 24,
    "minirocket": 20,
}
SLOW = {"gp": 10, "minirocket": 10, "umap-learn": 5}  # shuffles
SHUFFLES = dict.fromkeys(SECONDS, 30) | SLOW
GRIDS = {
    ("conv", "wilson"): 30,
    ("conv", "binomial"): 30,
    ("umap", "wilson"): 30,
    ("umap", "binomial"): 30,
}
PROMISES = 10  # shuffles of each
LABELS = 50  # from one point of a learning curve to the next
PARTS, SAMPLES = 1000, 400  # of a made set
CONDITION = ["set", "recipe", "interval", "alpha", "lower_bound"]
KEPT = [
    "seed",
    "cycles",
    "certain",
    "first_certain",
    "accepted",
    "rejected",
    "false_positive",
    "false_negative",
    "net_s",
]
KEPT += ["retrain_p50_s", "retrain_max_s"]
MEASURES = {
    "certain": "Certain decisions",
    "false_positive": "Bad parts accepted",
    "net_s": "Net seconds saved",
}


def oscillation(rng: np.random.Generator) -> Dataset:
    """Noise of an engine: one of two resonances, a seventh apart, under white noise."""
    good = rng.random(PARTS) < 0.6
    X = rng.normal(0.0, 0.6, (PARTS, SAMPLES))
    for i, angle in enumerate(
        2.0 * np.pi * np.where(good, 0.1, 0.115) * rng.normal(1.0, 0.03, PARTS)
    ):
        ringing = lfilter(
            [1.0], [1.0, -1.94 * np.cos(angle), 0.97**2], rng.normal(size=SAMPLES + 200)
        )[200:]
        X[i] += ringing / ringing.std()
    return of(X, good)


def contact(rng: np.random.Generator, age: Any) -> tuple[np.ndarray, np.ndarray]:
    """Forces (PARTS, SAMPLES) that rise from contact on and fall where a part snaps in, as bad ones hardly do; labels.

    age : (PARTS,) from 0 to 1: friction and stiffness grow, contact comes sooner, the snap becomes less.
    """
    good, time = rng.random(PARTS) < 0.65, np.linspace(0.0, 1.0, SAMPLES)
    fall = rng.normal(np.where(good, 1.5, 0.2) * (1.0 - 0.4 * age), 0.3)[:, None]
    begin = (rng.normal(0.3, 0.04, PARTS) - 0.12 * age)[:, None]
    force = (3.0 + age[:, None]) * np.clip(time - begin, 0.0, None) + 0.8 * age[:, None]
    force -= fall / (1.0 + np.exp(-(time - begin - rng.normal(0.4, 0.05, (PARTS, 1))) / 0.01))
    wander = np.cumsum(rng.normal(0.0, 0.02, force.shape), axis=1)
    return force + wander + rng.normal(0.0, 0.1, force.shape), good


def drift(rng: np.random.Generator) -> Dataset:
    """The tool wears from the first part to the last."""
    return of(*contact(rng, np.linspace(0.0, 1.0, PARTS)))


def variant(rng: np.random.Generator) -> Dataset:
    """Half way another part comes."""
    return of(*contact(rng, (np.arange(PARTS) >= PARTS // 2).astype(float)))


def two_channels(rng: np.random.Generator) -> Dataset:
    """Force and torque: a part is good that snaps in by both."""
    (force, snapped), (torque, turned) = (contact(rng, np.zeros(PARTS)) for _ in range(2))
    return of(np.stack([force, torque], axis=1), snapped & turned)


def opposite(rng: np.random.Generator) -> Dataset:
    """Made to be hard for conv, whose heads are linear: two products in turn, what is good of one is bad of the other."""
    product, high = rng.random(PARTS) < 0.5, rng.random(PARTS) < 0.5
    time = np.linspace(0.0, 1.0, SAMPLES)
    levels = [
        (np.where(chosen, 1.0, -1.0) + rng.normal(0.0, 0.3, PARTS))[:, None]
        for chosen in (product, high)
    ]
    X = levels[0] * (time < 0.1) + levels[1] * (time > 0.9) + rng.normal(0.0, 0.3, (PARTS, SAMPLES))
    return of(X, (product == high) ^ (rng.random(PARTS) < 0.02))


def of(X: np.ndarray, good: np.ndarray) -> Dataset:
    """A made set."""
    return Dataset(X.astype(np.float32), good.astype(np.int8), name="made")


MADE = {
    made.__name__.replace("_", " "): made
    for made in (oscillation, drift, variant, two_channels, opposite)
}
SETS = ("insertion", "insertion 1.2 s", "screw driving", *MADE)


@cache
def recorded(name: str, screw: Path | None) -> Dataset:
    """A set that is not made here."""
    if name == "screw driving":
        return load_dataset(screw, 400)
    data = load_dataset("insertion")
    return data.cut(round(1.2 * data.spec.rate_hz)) if "1.2 s" in name else data


class DishonestReducer(ConvReducer):
    """conv with members that are trained on the labels of every fold, which are then counted: for comparison only."""

    def fit_loop(
        self, x: torch.Tensor, y: torch.Tensor, folds: np.ndarray, stop: StopRule, steps: int
    ) -> None:
        super().fit_loop(x, y, np.full_like(folds, -1), stop, steps)


def promises() -> list[Contender]:
    """What is promised beyond the paper's rule, one after the other."""
    paper = Contender.load("conv").recipe
    known, pooled = (
        paper.with_policy(stops="all"),
        paper.with_policy(stops="all", guarantee="pooled"),
    )
    found = {
        "no novelty": replace(paper, novelty=0.0),
        "every stop known": known,
        "every stop known, dishonest": replace(known, reducer=DishonestReducer(), params={}),
        "pooled": pooled,
        "pooled, 2 % audits": pooled.with_policy(audit_rate=0.02),
        "pooled, 10 % audits": pooled.with_policy(audit_rate=0.1),
    }
    return [Contender(f"conv, {name}", recipe) for name, recipe in found.items()]


def conditions(name: str, nth: int, cells: int) -> Iterator[Contender]:
    """All that the nth shuffle of a set is played with, each once."""
    asked = [
        (who, "wilson", *cell)
        for (who, most), cell in product(SHUFFLES.items(), CELLS[:cells])
        if nth < most
    ]
    if name == "insertion" and cells == len(CELLS):
        grid = list(product(ALPHAS, LOWER_BOUNDS))
        asked += [(*who, *cell) for (who, most), cell in product(GRIDS.items(), grid) if nth < most]
    for who, interval, alpha, bound in dict.fromkeys(asked):
        yield Contender.load(who).with_policy(interval=interval, alpha=alpha, lower_bound=bound)
    if name in ("insertion", "screw driving") and nth < PROMISES:
        yield from (one.with_policy(alpha=0.1, lower_bound=0.9) for one in promises())


def row_of(name: str, replay: Replay, commit: str) -> dict[str, Any]:
    """What is kept of a replay. bought : the cycles, from 1, at which every LABELS-th label was there."""
    row = {"set": name} | replay.summary()
    cycles = np.flatnonzero(replay.verified)[LABELS - 1 :: LABELS] + 1
    return {key: row[key] for key in CONDITION + KEPT} | {
        "bought": " ".join(map(str, cycles)),
        "commit": commit,
    }


def merged(old: pd.DataFrame, new: pd.DataFrame) -> pd.DataFrame:
    """Old rows beside new ones, which come in the place of all of another commit that have their condition."""
    again = old.merge(
        new[[*CONDITION, "commit"]].drop_duplicates(),
        on=CONDITION,
        how="left",
        suffixes=("", "_new"),
    )
    other = (again["commit_new"].notna() & (again["commit_new"] != again["commit"])).to_numpy()
    rows = pd.concat([old[~other], new]).drop_duplicates([*CONDITION, "seed"], keep="last")
    order = {name: i for i, name in enumerate([*SETS, *SHUFFLES])}
    return rows.sort_values(
        [*CONDITION, "seed"], key=lambda of: of.map(order) if of.name in ("set", "recipe") else of
    )


def differences(frame: pd.DataFrame) -> pd.DataFrame:
    """A row a set, policy and contender: means, and what is more than conv's of the same seed, with its 95 % interval."""
    rows, beside = [], ["set", "interval", "alpha", "lower_bound"]
    for key, cell in frame.groupby(beside, sort=False):
        for who, own in cell.groupby("recipe", sort=False):
            pairs = own.merge(cell[cell["recipe"] == "conv"], on="seed", suffixes=("", "_conv"))
            row = dict(zip(beside, key, strict=True)) | {
                "recipe": who,
                "commit": own["commit"].iloc[0],
            }
            row |= {
                "replays": len(own),
                "cycles": own["cycles"].mean(),
                "accepted": own["accepted"].mean(),
            }
            for name in MEASURES:
                more, n = pairs[name] - pairs[f"{name}_conv"], len(pairs)
                half = student.ppf(0.975, n - 1) * more.std() / np.sqrt(n) if n > 1 else np.nan
                row |= {name: own[name].mean(), f"{name}_more": more.mean() if n else np.nan}
                row |= {
                    f"{name}_low": row[f"{name}_more"] - half,
                    f"{name}_high": row[f"{name}_more"] + half,
                }
            rows.append(row)
    return pd.DataFrame(rows)


def learning_curve(frame: pd.DataFrame) -> pd.Series:
    """By labels bought, the share that was certain from there to the next LABELS; as far as every replay bought so many."""
    cycles = pd.DataFrame(
        [np.diff([0, *map(int, text.split())]) for text in frame["bought"].fillna("")]
    ).mean(skipna=False)
    return pd.Series((1.0 - LABELS / cycles).to_numpy(), index=LABELS * cycles.index).dropna()


def picture(frame: pd.DataFrame) -> Figure:
    """A panel a set: learning curves at the first of CELLS."""
    figure = blank(11.0, 8.0, "Certain share of the parts by labels bought; alpha 0.1, LB 90 %")
    panels = dict(zip(SETS, figure.subplots(3, 3, sharey=True).ravel(), strict=False))
    looks = dict(zip(SHUFFLES, product(("-", "--"), RECIPES), strict=False))
    rows = frame.query(
        "interval == 'wilson' and alpha == 0.1 and lower_bound == 0.9 and recipe in @looks"
    )
    for (name, who), own in rows.groupby(["set", "recipe"], sort=False):
        curve = 100.0 * learning_curve(own)
        panels[name].plot(
            curve.index, curve, looks[who][0], marker=".", color=looks[who][1], label=who
        )
    for name, axes in panels.items():
        finish(axes, legend=0, ylim=(0, 100), title=name)
    figure.supxlabel("labels bought")
    figure.supylabel("certain [%]")
    figure.axes[-1].set_axis_off()  # the ninth place
    figure.axes[-1].legend(
        *panels["insertion"].get_legend_handles_labels(), loc="center", frameon=False
    )
    return figure


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a Markdown table, and an empty one."""
    return [f"| {' | '.join(line)} |" for line in (head, ["---"] * len(head), *rows)] + [""]


def more(row: pd.Series, name: str) -> str:
    """What is more than conv's, with its interval."""
    ends = (
        f" ({row[f'{name}_low']:.0f} to {row[f'{name}_high']:.0f})"
        if np.isfinite(row[f"{name}_low"])
        else ""
    )
    return f"{row[f'{name}_more']:+.0f}{ends}" if np.isfinite(row[f"{name}_more"]) else "-"


def compared(told: pd.DataFrame) -> list[str]:
    """For each policy: conv and the others on each set, where conv loses, and ranks over the sets."""
    lines, known = [], [who for who in SHUFFLES if who in set(told["recipe"])]
    for alpha, bound in CELLS:
        cell = told.query(
            "alpha == @alpha and lower_bound == @bound and interval == 'wilson' and recipe in @known"
        )
        for name, title in MEASURES.items():
            said = cell.assign(
                said=[
                    f"{r[name]:.0f}" if r["recipe"] == "conv" else more(r, name)
                    for _, r in cell.iterrows()
                ]
            )
            wide = said.pivot_table("said", "set", "recipe", aggfunc="first").reindex(
                index=cell["set"].unique(), columns=known
            )
            lines += [
                f"**{title}, alpha {alpha:g}, LB {100 * bound:g} %**: conv's mean, and what others have more",
                "",
            ]
            lines += table(
                ["set", *known], [[key, *map(str, row.fillna("-"))] for key, row in wide.iterrows()]
            )
        worse = cell.query("certain_low > 0 or net_s_low > 0")
        said = [
            [r["set"], r["recipe"], *(more(r, name) for name in MEASURES)]
            for _, r in worse.iterrows()
        ]
        lines += [
            "Where conv loses, in certain decisions or in net seconds, beyond chance; how much more others have:",
            "",
        ]
        lines += table(
            ["set", "who", "certain", "bad accepted", "net seconds"], said or [["nowhere", *"----"]]
        )
        full = cell[cell.groupby("set")["recipe"].transform("size") == len(known)]
        ranks = (
            full.groupby("set")[["net_s", "certain"]]
            .rank(ascending=False)
            .groupby(full["recipe"])
            .mean()
        )
        head = [
            f"mean rank over {full['set'].nunique()} sets",
            "by net seconds",
            "by certain decisions",
        ]
        lines += table(
            head,
            [
                [who, *(f"{rank:.1f}" for rank in row)]
                for who, row in ranks.sort_values("net_s").iterrows()
            ],
        )
    return lines


def paper(frame: pd.DataFrame) -> list[str]:
    """The paper's two tables for each of the two reducers, and its findings."""
    lines, rows = [], frame[(frame["set"] == "insertion") & frame["recipe"].isin(["conv", "umap"])]
    for who, interval in product(("umap", "conv"), ("wilson", "binomial")):
        own = rows[(rows["recipe"] == who) & (rows["interval"] == interval)]
        if len(own):
            lines += [f"**{who}, {interval}**", "", paper_table(own, who, interval), ""]
    return [*lines, *(f"- {line}" for line in findings(rows)), ""]


def cost_of_promises(told: pd.DataFrame) -> list[str]:
    """The paper's rule with conv, and its variants."""
    sets = set(told.loc[told["recipe"] == "conv, pooled", "set"])
    rows = told.query("alpha == 0.1 and lower_bound == 0.9 and interval == 'wilson'")
    rows = rows.assign(bad=100.0 * rows["false_positive"] / rows["accepted"])
    rows = rows[rows["recipe"].str.startswith("conv") & rows["set"].isin(sets)]
    said = [
        [
            r["set"],
            r["recipe"],
            f"{r['certain']:.0f}",
            more(r, "certain"),
            f"{r['bad']:.1f} %",
            more(r, "net_s"),
        ]
        for _, r in rows.iterrows()
    ]
    return table(["set", "", "certain", "more", "bad of the accepted", "net seconds, more"], said)


def write(frame: pd.DataFrame, out: Path) -> None:
    """Write the CSV files, the picture and the tables into the folder `evidence` of out."""
    told, folder = differences(frame), out / "evidence"
    write_csv(frame, folder / "replays.csv", force=True)
    write_csv(told.round(3), folder / "differences.csv", force=True)
    save(picture(frame), folder / "curves.png", dpi=80, force=True)
    sides = (
        told.groupby(["recipe", "commit"], sort=False)["replays"].agg(["min", "max"]).reset_index()
    )
    rows = [[r["recipe"], r["commit"], f"{r['min']} to {r['max']}"] for _, r in sides.iterrows()]
    seeds = f"seeds {frame['seed'].min()} to {frame['seed'].max()}"
    sections = {
        "Machine": [f"Last on {datetime.now(UTC):%d %B %Y}, {seeds}.", "", *machine()],
        "Replays": table(["method", "commit", "shuffles of a condition"], rows),
        "Reducers and baselines": compared(told),
        "The paper's cells": paper(frame),
        "What each promise costs": cost_of_promises(told),
    }
    page = "\n".join(
        line for title, lines in sections.items() for line in (f"## {title}", "", *lines, "")
    )
    write_output(folder / "tables.md", page.encode(), force=True)


def machine() -> list[str]:
    """Processor and cores; Python and torch: as lines of a page."""
    known = Path("/proc/cpuinfo")
    lines = known.read_text(encoding="utf-8").splitlines() if known.exists() else []
    names = [line.split(": ")[1] for line in lines if line.startswith("model name")]
    cores = f"{names[0] if names else platform.processor()}, {os.cpu_count()} cores"
    return [f"    {cores}", f"    Python {platform.python_version()}, torch {torch.__version__}"]


def commit() -> str:
    """The last one that changed the dengine that is imported; with a + where its files are not as in any."""
    folder = Path(dengine.__file__).parent

    def git(*words: str) -> str:
        return subprocess.run(
            ["git", "-C", folder, *words], capture_output=True, text=True, check=False
        ).stdout.strip()

    return (git("log", "-1", "--format=%h", ".") or "unknown") + (
        "+" if git("status", "--porcelain", ".") else ""
    )


def main() -> None:
    """Parse, say the cost, play, write."""
    parser = options(__doc__, seeds="100:130", n_jobs=2, keep=Path("out/evidence"), out=Path("out"))
    parser.add_argument("--screw", help="the screw-driving set, an .npz file")
    parser.add_argument(
        "--sets", default=",".join(SETS), help="with commas between; all by default"
    )
    parser.add_argument(
        "--only",
        help="reducers and baselines, with commas between; 'promises' for the variants of conv",
    )
    parser.add_argument("--cycles", type=int, default=1503, help="of a replay, at most")
    parser.add_argument(
        "--cells", type=int, default=len(CELLS), help="1: at (0.1, 90 %%) alone, and no grid"
    )
    args = parser.parse_args()
    names, only = args.sets.split(","), (args.only or f"{','.join(SHUFFLES)},promises").split(",")
    if unknown := {*names, *only} - {*SETS, *SHUFFLES, "promises"}:
        parser.error(
            f"known are {', '.join(SETS)}, and {', '.join(SHUFFLES)}, promises; not {', '.join(sorted(unknown))}"
        )
    if "screw driving" in names and args.screw is None:
        names.remove("screw driving")
        print(
            "Without screw driving: make it by training/make_screw_driving.py from its public source, and give SCREW=FILE."
        )
    left = list[str]()
    for (nth, seed), name in product(enumerate(args.seeds), names):
        data, tasks = asked(nth, seed, name, args, only)
        kept = KeptReplays(args.keep, data)
        left += [task.contender.name for task in tasks if not kept.path(task).is_file()]
    hours = sum(SECONDS.get(who, SECONDS["conv"]) for who in left) / 3600.0 / max(1, args.n_jobs)
    print(
        f"{len(left)} replays are left, about {hours:.1f} hours at {args.n_jobs} at a time.",
        flush=True,
    )
    path, here, rows = args.out / "evidence" / "replays.csv", commit(), list[dict[str, Any]]()
    old = (
        pd.read_csv(path, dtype={"bought": str, "commit": str})
        if path.exists()
        else pd.DataFrame(columns=[*CONDITION, "seed", "commit"])
    )
    for nth, seed in enumerate(args.seeds):
        for name in names:
            data, tasks = asked(nth, seed, name, args, only)
            found = iterate_replays(data, tasks, n_jobs=args.n_jobs, keep=args.keep)
            rows += [row_of(name, each.replay, here) for each in found]
        write(merged(old, pd.DataFrame(rows)), args.out)
        print(f"{datetime.now(UTC):%H:%M:%S} seed {seed}: {len(rows)} replays", flush=True)


def asked(
    nth: int, seed: int, name: str, args: Any, only: Sequence[str]
) -> tuple[Dataset, list[Task]]:
    """The parts of one shuffle, and its replays."""
    data = MADE[name](np.random.default_rng(seed)) if name in MADE else recorded(name, args.screw)
    cycles = None if args.cycles >= len(data) else args.cycles
    who = [
        one
        for one in conditions(name, nth, args.cells)
        if ("promises" if one.name.startswith("conv, ") else one.name) in only
    ]
    return data, [Task(one, seed, cycles, name not in MADE) for one in who]


if __name__ == "__main__":
    main()
