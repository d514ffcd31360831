"""What each choice is worth: one setting is changed at a time, on the same shuffled streams.

    python training/compare_ablations.py --data insertion --seeds 100:110 --out out/ablations
    python training/compare_ablations.py --data screw_driving.npz --samples 400 --only radius,folds,length

Axes: radius, retrain (labels between two retrains), folds, features (what they are made of), length (a part is decided on
the beginning of its trace: 0.2 of 2 s are 0.4 s), channels (of traces that have several), feedback, interval, guarantee,
promises (what honesty, novelty, audits, parts and the pooled guarantee each cost, every stop known: dishonest heads are
trained on all labels, their own fold's too).
Writes ablations.csv, a row a replay, and ablations.png. Finished replays are kept in --keep, so that an interrupted run
goes on.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from common import POLICY, options
from matplotlib.figure import Figure
from rich.console import Console

from dengine import Dataset, Recipe, Replay, load_dataset
from dengine.experiments.figures import GREEN, LIMIT, blank, finish, save
from dengine.experiments.grid import Task, play_tasks
from dengine.experiments.replay import Contender
from dengine.experiments.tables import frame_of, pool, pooled_table, write_csv
from dengine.reducers import ConvReducer

CYCLES = 1503


@dataclass(frozen=True)
class Variant:
    """One try: what is played, by which recipe, under which feedback."""

    data: Dataset
    recipe: Recipe
    confirm: bool = False


Variants = dict[str, Variant]


def setting(name: str, values: tuple[Any, ...]) -> Callable[[Dataset, Recipe], Variants]:
    """An axis that changes one setting of the recipe."""
    return lambda data, base: {f"{value:g}": Variant(data, replace(base, **{name: value})) for value in values}


def features(data: Dataset, base: Recipe) -> Variants:
    """What the features are made of: conv's encoder, smaller ones, and rocket's."""
    others = {
        "14 kernels": replace(base, params={**base.params, "kernels": 14}),
        "32 directions": replace(base, params={**base.params, "width": 32}),
        "rocket": replace(base, reducer="rocket", params={}),
    }
    return {"all of conv's": Variant(data, base)} | {name: Variant(data, recipe) for name, recipe in others.items()}


def length(data: Dataset, base: Recipe) -> Variants:
    """The beginning of each trace: decided earlier, on less."""
    whole = data.X.shape[-1]
    cuts = [max(2, round(share * whole)) for share in (0.1, 0.2, 0.4, 0.6, 0.8, 1.0)]
    return {f"{n / data.rate_hz:.3g} s": Variant(data.cut(n), base) for n in cuts}


def channels(data: Dataset, base: Recipe) -> Variants:
    """Each channel alone, and all; nothing where there is but one."""
    if data.X.ndim == 2 or data.X.shape[1] == 1:
        return {}
    names = data.channels or [f"channel {c}" for c in range(data.X.shape[1])]
    alone = {name: Variant(replace(data, X=data.X[:, c], channels=()), base) for c, name in enumerate(names)}
    return alone | {"all": Variant(data, base)}


def feedback(data: Dataset, base: Recipe) -> Variants:
    """What is known of accepted parts."""
    return {
        "stops alone": Variant(data, base),
        "good ones confirmed": Variant(data, base, confirm=True),
        "silence confirms": Variant(data, base.with_policy(stops="all")),
    }


def policy(name: str, values: tuple[str, ...], **others: Any) -> Callable[[Dataset, Recipe], Variants]:
    """An axis that changes the policy."""
    return lambda data, base: {value: Variant(data, base.with_policy(**{name: value}, **others)) for value in values}


class DishonestReducer(ConvReducer):
    """conv with heads that are trained on every fold's labels, which are then counted in them: for comparison only."""

    def trained_on(self, folds: np.ndarray) -> np.ndarray:
        return np.ones((self.folds, len(folds)), dtype=np.bool_)


def promises(data: Dataset, base: Recipe) -> Variants:
    """The paper's rule, and what is promised beyond it, one after the other."""
    plain, known = replace(data, part=None), base.with_policy(stops="all")
    bare, pooled = replace(known, novelty=0.0), known.with_policy(guarantee="pooled")
    found = {
        "the paper's rule": Variant(plain, replace(base, novelty=0.0)),
        "silence confirms": Variant(plain, bare),
        "the same, dishonest": Variant(plain, replace(bare, reducer=DishonestReducer(), params={})),
        "novelty": Variant(plain, known),
        "novelty, pooled": Variant(plain, pooled),
        "2 % audits": Variant(plain, pooled.with_policy(audit_rate=0.02)),
        "10 % audits": Variant(plain, pooled.with_policy(audit_rate=0.1)),
    }
    named = {"novelty, parts named": Variant(data, known), "novelty, pooled, parts named": Variant(data, pooled)}
    return found | ({} if data.part is None else named)


AXES: dict[str, Callable[[Dataset, Recipe], Variants]] = {
    "radius": setting("radius", (0.02, 0.03, 0.05, 0.07, 0.1, 0.2)),
    "retrain": setting("retrain_every", (25, 50, 100, 200, 400)),
    "folds": setting("folds", (2, 3, 5, 10)),
    "features": features,
    "length": length,
    "channels": channels,
    "feedback": feedback,
    "interval": policy("interval", ("wilson", "clopper_pearson", "jeffreys", "binomial")),
    "guarantee": policy("guarantee", ("local", "pooled"), stops="all"),
    "promises": promises,
}


def shuffles(name: str, one: Variant, args: argparse.Namespace) -> list[Replay]:
    """The replays of one variant, a seed each."""
    cycles = min(args.cycles, len(one.data))
    tasks = [Task(Contender(name, one.recipe), seed, cycles, True, one.confirm) for seed in args.seeds]
    return play_tasks(one.data, tasks, n_jobs=args.n_jobs, keep=args.keep)


def picture(rows: list[dict[str, Any]], as_it_is: float, title: str) -> Figure:
    """Certain decisions of each variant with their deviation over the shuffles."""
    figure = blank(9.0, 1.0 + 0.34 * len(rows), title)
    axes, deviation = figure.subplots(), np.nan_to_num([row["certain_sd"] for row in rows])
    names = [row["recipe"] for row in rows]
    axes.barh(names, [row["certain"] for row in rows], xerr=deviation, color=GREEN, alpha=0.7, height=0.7)
    axes.axvline(as_it_is, **LIMIT)
    axes.invert_yaxis()
    finish(axes, legend=0, xlabel="certain decisions a replay; dotted: the recipe as it is")
    return figure


def main() -> None:
    """Parse, play every axis that was asked for, print, write."""
    defaults = {
        "data": "insertion",
        "samples": None,
        "part": "part",
        "recipe": "conv",
        **POLICY,
        "seeds": "100:110",
        "cycles": CYCLES,
    }
    parser = options(__doc__, **defaults, n_jobs=-1, keep=None, out=Path("out"))
    parser.add_argument("--only", default=",".join(AXES), help="axes, with commas between")
    args = parser.parse_args()
    axes = args.only.split(",")
    if unknown := set(axes) - set(AXES):
        parser.error(f"expected axes among {', '.join(AXES)}, got {', '.join(sorted(unknown))}")
    data = load_dataset(args.data, args.samples, args.part)
    base = Recipe.load(args.recipe).with_policy(alpha=args.alpha, lower_bound=args.lower_bound)
    with TemporaryDirectory() as kept:  # what stands on several axes, the recipe as it is, is played once
        args.keep = args.keep or kept
        replays = shuffles("as it is", Variant(data, base), args)
        for axis in axes:
            for name, one in (variants := AXES[axis](data, base)).items():
                replays += shuffles(f"{axis} {name}", one, args)
            if not variants:
                print(f"{axis}: {data.name} has one channel, there is nothing to leave out.")
    frame = frame_of(replays)
    rows = pool(frame, replays)
    level, seeds = f"({args.alpha:g}, {100 * args.lower_bound:g} %)", f"seeds {args.seeds[0]} to {args.seeds[-1]}"
    title = f"{args.recipe} on {data.name}, {level}, {seeds}"
    Console(width=100).print(pooled_table(rows, title))
    print(f"Wrote {write_csv(frame, args.out / 'ablations.csv', force=True)}")
    if len(rows) > 1:
        print(f"Wrote {save(picture(rows[1:], rows[0]['certain'], title), args.out / 'ablations.png', force=True)}")


if __name__ == "__main__":
    main()
